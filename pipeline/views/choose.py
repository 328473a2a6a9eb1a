"""What `--view` names: photos' own views, a file with a camera path, a loop, or a flight from photo to photo."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import CrossrayError
from pipeline.views.camera import Camera
from pipeline.views.foreign import content_of
from pipeline.views.nerfstudio import read_camera_path
from pipeline.views.path import FPS, CameraPath, path_of
from pipeline.views.smooth import between, orbit
from pipeline.views.trajectory import read_trajectory

SPLITS = ("train", "val", "test")
FLIGHT = "interpolate:"
BETWEEN = ".."


@dataclass(frozen=True)
class Stills:
    """Single views, named after their photos."""

    views: tuple[tuple[str, Camera], ...]


def views_of(
    text: str,
    cameras: Mapping[str, Camera],
    splits: Mapping[str, str],
    scale: float,
    frames: int = 240,
    fps: float = FPS,
) -> Stills | CameraPath:
    """The views that `text` names: `train`, `val`, `test`, a photo, a `.json` with a camera path, `orbit`, or
    `interpolate:A..B` with two photos or more.

    Args:
        cameras: photo name -> camera, of all photos.
        splits: photo name -> its split.
        scale: COLMAP units per scene unit; files are in COLMAP units.
        frames: of an orbit or a flight.
        fps: frames per second of an orbit or a flight; a file has its own.

    Raises:
        CrossrayError: nothing of this name, a file that cannot be used, or a path that cannot be made.
    """
    train = {name: camera for name, camera in cameras.items() if splits[name] == "train"}
    if text in SPLITS:
        views = tuple((name, camera) for name, camera in cameras.items() if splits[name] == text)
        if not views:
            raise CrossrayError(f"--view {text}: no photo of the scene is of this split")
        return Stills(views)
    if text == "orbit":
        return path_of(orbit(list(train.values()), frames), fps)
    if text.startswith(FLIGHT):
        stops = stops_of(text.removeprefix(FLIGHT), cameras)
        return path_of(between([cameras[name] for name in stops], frames), fps)
    if text in cameras:
        return Stills(((text, cameras[text]),))
    if Path(text).suffix.lower() == ".json":
        return read_path(Path(text), scale, train)
    raise CrossrayError(
        f"--view {text}: neither {', '.join(SPLITS)}, orbit, {FLIGHT}A..B, a .json file, nor a photo of the scene"
        + guess(text, cameras, [*SPLITS, "orbit", FLIGHT + "A..B"])
    )


def read_path(path: Path, scale: float, train: Mapping[str, Camera]) -> CameraPath:
    """A camera path of either format, told apart by what is in the file. Arguments as `read_trajectory`.

    Raises:
        CrossrayError: it is of neither format, or damaged.
    """
    content = content_of(path)
    if "format" in content:
        return read_trajectory(path, scale, train)
    if "camera_path" in content:
        return read_camera_path(path, scale, train)
    raise CrossrayError(
        f"{path}: no camera path: it has neither camera_path, as nerfstudio's has, nor format, as a trajectory of "
        "nerfbaselines has"
    )


def stops_of(text: str, cameras: Mapping[str, Camera]) -> list[str]:
    """The photos of `A..B` or `A..B..C`; names may hold `..` themselves.

    Raises:
        CrossrayError: a name is not a photo's, there is one only, or the text can be read in two ways.
    """
    found = readings(text, list(cameras))
    if len(found) > 1:
        raise CrossrayError(
            f"--view {FLIGHT}{text} can be read as {' to '.join(map(repr, found[0]))} and as "
            f"{' to '.join(map(repr, found[1]))}, as names hold {BETWEEN}; take other photos"
        )
    if not found:
        parts = text.split(BETWEEN)
        strange = next((part for part in parts if part not in cameras), text)
        raise CrossrayError(f"--view {FLIGHT}{text}: {strange!r} is no photo of the scene{guess(strange, cameras)}")
    if len(found[0]) < 2:
        raise CrossrayError(f"--view {FLIGHT}{text}: a flight needs two photos, as in {FLIGHT}A..B")
    return found[0]


def readings(text: str, names: list[str]) -> list[list[str]]:
    """The ways, two at most, in which `text` is known names with `..` between them."""
    starts = [0, *(i + len(BETWEEN) for i in range(len(text)) if text.startswith(BETWEEN, i))]
    after: dict[int, list[list[str]]] = {len(text): [[]]}  # where a name ends -> the ways to go on from there
    for start in reversed(starts):
        fitting = [name for name in names if text.startswith(name, start)]
        ways = [[name, *more] for name in fitting for more in after.get(start + len(name), [])]
        after[start - len(BETWEEN)] = ways[:2]
    return after[-len(BETWEEN)]


def guess(name: str, names: Collection[str], words: Sequence[str] = ()) -> str:
    """`; did you mean x?` of the names and words, or else the first name as an example."""
    close = difflib.get_close_matches(name, [*words, *names], n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else f" (the first is {next(iter(names))!r})"
