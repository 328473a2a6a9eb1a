"""Training on one rank: it learns, resumes to the bit, refuses what is not its own, never saves nonsense."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import shutil
import time
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny_run import assert_same_bits, cut_tiny, final_state, tiny_job, tiny_mapping, tiny_photos, train_until
from tiny_scene import write_tiny_scene

from pipeline import judge
from pipeline import train as module
from pipeline.batches import check_references
from pipeline.board import write_pictures
from pipeline.checkpoint import committed, latest_checkpoint, read_checkpoint, save_checkpoint
from pipeline.config import load_job, make_job, merge
from pipeline.cutting import cut_shards
from pipeline.errors import CrossrayError
from pipeline.evaluate import evaluate_run
from pipeline.launch import run as launch
from pipeline.launch.run import claim_run, ensure_shards, run_job
from pipeline.launch.tasks import in_process
from pipeline.launch.torchrun import pick_device, run_rank
from pipeline.manifest import read_manifest
from pipeline.masks import MaskRecord, encode_mask
from pipeline.photos import open_photos
from pipeline.resume import TrainingError, checkpoints
from pipeline.scene import read_scene
from pipeline.shards import verify_shards
from pipeline.train import train
from pipeline.work import Context


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    """One scene and its shards for all tests of this file."""
    return cut_tiny(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(autouse=True)
def _cache(cut, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(cut / "cache"))


@pytest.fixture
def make(cut, tmp_path):
    """make(method, **train settings): a tiny job whose runs are this test's own."""

    def of(method="crossray", name="tiny", over=None, **settings):
        job = tiny_job(cut, method, {"name": name, "runs": str(tmp_path / "runs"), "train": settings})
        return make_job(merge(job.model_dump(mode="json"), over)) if over else job

    return of


@pytest.fixture
def losses(monkeypatch):
    """Total loss and terms of every step taken."""
    taken: list[dict[str, float]] = []
    step = module.training_step

    def spy(*args):
        terms, watched = step(*args)
        taken.append({k: float(v) for k, v in terms.items()} | {"mse": float(watched["mse"])})
        return terms, watched

    monkeypatch.setattr(module, "training_step", spy)
    return taken


# Learning


@pytest.mark.parametrize("method", ["crossray", "nerf"])
def test_losses_fall(make, losses, method):
    settings = {"epochs": 1, "steps_per_epoch": 40}
    if method == "nerf":
        settings["learning_rates"] = dict.fromkeys(("grid", "field", "appearance", "transient"), 5e-3)
    result = train(make(method, **settings), Context())
    assert result["finished"]
    assert result["steps"] == len(losses) == 40
    first, last = losses[:6], losses[-6:]  # as many steps as show every photo
    for key in ("fine", "mse"):
        assert sum(s[key] for s in last) < 0.7 * sum(s[key] for s in first), key
    assert all(math.isfinite(v) for s in losses for v in s.values())


def test_every_term_of_the_full_method_is_there(make, losses):
    over = {"patch": {"photos": 1}}
    train(make("crnerf", over=over, epochs=1, steps_per_epoch=2), Context())
    assert losses[0].keys() == {"fine", "coarse", "mask", "embedding", "appearance", "content", "mse"}


def test_training_json_says_what_was_done(make):
    job = make("nerf", epochs=2, steps_per_epoch=4)
    result = train(job, Context())
    assert json.loads((job.run / "training.json").read_text()) == result
    expected = {"steps": 8, "ranks": 1, "finished": True, "steps_per_epoch": 4, "rays_a_step": 128, "bfloat16": False}
    assert expected.items() <= result.items()
    assert result["train_seconds"] > 0
    assert [p.name for p in committed(checkpoints(job))] == ["step-00000008"]


def test_an_epoch_by_itself_sees_as_many_rays_as_there_are_pixels(make, cut):
    job = make("nerf", epochs=1, steps_per_epoch="auto")
    assert train(job, Context())["steps"] == 4 * 24 * 18 // 128  # 4 training photos of 24 x 18


