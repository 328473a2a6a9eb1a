"""The built-in scene: photos of a landmark "in the wild", with ground truth for everything.

`write_landmark` leaves the Phototourism layout and, in `truth/`, what no real collection has:

    dense/images/<stem>.png            the photos, tourists included
    dense/sparse/*.bin                 COLMAP model: cameras, poses, points with tracks in the photos that see them
    landmark.tsv                       filename, id, split, dataset
    truth/<stem>.clean.png             the photo without tourists
    truth/<stem>.mask.png              255 where max over channels of |photo - clean| > 10, else 0
    truth/<stem>.depth.npy             float32 (h, w) z-depth at the pixel centres in COLMAP units; inf where the sky is
    truth/arguments.json               written first: what was asked for
    truth/landmark.json                written last: the recorded scene, from which any other pair can be rendered

Photo i is a pure function of (seed, i, its split, size, sun_jitter). One COLMAP unit is a fifth of the building's
width; z is up.
"""

from __future__ import annotations

import io
import json
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.colmap import import_pycolmap
from pipeline.errors import CrossrayError
from pipeline.files import atomic_write
from pipeline.landmark.crowd import Tourist, place_crowd
from pipeline.landmark.light import RGB, Light, Response, draw_light, draw_response
from pipeline.landmark.photo import depth_map, photograph
from pipeline.landmark.scene import OBSTACLES, SUN, solids, surfaces
from pipeline.landmark.tracer import Pinhole, trace_grid, trace_points

Mapper = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]

FORMAT = 1
SPLITS = ("train", "val", "test")
MASK_LEVEL = 10  # of 255: smaller changes are no transients
BATCH = 4  # photos a task


@dataclass(frozen=True)
class PhotoRecord:
    """Everything that decides one photo. `model` is COLMAP's name of its camera."""

    name: str
    split: str
    model: str
    camera: Pinhole
    light: Light
    response: Response
    crowd: tuple[Tourist, ...]

    @property
    def stem(self) -> str:
        return self.name.removesuffix(".png")


@dataclass(frozen=True)
class _Batch:
    root: str
    photos: tuple[tuple[int, str], ...]  # (index, split)
    size: int
    seed: int
    sun_jitter: float


def write_landmark(
    root: Path,
    *,
    train: int = 48,
    val: int = 8,
    test: int = 8,
    size: int = 128,
    seed: int = 0,
    sun_jitter: float = 0.0,
    mapper: Mapper = map,
) -> Path:
    """Write the scene into `root` and return `root`; an interrupted one is finished, a complete one is kept.

    `size` is the long side in pixels; `sun_jitter` the standard deviation in degrees of the sun's direction
    between photos.
    Raises CrossrayError for arguments out of range and where `root` holds something else.
    """
    root = Path(root)
    asked = {"format": FORMAT, "train": train, "val": val, "test": test, "size": size, "seed": seed,
             "sun_jitter": float(sun_jitter)}  # fmt: skip
    _check(asked)
    if _claim(root, asked):
        return root
    splits = ["train"] * train + ["val"] * val + ["test"] * test
    numbered = list(enumerate(splits))
    batches = [
        _Batch(str(root), tuple(numbered[k : k + BATCH]), size, seed, float(sun_jitter))
        for k in range(0, len(numbered), BATCH)
    ]
    done: dict[int, tuple[PhotoRecord, np.ndarray, np.ndarray]] = {}
    for results in mapper(_make_photos, batches):
        done.update(results)
    records = [done[i][0] for i in range(len(splits))]
    _write_model(root / "dense" / "sparse", seed, records, [done[i][1:] for i in range(len(splits))])
    rows = [f"{r.name}\t{i + 1}\t{r.split}\tlandmark\n" for i, r in enumerate(records)]
    atomic_write(root / "landmark.tsv", "filename\tid\tsplit\tdataset\n" + "".join(rows))
    for remains in root.rglob(".*.tmp"):  # of a run that was killed while it wrote
        remains.unlink()
    lines = ",\n".join(json.dumps(asdict(r)) for r in records)
    atomic_write(_record_path(root), f'{{"arguments": {json.dumps(asked)}, "photos": [\n{lines}\n]}}\n')
    return root


