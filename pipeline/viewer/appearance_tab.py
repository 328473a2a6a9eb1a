"""Choosing an appearance: the strip of thumbnails, a photo of one's own, a blend of two."""

from __future__ import annotations

from collections.abc import Callable
from threading import RLock
from typing import TYPE_CHECKING, Any

from torch import Tensor

from pipeline.appearances import Read
from pipeline.errors import CrossrayError
from pipeline.viewer.gallery import Gallery
from pipeline.viewer.lights import LARGEST_FILE, plain_name, read_photo, read_upload, too_large
from pipeline.viewer.recording import Light
from pipeline.viewer.strip import chosen_style
from pipeline.viewer.telling import tell, told

if TYPE_CHECKING:
    from viser import ClientHandle, UploadedFile

NO_SECOND = "(none)"
OWN = "my photo: "
OWN_PHOTOS = 3  # of one's own that a browser keeps beside those in use


class AppearanceTab:
    """The controls in the container that is open, and the appearance that they say."""

    def __init__(self, client: ClientHandle, gallery: Gallery, changed: Callable[[], None]) -> None:
        """
        Args:
            changed: called when there is another appearance.
        """
        self.client, self.gallery, self._changed = client, gallery, changed
        self._lock = RLock()  # viser calls back on many threads; each reads what the controls say now
        self.own: dict[str, tuple[Read, bytes]] = {}  # by the name in the lists
        self.F: Tensor | None = read_photo(gallery.painter, gallery.strip[0]).F
        gui = client.gui
        gui.add_html(gallery.style)
        strip = gui.add_button_group("", gallery.strip, hint="The scene as it looked when this photo was taken")
        self._mark = gui.add_html(chosen_style(0))
        self.first = gui.add_dropdown(
            "Appearance", gallery.names, initial_value=gallery.strip[0], hint="Any photo of the scene, by its name"
        )
        if gallery.painter.model.embedding is None:  # or only training photos have an appearance
            self._add_upload()
        self.second = gui.add_dropdown(
            "Blend with", (NO_SECOND, *gallery.names), initial_value=NO_SECOND, hint="A second photo to go towards"
        )
        self.share = gui.add_slider("How far", 0.0, 1.0, 0.01, 0.5, marks=((0.0, "first"), (1.0, "second")))
        self.share.disabled = True
        strip.on_click(told(client, lambda: self.take(strip.value)))
        self.first.on_update(told(client, self._choose))
        self.second.on_update(told(client, self._choose))
        self.share.on_update(told(client, self._choose))

    def _add_upload(self) -> None:
        hint = f"Of this or any other place; at most {LARGEST_FILE // 2**20} MiB"
        button = self.client.gui.add_upload_button("Use my own photo ...", mime_type="image/*", hint=hint)
        button.on_upload(told(self.client, lambda: self._take_upload(button.value)))
        refuse_large_uploads(self.client)

    def take(self, name: str) -> None:
        """Set the first appearance to a photo's, as by the list. CrossrayError: there is no such photo."""
        if name not in self.first.options:
            raise CrossrayError(f"{name[:80]!r} is no photo of this scene")
        self.first.value = name  # type: ignore[misc] # viser's setter, which mypy does not see

    def shares(self) -> tuple[tuple[Light, float], ...]:
        """The photos that the appearance is of, and how much of it each is."""
        with self._lock:
            first, second, share = self._said()
            if second is None:
                return ((self._light(first), 1.0),)
            return (self._light(first), 1 - share), (self._light(second), share)

    def _said(self) -> tuple[str, str | None, float]:
        """Names of the first and second photo (None: one alone), and how far from one to the other."""
        second = self.second.value
        return self.first.value, None if second == NO_SECOND else second, float(self.share.value)

    def _light(self, name: str) -> Light:
        return Light(name.removeprefix(OWN), self.own[name][1]) if name in self.own else Light(name)

    def _choose(self) -> None:
        """Make the appearance that the controls say."""
        with self._lock:
            first, second, share = self._said()
            a = self._read(first)
            b = None if second is None else self._read(second)
            self.F = a.F if b is None else self.gallery.painter.between(a, b, share)
            self.share.disabled = b is None
            self._mark.content = chosen_style(self.gallery.strip.index(first) if first in self.gallery.strip else None)
        self._changed()

    def _read(self, name: str) -> Read:
        return self.own[name][0] if name in self.own else read_photo(self.gallery.painter, name)

    def _take_upload(self, file: UploadedFile) -> None:
        name = plain_name(file.name)
        read = read_upload(self.gallery.painter, name, file.content)
        with self._lock:
            listed = OWN + name
            self.own[listed] = read, file.content
            unused = [n for n in self.own if n not in (listed, self.first.value, self.second.value)]
            for old in unused[: max(0, len(self.own) - OWN_PHOTOS)]:
                del self.own[old]
            self.first.options = (*self.own, *self.gallery.names)
            self.second.options = (NO_SECOND, *self.own, *self.gallery.names)
            if self.first.value == listed:  # another photo of the same name
                self._choose()
            self.first.value = listed  # type: ignore[misc]


def refuse_large_uploads(client: ClientHandle) -> None:
    """Drop a file that says it is too large before its bytes come: viser holds all of them in memory."""
    from viser._messages import FileTransferPartAck, FileTransferStartUpload
    from viser.infra import ClientId

    gui = client.gui

    def begins(_: int, message: Any) -> None:
        if message.size_bytes > LARGEST_FILE:
            gui._drop_uploads_from_client(ClientId(client.client_id))
            done = (message.source_component_uuid, message.transfer_uuid, message.size_bytes, message.size_bytes)
            gui._websock_interface.queue_message(FileTransferPartAck(*done))  # or the button waits for ever
            tell(client, "Not possible", too_large(plain_name(message.filename), message.size_bytes))

    gui._websock_interface.register_handler(FileTransferStartUpload, begins)