def test_a_run_that_has_ended_does_nothing_more(make, losses):
    job = make("nerf")
    first = train(job, Context())
    before = (checkpoints(job) / "step-00000012" / "meta.json").stat().st_mtime_ns
    count = len(losses)
    again = train(job, Context())
    assert len(losses) == count
    assert (again["steps"], again["finished"]) == (first["steps"], True)
    assert again["train_seconds"] == pytest.approx(first["train_seconds"])
    assert (checkpoints(job) / "step-00000012" / "meta.json").stat().st_mtime_ns == before


def test_the_same_job_gives_the_same_bits_and_another_seed_others(make):
    jobs = [make("nerf", "a"), make("nerf", "b"), make("nerf", "c", over={"patch": {"seed": 1}})]
    for job in jobs:
        train(job, Context())
    a, b, c = (final_state(job) for job in jobs)
    assert_same_bits(a, b)
    assert not torch.equal(a[0]["field.fine.density.weight"], c[0]["field.fine.density.weight"])


def test_checkpoints_come_when_asked_and_the_oldest_go(make):
    job = make("nerf", checkpoint_every=2, keep_checkpoints=3)
    train(job, Context())
    assert [p.name for p in committed(checkpoints(job))] == ["step-00000008", "step-00000010", "step-00000012"]


# Exact resume


@pytest.mark.parametrize("method", ["crossray", pytest.param("crnerf", marks=pytest.mark.slow)])
def test_stopped_and_resumed_is_the_same_to_the_bit(make, losses, method):
    over = {"patch": {"photos": 1}} if method == "crnerf" else None
    straight, stopped = (make(method, name, over=over) for name in ("straight", "stopped"))
    assert train(straight, Context())["steps"] == 12
    of_straight = losses[:]
    losses.clear()
    partial = train_until(stopped, 6)
    assert (partial["steps"], partial["finished"]) == (6, False)
    assert [p.name for p in committed(checkpoints(stopped))] == ["step-00000006"]
    final = train(stopped, Context())
    assert (final["steps"], final["finished"]) == (12, True)
    assert losses == of_straight  # every term of every step
    model, optimiser = final_state(stopped)
    expected_model, expected_optimiser = final_state(straight)
    assert_same_bits(dict(model), dict(expected_model), "model")
    assert_same_bits(optimiser, expected_optimiser, "optimiser")


def test_pictures_and_checkpoints_on_the_way_change_nothing(make):
    """Pictures are rendered in evaluation mode, between two steps."""
    plain = make("crossray", "plain")
    busy = make("crossray", "busy", picture_every=2, checkpoint_every=2, log_every=1)
    for job in (plain, busy):
        train(job, Context())
    assert_same_bits(dict(final_state(plain)[0]), dict(final_state(busy)[0]))


def test_a_stop_takes_effect_in_the_step_in_which_it_comes(make):
    job = make("nerf", epochs=4)
    result = train_until(job, 7)
    assert (result["steps"], result["finished"]) == (7, False)
    assert [p.name for p in committed(checkpoints(job))] == ["step-00000007"]


@pytest.mark.parametrize("file", ["model.safetensors", "training.pt"])
def test_a_damaged_checkpoint_falls_back_and_ends_with_the_same_bits(make, file):
    straight, damaged = (
        make("crossray", "straight", checkpoint_every=3),
        make("crossray", "damaged", checkpoint_every=3),
    )
    train(straight, Context())
    assert train_until(damaged, 9)["steps"] == 9
    path = checkpoints(damaged) / "step-00000009" / file
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert train(damaged, Context())["finished"]
    model, optimiser = final_state(damaged)
    expected_model, expected_optimiser = final_state(straight)
    assert_same_bits(dict(model), dict(expected_model))
    assert_same_bits(optimiser, expected_optimiser)
    assert read_checkpoint(path.parent).step == 9  # mended on the way


@pytest.mark.parametrize(
    ("over", "what"),
    [
        ({"train": {"learning_rates": {"field": 0.1}}}, "job"),
        ({"patch": {"seed": 5}}, "job"),
        ({"losses": {"embedding": 1.0}}, "job"),
    ],
    ids=str,
)
def test_another_jobs_checkpoint_is_refused(make, over, what):
    job = make("nerf")
    train(job, Context())
    with pytest.raises(TrainingError, match=rf"other {what}.*--set name=") as error:
        train(make("nerf", over=over), Context())
    assert str(job.run) in str(error.value)


