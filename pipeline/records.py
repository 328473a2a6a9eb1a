"""What a measured number is, and where it comes from: the records that all tables are made of."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from pipeline.timing import TimingRow

PROTOCOL = re.compile(r"(?P<name>[a-z0-9-]+)@R(?P<downscale>[1-9][0-9]*)(?P<suffix>\+[a-z]+)?")


@dataclass(frozen=True)
class Source:
    """Where a number comes from."""

    file: str
    run: str | None = None
    command: str | None = None
    commit: str | None = None
    date: str | None = None
    hardware: str | None = None
    settings: tuple[str, ...] = ()
    """What is not as the method's recipe has it, and is not said in the row."""
    notes: tuple[str, ...] = ()
    """What a reader has to know beside."""


class Budget(NamedTuple):
    """What a training was given."""

    seconds: float | None  # instead of epochs
    epochs: int | None
    steps_per_epoch: int | str | None
    ranks: int
    threads: int  # of a rank, on CPU
    device: str  # cpu or cuda; "elsewhere" for a released checkpoint that was imported
    machine: str = ""  # what it ran on, where the budget is one of seconds: they are worth what the machine is

    def __str__(self) -> str:
        if self.device == "elsewhere":
            return "imported checkpoint"
        steps = f" × {self.steps_per_epoch:,} steps" if isinstance(self.steps_per_epoch, int) else ""
        units = self.ranks * (self.threads if self.device == "cpu" else 1)
        unit = ("core" if self.device == "cpu" else "GPU") + ("s" if units > 1 else "")
        time = f"{self.seconds:g} s" if self.seconds is not None else f"{self.epochs} epochs{steps}"
        return f"{time}, {units} {unit}"


ELSEWHERE = Budget(None, None, None, 0, 0, "elsewhere")


class Design(NamedTuple):
    """What was trained."""

    method: str  # a row of METHODS, by its choices
    field: str
    changes: tuple[str, ...]  # key=value of the model that are not as the method's recipe on this field has them
    masks: str  # of fixed masks: deeplabv3 or maskrcnn where the run's name says so, else "unnamed"; "" without


class Column(NamedTuple):
    """What all numbers in a column of ours have in common."""

    scene: str
    protocol: str
    meaning: tuple[str, ...]
    field: str
    budget: Budget
    reference: int
    photos: frozenset[str]
    """Names of the scored photos; empty where nothing was measured yet."""


@dataclass(frozen=True)
class Score:
    """One checkpoint under one protocol, photo by photo."""

    scene: str
    protocol: str
    meaning: tuple[str, ...]
    """What of the protocol's definition moves scores."""
    design: Design
    rays: int
    """Of a patch."""
    usual_patch: bool
    """Whether patches are as the method's recipe has them."""
    reference: int
    """Downscale of what the appearance is read from."""
    budget: Budget
    seed: int
    steps: int
    images: dict[str, dict[str, float]] = field(hash=False)
    """Photo's name -> metric -> value."""
    checkpoint: str
    """SHA-256."""
    source: Source

    @property
    def column(self) -> Column:
        """The column of a table that it belongs into."""
        return Column(
            self.scene,
            self.protocol,
            self.meaning,
            self.design.field,
            self.budget,
            self.reference,
            frozenset(self.images),
        )


@dataclass(frozen=True)
class Timed:
    """One measured time."""

    row: TimingRow
    source: Source


@dataclass(frozen=True)
class Other:
    """A record of a benchmark with a format of its own."""

    content: dict[str, Any]
    source: Source


@dataclass(frozen=True)
class Results:
    """Everything that was found."""

    scores: tuple[Score, ...] = ()
    times: tuple[Timed, ...] = ()
    others: dict[str, Other] = field(default_factory=dict)
    """By the file's name without `.json`."""


def parts_of(protocol: str) -> dict[str, str]:
    """`crnerf-full@R4+fit` -> name, downscale, suffix ("" where there is none)."""
    found = PROTOCOL.fullmatch(protocol)
    return {key: value or "" for key, value in found.groupdict().items()} if found else {}
