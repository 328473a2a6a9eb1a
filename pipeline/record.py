"""Every step's losses, as the bits that they were: what two runs are compared by, and where a bad step is found.

    <run>/losses/rank-<r>.f32    one line of JSON with the names, then a row of float32 a step

The row of a step that was left out, or was not recorded, is NaN. A file grows when a checkpoint is saved, before that
is committed: what a killed run loses here, it trains again.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pipeline.errors import CrossrayError

GRADIENT = "gradient_norm"  # the last number of a row: of the averaged gradient, so the same on all ranks


class Losses(NamedTuple):
    """What a rank has recorded."""

    names: tuple[str, ...]
    rows: np.ndarray  # (steps, names) float32


class BadStep(NamedTuple):
    """A step with numbers that are not finite, and the names of these."""

    step: int
    names: tuple[str, ...]


def record_path(run: Path, rank: int) -> Path:
    """Where a rank writes."""
    return run / "losses" / f"rank-{rank}.f32"


class LossRecord:
    """Takes a row a step. Rows stay on their device until somebody looks.

    Args:
        step: the first step that will be added; of what the file holds, earlier ones stay.
    """

    def __init__(self, path: Path, step: int) -> None:
        self.path = path
        self.names: tuple[str, ...] = ()
        self.step, self.saved = step, step
        self.fresh: list[Tensor | None] = []  # rows that nobody has looked at
        self.seen: list[np.ndarray | None] = []  # rows that are not in the file

    def add(self, numbers: dict[str, Tensor]) -> None:
        """A step's numbers, each a tensor of one element; the same names in every step."""
        self.names = tuple(numbers)
        self.fresh.append(torch.stack([number.detach().float().reshape(()) for number in numbers.values()]))
        self.step += 1

    def leave_out(self) -> None:
        """A step that is not trained on."""
        self.fresh.append(None)
        self.step += 1

    def look(self) -> BadStep | None:
        """Read what is new; the first step with a number that is not finite, if there is one."""
        first = self.step - len(self.fresh)
        rows = [None if row is None else row.cpu().numpy() for row in self.fresh]
        self.fresh = []
        self.seen += rows
        for step, row in enumerate(rows, start=first):
            if row is not None and not np.isfinite(row).all():
                return BadStep(step, tuple(np.array(self.names)[~np.isfinite(row)]))
        return None

    def save(self) -> None:
        """Append what was looked at to the file; safe on the disk when this returns.

        Raises:
            OSError: it cannot be written; the rows are kept for the next try.
        """
        if not self.names:  # every step so far was left out
            return
        nothing = np.full(len(self.names), np.nan, np.float32)
        rows = np.array([nothing if row is None else row for row in self.seen], np.float32).reshape(-1, len(nothing))
        header = json.dumps({"names": self.names}).encode() + b"\n"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab") as file:
            kept = self.kept_rows(header)
            if kept is None:
                file.truncate(0)
                file.write(header)
                kept = 0
            kept = min(kept, self.saved)
            file.truncate(len(header) + kept * nothing.nbytes)
            file.write(np.tile(nothing, self.saved - kept).tobytes())
            file.write(rows.tobytes())
            file.flush()
            os.fsync(file.fileno())
        self.saved += len(rows)
        self.seen = []

    def kept_rows(self, header: bytes) -> int | None:
        """How many whole rows the file holds; None if it is not a record of these names."""
        with self.path.open("rb") as file:
            if file.readline() != header:
                return None
        return (self.path.stat().st_size - len(header)) // (4 * len(self.names))


def read_losses(run: Path) -> dict[int, Losses]:
    """What each rank of a run has recorded, by rank.

    Raises:
        CrossrayError: a file is not a record.
    """
    return {
        int(path.stem.removeprefix("rank-")): read_record(path)
        for path in sorted(record_path(run, 0).parent.glob("rank-*.f32"))
    }


def read_record(path: Path) -> Losses:
    """One rank's record; a row that is half written is left out.

    Raises:
        CrossrayError: the file is not a record.
    """
    head, _, body = path.read_bytes().partition(b"\n")
    try:
        names = tuple(str(name) for name in json.loads(head)["names"])
    except (ValueError, KeyError, TypeError) as error:
        raise CrossrayError(f"{path}: is not a record of losses ({error})") from None
    whole = len(body) // (4 * len(names)) if names else 0
    return Losses(names, np.frombuffer(body, "<f4", whole * len(names)).reshape(whole, len(names)))
