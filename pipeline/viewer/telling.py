"""Telling a browser what its user has to put right."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pipeline.errors import CrossrayError

if TYPE_CHECKING:
    from viser import ClientHandle

SHOWN = 12.0  # seconds


def told(client: ClientHandle, act: Callable[[], None]) -> Callable[[Any], None]:
    """A callback for viser that does `act`; what the user has to put right is a notice in the browser."""

    def callback(_: Any) -> None:
        try:
            act()
        except (CrossrayError, OSError) as error:
            tell(client, "Not possible", str(error))

    return callback


def tell(client: ClientHandle, title: str, text: str) -> None:
    """A red notice, for SHOWN seconds."""
    client.add_notification(title, text, color="red", auto_close_seconds=SHOWN)
