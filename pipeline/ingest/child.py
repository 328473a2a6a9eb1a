"""Native code in a process of its own: it can be stopped within a moment, and what it prints goes to a file.

pycolmap's mapper and matcher hold the thread that Python's signal handlers need.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from pipeline.errors import CrossrayError

DIES_WITH_PARENT = 1  # PR_SET_PDEATHSIG


class NativeError(CrossrayError):
    """A process that ended without having done its work."""


def in_child(
    fn: Callable[..., None], *args: Any, log: Path, watch: Callable[[], None] = lambda: None, every: float = 0.5
) -> None:
    """Run `fn(*args)`, a function of a module, in a new process; whatever ends this call ends the process.

    Args:
        log: gets what the process prints.
        watch: called every so many seconds while it runs.

    Raises:
        NativeError: it raised or died; the last line that it printed is in the message.
    """
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=_run, args=(fn, args, str(log), os.getpid()), daemon=True)
    process.start()
    try:
        while process.is_alive():
            process.join(every)
            watch()
    finally:
        if process.is_alive():
            process.kill()
        process.join()
    if process.exitcode:
        printed = log.read_text(errors="replace") if log.exists() else ""
        lines = [line.strip() for line in printed.splitlines() if line.strip()]
        raise NativeError(f"{fn.__name__}: {lines[-1] if lines else 'died'} (exit status {process.exitcode}; {log})")


def _run(fn: Callable[..., None], args: tuple, log: str, parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to both, and the parent decides
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).prctl(DIES_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    try:
        fn(*args)
    except BaseException as error:
        traceback.print_exc()
        print(f"{type(error).__name__}: {error}", flush=True)
        sys.stdout.flush()
        os._exit(1)