def test_other_shards_are_refused(make, tmp_path):
    job = make("nerf")
    train(job, Context())
    other = tiny_job(cut_tiny(tmp_path / "other", seed=9))
    moved = job.model_copy(update={"scene": other.scene})
    with pytest.raises(TrainingError, match=r"other shards.*--set name="):
        train(moved, Context())


def test_another_number_of_ranks_is_refused(make):
    """Two ranks see other patches than one: the losses would be others without a word."""
    job = make("nerf", epochs=4)
    train_until(job, 10)
    found = latest_checkpoint(checkpoints(job))
    assert found is not None
    meta = {key: found.meta[key] for key in ("shards", "job", "seconds", "finished", "skipped", "steps_per_epoch")} | {
        "world_size": 2
    }
    save_checkpoint(checkpoints(job), 11, found.model, found.optimiser(), meta)
    with pytest.raises(TrainingError, match=r"by 2 ranks, and now there are 1: --set ranks=2 .*any_ranks=true"):
        train(job, Context())


def test_another_number_of_ranks_keeps_the_length_of_an_epoch(make):
    """`auto` gives two ranks half as many steps: the number goes on, whether the job gives it or not."""
    job = make("nerf", epochs=4, steps_per_epoch="auto", any_ranks=True)
    train_until(job, 3)
    found = latest_checkpoint(checkpoints(job))
    assert found is not None
    length = found.meta["steps_per_epoch"]
    meta = {k: v for k, v in found.meta.items() if k not in ("format", "step", "sha256", "digest")}
    save_checkpoint(checkpoints(job), 3, found.model, found.optimiser(), meta | {"steps_per_epoch": 2 * length})
    with pytest.raises(TrainingError, match=rf"of epochs of {2 * length} steps, .* have {length}; --set"):
        train(job, Context())
    with_number = make("nerf", epochs=4, steps_per_epoch=2 * length, any_ranks=True)
    claim_run(job)
    claim_run(with_number)  # not another job: the checkpoint decides
    assert train_until(with_number, 1)["steps"] == 4


def test_where_a_run_lies_does_not_enter_its_identity(make, tmp_path):
    job = make("nerf")
    train_until(job, 6)
    shutil.move(tmp_path / "runs", tmp_path / "moved")
    moved = job.model_copy(update={"runs": tmp_path / "moved"})
    assert train(moved, Context())["steps"] == 12


# Losses that are not finite


def exploding(make, name="tiny", **settings):
    rates = dict.fromkeys(("grid", "field", "appearance", "transient"), 1e30)
    return make("nerf", name, epochs=4, learning_rates=rates, **settings)


def test_a_loss_that_is_not_finite_stops_with_step_term_and_photos(make):
    with pytest.raises(TrainingError, match=r"step \d+: .*loss .*(fine|coarse).*not .*finite") as error:
        train(exploding(make, log_every=1), Context())
    assert re.search(r"photo_00[0125]\.jpg", str(error.value))
    assert "lower learning rate" in str(error.value)


def assert_only_finite_checkpoints(job):
    for target in committed(checkpoints(job)):
        bad = [k for k, v in read_checkpoint(target).model.items() if not v.isfinite().all()]
        assert not bad, f"{target.name} was committed with {bad}"


@pytest.mark.parametrize("log_every", [1, 100])
def test_weights_that_are_not_finite_are_never_committed(make, log_every):
    """Whatever the distance between two logs: a checkpoint must not outrun the check."""
    job = exploding(make, log_every=log_every, checkpoint_every=1)
    with pytest.raises(TrainingError):
        train(job, Context())
    assert_only_finite_checkpoints(job)


def test_a_stop_does_not_commit_weights_that_are_not_finite(make):
    job = exploding(make, log_every=100)
    with pytest.raises(TrainingError):
        train_until(job, 6)
    assert committed(checkpoints(job)) == []


