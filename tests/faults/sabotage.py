"""The command line with something broken on purpose, for processes that tests start: `python sabotage.py run JOB.yaml`.

CROSSRAY_SABOTAGE is a JSON list of lists:

    ["kill", rank, step, marker]        kill -9 this rank before it takes this step, unless the file is there already
    ["kill-uncommitted", step, marker]  kill -9 rank 0 between the files of this checkpoint and its commit
    ["nan", rank, step]                 this rank's loss is not a number in this step
    ["infinite-gradient", step]         the loss is finite, its gradient is not
    ["wait", rank, step, file]          this rank waits before this step until the file is there
    ["patience", seconds]               how long a second run waits for the first
    ["blind", rank]                     this rank sees no checkpoint, as where a network's disk lags behind

A rank that a launcher starts as a process imports this file as well, so the ranks are sabotaged, too.
"""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import torch

from pipeline import checkpoint, resume, train


def kill_once(marker: str) -> None:
    if not Path(marker).exists():
        Path(marker).touch()
        os.kill(os.getpid(), signal.SIGKILL)


def before_step(act):
    """act(rank, step) before each step."""
    original = train.training_step

    def training_step(work, ddp, optimiser, step, record):
        act(work.context.rank, step)
        return original(work, ddp, optimiser, step, record)

    train.training_step = training_step


def kill(rank: int, step: int, marker: str) -> None:
    before_step(lambda r, s: kill_once(marker) if (r, s) == (rank, step) else None)


def wait(rank: int, step: int, file: str) -> None:
    def act(r: int, s: int) -> None:
        while (r, s) == (rank, step) and not Path(file).exists():
            time.sleep(0.02)

    before_step(act)


def kill_uncommitted(step: int, marker: str) -> None:
    original = checkpoint.atomic_write

    def atomic_write(path, content):
        if path.name == checkpoint.META and path.parent.name == checkpoint.folder_name(step):
            kill_once(marker)
        original(path, content)

    checkpoint.atomic_write = atomic_write


def nan(rank: int, step: int) -> None:
    original = train.forward

    def forward(work, ddp, number):
        terms, watched = original(work, ddp, number)
        if (work.context.rank, number) == (rank, step):
            terms["fine"] = terms["fine"] * torch.nan
        return terms, watched

    train.forward = forward


def infinite_gradient(step: int) -> None:
    original = train.forward

    def forward(work, ddp, number):
        terms, watched = original(work, ddp, number)
        if number == step:
            zero = (terms["fine"] - terms["fine"].detach()).abs()
            terms["fine"] = terms["fine"] + zero.sqrt()  # 0, and its slope is infinite
        return terms, watched

    train.forward = forward


def patience(seconds: float) -> None:
    resume.PATIENCE = seconds


def blind(rank: int) -> None:
    original = resume.latest_checkpoint
    resume.latest_checkpoint = lambda folder: None if os.environ.get("RANK") == str(rank) else original(folder)


FAULTS = {
    "kill": kill,
    "kill-uncommitted": kill_uncommitted,
    "nan": nan,
    "infinite-gradient": infinite_gradient,
    "wait": wait,
    "patience": patience,
    "blind": blind,
}

for name, *arguments in json.loads(os.environ.get("CROSSRAY_SABOTAGE", "[]")):
    FAULTS[name](*arguments)

if __name__ == "__main__":
    from pipeline.cli import main

    main()