def _record_path(root: Path) -> Path:
    return root / "truth" / "landmark.json"


def _check(asked: dict[str, Any]) -> None:
    counts = asked["train"], asked["val"], asked["test"]
    if min(counts) < 0 or asked["train"] < 1 or not 10 <= sum(counts) <= 10_000:
        raise CrossrayError(
            f"landmark: {counts[0]} train + {counts[1]} val + {counts[2]} test photos; it takes 10 to 10,000 in all, "
            "at least one of them for training and none of the counts negative"
        )
    if not 16 <= asked["size"] <= 4096:
        raise CrossrayError(f"landmark: size {asked['size']}; the long side must have 16 to 4096 pixels")
    if asked["seed"] < 0:
        raise CrossrayError(f"landmark: seed {asked['seed']}; it must not be negative")
    if not 0 <= asked["sun_jitter"] <= 45:
        raise CrossrayError(f"landmark: sun_jitter {asked['sun_jitter']}; it must lie within 0 to 45 degrees")


def _claim(root: Path, asked: dict[str, Any]) -> bool:
    """Write down what is asked for; True where it is already complete. Raises where `root` holds something else."""
    path = root / "truth" / "arguments.json"
    if not path.exists():
        if (root / "dense").exists():
            raise CrossrayError(f"{root} holds a scene that is not the built-in landmark; name another folder")
        atomic_write(path, json.dumps(asked))
        return False
    found = json.loads(path.read_text())
    different = [f"{k} {found.get(k)} there, {asked[k]} asked" for k in asked if found.get(k) != asked[k]]
    if different:
        raise CrossrayError(
            f"{root} holds a landmark made with other arguments ({'; '.join(different)}); "
            "name another folder or remove this one"
        )
    return _record_path(root).exists()


# ---- one photo


def _make_photos(batch: _Batch) -> dict[int, tuple[PhotoRecord, np.ndarray, np.ndarray]]:
    """Write a batch's files. Returns per index the record and what `_observations` found."""
    results = {}
    for index, split in batch.photos:
        record = draw_photo(batch.seed, index, split, batch.size, batch.sun_jitter)
        _write_photo(Path(batch.root), record)
        results[index] = (record, *_observations(batch.seed, index, record.camera))
    return results


def draw_photo(seed: int, index: int, split: str, size: int, sun_jitter: float) -> PhotoRecord:
    """Camera, light, response and crowd of photo `index`.

    Where a photo stands on the arc, its weather, and how crowded it is follow low-discrepancy sequences in
    `index`, so that even a few photos are spread evenly; the rest is drawn from a generator keyed by (seed, index).
    """
    start = np.random.default_rng((seed, 0)).random(3)
    along, weather, crowded = (
        float((s + index * step) % 1) for s, step in zip(start, (0.618034, 0.754878, 0.569840), strict=True)
    )
    rng = np.random.default_rng((seed, 1, index))
    model, camera = _draw_camera(rng, along, split, size)
    light = draw_light(rng, weather, _draw_sun(rng, sun_jitter))
    response = draw_response(rng, light)
    crowd = place_crowd(rng, camera, light, _wanted_share(crowded, split))
    return PhotoRecord(f"{index:05d}.png", split, model, camera, light, response, tuple(crowd))


def _wanted_share(crowded: float, split: str) -> float:
    """Share of the pixels that tourists are to change: none on every eighth photo, 8 % on average."""
    if crowded < 0.125:
        return 0.0
    share = 0.02 + 0.26 * ((crowded - 0.125) / 0.875) ** 2.1
    return share if split != "test" else 0.35 * share