def test_a_gradient_that_is_not_finite_never_reaches_a_checkpoint(make, monkeypatch):
    """The loss of the last step is fine, and its gradient is not: only the weights tell."""
    step = module.training_step

    def poison(work, ddp, optimiser, number, record):
        found = step(work, ddp, optimiser, number, record)
        if number == 11:
            with torch.no_grad():
                next(ddp.parameters()).fill_(math.nan)
        return found

    monkeypatch.setattr(module, "training_step", poison)
    job = make("nerf")
    with pytest.raises(TrainingError):
        train(job, Context())
    assert_only_finite_checkpoints(job)


def test_the_last_good_checkpoint_survives_and_is_named(make, monkeypatch):
    step = module.training_step

    def poison(work, ddp, optimiser, number, record):
        if number == 7:
            with torch.no_grad():
                next(ddp.parameters()).fill_(math.nan)
        return step(work, ddp, optimiser, number, record)

    monkeypatch.setattr(module, "training_step", poison)
    job = make("nerf", log_every=1, checkpoint_every=2)
    with pytest.raises(TrainingError, match="step 7: ") as error:
        train(job, Context())
    assert str(checkpoints(job)) in str(error.value)
    assert [p.name for p in committed(checkpoints(job))][-1] == "step-00000006"
    assert_only_finite_checkpoints(job)


# TensorBoard


def events(job) -> EventAccumulator:
    return EventAccumulator(str(job.run / "tensorboard"), size_guidance={"scalars": 0, "images": 0}).Reload()


def test_tensorboard_has_every_term_and_the_pictures(make):
    job = make("crossray", log_every=3, picture_every=6)
    train(job, Context())
    found = events(job)
    scalars, images = set(found.Tags()["scalars"]), set(found.Tags()["images"])
    assert {
        "loss/fine",
        "loss/mask",
        "loss/embedding",
        "loss/interlevel",
        "loss/total",
        "train/psnr",
        "train/mask_share",
        "learning_rate/grid",
        "learning_rate/field",
        "learning_rate/appearance",
        "learning_rate/transient",
        "speed/rays_per_second",
        "memory/resident_MiB",
        "view/psnr",
    } <= scalars
    assert {"view/rendered", "view/photo", "view/depth", "view/mask"} <= images
    assert [e.step for e in found.Scalars("loss/fine")] == [3, 6, 9, 12]
    assert [e.step for e in found.Images("view/rendered")] == [6, 12]
    total = found.Scalars("loss/total")[0].value
    parts = sum(found.Scalars(tag)[0].value for tag in scalars if tag.startswith("loss/") and tag != "loss/total")
    assert total == pytest.approx(parts, rel=1e-5)
    picture = found.Images("view/rendered")[0]
    assert (picture.width, picture.height) == (24, 18)  # the validation photo, small enough to be whole


def test_tensorboard_shows_the_learning_rate_of_the_step(make):
    job = make("nerf", log_every=3)
    train(job, Context())
    shown = [e.value for e in events(job).Scalars("learning_rate/field")]
    assert shown == pytest.approx([5e-4, 5e-4, 1e-8 + (5e-4 - 1e-8) / 2, 1e-8 + (5e-4 - 1e-8) / 2], rel=1e-5)


def test_tensorboard_of_a_resumed_run_has_each_step_once(make):
    job = make("nerf", log_every=1, checkpoint_every=100)
    train_until(job, 6)
    train(job, Context())
    assert [e.step for e in events(job).Scalars("loss/fine")] == list(range(1, 13))


def test_a_picture_that_cannot_be_written_leaves_the_model_in_training(make):
    """Else BatchNorm would use its running averages from here on."""
    job = make("crossray")
    photos = open_photos(job.shards)
    model = module.build_model(job, photos, torch.device("cpu"))

    class Full:
        def add_image(self, *args, **kwargs):
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        write_pictures(Full(), 3, model, photos)
    assert model.training


def test_without_a_validation_photo_a_training_photo_is_shown(make, tmp_path):
    write_tiny_scene(tmp_path / "scene", photos=2, splits=["train", "train"])
    job = tiny_job(tmp_path, "nerf", {"train": {"epochs": 1, "steps_per_epoch": 1}})
    cut_shards(job.scene.path, job.shards, downscale=2, reference_downscale=1, plan=job.patch, mapper=in_process)
    train(job, Context())
    assert "view/rendered" in events(job).Tags()["images"]


