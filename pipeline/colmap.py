"""pycolmap, as this project imports it."""

from __future__ import annotations

import signal
import threading
from types import ModuleType


def import_pycolmap() -> ModuleType:
    """pycolmap, which on import takes SIGTERM from Python for a stack trace of its own: Python gets it back.

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    handler = signal.getsignal(signal.SIGTERM)
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap
