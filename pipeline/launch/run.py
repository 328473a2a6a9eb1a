"""A training job from its first stage to its last: shards if they are absent, training, evaluation."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Mapping
from contextlib import nullcontext
from importlib.util import find_spec
from typing import Any

from filelock import FileLock

from pipeline.config import BOOKKEEPING, Job, flatten, read_saved, save_job
from pipeline.cutting import cut_shards, mask_path, masks_hash, scene_record
from pipeline.errors import CrossrayError
from pipeline.evaluate import run_protocols
from pipeline.heartbeat import Heartbeat, driver_path
from pipeline.launch.local import run_local
from pipeline.launch.reeval import each_checkpoint, evaluate_rest, evaluation_tasks
from pipeline.launch.tasks import ray_session, ray_tasks
from pipeline.launch.torchrun import pick_device, run_rank
from pipeline.least_memory import check_memory
from pipeline.manifest import MANIFEST, Manifest, read_manifest
from pipeline.masks import read_record
from pipeline.memory import give_back
from pipeline.progress import shown
from pipeline.protocol import check_protocols
from pipeline.scene import Scene, fingerprint, read_scene

log = logging.getLogger("crossray")

# Keys that may change between two starts of one run: they decide where and when, not what comes out; or the checkpoint
# tells whether they may (pipeline/resume.py).
FREE_KEYS = (
    *("launcher", "device", "threads", "runs", "evaluate", "ray"),
    *("ranks", "train.steps_per_epoch"),
    *(f"train.{key}" for key in BOOKKEEPING),
)


def run_job(job: Job) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Run a training job; a job that has run before goes on from where it was.

    Returns:
        What training.json holds, and what each protocol's metrics.json holds (empty on ranks other than 0).

    Raises:
        CrossrayError: anything that the user has to put right.
    """
    check_protocols(job)
    launcher = launcher_of(job)
    check_each_checkpoint(job, launcher)
    if launcher == "ray":
        return run_on_ray(job)
    if launcher == "local":
        # A job that wants more than there is says so before anything is started.
        check_memory(job, pick_device(job, job.ranks - 1))
    ensure_shards(job)
    claim_run(job)
    if launcher == "torchrun":
        trained = run_rank(job)
        if int(os.environ["RANK"]) != 0:
            return trained, []
    else:
        enter(job, "starting ranks")
        trained = run_local(job)
    if not trained["finished"]:
        return trained, []
    enter(job, "evaluating")
    return trained, run_protocols(job)


