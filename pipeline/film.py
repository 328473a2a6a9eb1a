"""`crossray render`: views of a trained run in chosen appearances, as PNGs or as a film.

    OUT/<what>/<name>.png     stills have the names of their photos, frames of a path are numbered
    OUT/film.json             what they are, written first: frames of something else are never mixed with these
    OUT.mp4                   or a film: its frames lie in OUT.mp4.frames until all are there

A frame is a pure function of its spec, written whole or not at all, so that the same command goes on where it was
stopped, and a mapper may spread frames over processes and machines that share the folder. The appearance, or the way
between two, is read once for all frames.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from PIL import Image
from torch import Tensor

from model.appearance.crossray import ContentStatistics
from pipeline.checkpoint import MODEL
from pipeline.errors import CrossrayError
from pipeline.files import atomic_file, atomic_write
from pipeline.looks import Looks, looks_of, read_looks
from pipeline.painter import Painter, Picture
from pipeline.pictures import reason
from pipeline.render import predicted_mask
from pipeline.video import about_video, write_video
from pipeline.views.camera import MAX_SIDE, Camera, camera_of, resized
from pipeline.views.choose import Stills, views_of
from pipeline.views.nerfstudio import camera_path_text
from pipeline.views.path import CameraPath
from pipeline.views.trajectory import trajectory_text

Mapper = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]

WHAT = ("rgb", "depth", "mask", "accumulation")
LAYOUTS = ("nerfstudio", "nerfbaselines")
NOT_WRITTEN = (".png", ".jpg", ".jpeg", ".gif", ".webp", ".avi", ".mov", ".mkv", ".webm")
SURVEYED, SURVEY_SIDE = 8, "48"  # shots whose depths set a film's scale, at most, and their longer side
RECORD = "film.json"


@dataclass(frozen=True)
class Order:
    """What the user asked for: options of `crossray render`."""

    view: str = "orbit"  # `pipeline.views.choose`
    appearance: str | None = None  # `pipeline.looks`
    what: tuple[str, ...] = ("rgb",)  # of WHAT
    size: str | None = None  # "640": the longer side; "640x480"
    frames: int = 120
    fps: float | None = None  # by default the file's, or 30
    layout: str = "nerfstudio"  # of LAYOUTS, of a path that is written


@dataclass(frozen=True)
class Shot:
    """One picture to take, with all that a process needs for it."""

    run: Path
    step: int
    name: str
    camera: Camera
    files: dict[str, Path]  # of WHAT -> where it goes
    content: ContentStatistics | None
    F: Tensor | None = None  # the appearance
    photo: int | None = None  # of the scene, whose view it is
    own: bool = False  # in its photo's appearance
    depths: tuple[float, float] = (1.0, 2.0)  # scene units that are shown brightest and darkest, for all of a film


def take(shot: Shot) -> None:
    """Render a shot and write its files; those that are there are left alone."""
    missing = {what: path for what, path in shot.files.items() if not path.exists()}
    painter = painter_of(shot.run, shot.step)
    painter.content = shot.content
    picture = painter.picture(shot.camera, look_of(painter, shot)) if missing.keys() - {"mask"} else None
    for what, path in missing.items():
        pixels = mask_of(painter, shot) if picture is None or what == "mask" else shown(picture, what, *shot.depths)
        with atomic_file(path) as file:
            Image.fromarray(pixels).save(file, format="PNG")


def look_of(painter: Painter, shot: Shot) -> Tensor | None:
    """F^a of a shot."""
    return painter.read(shot.name).F if shot.own else shot.F


@lru_cache(maxsize=1)
def painter_of(run: Path, step: int) -> Painter:
    """A process reads a checkpoint once for all its shots."""
    return Painter(run, step)


def shown(picture: Picture, what: str, nearest: float, farthest: float) -> np.ndarray:
    """One of WHAT but a mask, as uint8 pixels (h, w, 3) or (h, w).

    Depth is shown by its logarithm, from 255 at `nearest` scene units to 0 at `farthest` and where nothing is.
    """
    if what == "rgb":
        return picture.rgb
    share = picture.accumulation.clip(0, 1)
    if what == "depth":
        share = share * np.log(farthest / picture.depth.clip(nearest, farthest)) / np.log(farthest / nearest)
    return (share * 255).round().astype(np.uint8)


def mask_of(painter: Painter, shot: Shot) -> np.ndarray:
    """The transient probability of a shot's photo, uint8 (h, w), at the size of the shot."""
    assert shot.photo is not None
    mask = predicted_mask(painter.model, painter.photos, shot.photo)
    if mask is None:
        raise CrossrayError(
            f"--what mask: this run has none of {shot.name} (model.transient: {painter.model.spec.transient})"
        )
    image = Image.fromarray((mask.clip(0, 1) * 255).round().astype(np.uint8))
    return np.asarray(image.resize((shot.camera.width, shot.camera.height), Image.Resampling.BILINEAR))