# Time


def test_a_budget_of_seconds_is_kept(make):
    began = time.monotonic()
    job = make("nerf", seconds=0.6)
    result = train(job, Context())
    wall = time.monotonic() - began
    assert result["finished"]
    assert result["steps"] > 0
    assert 0.6 <= result["train_seconds"] <= wall
    assert result["train_seconds"] < 0.6 + 2  # generous: a step takes about 10 ms
    assert [p.name for p in committed(checkpoints(job))] == [f"step-{result['steps']:08d}"]


@pytest.mark.slow
def test_a_stopped_budget_goes_on_from_its_clock(make):
    job = make("nerf", seconds=1.0)
    first = train_until(job, 10)
    assert not first["finished"]
    again = train(job, Context())
    assert again["finished"]
    assert again["steps"] > first["steps"]
    assert again["train_seconds"] >= 1.0
    assert train(job, Context())["steps"] == again["steps"]  # the budget is spent


# The run's folder


def test_claim_run_writes_the_resolved_job(make):
    job = make("nerf")
    claim_run(job)
    assert load_job(job.run / "job.yaml") == job
    claim_run(job)  # the same job again


def test_claim_run_refuses_a_changed_job_and_shows_the_key(make):
    job = make("nerf")
    claim_run(job)
    with pytest.raises(CrossrayError, match=r"train\.epochs: 2 -> 3") as error:
        claim_run(make("nerf", epochs=3))
    assert "--set name=" in str(error.value)
    assert "patch" not in str(error.value)  # only what differs
    with pytest.raises(CrossrayError, match=r"train\.learning_rates\.grid: 0\.0005 -> 0\.5"):
        claim_run(make("nerf", learning_rates={"grid": 0.5}))
    assert load_job(job.run / "job.yaml") == job  # the refused ones left no trace


def test_claim_run_lets_where_and_when_change(make):
    job = make("nerf")
    claim_run(job)
    changed = make("nerf", over={"launcher": "torchrun", "threads": 2, "evaluate": {"protocols": ["crnerf-full@R2"]}})
    claim_run(changed)
    assert load_job(job.run / "job.yaml") == changed


def test_shards_of_another_size_are_refused(make):
    job = make("nerf", over={"scene": {"downscale": 3}})
    with pytest.raises(CrossrayError, match=r"scene\.downscale: the job says 3.*cut with 2.*scene\.shards"):
        ensure_shards(job)


def test_shards_of_another_scene_are_refused(make, tmp_path):
    write_tiny_scene(tmp_path / "other", photos=5)
    job = make("nerf", over={"scene": {"path": str(tmp_path / "other")}})
    with pytest.raises(CrossrayError, match=r"cut from another scene.*scene\.shards"):
        ensure_shards(job)


def test_a_model_that_is_the_one_of_the_shards_is_not_read_again(make, cut, tmp_path, monkeypatch):
    shutil.copytree(cut / "scene", tmp_path / "scene")
    job = make("nerf", over={"scene": {"path": str(tmp_path / "scene")}})
    read = []
    monkeypatch.setattr(launch, "read_scene", lambda *a, **k: read.append(1) or read_scene(*a, **k))
    assert ensure_shards(job) == read_manifest(job.shards)
    assert not read
    table = next((tmp_path / "scene").glob("*.tsv"))
    table.write_text(table.read_text() + "\n")  # says the same
    assert ensure_shards(job) == read_manifest(job.shards)
    assert read
    table.write_text(table.read_text().replace("val", "train"))
    with pytest.raises(CrossrayError, match="before it changed"):
        ensure_shards(job)


