"""Features of each photo and matches between photos, in COLMAP's database.

Features are found in batches of photos, each a task and a small database of its own (`features/`); one database is then
made of them, and its pairs are matched in one process with all threads, for SQLite has one writer.
"""

from __future__ import annotations

import sqlite3
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipeline.colmap import import_pycolmap
from pipeline.errors import CrossrayError
from pipeline.files import atomic_write, sync_folder
from pipeline.ingest.folder import Mapper

MATCHING = ("auto", "exhaustive", "sequential", "nearest")
BATCH = 4  # photos a task: at most some 20 s of work that an interruption loses
EXHAUSTIVE_UP_TO = 200  # photos: 19,900 pairs
NEIGHBOURS = 30  # photos most like a photo, by descriptor
OVERLAP = 10  # next photos in name order
# Features a photo, on average: up to here, matching is guided by the geometry found. On 30 renderings (640 pixels) that
# gave 2.5 times the points and a third of the error; but its time grows with the square (2 s a pair at 10,000).
GUIDED_UP_TO = 5000
PAIRS = "pairs.txt"
WORDS = 64  # of the vocabulary of the descriptor


@dataclass(frozen=True)
class Batch:
    """Photos (names in the folder `photos`) whose features go into the database file `out`."""

    photos: Path
    names: tuple[str, ...]
    out: Path


