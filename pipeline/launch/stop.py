"""How SIGTERM and Ctrl-C reach those who train, so that they save where they are."""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

log = logging.getLogger("crossray")

LOOK_EVERY = 0.5  # seconds between two looks at a file on what may be a network's disk


class StopFlag:
    """Set by SIGTERM or Ctrl-C: the ranks agree on it, write a checkpoint and return. A later Ctrl-C ends at once."""

    def __init__(self) -> None:
        self.set = False
        self.since = 0.0

    def install(self) -> StopFlag:
        """Listen from now on."""
        signal.signal(signal.SIGTERM, self.stop)
        signal.signal(signal.SIGINT, self.stop)
        return self

    def stop(self, number: int, frame: object) -> None:
        """The handler. One Ctrl-C arrives twice where a launcher hands it to ranks that had it from the terminal."""
        if self.set and number == signal.SIGINT and time.monotonic() - self.since > 2:
            raise KeyboardInterrupt
        if not self.set:
            self.set, self.since = True, time.monotonic()

    def __call__(self) -> bool:
        return self.set


class RankStop(StopFlag):
    """Also set once the launcher that started this rank is gone: nobody else could stop it, or would go on with it."""

    def __init__(self) -> None:
        super().__init__()
        self.launcher = os.getppid()

    def __call__(self) -> bool:
        return self.set or os.getppid() != self.launcher


class StopFile(StopFlag):
    """Set by SIGTERM or Ctrl-C, and seen by processes elsewhere as words in a file. A later Ctrl-C ends at once."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def stop(self, number: int, frame: object) -> None:
        """The handler."""
        first = not self.set
        super().stop(number, frame)
        if first:
            self.path.write_text("stop\n")
            log.info("stopping: what trains saves where it is (Ctrl-C again: nobody waits for it)")


@contextmanager
def stopped_by_signals(path: Path) -> Iterator[StopFile]:
    """SIGTERM and Ctrl-C write to the file `path`; whatever ends the block, nothing of it is left."""
    previous = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    stop = StopFile(path)
    stop.install()
    try:
        yield stop
    finally:
        path.unlink(missing_ok=True)
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """SIGTERM is a Ctrl-C, and both are told. Either may come several times for one wish, to a process and to its
    group: what comes within two seconds of the first does not disturb the cleaning up.
    """
    first: list[float] = []

    def interrupt(number: int, frame: object) -> None:
        now = time.monotonic()
        if not first or now - first[0] > 2:
            first.append(now)
            name = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
            log.info("stopping (%s): what is finished stays, and nothing is half-written", name)
            raise KeyboardInterrupt

    previous = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


class StopRequest:
    """Whether somebody has written to a file that was empty before, or has removed it: its driver is gone then."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.set = False
        self.looked = -LOOK_EVERY

    def __call__(self) -> bool:
        if not self.set and time.monotonic() - self.looked >= LOOK_EVERY:
            self.looked = time.monotonic()
            try:
                self.set = bool(self.path.read_bytes())
            except FileNotFoundError:
                self.set = True
        return self.set
