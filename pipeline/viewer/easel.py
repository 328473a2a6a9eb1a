"""The one thread that renders, for all browsers in turn: a slice of work for each, latest wishes only."""

from __future__ import annotations

import logging
from collections.abc import Callable
from threading import Condition, Thread

from pipeline.viewer.standing import Shown, Standing

logger = logging.getLogger(__name__)

Deliver = Callable[[Shown], None]


class Easel:
    """Renders what its browsers stand before, until it is closed."""

    def __init__(self) -> None:
        self._standing: dict[int, tuple[Standing, Deliver]] = {}
        self._wake = Condition()
        self._open = True
        self._thread = Thread(target=self._work, daemon=True, name="easel")
        self._thread.start()

    def add(self, who: int, standing: Standing, deliver: Deliver) -> None:
        """Draw for a browser; `deliver` is called on the easel's thread with every picture."""
        with self._wake:
            self._standing[who] = standing, deliver
            self._wake.notify()

    def remove(self, who: int) -> None:
        """Forget a browser and all that was kept for it."""
        with self._wake:
            self._standing.pop(who, None)

    def wake(self) -> None:
        """Someone wishes for something else."""
        with self._wake:
            self._wake.notify()

    def close(self) -> None:
        """Stop after the slice at hand."""
        with self._wake:
            self._open = False
            self._wake.notify()
        self._thread.join(timeout=5)

    def _work(self) -> None:
        while (found := self._next()) is not None:
            who, standing, deliver = found
            try:
                shown = standing.advance()
                if shown is not None:
                    deliver(shown)
            except Exception:  # one browser's trouble must not leave all others without pictures
                logger.exception("a picture could not be drawn; its browser is left out until it is loaded again")
                self.remove(who)

    def _next(self) -> tuple[int, Standing, Deliver] | None:
        """The browser that waited longest of those with a wish, once there is one; None when closed."""
        with self._wake:
            while self._open:
                for who, (standing, deliver) in self._standing.items():
                    if not standing.idle:
                        self._standing[who] = self._standing.pop(who)  # to the end of the row
                        return who, standing, deliver
                self._wake.wait()
            return None
