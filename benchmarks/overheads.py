"""What everything around the training steps costs: starting ranks, checkpoints, starting again after a kill, evaluation
beside the training.

    python benchmarks/overheads.py [--out benchmarks/results/overheads.json]

On the built-in landmark with the fast field, two ranks of one thread, as real processes on this machine; Ray is a
private one, whose own start counts. The faithful method takes two steps, for the size of its checkpoint.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from pipeline.checkpoint import committed
from pipeline.config import Job, make_job
from pipeline.files import atomic_write
from pipeline.heartbeat import rank_path, read_beat
from pipeline.provenance import provenance

STEPS = 400


def crossray(*words: object, cwd: Path, **variables: str) -> subprocess.Popen:
    """The command line as a process of its own."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo"} | variables
    command = [sys.executable, "-m", *map(str, words)]
    log = (cwd / "log.txt").open("ab")
    return subprocess.Popen(command, cwd=cwd, env=environment, stdout=log, stderr=log, start_new_session=True)


def job_of(folder: Path, name: str, *settings: str) -> tuple[Job, list[str]]:
    """A job on the landmark in `folder`, and the words that run it."""
    raw: dict[str, Any] = {
        "name": name,
        "method": "crossray",
        "scene": {"path": "scene", "downscale": 1, "reference_downscale": 1},
        "ranks": 2,
        "device": "cpu",
        "train": {"epochs": 1, "steps_per_epoch": STEPS, "picture_every": 100000},
    }
    (folder / f"{name}.yaml").write_text(json.dumps(raw))  # JSON is YAML
    words = ["pipeline", "run", f"{name}.yaml", *(w for s in settings for w in ("--set", s))]
    return make_job(raw, settings), words


def finish(process: subprocess.Popen, folder: Path) -> None:
    """Wait for a good end."""
    if process.wait() != 0:
        sys.exit(f"a run failed; see {folder / 'log.txt'}")


def result_of(folder: Path, job: Job) -> dict[str, Any]:
    """training.json of a run."""
    return json.loads((folder / job.run / "training.json").read_text())


def first_beat(folder: Path, job: Job, process: subprocess.Popen, not_of: int | None = None) -> float:
    """Wait until rank 0 (another process than `not_of`) has taken a step; the moment."""
    path = rank_path(folder / job.run, 0)
    while (beat := read_beat(path)) is None or beat["pid"] == not_of:
        if process.poll() is not None:
            sys.exit(f"a run ended early; see {folder / 'log.txt'}")
        time.sleep(0.01)
    return time.monotonic()


def starts(folder: Path) -> dict[str, float]:
    """Seconds from the command to the end of the first step, for each launcher."""
    seconds = {}
    for launcher in ("local", "torchrun", "ray"):
        job, words = job_of(folder, f"start-{launcher}", f"launcher={launcher}")
        if launcher == "torchrun":
            words = ["torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m", *words]
        began = time.monotonic()
        process = crossray(*words, cwd=folder)
        seconds[launcher] = first_beat(folder, job, process) - began
        finish(process, folder)
    return seconds


def restarts(folder: Path) -> dict[str, float]:
    """Seconds from the kill -9 of rank 1 to the end of the next step, torchrun and Ray starting the ranks again."""
    seconds = {}
    for launcher in ("torchrun", "ray"):
        job, words = job_of(folder, f"kill-{launcher}", f"launcher={launcher}", "train.checkpoint_every=50")
        if launcher == "torchrun":
            options = ["--standalone", "--nproc-per-node=2", "--max-restarts=1", "--monitor-interval=0.1"]
            words = ["torch.distributed.run", *options, "-m", *words]
        process = crossray(*words, cwd=folder, TORCH_DISABLE_SHARE_RDZV_TCP_STORE="1")
        first_beat(folder, job, process)
        while not committed(folder / job.run / "checkpoints"):
            time.sleep(0.01)
        pids = [read_beat(rank_path(folder / job.run, rank))["pid"] for rank in (0, 1)]  # type: ignore[index]
        os.kill(pids[1], signal.SIGKILL)
        began = time.monotonic()
        seconds[launcher] = first_beat(folder, job, process, not_of=pids[0]) - began
        finish(process, folder)
    return seconds


