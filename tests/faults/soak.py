"""Kill training again and again, and see that it still ends with the right weights: `make soak` (opt-in, 20 minutes).

Each round trains one run while something is killed every few seconds: a rank, the launcher, or all by kill -9, or
the launcher by SIGTERM; what was killed is started again, by either launcher. In the end every step's losses and all
checkpoints have to be those of a run that nobody disturbed, to the bit.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1]), str(HERE.parent / "pipeline"), str(HERE)]

from real_runs import Running, assert_same_run, finish, small_job  # noqa: E402
from tiny_run import cut_tiny  # noqa: E402

from pipeline.checkpoint import committed  # noqa: E402
from pipeline.config import Job  # noqa: E402
from pipeline.heartbeat import rank_path, read_beat  # noqa: E402
from pipeline.train import checkpoints  # noqa: E402

HOWS = ("rank", "launcher", "all", "SIGTERM")
OPTIONS = {"steps_per_epoch": 1000, "checkpoint_every": 50, "keep_checkpoints": 1000}


def main() -> None:
    """Rounds until the time is over."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    draws, began = random.Random(chosen.seed), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="soak-") as name:
        folder = cut_tiny(Path(name))
        os.environ["CROSSRAY_CACHE"] = str(folder / "cache")
        straight = small_job(folder, "straight", chosen.ranks, **OPTIONS)
        finish(straight, folder)
        rounds = kills = 0
        while rounds == 0 or time.monotonic() - began < 60 * chosen.minutes:
            job = small_job(folder, f"round-{rounds}", chosen.ranks, **OPTIONS)
            killed = one_round(job, folder, draws)
            assert_same_run(job, straight)
            rounds, kills = rounds + 1, kills + len(killed)
            print(f"{time.monotonic() - began:6.0f} s  round {rounds}: survived {', '.join(killed)}", flush=True)
        print(f"{rounds} rounds, {kills} kills: the same bits as undisturbed, every time")


def one_round(job: Job, folder: Path, draws: random.Random) -> list[str]:
    """Train a run to its end; returns what was done to it."""
    killed: list[str] = []
    while True:
        running = Running(job, folder, draws.choice(("local", "torchrun")))
        if comes_further(running, job, draws.uniform(0.0, 4.0)):
            killed.append(draws.choice(HOWS))
            disturb(running, job, killed[-1], draws)
            running.end()
            continue
        status, text = running.end()
        assert status == 0, text
        return killed


def comes_further(running: Running, job: Job, seconds: float) -> bool:
    """Wait for a new checkpoint, so that rounds end, and then some seconds more; False if the run has ended by then."""
    before = len(committed(checkpoints(job)))
    deadline = float("inf")
    while time.monotonic() < deadline:
        if running.process.poll() is not None:
            return False
        if deadline == float("inf") and len(committed(checkpoints(job))) > before:
            deadline = time.monotonic() + seconds
        time.sleep(0.05)
    return True


def disturb(running: Running, job: Job, how: str, draws: random.Random) -> None:
    """Do it; whatever is hit may just have ended by itself."""
    with suppress(ProcessLookupError):
        if how == "rank":
            beat = read_beat(rank_path(job.run, draws.randrange(job.ranks)))
            os.kill(beat["pid"] if beat else running.process.pid, signal.SIGKILL)
        elif how == "launcher":
            running.process.kill()
        elif how == "all":
            os.killpg(running.process.pid, signal.SIGKILL)
        else:
            running.process.send_signal(signal.SIGTERM)


if __name__ == "__main__":
    main()
