"""The steps from photos to a posed scene, each kept, so that the same command goes on where it was.

    SCENE/ingest/identity.json         what was asked for, and which files
                 files.json            what each file turned out to be
                 photos/               the photos that are used
                 features/*.db         features, a few photos each
                 database.db, matched  all of them, and their matches
                 tries/*/              models, and what was found wrong with them
                 colmap.log            what COLMAP printed
                 summary.json, cameras.png
    SCENE/dense/images, dense/sparse   the undistorted photos and their model
    SCENE/transforms.json, points.ply  the same for nerfstudio
    SCENE/<name>.tsv                   the split; written last: with it the scene is there

The same photos on the same machine give the same scene but for the order of additions in bundle adjustment, which
depends on the number of threads.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from pipeline.colmap import import_pycolmap
from pipeline.errors import CrossrayError
from pipeline.files import atomic_write, resolved
from pipeline.ingest import transforms
from pipeline.ingest.child import in_child
from pipeline.ingest.features import MATCHING, PAIRS, count_matched, find_features, inliers, make_database, match
from pipeline.ingest.folder import Mapper, Seen, list_files, look_at
from pipeline.ingest.mapping import TRIES, Found, components, find_poses, read_try, run_try
from pipeline.ingest.picture import draw_cameras
from pipeline.ingest.summary import Summary, summarise
from pipeline.ingest.undistort import undistort
from pipeline.progress import Progress, shown
from pipeline.scene import read_scene

FORMAT = 1
OURS = ("ingest", "dense", "transforms.json", "points.ply", "masks")

log = logging.getLogger("crossray")


def ingest(photos: Path, out: Path, *, mapper: Mapper, matching: str = "auto", test_every: int = 8) -> Summary:
    """Make the posed scene `out` of a folder of photos, or of those that a nerfstudio transforms.json poses.

    Args:
        mapper: runs the tasks (`pipeline.launch.tasks`): looking at files, finding features.
        matching: which pairs of photos are compared: exhaustive (all), sequential (next in name order; if all have one
            size they share a camera, as a film's frames do), nearest (most alike), or auto: all up to 200 photos, above
            that the next and the nearest together.
        test_every: every so many photos in name order, the first of all included, one is for testing; 0: none.

    Raises:
        CrossrayError: the photos or the folder cannot be used, or no sound model comes out.
    """
    if matching not in MATCHING:
        raise CrossrayError(f"--matching {matching}: there are {', '.join(MATCHING)}")
    if test_every < 0 or test_every == 1:
        raise CrossrayError(f"--test-every {test_every}: 0 for no test photo, else 2 or more, for some are to train on")
    posed = transforms.read_transforms(photos) if photos.suffix.lower() == ".json" and photos.is_file() else None
    out, photos = resolved(out), resolved(photos)
    files = sorted(posed) if posed else list_files(photos)
    if not posed and (out == photos or out.is_relative_to(photos)):
        raise CrossrayError(f"{out} is in the folder of the photos; --out names one beside it")
    identity = identity_of(photos, files, matching, test_every)
    with claimed(out, identity) as work:
        if (out / f"{out.name}.tsv").exists() and (work / "summary.json").exists():
            log.info("%s is complete; nothing to do", out)
            summary = Summary.read(work / "summary.json")
        else:
            summary = _ingest(photos, files, posed, out, work, mapper, matching, test_every)
    if summary.inexact:
        log.warning("%s: %s", out, summary.inexact)
    return summary


def identity_of(photos: Path, files: list[Path], matching: str, test_every: int) -> dict[str, Any]:
    """What decides the scene: a change is seen by the names, sizes and times of the files."""
    stats = [(str(f), f.stat().st_size, f.stat().st_mtime_ns) for f in files]
    if photos.is_file():
        stats.append((str(photos), photos.stat().st_size, photos.stat().st_mtime_ns))
    digest = hashlib.sha256(repr(stats).encode()).hexdigest()
    return {"format": FORMAT, "photos": str(photos), "files": len(files), "digest": digest, "matching": matching,
            "test_every": test_every}  # fmt: skip


@contextmanager
def claimed(out: Path, identity: dict[str, Any]) -> Iterator[Path]:
    """The workspace of `out`, locked; emptied where other photos or options were begun in it and not finished.

    Raises:
        CrossrayError: `out` holds something else, cannot be written, or another process works on it.
    """
    work, record = out / "ingest", out / "ingest" / "identity.json"
    if out.exists() and not out.is_dir():
        raise CrossrayError(f"{out} is a file; --out names a folder for the scene")
    if out.is_dir() and not work.is_dir() and (strange := sorted(p.name for p in out.iterdir())):
        raise CrossrayError(f"{out} holds {strange[0]} and is no scene of ingest; --out names a new or an empty folder")
    try:
        work.mkdir(parents=True, exist_ok=True)
        lock = FileLock(work / ".lock")
        lock.acquire(timeout=0)
    except Timeout:
        raise CrossrayError(f"{out}: another ingest is working on it") from None
    except OSError as error:
        raise CrossrayError(f"{out} cannot be written ({error.strerror}); --out names another folder") from error
    try:
        found = json.loads(record.read_text()) if record.exists() else {}
        if found and (out / f"{out.name}.tsv").exists():
            refuse_other(out, found, identity)
        elif found != identity:
            if found:
                log.info("%s: the photos or options have changed since it was begun; it is begun anew", out)
            clear(work)
        if found != identity:
            atomic_write(record, json.dumps(identity, indent=1) + "\n")
        yield work
    finally:
        lock.release()


def clear(work: Path) -> None:
    """Remove all but the lock."""
    (work / "identity.json").unlink(missing_ok=True)  # first: what is left of an interrupted removal is no one's
    for path in work.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != ".lock":
            path.unlink()


def refuse_other(out: Path, found: dict[str, Any], asked: dict[str, Any]) -> None:
    """CrossrayError where `out` was begun with other photos or options."""
    different = [
        f"{k} {found.get(k)} there, {asked[k]} asked" for k in asked if k != "digest" and found.get(k) != asked[k]
    ]
    if not different and found.get("digest") != asked["digest"]:
        different = ["files that have changed since"]
    if different:
        raise CrossrayError(
            f"{out} is an ingest of something else ({'; '.join(different)}): --out names another "
            "folder, or remove this one"
        )


def _ingest(
    photos: Path,
    files: list[Path],
    posed: dict[Path, Any] | None,
    out: Path,
    work: Path,
    mapper: Mapper,
    matching: str,
    test_every: int,
) -> Summary:
    seconds: dict[str, float] = {}
    native = partial(in_child, log=work / "colmap.log")
    folder, database = work / "photos", work / "database.db"
    with timed(seconds, "looking"):
        seen = look_once(work, photos if photos.is_dir() else photos.parent, files, folder, mapper, upright=not posed)
    names = sorted(s.photo for s in seen if s.photo)
    rejected = len(seen) - len(names)
    log.info("%d photos%s", len(names), f"; {rejected} files rejected" if rejected else "")
    known, poses = known_cameras(posed, seen, photos.parent) if posed else (None, None)
    with timed(seconds, "features"):
        batches = find_features(folder, names, work / "features", shown(mapper, "finding features"))
        if not database.exists():
            native(make_database, database, folder, names, batches, matching, known)
    with timed(seconds, "matching"):
        match_once(work, database, native)
    pairs = inliers(database)
    with timed(seconds, "mapping"):
        if poses:
            found = triangulated(work, database, folder, poses, native)
        else:
            found = mapped(work, database, folder, names, pairs, native)
    with timed(seconds, "undistorting"):
        staging = work / "scene"
        if not (staging / "dense").exists():
            native(undistort, str(found.tried.folder / found.model.folder), str(folder), str(staging / "dense"))
        model = import_pycolmap().Reconstruction(str(staging / "dense" / "sparse"))
    table = split_table(found.model.photos, out.name, test_every)
    atomic_write(staging / f"{out.name}.tsv", table)
    read_scene(staging)
    summary = summarise(out, seen, model, found, pairs, seconds)
    draw_cameras(
        work / "cameras.png", model, f"{out.name}: {len(found.model.photos)} photos, {len(model.points3D)} points"
    )
    transforms.write_transforms(out, model, "dense/images")
    summary.write(work / "summary.json")
    shutil.rmtree(out / "dense", ignore_errors=True)
    (staging / "dense").rename(out / "dense")
    atomic_write(out / f"{out.name}.tsv", table)
    shutil.rmtree(staging)
    return summary


@contextmanager
def timed(seconds: dict[str, float], step: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[step] = round(time.perf_counter() - began, 1)


def look_once(work: Path, root: Path, files: list[Path], photos: Path, mapper: Mapper, *, upright: bool) -> list[Seen]:
    """What each file is, from files.json where that is there."""
    record = work / "files.json"
    if not record.exists():
        seen = look_at(root, files, photos, shown(mapper, "looking at files"), upright=upright)
        atomic_write(record, json.dumps([asdict(s) for s in seen], indent=1) + "\n")
    return [Seen(**{**s, "size": tuple(s["size"])}) for s in json.loads(record.read_text())]


def match_once(work: Path, database: Path, native: Callable[..., None]) -> None:
    """Match the pairs, unless that is done."""
    done = work / "matched"
    if done.exists():
        return
    total = max(1, (work / PAIRS).read_text().count("\n"))
    progress = Progress(f"matching {total} pairs of photos")
    try:
        native(
            match, str(database), str(work / PAIRS), 0, watch=lambda: progress.update(count_matched(database) / total)
        )
    finally:
        progress.close()
    atomic_write(done, "")


def mapped(
    work: Path, database: Path, folder: Path, names: list[str], pairs: dict, native: Callable[..., None]
) -> Found:
    """Poses by structure from motion."""
    groups = components(names, pairs)

    def run(index: int, path: Path) -> None:
        log.info("finding poses, try %d of at most %d: %s", index + 1, len(TRIES), TRIES[index][0])
        native(run_try, str(database), str(folder), str(path), index)
        log.info("  %s", read_try(path).told())

    return find_poses(work / "tries", len(groups[0]) if groups else len(names), run)


def triangulated(work: Path, database: Path, folder: Path, poses: dict, native: Callable[..., None]) -> Found:
    """Points of photos whose poses are known."""
    path = work / "tries" / "0-triangulation"
    if not (path / "verdict.json").exists():
        native(transforms.triangulate, str(database), str(folder), str(path), poses)
    tried = read_try(path)
    if tried.best is None:
        raise CrossrayError(f"the poses and the photos do not agree: {tried.told()}")
    return Found(tried, tried.best, [tried], {})


def known_cameras(
    posed: dict[Path, Any], seen: list[Seen], root: Path
) -> tuple[dict[str, tuple[str, list[float]]], dict[str, np.ndarray]]:
    """Photo -> COLMAP's camera model and parameters, and photo -> world-to-camera."""
    cameras, poses = {}, {}
    for s in (s for s in seen if s.photo):
        intrinsics, pose = posed[(root / s.name).resolve()]
        camera = transforms.camera_of(intrinsics, s.size, s.name, 1)
        cameras[s.photo], poses[s.photo] = (camera.model.name, camera.params.tolist()), pose
    return cameras, poses


def split_table(names: list[str], scene: str, test_every: int) -> str:
    """NeRF-W's table of a scene's photos."""
    rows = [
        f"{name}\t{i + 1}\t{'test' if test_every and i % test_every == 0 else 'train'}\t{scene}\n"
        for i, name in enumerate(sorted(names))
    ]
    return "filename\tid\tsplit\tdataset\n" + "".join(rows)