def find_features(photos: Path, names: list[str], folder: Path, mapper: Mapper) -> list[Path]:
    """Databases with the features of all photos, under `folder`; those that are there are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    batches = [
        Batch(photos, tuple(names[i : i + BATCH]), folder / f"{i // BATCH:05d}.db") for i in range(0, len(names), BATCH)
    ]
    missing = [b for b in batches if not b.out.exists()]
    if missing:
        for _ in mapper(find_in_batch, missing):
            pass
    return [b.out for b in batches]


def find_in_batch(batch: Batch) -> None:
    """SIFT of a few photos, one thread."""
    pycolmap = import_pycolmap()
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    with tempfile.TemporaryDirectory(dir=batch.out.parent, prefix=".") as scratch:
        path = Path(scratch) / "features.db"
        pycolmap.extract_features(
            path,
            batch.photos,
            image_names=list(batch.names),
            camera_mode=pycolmap.CameraMode.PER_IMAGE,
            extraction_options=options,
        )
        path.replace(batch.out)
    sync_folder(batch.out.parent)


def make_database(
    path: Path, photos: Path, names: list[str], batches: list[Path], matching: str, known: dict[str, tuple] | None
) -> None:
    """One database of all photos and their features, and beside it the pairs to match; `known` cameras (photo -> model,
    parameters) are as they are.
    """
    pycolmap = import_pycolmap()
    scratch = path.with_name(f".{path.name}.tmp")
    scratch.unlink(missing_ok=True)
    pycolmap.Database.open(scratch).close()
    mode = "PER_IMAGE" if known else who_shares(photos, names, matching)
    pycolmap.import_images(scratch, photos, camera_mode=getattr(pycolmap.CameraMode, mode), image_names=names)
    database = pycolmap.Database.open(scratch)
    for image in database.read_all_images() if known else ():
        assert known is not None
        camera, (kind, params) = database.read_camera(image.camera_id), known[image.name]
        database.update_camera(
            pycolmap.Camera(
                camera_id=image.camera_id,
                model=kind,
                width=camera.width,
                height=camera.height,
                params=params,
                has_prior_focal_length=True,
            )
        )
    ids = {image.name: image.image_id for image in database.read_all_images()}
    for batch in batches:
        source = pycolmap.Database.open(batch)
        for image in source.read_all_images():
            database.write_keypoints(ids[image.name], source.read_keypoints(image.image_id))
            database.write_descriptors(ids[image.name], source.read_descriptors(image.image_id))
        source.close()
    database.close()
    choose_pairs(scratch, matching, path.with_name(PAIRS))
    scratch.replace(path)


def who_shares(photos: Path, names: list[str], matching: str) -> str:
    """pycolmap's camera mode: a film's frames of one size have one camera; else photos share one whose EXIF names the
    same camera, lens setting and size, and all others have their own.
    """
    if matching != "sequential":
        return "AUTO"
    sizes = set()
    for name in names:
        with Image.open(photos / name) as image:
            sizes.add(image.size)
    return "SINGLE" if len(sizes) == 1 else "AUTO"


def choose_pairs(database: Path, matching: str, pairs_file: Path) -> int:
    """Write which pairs of photos to match, one "name name" a line, and return how many."""
    pycolmap = import_pycolmap()
    opened = pycolmap.Database.open(database)
    images = sorted(opened.read_all_images(), key=lambda image: image.name)
    names = [image.name for image in images]
    if matching == "auto":
        pairs = all_pairs(len(names))
        if len(names) > EXHAUSTIVE_UP_TO:
            pairs = next_pairs(len(names)) | nearest_pairs(global_descriptors(opened, images))
    elif matching == "exhaustive":
        pairs = all_pairs(len(names))
    elif matching == "sequential":
        pairs = next_pairs(len(names))
    elif matching == "nearest":
        pairs = nearest_pairs(global_descriptors(opened, images))
    else:
        raise CrossrayError(f"--matching {matching}: there are {', '.join(MATCHING)}")
    opened.close()
    atomic_write(pairs_file, "".join(f"{names[i]} {names[j]}\n" for i, j in sorted(pairs)))
    return len(pairs)


def all_pairs(count: int) -> set[tuple[int, int]]:
    return {(i, j) for i in range(count) for j in range(i + 1, count)}


def next_pairs(count: int) -> set[tuple[int, int]]:
    """Each photo with the `OVERLAP` next ones, and with those 2, 4, 8, ... further on."""
    steps = {*range(1, OVERLAP + 1), *(2**k for k in range(1, OVERLAP))}
    return {(i, i + s) for i in range(count) for s in steps if i + s < count}


def nearest_pairs(descriptors: np.ndarray) -> set[tuple[int, int]]:
    """Each of the descriptors (n, d), of length 1, with the `NEIGHBOURS` most like it."""
    pairs = set()
    for i, row in enumerate(descriptors):
        likeness = descriptors @ row
        likeness[i] = -np.inf
        pairs |= {(min(i, j), max(i, j)) for j in np.argsort(-likeness, kind="stable")[:NEIGHBOURS].tolist() if j != i}
    return pairs


def global_descriptors(database: Any, images: list[Any]) -> np.ndarray:
    """(n, WORDS * 128) float32 of length 1: residuals of each photo's SIFT to the nearest of a few words (VLAD), the
    words being descriptors drawn from the photos. About 32 kB a photo.
    """
    rng = np.random.default_rng(0)

    def read(image: Any, most: int) -> np.ndarray:
        data = np.asarray(database.read_descriptors(image.image_id).data).reshape(-1, 128)
        picked = rng.permutation(len(data))[:most]
        values = data[picked].astype(np.float32)
        return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)

    sample = np.concatenate([read(image, 64) for image in images[:: max(1, len(images) // 200)]])
    words = _means(sample, WORDS, rng)
    result = np.zeros((len(images), len(words) * 128), np.float32)
    for row, image in zip(result, images, strict=True):
        values = read(image, 2000)
        if not len(values):
            continue
        nearest = np.argmax(values @ words.T - 0.5 * (words**2).sum(1), axis=1)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, values - words[nearest])
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
        row[:] = sums.ravel() / max(float(np.linalg.norm(sums)), 1e-9)
    return result


def _means(values: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """k-means of `values` (n, d), ten rounds."""
    words = values[rng.permutation(len(values))[:count]].copy()
    for _ in range(10):
        nearest = np.argmax(values @ words.T - 0.5 * (words**2).sum(1), axis=1)
        for k in np.unique(nearest):
            words[k] = values[nearest == k].mean(0)
    return words


def match(database: str, pairs_file: str, seed: int) -> None:
    """Match the pairs and verify each geometrically; pairs that are matched already are passed over."""
    pycolmap = import_pycolmap()
    pycolmap.set_random_seed(seed)
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = pairs_file
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    matching = pycolmap.FeatureMatchingOptions()
    opened = pycolmap.Database.open(database)
    matching.guided_matching = opened.num_keypoints() <= GUIDED_UP_TO * opened.num_images()
    opened.close()
    pycolmap.match_image_pairs(database, matching, pairing, verification)


def count_matched(database: Path) -> int:
    """Pairs that have been matched so far, read beside whoever writes."""
    try:
        with sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=0.2) as connection:
            return int(connection.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0])
    except sqlite3.Error:
        return 0


def inliers(database: Path) -> dict[tuple[str, str], int]:
    """Verified matches of each pair of photos that has any."""
    pycolmap = import_pycolmap()
    opened = pycolmap.Database.open(database)
    names = {image.image_id: image.name for image in opened.read_all_images()}
    found = {}
    for pair, count in zip(*opened.read_two_view_geometry_num_inliers(), strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair)
        found[names[a], names[b]] = int(count)
    opened.close()
    return found
