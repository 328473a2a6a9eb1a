"""One progress line: a bar in a terminal, a log line now and then elsewhere."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

log = logging.getLogger("crossray")

LINE_EVERY = 15.0  # seconds between log lines where there is no terminal


class Progress:
    """Share done with a note and the time left.

    Args:
        title: what is going on.
        start: share already done, in [0, 1].
        enabled: False prints nothing (ranks other than 0).
    """

    def __init__(self, title: str, start: float = 0.0, enabled: bool = True) -> None:
        self.title = title
        self.enabled = enabled
        self.start, self.began = start, time.monotonic()
        self.last_line = self.began
        self.bar: RichProgress | None = None
        if enabled and sys.stdout.isatty():
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                TaskProgressColumn(),
                TimeRemainingColumn(),
                TextColumn("{task.fields[note]}"),
            )
            self.bar = RichProgress(*columns)
            self.task = self.bar.add_task(title, total=1.0, note="")
            self.bar.update(self.task, completed=start)
            self.bar.start()

    def update(self, done: float, note: str = "") -> None:
        """`done` in [0, 1] of the work is over."""
        if self.bar is not None:
            self.bar.update(self.task, completed=done, note=note)
        elif self.enabled and time.monotonic() - self.last_line > LINE_EVERY:
            self.last_line = time.monotonic()
            rate = (done - self.start) / (self.last_line - self.began)
            left = f", {(1 - done) / rate:.0f} s left" if rate > 0 else ""
            log.info("%s: %.0f %%%s  %s", self.title, 100 * done, left, note)

    def close(self) -> None:
        """End the line."""
        if self.bar is not None:
            self.bar.stop()


def shown(mapper: Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]], title: str) -> Callable:
    """`mapper` with a progress line: how many of its tasks are done."""

    def mapped(fn: Callable[[Any], Any], specs: Iterable[Any]) -> Iterator[Any]:
        tasks = list(specs)
        progress = Progress(title)
        try:
            for done, result in enumerate(mapper(fn, tasks), start=1):
                progress.update(done / len(tasks), f"{done} of {len(tasks)}")
                yield result
        finally:
            progress.close()

    return mapped
