"""One browser: its controls, and what it sees. Nothing is shared with other browsers but the model and its thread."""

from __future__ import annotations

from html import escape
from threading import Lock
from typing import TYPE_CHECKING, Any

from torch import Tensor

from pipeline.errors import CrossrayError
from pipeline.viewer.appearance_tab import AppearanceTab
from pipeline.viewer.easel import Easel
from pipeline.viewer.gallery import Gallery
from pipeline.viewer.path_tab import PathTab
from pipeline.viewer.recording import Key
from pipeline.viewer.standing import Shown, Standing, Wish
from pipeline.viewer.view_tab import ViewTab
from pipeline.views.camera import Camera

if TYPE_CHECKING:
    from viser import ClientHandle

JPEG_QUALITY = 85


class Panel:
    """A browser that has come, until it goes."""

    def __init__(self, client: ClientHandle, gallery: Gallery, easel: Easel) -> None:
        self.client, self._gallery, self._easel = client, gallery, easel
        self._lock = Lock()  # viser calls back on many threads: who reads first must ask first
        self.standing: Standing | None = None
        self._status = client.gui.add_html(status("..."))
        tabs = client.gui.add_tab_group()
        self.appearance = None
        if gallery.names:
            with tabs.add_tab("Appearance"):
                self.appearance = AppearanceTab(client, gallery, self.changed)
        with tabs.add_tab("View"):
            take = None if self.appearance is None else self.appearance.take
            self.view = ViewTab(client, gallery, self.changed, take)
        with tabs.add_tab("Film"):
            scale = gallery.painter.photos.manifest.scene.scale
            self.path = PathTab(client, gallery.painter.run, scale, self.here)
        client.camera.on_update(lambda _: self.changed())
        self.changed()

    @property
    def F(self) -> Tensor | None:
        """The appearance that is chosen."""
        return None if self.appearance is None else self.appearance.F

    def changed(self) -> None:
        """Wish for what the controls and the browser's camera say now."""
        with self._lock:
            camera = self.camera()
            if camera is None:
                return
            wish: dict[str, Any] = {"camera": camera, "F": self.F, "what": self.view.what}
            if self.standing is None:
                self.standing = Standing(self._gallery.painter, self._gallery.pace, Wish(**wish))
                self._easel.add(self.client.client_id, self.standing, self.show)
            else:
                self.standing.ask(**wish)
                self._easel.wake()

    def camera(self) -> Camera | None:
        """The browser's camera; None while its window shows nothing."""
        seen = self.client.camera
        window = (seen.image_width, seen.image_height)
        return self._gallery.place.camera(seen.wxyz, seen.position, seen.fov, window, self._gallery.side)

    def show(self, shown: Shown) -> None:
        """Send a picture to the browser."""
        self.client.scene.set_background_image(shown.pixels, format="jpeg", jpeg_quality=JPEG_QUALITY)
        height, width = shown.pixels.shape[:2]
        sharp = shown.step == shown.steps - 1
        self._status.content = status(f"{width} x {height} pixels, {'sharp' if sharp else 'getting sharper ...'}")

    def here(self) -> Key:
        """What is seen now, as a key view. CrossrayError: nothing."""
        camera = self.camera()
        if camera is None:
            raise CrossrayError("the window shows nothing; make it larger")
        return Key(camera, () if self.appearance is None else self.appearance.shares())


def status(text: str) -> str:
    return f'<div class="crossray-status" style="padding:0 10px 6px;font-size:12px;opacity:.7">{escape(text)}</div>'