def render_film(run: Path, out: Path, order: Order, mapper: Mapper = map, step: int | None = None) -> list[Path]:
    """Render what `order` says of a run's checkpoint (the newest, or of `step`).

    Returns what was written: the folder of PNGs; or where `out` ends with .mp4, a film for each of `order.what`; or
    where it ends with .json, the camera path.

    Raises:
        CrossrayError: the run, a view, an appearance, a size or `out` cannot be used.
    """
    painter = Painter(run, step)
    views = chosen_views(painter, order)
    check_order(order, out, views, painter)
    order = replace(order, what=tuple(what for what in WHAT if what in order.what))
    looks = chosen_looks(painter, order, views)
    if isinstance(views, CameraPath) and out.suffix.lower() == ".json":
        write_path(out, views, looks, painter, order.layout)
        return [out]
    about = described(painter, order, views, looks)
    films = film_files(out, order.what) if out.suffix.lower() == ".mp4" else {}
    if any(path.exists() for path in films.values()):
        check_films(films, about)
    folder = out.with_name(f"{out.name}.frames") if films else out
    if films and all(path.exists() for path in films.values()):
        shutil.rmtree(folder, ignore_errors=True)  # left by a process that was killed once its film was whole
        return list(films.values())
    shots = shots_of(painter, views, looks, order.what, folder)
    if isinstance(views, Stills):
        check_still(painter, shots[0])
    claim(folder, about)
    if "depth" in order.what:
        depths = depth_range(painter, shots)
        shots = [replace(shot, depths=depths) for shot in shots]
    for _ in mapper(take, [s for s in shots if not all(path.exists() for path in s.files.values())]):
        pass
    if not (films and isinstance(views, CameraPath)):
        return [folder]
    for what, path in films.items():
        write_video(path, (as_frame(s.files[what]) for s in shots), views.fps, about)
    shutil.rmtree(folder, ignore_errors=True)  # another process of the same command may be at it
    return list(films.values())


def check_order(order: Order, out: Path, views: Stills | CameraPath, painter: Painter) -> None:
    """CrossrayError where parts of an order do not fit each other, before anything is rendered."""
    is_film = isinstance(views, CameraPath)
    if order.layout not in LAYOUTS:
        raise CrossrayError(f"--path-format {order.layout}: there are {', '.join(LAYOUTS)}")
    unknown = [what for what in order.what if what not in WHAT]
    if unknown or not order.what:
        raise CrossrayError(f"--what {','.join(order.what)}: give some of {', '.join(WHAT)}, separated by commas")
    if "mask" in order.what and is_film:
        raise CrossrayError(f"--what mask: only photos have masks; --view {order.view} is a path (test, train, NAME)")
    if "mask" in order.what and painter.model.spec.transient == "none":
        raise CrossrayError(f"--what mask: {painter.run} has no masks (model.transient: none)")
    if out.suffix.lower() in (".mp4", ".json") and not is_film:
        raise CrossrayError(f"--out {out}: --view {order.view} gives single pictures; name a folder for them")
    if out.suffix.lower() == ".mp4" and isinstance(views, CameraPath) and min(views.size) < 2:
        raise CrossrayError(f"--out {out}: a film of {views.size[0]} x {views.size[1]} pixels; each side needs two")
    if out.suffix.lower() in NOT_WRITTEN:
        raise CrossrayError(f"--out {out}: a folder for PNGs, film.mp4, or path.json for the camera path alone")


