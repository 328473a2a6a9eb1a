"""The project's log, as a person at a terminal reads it."""

from __future__ import annotations

import logging
import os
import sys

from rich.console import Console
from rich.logging import RichHandler


def plain(text: str) -> str:
    """A text as it can be shown: names of photos may hold what a terminal acts upon."""
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


class PlainFormatter(logging.Formatter):
    """Plain messages."""

    def format(self, record: logging.LogRecord) -> str:
        return plain(super().format(record))


def set_up_logging() -> None:
    """The project's log to the terminal; only rank 0 says what is not a warning."""
    quiet = os.environ.get("RANK", "0") != "0"
    handler: logging.Handler
    if sys.stderr.isatty():
        handler = RichHandler(show_path=False, show_level=False, log_time_format="[%X]", console=Console(stderr=True))
        handler.setFormatter(PlainFormatter("%(message)s"))
    else:  # a file, or a job's log: a message stays on its line, so that it can be searched for
        handler = logging.StreamHandler()
        handler.setFormatter(PlainFormatter("[%(asctime)s] %(message)s", "%H:%M:%S"))
    logger = logging.getLogger("crossray")
    logger.handlers[:] = [handler]
    logger.setLevel(logging.WARNING if quiet else logging.INFO)
    logger.propagate = False