def test_a_scene_that_is_a_file_is_refused(make, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(CrossrayError, match=r"scene\.path: .* is a file"):
        ensure_shards(make("nerf", over={"scene": {"path": str(tmp_path / "file")}}))


def test_shards_train_without_their_scene(make, tmp_path):
    manifest = ensure_shards(make("nerf", over={"scene": {"path": str(tmp_path / "not here")}}))
    assert len(manifest.keys) == 6


def test_a_first_try_with_a_wrong_scene_does_not_claim_the_name(make, tmp_path):
    wrong = make("nerf", over={"scene": {"path": str(tmp_path / "no"), "shards": str(tmp_path / "none")}})
    with pytest.raises(CrossrayError, match=r"scene\.path"):
        run_job(wrong)
    assert run_job(make("nerf"))[0]["finished"]


def test_missing_shards_are_cut(make, monkeypatch, tmp_path):
    monkeypatch.setattr(launch, "ray_tasks", lambda: nullcontext(in_process))
    job = make("nerf", over={"scene": {"shards": str(tmp_path / "new" / "shards")}})
    ensure_shards(job)
    assert len(verify_shards(job.shards).keys) == 6


@pytest.fixture
def masked(make, cut, tmp_path, monkeypatch):
    """A job with fixed masks on a copy of the scene whose masks may be changed, and how often its shards were cut."""
    shutil.copytree(cut / "scene", tmp_path / "scene")
    cuts: list[int] = []

    def counted():
        cuts.append(1)
        return nullcontext(in_process)

    monkeypatch.setattr(launch, "ray_tasks", counted)
    over = {"scene": {"path": str(tmp_path / "scene"), "shards": str(tmp_path / "masked")}}
    return make("crnerf-a-masks", over=over), cuts


def test_changed_masks_are_cut_into_the_shards_again(masked):
    job, cuts = masked
    before = ensure_shards(job)
    assert ensure_shards(job) == before
    assert len(cuts) == 1
    mask = np.array(Image.open(job.scene.path / "masks" / "photo_000.png"))
    Image.fromarray(255 - mask).save(job.scene.path / "masks" / "photo_000.png")
    after = ensure_shards(job)
    assert len(cuts) == 2
    assert after.content_hash != before.content_hash
    np.testing.assert_array_equal(open_photos(job.shards).mask(0) > 127, (255 - mask)[::2, ::2] > 127)


def test_a_dropped_photo_needs_no_mask(masked):
    job, cuts = masked
    photo = next((job.scene.path / "dense").rglob("photo_000.*"))
    photo.write_bytes(b"")
    (job.scene.path / "masks" / "photo_000.png").unlink()
    with pytest.raises(CrossrayError, match="holds no mask of photo_000"):
        ensure_shards(job)
    dropping = job.model_copy(update={"scene": job.scene.model_copy(update={"on_bad_photo": "drop"})})
    assert len(ensure_shards(dropping).keys) == 5
    assert ensure_shards(dropping).dropped.keys() == {photo.name}
    assert len(cuts) == 1


def test_with_all_test_photos_dropped_nothing_is_trained(make, cut, tmp_path, monkeypatch):
    monkeypatch.setattr(launch, "ray_tasks", lambda: nullcontext(in_process))
    shutil.copytree(cut / "scene", tmp_path / "scene")
    for photo in read_scene(tmp_path / "scene").photos:
        if photo.split == "test":
            photo.path.write_bytes(b"")
    scene = {"path": str(tmp_path / "scene"), "shards": str(tmp_path / "left"), "on_bad_photo": "drop"}
    job = make("nerf", over={"scene": scene, "evaluate": {"protocols": ["crnerf-full@R2"]}})
    for _ in range(2):
        with pytest.raises(CrossrayError, match="no test photo"):
            ensure_shards(job)


def test_masks_of_two_origins_are_refused(masked):
    job, cuts = masked
    record = MaskRecord(segmenter="0" * 64, photo="0" * 64, source=None, pixels="0" * 64, share=0.5)
    (job.scene.path / "masks" / "photo_000.png").write_bytes(encode_mask(np.zeros((36, 48), np.uint8), record))
    with pytest.raises(CrossrayError, match="masks of 2 origins"):
        ensure_shards(job)
    assert cuts == []


@pytest.mark.slow
def test_a_run_is_not_scored_on_masks_that_it_was_not_trained_on(masked):
    job, _ = masked
    ensure_shards(job)
    claim_run(job)
    train(job, Context())
    evaluate_run(job.run, "crnerf-full@R2")
    Image.new("L", (48, 36), 255).save(job.scene.path / "masks" / "photo_000.png")
    ensure_shards(job)
    with pytest.raises(CrossrayError, match="other photos or masks than"):
        evaluate_run(job.run, "crnerf-full@R2")


def test_numbers_that_a_closed_form_cannot_use_end_with_step_and_checkpoint(make, monkeypatch):
    job = make("crossray", over={"model": {"transform": "closed_form"}})

    def broken(*_):
        raise ValueError("content_cov has values that are not finite")

    monkeypatch.setattr(module, "forward", broken)
    with pytest.raises(TrainingError, match=r"step 0: content_cov .*checkpoint"):
        train(job, Context())


def test_a_reference_that_is_too_small_is_named(make):
    job = make("crnerf", over={"model": {"mlp": {"width": 16}}})
    photos = open_photos(job.shards)
    with pytest.raises(CrossrayError, match=r"scene\.reference_downscale: 1 makes photo_000\.jpg 48 x 36 .* under 37"):
        check_references(photos, 37)
    check_references(photos, 36)


def test_a_missing_mask_is_named_before_anything_is_cut(masked):
    job, cuts = masked
    (job.scene.path / "masks" / "photo_001.png").unlink()
    (job.scene.path / "masks" / "photo_003.png").unlink()  # of a test photo: not needed
    with pytest.raises(CrossrayError, match=r"model\.transient: fixed.*no mask of photo_001\.jpg; `crossray mask"):
        ensure_shards(job)
    assert cuts == []


def test_shards_without_masks_cannot_train_on_masks(masked, tmp_path):
    job, _ = masked
    shutil.rmtree(job.scene.path / "masks")
    plain = job.model_copy(update={"model": dataclasses.replace(job.model, transient="none")})
    ensure_shards(plain)
    away = job.scene.model_copy(update={"path": tmp_path / "away"})  # the scene stays behind
    with pytest.raises(CrossrayError, match=r"hold no mask of photo_000\.jpg and 3 more"):
        train(job.model_copy(update={"scene": away}), Context())


def test_a_whole_job_trains_and_evaluates(make, monkeypatch):
    monkeypatch.setattr(judge, "find_lpips", lambda: None)
    job = make("nerf", over={"evaluate": {"protocols": ["crnerf-full@R2"]}})
    trained, scores = run_job(job)
    assert trained["finished"]
    assert [s["protocol"] for s in scores] == ["crnerf-full@R2"]
    metrics = job.run / "eval" / "crnerf-full@R2" / "step-00000012" / "metrics.json"
    written = metrics.stat().st_mtime_ns
    assert run_job(job)[1] == scores  # again: nothing is trained or scored twice
    assert metrics.stat().st_mtime_ns == written


@pytest.mark.parametrize("protocol", ["crnerf-ful@R2", "crnerf-full", "crnerf-full@R4"])
def test_a_protocol_that_cannot_be_is_said_before_the_training(make, losses, protocol):
    with pytest.raises(CrossrayError, match="crnerf-ful"):
        run_job(make("nerf", over={"evaluate": {"protocols": [protocol]}}))
    assert losses == []


def test_torchrun_without_torchrun_is_said(make, monkeypatch):
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(CrossrayError, match="torchrun --nproc-per-node=1"):
        run_rank(make("nerf"))


def test_another_number_of_ranks_than_torchruns_is_said(make, monkeypatch):
    for name, value in (("RANK", "0"), ("WORLD_SIZE", "4"), ("LOCAL_RANK", "0")):
        monkeypatch.setenv(name, value)
    with pytest.raises(CrossrayError, match=r"wants 1, torchrun started 4; --set ranks=4"):
        run_rank(make("nerf"))


def test_a_gpu_that_is_not_there_is_said(make, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(CrossrayError, match="--set device=cpu"):
        pick_device(make("nerf", over={"device": "cuda"}), 0)
    assert pick_device(make("nerf", over={"device": "auto"}), 3) == torch.device("cpu")


def test_the_tiny_scene_is_what_these_tests_think(cut):
    photos = tiny_photos(cut)
    assert photos.indices("train") == (0, 1, 2, 5)
    assert (photos.indices("test"), photos.indices("val")) == ((3,), (4,))
    assert photos.image(0).shape == (18, 24, 3)
    assert tiny_mapping(cut)["scene"]["downscale"] == 2