def checkpoints(folder: Path) -> list[dict[str, Any]]:
    """Bytes and time of a checkpoint, and its share of the training at the interval of the method's recipe."""
    rows = []
    for name, settings in (
        ("crossray", ["train.checkpoint_every=20"]),
        ("crnerf", ["method=crnerf", "ranks=1", "train.steps_per_epoch=2", "train.checkpoint_every=1"]),
    ):
        job, words = job_of(folder, f"checkpoint-{name}", *settings)
        usual = make_job({"name": "usual", "method": name, "scene": {"path": "scene"}}).train.checkpoint_every
        finish(crossray(*words, cwd=folder), folder)
        result = result_of(folder, job)
        count = result["steps"] // job.train.checkpoint_every
        newest = committed(folder / job.run / "checkpoints")[-1]
        seconds = result["checkpoint_seconds"] / count
        step = (result["train_seconds"] - result["checkpoint_seconds"]) / result["steps"]
        rows.append(
            {
                "method": name,
                "ranks": result["ranks"],
                "bytes": sum(path.stat().st_size for path in newest.iterdir()),
                "checkpoint_seconds": seconds,
                "step_seconds": step,
                "every": usual,
                "share": seconds / (usual * step),
            }
        )
    return rows


def beside(folder: Path) -> dict[str, float]:
    """Seconds a step of one rank under Ray, alone and with each checkpoint evaluated on the other core."""
    seconds = {}
    for name, settings in (
        ("alone", []),
        ("with evaluation", ["evaluate.each_checkpoint=true", "evaluate.protocols=[crnerf-full@R1]"]),
    ):
        common = ["launcher=ray", "ranks=1", "train.checkpoint_every=100", "train.steps_per_epoch=1000"]
        job, words = job_of(folder, f"beside-{name.split()[0]}", *common, *settings)
        finish(crossray(*words, cwd=folder), folder)
        result = result_of(folder, job)
        seconds[name] = (result["train_seconds"] - result["checkpoint_seconds"]) / result["steps"]
    return seconds


def main() -> None:
    """Measure, print, record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="overheads-") as name:
        folder = Path(name)
        finish(crossray("pipeline", "landmark", "scene", cwd=folder), folder)
        finish(crossray("pipeline", "shard", "scene", "--out", "shards/scene-R1", "--downscale", "1",
                        "--reference-downscale", "1", cwd=folder), folder)  # fmt: skip
        found = {
            "provenance": provenance(),
            "seconds_to_the_first_step": starts(folder),
            "seconds_from_a_kill_to_the_next_step": restarts(folder),
            "checkpoints": checkpoints(folder),
            "seconds_a_step_beside_evaluation": beside(folder),
        }
    for what in ("seconds_to_the_first_step", "seconds_from_a_kill_to_the_next_step"):
        print(f"{what.replace('_', ' ')}: " + ", ".join(f"{k} {v:.1f}" for k, v in found[what].items()))
    print("| method | ranks | MB | ms a checkpoint | ms a step | every | share of the training |\n" + "|---" * 7 + "|")
    for row in found["checkpoints"]:
        print(
            f"| {row['method']} | {row['ranks']} | {row['bytes'] / 1e6:.1f} | {1e3 * row['checkpoint_seconds']:.0f} | "
            f"{1e3 * row['step_seconds']:.0f} | {row['every']} | {100 * row['share']:.2f} % |"
        )
    print("ms a step: " + ", ".join(f"{k} {1e3 * v:.1f}" for k, v in found["seconds_a_step_beside_evaluation"].items()))
    if options.out:
        atomic_write(options.out, json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
