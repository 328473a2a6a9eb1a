"""The project's log, as a person at a terminal reads it."""

from __future__ import annotations

import logging
import os

from rich.console import Console
from rich.logging import RichHandler


def set_up_logging() -> None:
    """The project's log to the terminal; only rank 0 says what is not a warning."""
    quiet = os.environ.get("RANK", "0") != "0"
    handler = RichHandler(show_path=False, show_level=False, log_time_format="[%X]", console=Console(stderr=True))
    logger = logging.getLogger("crossray")
    logger.handlers[:] = [handler]
    logger.setLevel(logging.WARNING if quiet else logging.INFO)
    logger.propagate = False
