"""`crossray compare`: the same bits are the same, and one bit is a difference that is named."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from tiny_run import cut_tiny, tiny_job, train_until

from pipeline.checkpoint import committed, read_checkpoint, save_checkpoint
from pipeline.compare import compare_runs
from pipeline.config import save_job
from pipeline.errors import CrossrayError
from pipeline.record import record_path
from pipeline.train import train
from pipeline.work import Context

STEPS = 12


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A finished run with checkpoints of steps 6 and 12."""
    folder = cut_tiny(tmp_path_factory.mktemp("compare"))
    job = tiny_job(folder, "crossray", {"train": {"checkpoint_every": 6}})
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(folder / "cache"))
        train(job, Context())
    save_job(job, job.run / "job.yaml")
    return job.run


@pytest.fixture
def other(run, tmp_path) -> Path:
    return Path(shutil.copytree(run, tmp_path / "other"))


def texts(a: Path, b: Path) -> tuple[bool, str]:
    found = compare_runs(a, b)
    return found.same, "\n".join(f.text for f in found.findings)


def test_a_copy_is_the_same(run, other):
    found = compare_runs(run, other)
    assert found.same
    assert [f.text.split(":")[0] for f in found.findings] == ["rank 0", "step-00000006", "step-00000012"]
    assert found.differing_keys == []


def test_one_bit_of_one_loss(run, other):
    path = record_path(other, 0)
    content = bytearray(path.read_bytes())
    header = content.index(b"\n") + 1
    width = (len(content) - header) // STEPS
    place = header + 5 * width  # the first number of step 5
    (bits,) = struct.unpack_from("<I", content, place)
    struct.pack_into("<I", content, place, bits ^ 1)
    path.write_bytes(content)
    same, text = texts(run, other)
    assert not same
    assert "rank 0: 1 of 12 steps differ, the first at step 5: interlevel" in text
    assert f"{bits:08x}" in text
    assert f"{bits ^ 1:08x}" in text


def change_weights(run: Path, change) -> None:
    """Change the tensors of the newest checkpoint, and commit it anew."""
    newest = read_checkpoint(committed(run / "checkpoints")[-1])
    meta = {k: v for k, v in newest.meta.items() if k not in ("format", "step", "sha256", "digest")}
    optimiser, model = newest.optimiser(), newest.model
    change(model, optimiser)
    save_checkpoint(run / "checkpoints", newest.step, model, optimiser, meta)


def test_zeros_of_other_signs_are_other_bits(run, other, tmp_path):
    name = "transform.unzip.weight"

    def plus(model, optimiser):
        model[name] = torch.zeros_like(model[name])

    def minus(model, optimiser):
        model[name] = -torch.zeros_like(model[name])

    zero = Path(shutil.copytree(run, tmp_path / "zero"))
    change_weights(zero, plus)
    change_weights(other, minus)
    same, text = texts(zero, other)
    assert not same
    assert f"step-00000012: model {name} differ" in text


def test_the_optimiser_counts(run, other):
    def change(model, optimiser):
        first = next(iter(optimiser["state"].values()))
        first["exp_avg"].view(-1)[0] += 1

    change_weights(other, change)
    same, text = texts(run, other)
    assert not same
    assert "step-00000012: optimiser state" in text


def test_a_run_that_has_come_less_far_differs(run, tmp_path):
    folder = run.parent.parent
    job = tiny_job(folder, "crossray", {"name": "short", "train": {"checkpoint_every": 6}})
    train_until(job, 7)
    save_job(job, job.run / "job.yaml")
    same, text = texts(run, job.run)
    assert not same
    assert "12 steps against 7; the first 7 have the same bits" in text
    assert "newest checkpoint: step-00000012 against step-00000007" in text


def test_what_the_jobs_say_is_shown(run, other):
    text = (other / "job.yaml").read_text().replace("seed: 0", "seed: 3")
    (other / "job.yaml").write_text(text)
    assert compare_runs(run, other).differing_keys == ["patch.seed: 0 -> 3"]


def test_what_cannot_be_compared_is_refused(run, tmp_path):
    with pytest.raises(CrossrayError, match=r"nowhere is not a run"):
        compare_runs(run, tmp_path / "nowhere")
    empty = tmp_path / "empty"
    empty.mkdir()
    shutil.copy(run / "job.yaml", empty)
    with pytest.raises(CrossrayError, match=r"empty: no losses are recorded"):
        compare_runs(run, empty)
    shutil.copytree(run / "losses", empty / "losses")
    with pytest.raises(CrossrayError, match=r"empty: no committed checkpoint"):
        compare_runs(run, empty)


@pytest.mark.slow
def test_the_command_line(run, other, tmp_path):
    def crossray(*words) -> subprocess.CompletedProcess:
        return subprocess.run(
            [sys.executable, "-m", "pipeline", *map(str, words)], capture_output=True, text=True, check=False
        )

    same = crossray("compare", run, other)
    assert same.returncode == 0, same.stderr
    assert same.stdout.count("the same bits") == 3
    save_file({"x": torch.zeros(1)}, committed(other / "checkpoints")[-1] / "model.safetensors")
    damaged = crossray("compare", run, other)
    assert damaged.returncode == 2
    assert "damaged" in damaged.stderr
    record_path(other, 0).write_bytes(record_path(run, 0).read_bytes()[:-4])
    shutil.rmtree(committed(other / "checkpoints")[-1])
    differs = crossray("compare", run, other)
    assert differs.returncode == 1
    assert "DIFFERS" in differs.stdout
    shown = crossray("status", run.parent)
    assert shown.returncode == 0, shown.stderr
    assert "trained" in shown.stdout
    assert "12 of 12 (100 %)" in shown.stdout
    assert crossray("status", tmp_path / "nothing").returncode == 2