def check_still(painter: Painter, shot: Shot) -> None:
    """CrossrayError where a photo has no appearance of its own or no mask; all stills are of one split."""
    look_of(painter, shot)
    if "mask" in shot.files:
        mask_of(painter, shot)


def chosen_views(painter: Painter, order: Order) -> Stills | CameraPath:
    """The views of an order, at its size."""
    records = painter.photos.records
    views = views_of(
        order.view,
        {record.name: camera_of(record) for record in records},
        {record.name: record.split for record in records},
        painter.photos.manifest.scene.scale,
        order.frames,
    )
    if isinstance(views, Stills):
        return Stills(tuple((name, at_size(camera, order.size)) for name, camera in views.views))
    frames = tuple(replace(frame, camera=at_size(frame.camera, order.size)) for frame in views.frames)
    return replace(views, frames=frames, fps=views.fps if order.fps is None else order.fps)


def at_size(camera: Camera, size: str | None) -> Camera:
    """The camera at `--size`: `W` pixels on the longer side, or `WxH`. CrossrayError: it is no size."""
    if size is None:
        return camera
    numbers = size.lower().split("x")
    if len(numbers) > 2 or not all(n.isdecimal() and len(n) < 9 and 1 <= int(n) <= MAX_SIDE for n in numbers):
        raise CrossrayError(
            f"--size {size}: give the longer side in pixels, as in 640, or both, as in 640x480; {MAX_SIDE} at most"
        )
    if len(numbers) == 2:
        return resized(camera, int(numbers[0]), int(numbers[1]))
    share = int(size) / max(camera.width, camera.height)
    return resized(camera, max(1, round(camera.width * share)), max(1, round(camera.height * share)))


def chosen_looks(painter: Painter, order: Order, views: Stills | CameraPath) -> Looks:
    """The appearances of an order: its own, or those of the file that its path comes from."""
    if isinstance(views, Stills):
        return looks_of(painter, order.appearance, [name for name, _ in views.views], film=False)
    if order.appearance is None and views.appearances and painter.has_appearance:
        bare = [i for i, frame in enumerate(views.frames) if frame.weights is None]
        if bare:
            raise CrossrayError(
                f"--view {order.view}: frame {bare[0]} has no appearance_weights, and the file names appearances; give "
                "it some, or choose an appearance for all frames with --appearance"
            )
        return read_looks(painter, views.appearances, [frame.weights for frame in views.frames])
    return looks_of(painter, order.appearance, [""] * len(views.frames), film=True)


def described(painter: Painter, order: Order, views: Stills | CameraPath, looks: Looks) -> str:
    """What a film is, as one line of JSON: two of the same description are the same film."""
    views_hash = hashlib.sha256(json.dumps(asdict(views)).encode()).hexdigest()
    weights_hash = hashlib.sha256(json.dumps(looks.weights).encode()).hexdigest()
    return json.dumps(
        {
            "run": painter.job.name,
            "step": painter.checkpoint.step,
            "checkpoint_sha256": painter.checkpoint.meta["sha256"][MODEL],
            "view": order.view,
            "views_sha256": views_hash,
            "appearances": looks.sources,
            "weights_sha256": weights_hash,
            "own_appearance": looks.own,
            "what": list(order.what),
        }
    )


def film_files(out: Path, what: Sequence[str]) -> dict[str, Path]:
    """Where the films go: OUT.mp4, or of several kinds OUT-rgb.mp4, OUT-depth.mp4."""
    return {w: out if len(what) == 1 else out.with_stem(f"{out.stem}-{w}") for w in what}