def _draw_sun(rng: np.random.Generator, jitter: float) -> RGB:
    azimuth, height = math.atan2(SUN[1], SUN[0]), math.atan2(SUN[2], math.hypot(SUN[0], SUN[1]))
    azimuth += math.radians(jitter) * rng.normal()
    height = min(max(height + math.radians(jitter) * rng.normal(), 0.2), 1.3)
    return math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)


_ASPECTS = ((3, 2), (4, 3), (16, 9), (1, 1), (3, 4), (2, 3))


def _draw_camera(rng: np.random.Generator, along: float, split: str, size: int) -> tuple[str, Pinhole]:
    """A visitor somewhere on an arc of 130 degrees in front of the building, who looks at it."""
    a, b = _ASPECTS[int(rng.choice(len(_ASPECTS), p=[0.34, 0.26, 0.12, 0.1, 0.1, 0.08]))]
    width, height = (round(size * side / max(a, b)) for side in (a, b))
    spread = 65 if split == "train" else 57
    for _ in range(100):
        angle = math.radians(spread * (2 * along - 1) + 2 * rng.normal())
        fov = rng.uniform(38, 65) if width >= height else rng.uniform(35, 46)
        tangent = math.tan(math.radians(fov) / 2)
        fits = 1.9 / (tangent * height / width)  # at this distance the building fills the picture's height
        distance = min(max(fits * rng.uniform(0.8, 1.2), 4.0), 6.4)
        eye = rng.uniform(0.27, 0.42) if rng.random() < 0.65 else rng.uniform(0.45, 1.3)
        centre = (distance * math.sin(angle), -0.6 - distance * math.cos(angle), eye)
        if all(math.hypot(centre[0] - x, centre[1] - y) > r + 0.8 for x, y, r in OBSTACLES):
            break
    target = (rng.normal(0, 0.25), -0.5 + rng.normal(0, 0.15), 1.2 + rng.normal(0, 0.12))
    rotation = look(centre, target, math.radians(rng.normal(0, 1.0)))
    focal = width / 2 / tangent
    if rng.random() < 0.5:
        return "SIMPLE_PINHOLE", Pinhole(width, height, focal, focal, width / 2, height / 2, rotation, centre)
    fy = focal * rng.uniform(0.985, 1.015)
    cx, cy = (side / 2 + 0.015 * side * rng.uniform(-1, 1) for side in (width, height))
    return "PINHOLE", Pinhole(width, height, focal, fy, cx, cy, rotation, centre)


def look(centre: Sequence[float], target: Sequence[float], roll: float) -> tuple[tuple[float, float, float], ...]:
    """Rows right, down, forward of a camera that looks at `target` and is held `roll` radians askew."""
    forward = np.subtract(target, centre)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = math.cos(roll), math.sin(roll)
    rows = (c * right + s * down, c * down - s * right, forward)
    return tuple((float(r[0]), float(r[1]), float(r[2])) for r in rows)


def _write_photo(root: Path, record: PhotoRecord) -> None:
    photo_path = root / "dense" / "images" / record.name
    clean_path, mask_path, depth_path = _truth_paths(root, record)
    if all(path.exists() for path in (photo_path, clean_path, mask_path, depth_path)):
        return
    clean, photo = photograph(record.camera, record.light, record.response, record.crowd)
    mask = np.abs(photo.astype(np.int16) - clean).max(2) > MASK_LEVEL
    depth = io.BytesIO()
    np.save(depth, depth_map(record.camera))
    atomic_write(clean_path, _png(clean))
    atomic_write(mask_path, _png(mask.astype(np.uint8) * 255))
    atomic_write(depth_path, depth.getvalue())
    atomic_write(photo_path, _png(photo))


def _truth_paths(root: Path, record: PhotoRecord) -> list[Path]:
    return [root / "truth" / f"{record.stem}.{kind}" for kind in ("clean.png", "mask.png", "depth.npy")]


