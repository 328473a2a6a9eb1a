"""pycolmap, as this project imports it."""

from __future__ import annotations

import signal
import threading
from types import ModuleType


def import_pycolmap() -> ModuleType:
    """pycolmap, which on import takes SIGTERM from Python for a stack trace of its own: Python gets it back.

    Pillow comes first: its PNG encoder, loaded after pycolmap's libraries, corrupts the heap (Pillow 13, pycolmap 4.2).

    Raises:
        ModuleNotFoundError: it is not installed.
    """
    handler = signal.getsignal(signal.SIGTERM)
    import PIL.Image  # noqa: F401
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)
    return pycolmap