def check_films(films: dict[str, Path], about: str) -> None:
    """CrossrayError where one of the files is there and is another film, or none."""
    for path in films.values():
        if path.exists() and about_video(path) != about:
            raise CrossrayError(f"{path} is there already, and is not this film; --out names another file")


def claim(folder: Path, about: str) -> None:
    """Make the folder that of these pictures. CrossrayError: it holds other things, or other pictures."""
    record = folder / RECORD
    if record.is_file():
        if record.read_bytes() != f"{about}\n".encode():
            raise CrossrayError(
                f"{folder} holds other pictures ({record} says which); remove it, or --out names another place"
            )
    elif folder.exists() and any(p.suffix != ".tmp" for p in folder.iterdir()):
        raise CrossrayError(f"{folder} holds other things; --out names another folder")
    else:
        atomic_write(record, about + "\n")


def shots_of(
    painter: Painter, views: Stills | CameraPath, looks: Looks, what: Sequence[str], folder: Path
) -> list[Shot]:
    """The pictures to take, in order."""
    if isinstance(views, Stills):
        named = list(views.views)
    else:
        named = [(f"{i:05d}", frame.camera) for i, frame in enumerate(views.frames)]
    numbers = {record.name: i for i, record in enumerate(painter.photos.records)}
    stems = Counter(PurePath(name).with_suffix("") for name in numbers)
    short = {name: stem for name in numbers if stems[stem := PurePath(name).with_suffix("")] == 1}
    return [
        Shot(
            run=painter.run,
            step=painter.checkpoint.step,
            name=name,
            camera=camera,
            files={w: folder / w / f"{short.get(name, name)}.png" for w in what},
            content=painter.content,
            F=looks.of(i),
            photo=numbers.get(name) if isinstance(views, Stills) else None,
            own=looks.own,
        )
        for i, (name, camera) in enumerate(named)
    ]


def depth_range(painter: Painter, shots: Sequence[Shot]) -> tuple[float, float]:
    """Nearest and farthest that a few of the shots see, in scene units: 1st and 99th percentile in small pictures."""
    depths = []
    for shot in shots[:: -(-len(shots) // SURVEYED)]:
        picture = painter.picture(at_size(shot.camera, SURVEY_SIDE), look_of(painter, shot))
        depths.append(picture.depth[picture.accumulation > 0.5])
    seen = np.concatenate(depths)
    nearest, farthest = np.percentile(seen, [1, 99]) if len(seen) else (shots[0].camera.near, shots[0].camera.far)
    return float(nearest), max(float(farthest), float(nearest) * 1.01)


def write_path(out: Path, film: CameraPath, looks: Looks, painter: Painter, layout: str) -> None:
    """Write the camera path, with its appearances, for other programs and for `--view`.

    Raises:
        CrossrayError: `out` is there, and is something else.
    """
    frames = (replace(frame, weights=w) for frame, w in zip(film.frames, looks.weights, strict=True))
    film = CameraPath(tuple(frames), film.fps, looks.names)
    manifest, train = painter.photos.manifest, painter.photos.indices("train")
    if layout == "nerfstudio":
        text = camera_path_text(film, manifest.scene.scale)
    else:
        text = trajectory_text(film, manifest.scene.scale, [painter.photos.records[i].name for i in train])
    if out.is_file() and out.read_bytes() != text.encode():
        raise CrossrayError(f"{out} is there already, and is not this path; --out names another file")
    atomic_write(out, text)


def as_frame(path: Path) -> np.ndarray:
    """A picture as a frame of a film: three channels; a last odd row or column is left out, as H.264 wants it.

    Raises:
        CrossrayError: it is gone, or damaged.
    """
    try:
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGB"))
    except FileNotFoundError:
        raise CrossrayError(f"{path} was removed meanwhile; the same command makes it again") from None
    except Exception as error:  # Pillow's decoders raise whatever they meet
        raise CrossrayError(f"{path} is damaged ({reason(error)}); remove it, and give the same command") from error
    return pixels[: len(pixels) // 2 * 2, : pixels.shape[1] // 2 * 2]
