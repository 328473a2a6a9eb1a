"""Signs of life: what each rank of a run writes every few seconds, for people who watch and for whoever has to tell a
run that goes on from one that has died.

    <run>/ranks/rank-<r>.json    host, process, time, stage, step, how far, how long still
    <run>/ranks/driver.json      host, process, and the stage around the training; once a stage
"""

from __future__ import annotations

import json
import logging
import os
import socket
import time
from pathlib import Path
from typing import Any

import psutil

from pipeline.files import atomic_write

log = logging.getLogger("crossray")

INTERVAL = 2.0  # seconds between two beats
SILENCE = 30.0  # seconds without a beat after which a rank on another machine counts as lost
STAGES = ("making shards", "starting ranks", "evaluating")  # of a driver, while there are no ranks or none any more


class Heartbeat:
    """One process's signs of life.

    Args:
        path: the file; its folder is made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.last = -INTERVAL
        self.failed = False

    def due(self) -> bool:
        """Whether it is time for the next one."""
        return time.monotonic() - self.last >= INTERVAL

    def beat(self, stage: str, **facts: Any) -> None:
        """Write one now. A disk that is full is no reason to stop what is going on."""
        self.last = time.monotonic()
        record = {"host": socket.gethostname(), "pid": os.getpid(), "time": time.time(), "stage": stage, **facts}
        try:
            atomic_write(self.path, json.dumps(record))
        except OSError as error:
            if not self.failed:
                log.warning(
                    "%s: cannot be written (%s); `crossray status` will not know how far this is", self.path, error
                )
            self.failed = True


def rank_path(run: Path, rank: int) -> Path:
    """Where a rank writes."""
    return run / "ranks" / f"rank-{rank}.json"


def driver_path(run: Path) -> Path:
    """Where the process writes that takes a run through its stages."""
    return run / "ranks" / "driver.json"


def read_beat(path: Path) -> dict[str, Any] | None:
    """The last sign of life in a file, None if there is none that can be read."""
    try:
        record = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and {"host", "pid", "time", "stage"} <= record.keys() else None


def alive(record: dict[str, Any]) -> bool:
    """Whether the process that wrote this still runs: looked up on this machine, by its age elsewhere."""
    if record["host"] == socket.gethostname():
        try:
            process = psutil.Process(record["pid"])
            return process.status() != psutil.STATUS_ZOMBIE and process.create_time() <= record["time"]
        except psutil.NoSuchProcess:
            return False
    return time.time() - record["time"] < max(SILENCE, 10 * record.get("step_seconds", 0.0))
