"""Two runs compared to the bit, from what they recorded: every step's losses on every rank, and the checkpoints of the
steps that both have kept.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from pipeline.checkpoint import Checkpoint, committed, read_checkpoint
from pipeline.config import read_saved
from pipeline.errors import CrossrayError
from pipeline.record import Losses, read_losses


class Finding(NamedTuple):
    """One thing that was compared."""

    same: bool
    text: str


class Comparison(NamedTuple):
    """What two runs have in common and what not."""

    findings: list[Finding]
    differing_keys: list[str]

    @property
    def same(self) -> bool:
        """Whether everything that was compared has the same bits."""
        return all(finding.same for finding in self.findings)


def compare_runs(a: Path, b: Path) -> Comparison:
    """Compare two runs.

    Raises:
        CrossrayError: a folder is not a run, or the two have nothing that could be compared.
    """
    jobs = [read_job(run) for run in (a, b)]
    keys = [
        f"{key}: {jobs[0].get(key)!r} -> {jobs[1].get(key)!r}"
        for key in sorted(jobs[0].keys() | jobs[1].keys())
        if key != "name" and jobs[0].get(key) != jobs[1].get(key)
    ]
    findings = compare_losses(a, b) + compare_checkpoints(a, b)
    return Comparison(findings, keys)


def read_job(run: Path) -> dict[str, Any]:
    """A run's job as {"a.b": value}.

    Raises:
        CrossrayError: the folder is not a run.
    """
    path = run / "job.yaml"
    if not path.is_file():
        raise CrossrayError(f"{run} is not a run: it has no job.yaml")
    return read_saved(path)


def compare_losses(a: Path, b: Path) -> list[Finding]:
    """Rank by rank."""
    ours, theirs = read_losses(a), read_losses(b)
    if not ours or not theirs:
        raise CrossrayError(f"{b if ours else a}: no losses are recorded there; has it been trained to a checkpoint?")
    findings = []
    if ours.keys() != theirs.keys():
        findings.append(Finding(False, f"ranks: {len(ours)} in {a}, {len(theirs)} in {b}"))
    for rank in sorted(ours.keys() & theirs.keys()):
        findings.append(compare_rows(rank, ours[rank], theirs[rank]))
    return findings


def compare_rows(rank: int, ours: Losses, theirs: Losses) -> Finding:
    """The steps of one rank; a step that one of the two has not recorded differs."""
    if ours.names != theirs.names:
        return Finding(False, f"rank {rank}: recorded {', '.join(ours.names)} against {', '.join(theirs.names)}")
    steps = min(len(ours.rows), len(theirs.rows))
    differ = ours.rows[:steps].view(np.uint32) != theirs.rows[:steps].view(np.uint32)
    if differ.any():
        step, column = np.argwhere(differ)[0]
        x, y = ours.rows[step, column], theirs.rows[step, column]
        return Finding(
            False,
            f"rank {rank}: {int(differ.any(axis=1).sum())} of {steps} steps differ, the first at step {step}: "
            f"{ours.names[column]} {x:.9g} ({x.view(np.uint32):08x}) against {y:.9g} ({y.view(np.uint32):08x})",
        )
    if len(ours.rows) != len(theirs.rows):
        return Finding(
            False,
            f"rank {rank}: {len(ours.rows)} steps against {len(theirs.rows)}; the first {steps} have the same bits",
        )
    return Finding(True, f"rank {rank}: {len(ours.names)} numbers in each of {steps} steps have the same bits")


def compare_checkpoints(a: Path, b: Path) -> list[Finding]:
    """The checkpoints of the same steps, and always the newest."""
    ours, theirs = ({path.name: path for path in committed(run / "checkpoints")} for run in (a, b))
    if not ours or not theirs:
        raise CrossrayError(f"{b if ours else a}: no committed checkpoint")
    findings = []
    if max(ours) != max(theirs):
        findings.append(Finding(False, f"newest checkpoint: {max(ours)} against {max(theirs)}"))
    for name in sorted(ours.keys() & theirs.keys()):
        findings.append(compare_state(read_checkpoint(ours[name]), read_checkpoint(theirs[name])))
    return findings


def compare_state(ours: Checkpoint, theirs: Checkpoint) -> Finding:
    """Weights, buffers and optimiser of one step."""
    x = {f"model {k}": v for k, v in ours.model.items()} | tensors_of(ours.optimiser(), "optimiser")
    y = {f"model {k}": v for k, v in theirs.model.items()} | tensors_of(theirs.optimiser(), "optimiser")
    name = ours.folder.name
    if x.keys() != y.keys():
        return Finding(False, f"{name}: one of them lacks {', '.join(sorted(x.keys() ^ y.keys())[:3])}")
    differ = [key for key in x if not same_bits(x[key], y[key])]
    if differ:
        more = f" and {len(differ) - 1} more of {len(x)}" if len(differ) > 1 else ""
        return Finding(False, f"{name}: {differ[0]}{more} differ")
    return Finding(True, f"{name}: weights and optimiser ({len(x)} tensors) have the same bits")


def tensors_of(value: Any, name: str) -> dict[str, torch.Tensor]:
    """Every number and tensor in nested dicts and lists, by its place."""
    if isinstance(value, torch.Tensor):
        return {name: value}
    if isinstance(value, dict | list | tuple):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return {k: v for key, item in items for k, v in tensors_of(item, f"{name} {key}").items()}
    return {name: torch.tensor(value, dtype=torch.float64)} if isinstance(value, int | float) else {}


def same_bits(x: torch.Tensor, y: torch.Tensor) -> bool:
    """Equal in type, shape, and every bit."""
    if x.dtype != y.dtype or x.shape != y.shape:
        return False
    return x.reshape(-1).numpy().tobytes() == y.reshape(-1).numpy().tobytes()
