"""Cutting shards beside the bare work on pictures that it cannot do without.

    python benchmarks/shards.py [--scene DIR] [--out benchmarks/results/shards.json]

Bar: with Ray warm, cutting takes at most 1.5 times as long as the bare loop on the same cores. That decodes each photo,
makes it smaller by LANCZOS to both of its sizes, encodes both as PNG, by the functions of pipeline/pictures.py, and
keeps nothing. Its processes wait for work, as Ray's do. The two take turns, so that both meet the same machine.

On one core without Ray, each part of a cut has its own stopwatch, which tells what stands between. Photos are noise of
1000 x 750 pixels with about as much detail as Reichstag's have, or those of a posed scene (--scene). Exit status 1 if
the bar is missed.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import count
from math import cos, pi, sin
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from PIL import Image
from rich.console import Console
from rich.table import Table

from pipeline import cutting, pictures
from pipeline.cutting import Mapper, ShardSpec, cut_shards
from pipeline.files import atomic_write
from pipeline.launch.tasks import in_process, ray_tasks
from pipeline.patches import PatchPlan
from pipeline.provenance import provenance
from pipeline.scene import ScenePhoto, read_scene
from pipeline.timing_measure import Seconds, summarised

DOWNSCALE, REFERENCE_DOWNSCALE = 2, 8  # the paper's R/2, and the released code's references
PHOTOS, SIZE = 74, (1000, 750)  # about Reichstag's
POINTS = 100  # of the model, a photo; Phototourism's scenes have about as many
DISTINCT = 74  # photos with pixels of their own
ROUNDS = 5
BAR = 1.5

Parts = dict[str, list[tuple[Any, str]]]  # name -> functions: where each is looked up, and its name there

PARTS: Parts = {
    "model and poses": [(cutting, "read_scene")],
    "reading photos": [(cutting, "_read_source")],
    "SHA-256 of photos, cameras": [(cutting, "camera_record"), (cutting, "digest")],
    "decode": [(cutting, "decode_photo")],
    "LANCZOS": [(cutting, "resize")],
    "PNG": [(cutting, "encode_png")],
    "photos' kinds": [(cutting, "conversion")],
    "tar": [(cutting, "_write_tar")],
    "SHA-256 of shards, writing": [(cutting._Hashed, "write")],
    "fsync": [(os, "fsync")],
}


# ---------------------------------------------------------------------------------------------------- a scene


def write_scene(root: Path, photos: int, size: tuple[int, int]) -> Path:
    """A posed scene of `photos` JPEG photos of noise of `size` (width, height); returns `root`.

    Only DISTINCT photos differ. Cameras stand in a circle. There are POINTS points a photo, each seen by two photos;
    where in them nobody reads.
    """
    images, sparse = root / "dense" / "images", root / "dense" / "sparse"
    images.mkdir(parents=True)
    sparse.mkdir()
    rng = np.random.default_rng(0)
    names = [f"{i:06d}.jpg" for i in range(photos)]
    for i, name in enumerate(names):
        if i < DISTINCT:
            Image.fromarray(noise(rng, size)).save(images / name, quality=95)
        else:
            (images / name).hardlink_to(images / names[i % DISTINCT])
    width, height = size
    (sparse / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {width} {width} {width / 2} {height / 2}\n")
    with (sparse / "images.txt").open("w") as file:
        for i, name in enumerate(names):
            a = -pi * i / photos  # half the angle about the vertical axis
            seen = [POINTS * group + k for group in (i, (i - 1) % photos) for k in range(POINTS)]
            file.write(f"{i + 1} {cos(a)} 0 {sin(a)} 0 0 0 4 1 {name}\n")
            file.write(" ".join(f"1 1 {k + 1}" for k in seen) + "\n")
    with (sparse / "points3D.txt").open("w") as file:
        for k, (x, y, z) in enumerate(rng.uniform(-1, 1, (POINTS * photos, 3))):
            group, place = divmod(k, POINTS)
            track = f"{group + 1} {place} {(group + 1) % photos + 1} {POINTS + place}"
            file.write(f"{k + 1} {x} {y} {z} 128 128 128 0.5 {track}\n")
    return root


def noise(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """uint8 (h, w, 3): octaves of noise, each finer one fainter, so that its PNG takes about as many bytes a pixel as
    one of a photo.
    """
    longest = max(size)
    total = np.zeros((size[1], size[0], 3), np.float32)
    for octave in range(1, longest.bit_length()):
        width, height = (max(2, side * 2**octave // longest) for side in size)
        coarse = Image.fromarray(rng.integers(256, size=(height, width, 3), dtype=np.uint8))
        total += (np.asarray(coarse.resize(size, Image.Resampling.BICUBIC), np.float32) - 128) / 2 ** (octave / 2)
    return (128 + 40 * total / total.std()).clip(0, 255).astype(np.uint8)


# -------------------------------------------------------------------------------------------------- stopwatch


class Stopwatch:
    """Seconds inside each of several parts of a program, without the parts that they call."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.inside: list[float] = [0.0]  # seconds of the parts that the running ones have called

    def wrapped(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function`, whose time counts as that of part `name`."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            began = time.perf_counter()
            self.inside.append(0.0)
            try:
                return function(*args, **kwargs)
            finally:
                seconds = time.perf_counter() - began
                self.seconds[name] += seconds - self.inside.pop()
                self.inside[-1] += seconds

        return timed

    @contextmanager
    def running(self, parts: Parts) -> Iterator[None]:
        """Count the functions of `parts` for as long as the block lasts."""
        places = [(name, *place) for name, found in parts.items() for place in found]
        patches = [patch.object(home, word, self.wrapped(name, getattr(home, word))) for name, home, word in places]
        for replaced in patches:
            replaced.start()
        try:
            yield
        finally:
            for replaced in patches:
                replaced.stop()


# --------------------------------------------------------------------------------------------------- measuring


def bare_photo(photo: ScenePhoto) -> int:
    """The least that a shard takes of a photo; bytes of its two PNGs."""
    original = pictures.decode_photo(photo.path.read_bytes(), photo)
    sizes = [(photo.width // factor, photo.height // factor) for factor in (DOWNSCALE, REFERENCE_DOWNSCALE)]
    return sum(len(pictures.encode_png(pictures.resize(original, size, pictures.LANCZOS))) for size in sizes)


def busy(work: Callable[[ShardSpec], Any], spec: ShardSpec) -> tuple[Any, float]:
    """A task's result, and the seconds that it took where it ran."""
    began = time.perf_counter()
    return work(spec), time.perf_counter() - began


def summing(mapper: Mapper, seconds: list[float]) -> Mapper:
    """The mapper, which adds to `seconds` what each task took."""

    def mapped(work: Callable[[ShardSpec], Any], specs: list[ShardSpec], /) -> Iterable[Any]:
        for result, took in mapper(partial(busy, work), specs):
            seconds.append(took)
            yield result

    return mapped


def seconds_of(action: Callable[[], object]) -> float:
    """Of one go."""
    began = time.perf_counter()
    action()
    return time.perf_counter() - began


def cut(scene: Path, out: Path, mapper: Mapper) -> None:
    """All shards of the scene."""
    cut_shards(
        scene, out, downscale=DOWNSCALE, reference_downscale=REFERENCE_DOWNSCALE, plan=PatchPlan(), mapper=mapper
    )


def measure(scene: Path, folder: Path, cores: int) -> dict[str, list[float]]:
    """Seconds of each way, one a round, on `cores` cores and on one; and of a cut's parts on one."""
    photos = read_scene(scene).photos
    shards = (folder / f"shards-{i}" for i in count())
    found: dict[str, list[float]] = {}

    def go(name: str, action: Callable[[], object]) -> None:
        found.setdefault(name, []).append(seconds_of(action))

    with multiprocessing.get_context("spawn").Pool(cores) as pool, ray_tasks(cores) as mapper:

        def bare() -> None:
            for _ in pool.imap_unordered(bare_photo, photos):
                pass

        bare()
        there = next(shards)
        cut(scene, there, mapper)
        for _ in range(ROUNDS):
            go("bare", bare)
            go("ours", partial(cut, scene, next(shards), mapper))
            go("there", partial(cut, scene, there, mapper))
            tasks: list[float] = []
            whole = seconds_of(partial(cut, scene, next(shards), summing(mapper, tasks)))
            found.setdefault("outside tasks", []).append(whole - sum(tasks) / cores)
    for _ in range(ROUNDS):
        go("bare, one core", lambda: [bare_photo(photo) for photo in photos])
        go("ours, one core", partial(cut, scene, next(shards), in_process))
        go("there, one core", partial(cut, scene, there, in_process))
        watch = Stopwatch()
        with watch.running(PARTS):
            whole = seconds_of(partial(cut, scene, next(shards), in_process))
        for name in PARTS:
            found.setdefault(f"part: {name}", []).append(watch.seconds[name])
        found.setdefault("part: rest", []).append(whole - sum(watch.seconds.values()))
    return found


# -------------------------------------------------------------------------------------------------- the table


def table_of(seconds: dict[str, Seconds], cores: int) -> Table:
    """What a person reads."""
    ray = f"Ray, {cores} core{'s' if cores > 1 else ''}"
    rows = [
        (f"bare decode + LANCZOS + PNG, {cores} waiting processes", "bare", "bare"),
        (f"cutting shards ({ray}, warm)", "ours", "bare"),
        ("  of that outside the tasks, or with a core that waits", "outside tasks", "bare"),
        (f"shards that are there already: verified ({ray}, warm)", "there", "bare"),
        ("bare, one core", "bare, one core", "bare, one core"),
        ("cutting shards in process, one core", "ours, one core", "bare, one core"),
        ("shards that are there already: verified, one core", "there, one core", "bare, one core"),
        *((f"  a cut's {name}", f"part: {name}", "bare, one core") for name in (*PARTS, "rest")),
    ]
    table = Table("", "seconds", "quartiles", "of the bare")
    for text, name, base in rows:
        s = seconds[name]
        share = s.median / seconds[base].median
        table.add_row(text, f"{s.median:.3f}", f"{s.low:.3f} to {s.high:.3f}", f"{share:.3f}")
    return table


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, help="a posed scene instead of noise")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    where = provenance()
    cores = where["hardware"]["cores"]
    with tempfile.TemporaryDirectory(prefix="shards-") as name:
        folder = Path(name)
        scene = options.scene or write_scene(folder / "scene", PHOTOS, SIZE)
        photos = read_scene(scene).photos
        rounds = measure(scene, folder, cores)
        content = {
            "photos": len(photos),
            "mean_pixels": float(np.mean([photo.width * photo.height for photo in photos])),
            "mean_photo_bytes": float(np.mean([photo.path.stat().st_size for photo in photos])),
            "mean_png_bytes": float(np.mean([bare_photo(photo) for photo in photos])),
            "downscale": DOWNSCALE,
            "reference_downscale": REFERENCE_DOWNSCALE,
        }
    seconds = {name: summarised(times, None) for name, times in rounds.items()}
    ratio = seconds["ours"].median / seconds["bare"].median
    met = ratio <= BAR
    console = Console(width=None if sys.stdout.isatty() else 140)
    console.print(
        f"{len(photos)} photos of {content['mean_pixels'] / 1e6:.2f} megapixels, "
        f"{content['mean_photo_bytes'] / 1e3:.0f} kB; their PNGs {content['mean_png_bytes'] / 1e3:.0f} kB; "
        f"medians of {ROUNDS} rounds"
    )
    console.print(table_of(seconds, cores))
    console.print(f"cutting / bare: {ratio:.2f}, wanted at most {BAR}: {'met' if met else 'MISSED'}")
    if options.out:
        bar = {"bar": "cutting with Ray warm / bare", "measured": ratio, "wanted": BAR, "met": met}
        record = {
            "bars": [bar],
            "cores": cores,
            "scene": content,
            "seconds": {name: s._asdict() | {"rounds": rounds[name]} for name, s in seconds.items()},
            "provenance": where,
        }
        atomic_write(options.out, json.dumps(record, indent=1) + "\n")
    sys.exit(0 if met else 1)


if __name__ == "__main__":
    main()