def run_on_ray(job: Job) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Like run_job, with one Ray for all stages: shards and evaluation are its tasks."""
    from pipeline.launch.ray_train import check_cluster, run_ray

    with ray_session():
        check_cluster(job)  # a job that wants more than there is says so before anything is started
        ensure_shards(job)
        claim_run(job)
        enter(job, "starting ranks")
        with each_checkpoint(job) if job.evaluate.each_checkpoint else nullcontext():
            trained = run_ray(job)
        if not trained["finished"]:
            return trained, []
        enter(job, "evaluating")
        if job.evaluate.each_checkpoint:
            evaluate_rest(job)
        with evaluation_tasks() as mapper:
            return trained, run_protocols(job, mapper)


def enter(job: Job, stage: str) -> None:
    """Tell those who watch what this process does now."""
    Heartbeat(driver_path(job.run)).beat(stage)


def check_each_checkpoint(job: Job, launcher: str) -> None:
    """CrossrayError where a job wants evaluations beside its ranks, and nobody has a place for them."""
    if job.evaluate.each_checkpoint and launcher != "ray":
        raise CrossrayError(
            f"evaluate.each_checkpoint: launcher {launcher} has no place for evaluations beside the ranks; --set "
            "evaluate.each_checkpoint=false, and start jobs/reeval.yaml beside the training"
        )


def launcher_of(job: Job) -> str:
    """Who starts the ranks: what the job says; `auto` is decided by what is around this process."""
    if job.launcher != "auto":
        return job.launcher
    if "RANK" in os.environ:
        return "torchrun"
    return "ray" if os.environ.get("RAY_ADDRESS") else "local"


def claim_run(job: Job) -> None:
    """Record the resolved job in the run's folder.

    Raises:
        CrossrayError: the folder holds a run of another job; the message shows what differs.
    """
    path = job.run / "job.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(job.run / ".job.lock"):
        if path.exists():
            before = read_saved(path)
            now = flatten(job.model_dump(mode="json"))
            differs = [
                f"  {key}: {before.get(key)!r} -> {now.get(key)!r}"
                for key in sorted(before.keys() | now.keys())
                if before.get(key) != now.get(key) and not key.startswith(FREE_KEYS)
            ]
            if differs:
                raise CrossrayError(
                    f"{job.run} holds a run of another job:\n" + "\n".join(differs) + "\n"
                    "Choose another name (--set name=...), or remove that folder"
                )
        save_job(job, path)


def scene_at_hand(job: Job, manifest: Manifest | None) -> Scene | None:
    """The job's scene, without the photos that its shards lack. Shards may travel without it: None where it is not
    there, or pycolmap is not.
    """
    if not job.scene.path.is_dir() or find_spec("pycolmap") is None:
        return None
    without = manifest.dropped if manifest else {}
    return read_scene(job.scene.path, without=without, drop_missing=job.scene.on_bad_photo == "drop")


def known(job: Job, manifest: Manifest) -> bool:
    """Whether the job's scene is the one of the shards by its files alone, and nothing else of it is asked for."""
    if job.model.transient == "fixed" or not job.scene.path.is_dir() or manifest.source is None:
        return False
    return fingerprint(job.scene.path) == manifest.source


def check_scene(job: Job, scene: Scene, manifest: Manifest) -> None:
    """CrossrayError where the shards were cut from another scene than the one that the job names."""
    if scene_record(scene).hash != manifest.scene.hash:
        raise CrossrayError(
            f"scene.path: the shards in {job.shards} were cut from another scene, or from {job.scene.path} before it "
            "changed; --set scene.shards=FOLDER names other ones, or remove that folder"
        )


def check_test_photos(job: Job, splits: Mapping[str, int]) -> None:
    """CrossrayError where the job is to be evaluated, and its scene has no test photo: said before the training."""
    if job.evaluate.protocols and not splits.get("test"):
        raise CrossrayError(
            f"evaluate.protocols: {', '.join(job.evaluate.protocols)}, but {job.scene.path} has no test photo among "
            f"its {sum(splits.values())}; give some the split 'test', or --set 'evaluate.protocols=[]'"
        )


def check_masks(job: Job, scene: Scene) -> None:
    """CrossrayError where a training photo lacks the mask that the job reads."""
    without = [p.name for p in scene.photos if p.split == "train" and mask_path(scene, p) is None]
    if without:
        more = f" and {len(without) - 1} more training photos" if len(without) > 1 else ""
        raise CrossrayError(
            f"model.transient: fixed, but {scene.root / 'masks'} holds no mask of {without[0]}{more}; "
            f"`crossray mask {scene.root} --with ...` makes masks"
        )
    masks = [path for photo in scene.photos if (path := mask_path(scene, photo))]
    segmenters = {record and record.segmenter for record in map(read_record, masks)}
    if len(segmenters) > 1:
        raise CrossrayError(
            f"{scene.root / 'masks'} holds masks of {len(segmenters)} origins; `crossray mask` with --replace makes "
            "all of them by one"
        )