def _png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


# ---- the COLMAP model

POINTS = 4000
SEEN_NEAREST, SEEN_ELSEWHERE = 300, 700  # points a photo, at most


@cache
def surface_points(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) float64 on the surfaces seen from the arc, and their colours (n, 3) uint8."""
    rng = np.random.default_rng((seed, 2))
    places, tints = [], []
    for k, angle in enumerate(np.linspace(-1.15, 1.15, 12)):
        # Every other place lies behind and above the photographers: there are points at their feet, too.
        distance, height, aim = ((4.6, 0.8, 0.95), (7.2, 2.6, -2.2))[k % 2]
        eye = (distance * math.sin(angle), -0.6 - distance * math.cos(angle), height)
        camera = Pinhole(96, 72, 56.0, 56.0, 48.0, 36.0, look(eye, (0.0, -0.5, aim), 0.0), eye)
        hits = trace_grid(camera, solids(), 1)
        seen = rng.permutation(np.flatnonzero(hits.which >= 0))
        points, _, albedo = surfaces(hits, seen, list(solids()))
        # As in real models few points are far away: readers take the scene's box from percentiles.
        radius = np.hypot(points[0], points[1])
        near = radius < np.where(points[1] < -2, 6.9, 5.0)
        kept = np.flatnonzero(near | (rng.random(seen.size) < 0.12))[: POINTS // 12 + 1]
        places.append(np.array(points, np.float64).T[kept])
        tints.append(albedo.T[kept])
    colours = np.round(255 * np.clip(np.concatenate(tints), 0, 1) ** (1 / 2.2)).astype(np.uint8)
    return np.concatenate(places)[:POINTS], colours[:POINTS]


def _observations(seed: int, index: int, camera: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (n,) of the surface points that a camera sees, and where (n, 2) a feature detector finds them."""
    rng = np.random.default_rng((seed, 3, index))
    points, _ = surface_points(seed)
    u, v, z = camera.project(points)
    inside = np.flatnonzero((z > 0.05) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height))
    hits = trace_points(camera, solids(), u[inside], v[inside])
    inside = inside[np.abs(hits.t - z[inside]) < 2e-3 * z[inside]]
    # The nearest first: few photos see what lies at a photographer's feet, and bounds come from such points.
    inside = inside[np.argsort(z[inside], kind="stable")]
    others = rng.permutation(inside[SEEN_NEAREST:])[:SEEN_ELSEWHERE]
    inside = np.sort(np.concatenate([inside[:SEEN_NEAREST], others]))
    noise = np.clip(rng.normal(0, 0.15, (inside.size, 2)), -0.4, 0.4)
    return inside, np.stack([u[inside], v[inside]], 1) + noise


def _write_model(folder: Path, seed: int, records: list[PhotoRecord], seen: list) -> None:
    """COLMAP's binary files. Camera ids are those of the images, moved on by one: who mixes them up finds out."""
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction()
    points, colours = surface_points(seed)
    for i, (record, (_, pixels)) in enumerate(zip(records, seen, strict=True)):
        camera_id = (i + 1) % len(records) + 1
        c = record.camera
        params = [c.fx, c.cx, c.cy] if record.model == "SIMPLE_PINHOLE" else [c.fx, c.fy, c.cx, c.cy]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=camera_id, model=record.model, width=c.width, height=c.height, params=params)
        )
        rotation = np.array(c.rotation)
        image = pycolmap.Image(name=record.name, keypoints=pixels, camera_id=camera_id, image_id=i + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -(rotation * np.array(c.centre)).sum(1))
        model.add_image_with_trivial_frame(image, pose)
    for number, track in _tracks([numbers for numbers, _ in seen]):
        model.add_point3D(points[number], track, colours[number])
    with tempfile.TemporaryDirectory() as scratch:
        model.write_binary(scratch)
        for file in sorted(Path(scratch).iterdir()):
            atomic_write(folder / file.name, file.read_bytes())


