"""Recording a camera path: key views, one after the other, saved for `crossray render`."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING

from pipeline.errors import CrossrayError
from pipeline.viewer.recording import MOST_KEYS, Key, render_line, save_path
from pipeline.viewer.telling import told

if TYPE_CHECKING:
    from viser import ClientHandle

SHORTEST, LONGEST = 0.1, 60.0  # seconds between two key views


class PathTab:
    """The controls in the container that is open, and the key views so far."""

    def __init__(self, client: ClientHandle, run: Path, scale: float, here: Callable[[], Key]) -> None:
        """
        Args:
            scale: COLMAP units per scene unit.
            here: what is seen now.
        """
        self._run, self._scale, self._here = run, scale, here
        self._lock = RLock()
        self.keys: list[Key] = []
        gui = client.gui
        gui.add_html('<div style="padding:0 10px 6px;font-size:12px;opacity:.7">Fly to a view, add it; the film goes '
                     "smoothly from each key view to the next.</div>")  # fmt: skip
        add = gui.add_button("Add key view", hint="Where you are, in the appearance that you see")
        self._list = gui.add_html("")
        self._seconds = gui.add_number(
            "Seconds", 2.0, min=SHORTEST, max=LONGEST, step=0.1, hint="From one key view to the next, on average"
        )
        self._name = gui.add_text("Name", "path")
        save = gui.add_button("Save path")
        self._said = gui.add_html("")
        remove = gui.add_button("Remove the last", color="gray")
        clear = gui.add_button("Clear", color="gray")
        add.on_click(told(client, self._add))
        remove.on_click(told(client, self._remove))
        clear.on_click(told(client, self._clear))
        save.on_click(told(client, self._save))
        self._show()

    def _add(self) -> None:
        with self._lock:
            if len(self.keys) >= MOST_KEYS:
                raise CrossrayError(f"a path of more than {MOST_KEYS} key views; save this one, and begin another")
            self.keys.append(self._here())
            self._show()

    def _remove(self) -> None:
        with self._lock:
            del self.keys[-1:]
            self._show()

    def _clear(self) -> None:
        with self._lock:
            self.keys.clear()
            self._said.content = ""
            self._show()

    def _save(self) -> None:
        with self._lock:
            seconds = min(max(float(self._seconds.value), SHORTEST), LONGEST)
            file = save_path(self._run, self._name.value, self.keys, seconds, self._scale)
        self._said.content = (
            '<div class="crossray-saved" style="padding:0 10px 8px;font-size:12px">Saved. Make a film of it by<br>'
            f'<code style="user-select:all;overflow-wrap:anywhere">{escape(render_line(self._run, file))}</code></div>'
        )

    def _show(self) -> None:
        rows = "".join(f"<li>{escape(key.said or 'view')}</li>" for key in self.keys) or "<i>no key view yet</i>"
        self._list.content = (
            '<ol class="crossray-keys" style="margin:0 10px 8px;padding-left:22px;max-height:130px;overflow:auto;'
            f'font-size:12px">{rows}</ol>'
        )
