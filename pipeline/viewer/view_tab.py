"""What is shown, and from where: the kind of picture, the training cameras as frusta, flights to them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from threading import RLock
from typing import TYPE_CHECKING

import numpy as np

from pipeline.manifest import CameraRecord
from pipeline.viewer.gallery import Gallery
from pipeline.viewer.lights import thumbnail
from pipeline.viewer.place import angle_of, evenly, quaternion
from pipeline.viewer.standing import What
from pipeline.viewer.telling import told

if TYPE_CHECKING:
    from viser import CameraFrustumHandle, ClientHandle

FRUSTA = 150  # training cameras that are shown, at most
FRUSTUM = 0.035  # length of one, of the cameras' mean distance from their middle
NOWHERE = "(a photo)"
WHAT: dict[str, What] = {"Colours": "rgb", "Depth (near is bright)": "depth", "Accumulation": "accumulation"}


class ViewTab:
    """The controls in the container that is open."""

    def __init__(
        self,
        client: ClientHandle,
        gallery: Gallery,
        changed: Callable[[], None],
        take: Callable[[str], None] | None,
    ) -> None:
        """
        Args:
            changed: called when another kind of picture is asked for.
            take: sets the appearance to a photo's; None where the run knows no appearance.
        """
        self.client, self.gallery, self._changed, self._take = client, gallery, changed, take
        self._lock = RLock()
        self._frusta: dict[str, CameraFrustumHandle] = {}
        self._at = gallery.place.start.name  # the photo whose place the camera was put in
        gui = client.gui
        self._what = gui.add_dropdown("Show", tuple(WHAT), initial_value=next(iter(WHAT)))
        names = tuple(record.name for record in gallery.place.records)
        self._fly = gui.add_dropdown("Fly to", (NOWHERE, *names), hint="Where a training photo was taken from")
        self._back = gui.add_button("Back to the start")
        self._cameras = gui.add_checkbox("Photos in 3-D", False, hint="Click one in the scene to fly there")
        self._match = gui.add_button("Take its appearance", visible=False)
        self._what.on_update(told(client, changed))
        self._fly.on_update(told(client, self._fly_to_chosen))
        self._back.on_click(told(client, lambda: self.fly(gallery.place.start)))
        self._cameras.on_update(told(client, self._show_cameras))
        self._match.on_click(told(client, self._take_light))

    @property
    def what(self) -> What:
        return WHAT.get(self._what.value, "rgb")

    def fly(self, record: CameraRecord) -> None:
        """Put the browser's camera where a photo was taken, upright, with all of the photo in view."""
        camera, place = self.client.camera, self.gallery.place
        with self.client.atomic():
            camera.position = np.array(record.c2w)[:, 3]
            camera.look_at = place.look_at(record)
            camera.up_direction = place.up
            camera.fov = angle_of(record, camera.aspect)
        with self._lock:
            left, self._at = self._at, record.name
            self._cover(left)
            self._cover(record.name)
        if self._take is not None:
            self._match.label = f"Take the appearance of {record.name}"
            self._match.visible = True

    def _fly_to_chosen(self) -> None:
        for record in self.gallery.place.records:
            if record.name == self._fly.value:
                self.fly(record)
                self._fly.value = NOWHERE  # type: ignore[misc] # or it could not be chosen again
                return

    def _take_light(self) -> None:
        if self._take is not None:
            self._take(self._at)

    def _show_cameras(self) -> None:
        with self._lock:
            if self._cameras.value and not self._frusta:
                self._add_cameras()
            for name in self._frusta:
                self._cover(name)

    def _cover(self, name: str) -> None:
        """Show a photo's frustum if asked to, but not the one that one looks out of."""
        if name in self._frusta:
            self._frusta[name].visible = self._cameras.value and name != self._at

    def _add_cameras(self) -> None:
        photos, place = self.gallery.painter.photos, self.gallery.place
        spread = np.linalg.norm(place.positions - place.positions.mean(axis=0), axis=1).mean()
        for index in evenly(photos.indices("train"), FRUSTA):
            record = photos.records[index]
            self._frusta[record.name] = frustum = self.client.scene.add_camera_frustum(
                f"/photos/{record.key}",
                fov=angle_of(record, record.width / record.height),
                aspect=record.width / record.height,
                scale=FRUSTUM * max(float(spread), 1e-3),
                thickness=1.5,
                thickness_units="screen",
                color=(255, 255, 255),
                image=thumbnail(photos.image(index)),
                wxyz=quaternion(record),
                position=np.array(record.c2w)[:, 3],
                cast_shadow=False,
                receive_shadow=False,
            )
            frustum.on_click(told(self.client, partial(self.fly, record)))
