"""The command line with one function that waits before its first call: python waiting.py HERE MODULE:NAME WORDS...

The file HERE appears when it waits; only a signal ends that.
"""

from __future__ import annotations

import importlib
import sys
import threading
from operator import attrgetter
from pathlib import Path


def main() -> None:
    here, target, *words = sys.argv[1:]
    module, _, name = target.partition(":")
    *owners, attribute = name.split(".")
    owner = importlib.import_module(module)
    for step in owners:
        owner = getattr(owner, step)
    original = attrgetter(attribute)(owner)

    def waiting(*arguments: object, **more: object) -> object:
        if not Path(here).exists():
            Path(here).touch()
            threading.Event().wait()
        return original(*arguments, **more)

    setattr(owner, attribute, waiting)
    sys.argv = ["crossray", *words]
    from pipeline.cli import main as crossray

    crossray()


if __name__ == "__main__":
    main()