def _tracks(seen: list[np.ndarray]) -> Iterator[tuple[int, Any]]:
    """(number, track) of every point that some photo sees; `seen[i]` are the points of photo i."""
    pycolmap = import_pycolmap()
    numbers = np.concatenate(seen)
    images = np.repeat(np.arange(1, len(seen) + 1), [s.size for s in seen])
    places = np.concatenate([np.arange(s.size) for s in seen])
    order = np.argsort(numbers, kind="stable")
    found, starts = np.unique(numbers[order], return_index=True)
    for number, mine in zip(found.tolist(), np.split(order, starts[1:]), strict=True):
        track = pycolmap.Track()
        for image_id, place in zip(images[mine].tolist(), places[mine].tolist(), strict=True):
            track.add_element(image_id, place)
        yield number, track


# ---- reading it back


class Landmark:
    """A written landmark and its truth. Photos go by their file names, as in the COLMAP model."""

    def __init__(self, root: Path, records: Iterable[PhotoRecord]):
        self.root = Path(root)
        self._records = {record.name: record for record in records}

    @classmethod
    def read(cls, root: Path) -> Landmark:
        """Raises CrossrayError where `root` holds no complete landmark."""
        path = _record_path(Path(root))
        if not path.exists():
            raise CrossrayError(f"{path} is missing: {root} holds no complete landmark; write_landmark finishes it")
        return cls(Path(root), [_record(entry) for entry in json.loads(path.read_text())["photos"]])

    def record(self, name: str) -> PhotoRecord:
        """What is recorded of one photo. Raises CrossrayError for an unknown name."""
        if name not in self._records:
            raise CrossrayError(f"{self.root}: the landmark has no photo named {name!r}")
        return self._records[name]

    def names(self, split: str | None = None) -> list[str]:
        """File names of one split ("train", "val", "test"), or of all photos."""
        if split is not None and split not in SPLITS:
            raise CrossrayError(f"landmark: no split {split!r}; there are {', '.join(SPLITS)}")
        return [r.name for r in self._records.values() if split in (None, r.split)]

    def camera(self, name: str) -> Pinhole:
        """The photo's camera in world (COLMAP) units."""
        return self.record(name).camera

    def truth(self, view: str, appearance: str) -> np.ndarray:
        """uint8 RGB (h, w, 3): the camera of `view` in the light and response of `appearance`, nobody there.

        truth(x, x) is the stored clean picture of x, bit for bit.
        """
        seen, taken = self.record(view), self.record(appearance)
        return photograph(seen.camera, taken.light, taken.response)[0]

    def mask(self, name: str) -> np.ndarray:
        """bool (h, w): the pixels that tourists and their shadows change by more than 10/255 in some channel."""
        path = _truth_paths(self.root, self.record(name))[1]
        return np.asarray(Image.open(path)) > 0

    def depth(self, name: str) -> np.ndarray:
        """float32 (h, w): z-depth at the pixel centres, in COLMAP units; inf where the sky is."""
        return np.load(_truth_paths(self.root, self.record(name))[2], allow_pickle=False)


def _record(entry: dict[str, Any]) -> PhotoRecord:
    """A record as it was before it went through JSON."""
    return PhotoRecord(
        entry["name"],
        entry["split"],
        entry["model"],
        Pinhole(**_tuples(entry["camera"])),
        Light(**_tuples(entry["light"])),
        Response(**_tuples(entry["response"])),
        tuple(Tourist(**_tuples(t)) for t in entry["crowd"]),
    )


def _tuples(fields: dict[str, Any]) -> dict[str, Any]:
    def freeze(value: Any) -> Any:
        return tuple(map(freeze, value)) if isinstance(value, list) else value

    return {key: freeze(value) for key, value in fields.items()}
