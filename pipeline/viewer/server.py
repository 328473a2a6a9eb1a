"""`crossray view`: the server, from its start to Ctrl-C. The only file that starts viser."""

from __future__ import annotations

import io
import os
import socket
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import CrossrayError
from pipeline.painter import Painter
from pipeline.viewer.easel import Easel
from pipeline.viewer.gallery import Gallery, open_gallery
from pipeline.viewer.panel import Panel
from pipeline.viewer.place import angle_of

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

HOST, PORT, SIDE = "127.0.0.1", 8080, 640
MOST_BROWSERS = 8  # at once: each keeps the features of a view, C float32 a pixel: 79 MB at 640 x 480 and 64 channels
CLIP = 1e-3  # scene units: frusta nearer than this are cut off


def view_run(
    run: Path,
    host: str = HOST,
    port: int = PORT,
    side: int = SIDE,
    step: int | None = None,
    say: Callable[[str], None] = print,
) -> None:
    """Serve a trained run (its newest checkpoint, or of `step`) to browsers until interrupted.

    Args:
        host: the address to listen at; other than a loopback address, whoever reaches it can look.
        side: pixels of a sharp picture's long side, at most.

    Raises:
        CrossrayError: the run, the address or the port cannot be used.
    """
    check_address(host, port)
    painter = Painter(run, step)
    say(f"{run}: {painter.job.method}, step {painter.checkpoint.step}; reading its photos")
    gallery = open_gallery(painter, side)
    with serving(gallery, host, port) as viewer:
        say(viewer.address)
        if not loopback(host):
            say(f"--host {host}: whoever reaches this address can look, and save camera paths in {run / 'paths'}")
        elif not has_display():
            tunnel = f"ssh -N -L {viewer.port}:{host}:{viewer.port} {socket.gethostname()}"
            say(f"This machine has no display. On one that has: {tunnel}")
        say("Ctrl-C ends it")
        Event().wait()


class Viewer:
    """A server that browsers come to."""

    def __init__(self, gallery: Gallery, host: str, port: int) -> None:
        self.gallery, self.host = gallery, host
        self.panels: dict[int, Panel] = {}
        self._easel = Easel()
        self._server = start_viser(host, port, f"Crossray: {gallery.painter.run.name}")
        self.port = self._server.get_port()
        prepare(self._server, gallery)
        self._server.on_client_disconnect(self._leave)
        self._server.on_client_connect(self._come)

    @property
    def address(self) -> str:
        return f"http://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"

    def close(self) -> None:
        self._easel.close()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _come(self, client: ClientHandle) -> None:
        if len(self.panels) >= MOST_BROWSERS:
            client.gui.add_markdown(f"{MOST_BROWSERS} browsers look at this run already: close one, and reload.")
            return
        self.panels[client.client_id] = Panel(client, self.gallery, self._easel)
        if client.client_id not in self._server.get_clients():  # gone while its panel was made
            self._leave(client)

    def _leave(self, client: ClientHandle) -> None:
        self.panels.pop(client.client_id, None)
        self._easel.remove(client.client_id)


@contextmanager
def serving(gallery: Gallery, host: str = HOST, port: int = PORT) -> Iterator[Viewer]:
    """A viewer that is closed when the block ends. CrossrayError: the port is taken."""
    viewer = Viewer(gallery, host, port)
    try:
        yield viewer
    finally:
        viewer.close()


def start_viser(host: str, port: int, label: str) -> ViserServer:
    """viser at this address and no other. CrossrayError: another program took the port first."""
    import viser

    # A picture may be ready when its browser has just gone.
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
    with redirect_stdout(io.StringIO()):  # it prints a panel of its own
        server = viser.ViserServer(host, port, label=label, verbose=False)
    if port not in (0, server.get_port()):  # viser goes on to the next free port by itself
        with redirect_stdout(io.StringIO()):
            server.stop()
        raise CrossrayError(f"--port {port}: taken by another program; name another one")
    # A page could ask viser to open a tunnel through a public host; what is looked at stays on this machine.
    server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
    return server


def prepare(server: ViserServer, gallery: Gallery) -> None:
    """What every browser starts with: up is up, and the camera stands where a typical photo was taken."""
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    place, start = gallery.place, gallery.place.start
    server.scene.set_up_direction(place.up)
    server.scene.world_axes.visible = False
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up = np.array(start.c2w)[:, 3], place.look_at(start), place.up
    camera.fov = angle_of(start, start.width / start.height)
    camera.near = CLIP


def check_address(host: str, port: int) -> None:
    """CrossrayError where nothing can listen at this address; port 0 is any free one."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        raise CrossrayError(f"--host {host}: no such address ({error.strerror or error})") from None
    with socket.socket(found[0], found[1]) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port that was left a minute ago is free
        try:
            trial.bind(found[4])
        except OSError as error:
            raise CrossrayError(
                f"--host {host} --port {port}: cannot listen there ({error.strerror}); `--port` names another port"
            ) from None


def loopback(host: str) -> bool:
    return host in ("localhost", "::1") or host.startswith("127.")


def has_display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or os.name != "posix")