def ensure_shards(job: Job) -> Manifest:
    """The job's shards, cut by Ray tasks if they are not there, or if the masks that the job reads have changed; a
    Ray that was started for it is gone when this returns.

    Raises:
        CrossrayError: the scene or its masks are missing, or the shards that are there are of another size.
    """
    folder = job.shards
    if job.scene.path.exists() and not job.scene.path.is_dir():
        raise CrossrayError(f"scene.path: {job.scene.path} is a file; it names the folder of a posed scene")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.parent / f".{folder.name}.lock"):
        manifest = read_manifest(folder) if (folder / MANIFEST).is_file() else None
        if manifest is not None and known(job, manifest):
            check_test_photos(job, manifest.splits)
            check_dropped(job, manifest)
            check_sizes(job, manifest)
            return manifest
        manifest = compared(job, scene_at_hand(job, manifest), manifest)
    give_back()  # of a large model, which pycolmap holds outside Python
    return manifest


def compared(job: Job, scene: Scene | None, manifest: Manifest | None) -> Manifest:
    """The job's shards, with a look at its scene if that is at hand: cut if there are none, or of other masks."""
    fixed = job.model.transient == "fixed"
    if scene is not None:
        check_test_photos(job, Counter(photo.split for photo in scene.photos))
        if fixed and (manifest is not None or job.scene.on_bad_photo == "refuse"):
            check_masks(job, scene)
    if manifest is None:
        if scene is None and not job.scene.path.is_dir():
            raise CrossrayError(
                f"scene.path: {job.scene.path} is not a folder, and there are no shards in {job.shards}; "
                "--set scene.path=FOLDER names the posed scene"
            )
        return cut_and_check(job)
    check_dropped(job, manifest)
    if scene is None:
        log.info("%s is not at hand; training on the shards of %s", job.scene.path, manifest.scene.name)
    else:
        check_scene(job, scene, manifest)
    check_sizes(job, manifest)
    if fixed and scene is not None and masks_hash(scene) != manifest.masks:
        log.info("the masks of %s have changed; its shards are cut again", job.scene.path)
        return cut_and_check(job)
    return manifest


def cut_and_check(job: Job) -> Manifest:
    """Shards anew; which photos are left is known only now, where some may be left out."""
    manifest = cut(job)
    if job.scene.on_bad_photo == "drop":
        check_test_photos(job, manifest.splits)
        if job.model.transient == "fixed":
            check_masks(job, read_scene(job.scene.path, without=manifest.dropped))
    return manifest


def cut(job: Job) -> Manifest:
    """Cut the job's shards as Ray tasks."""
    enter(job, "making shards")
    scene = job.scene
    with ray_tasks() as mapper:
        return cut_shards(
            scene.path,
            job.shards,
            downscale=scene.downscale,
            reference_downscale=scene.reference_downscale,
            plan=job.patch,
            mapper=shown(mapper, f"cutting shards of {scene.path.name}"),
            on_bad_photo=scene.on_bad_photo,
        )


def check_dropped(job: Job, manifest: Manifest) -> None:
    """CrossrayError where the shards lack photos, and the job did not say that they may."""
    if manifest.dropped and job.scene.on_bad_photo == "refuse":
        raise CrossrayError(
            f"scene.on_bad_photo: refuse, but the shards in {job.shards} were cut without {len(manifest.dropped)} "
            f"photos ({next(iter(manifest.dropped.values()))}); mend them and remove that folder, or --set "
            "scene.on_bad_photo=drop"
        )
    if manifest.dropped:
        log.warning(
            "%d photos are not in the shards of %s (%s); once they are mended, remove that folder",
            len(manifest.dropped),
            job.shards,
            next(iter(manifest.dropped.values())),
        )


def check_sizes(job: Job, manifest: Manifest) -> None:
    """CrossrayError where the shards were cut at other sizes than the job's."""
    for key in ("downscale", "reference_downscale"):
        if getattr(manifest, key) != getattr(job.scene, key):
            raise CrossrayError(
                f"scene.{key}: the job says {getattr(job.scene, key)}, but the shards in {job.shards} were cut with "
                f"{getattr(manifest, key)}; --set scene.shards=FOLDER names other ones"
            )
