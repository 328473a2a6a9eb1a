"""A film's cameras, and which appearance each frame has.

An appearance is chosen once a film: where frames carry weights, they blend a few named appearances, as in the
trajectories of nerfbaselines.
"""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.errors import CrossrayError
from pipeline.views.camera import Camera

FPS = 30.0  # frames a second, where nobody says otherwise
MAX_FRAMES = 100_000  # of a path: about an hour
SLOWEST, FASTEST = 1e-3, 1e3  # frames a second that films and files hold


@dataclass(frozen=True)
class Frame:
    """One picture of a film."""

    camera: Camera
    weights: tuple[float, ...] | None = None
    """One a path's appearance, none below 0, with sum 1; None: the appearance is chosen elsewhere."""


@dataclass(frozen=True)
class CameraPath:
    """The frames of a film, all of one size.

    Raises:
        CrossrayError: no frame or more than MAX_FRAMES, frames of two sizes, frames per second outside SLOWEST to
            FASTEST, or weights that do not fit the appearances.
    """

    frames: tuple[Frame, ...]
    fps: float = FPS
    appearances: tuple[str, ...] = ()  # names of photos of the scene, or image files

    def __post_init__(self) -> None:
        if not 1 <= len(self.frames) <= MAX_FRAMES:
            raise CrossrayError(f"a camera path of {len(self.frames)} frames: it needs 1 to {MAX_FRAMES}")
        if not SLOWEST <= self.fps <= FASTEST:
            raise CrossrayError(
                f"a camera path with {self.fps:g} frames per second: it needs {SLOWEST:g} to {FASTEST:g}"
            )
        size = self.size
        for i, frame in enumerate(self.frames):
            if (frame.camera.width, frame.camera.height) != size:
                raise CrossrayError(
                    f"frame {i} of a camera path has {frame.camera.width} x {frame.camera.height} pixels, the first "
                    f"has {size[0]} x {size[1]}: a film has one size"
                )
            weights = frame.weights
            if weights is not None and not (
                len(weights) == len(self.appearances) and min(weights) >= 0 and abs(sum(weights) - 1) < 1e-6
            ):
                raise CrossrayError(
                    f"frame {i} of a camera path has the appearance weights {list(weights)} for "
                    f"{len(self.appearances)} appearances: it needs one each, none below 0, with sum 1"
                )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of every frame in pixels."""
        first = self.frames[0].camera
        return first.width, first.height


def path_of(cameras: list[Camera], fps: float = FPS) -> CameraPath:
    """The cameras as a film whose appearance is chosen elsewhere. CrossrayError as `CameraPath`."""
    return CameraPath(tuple(Frame(camera) for camera in cameras), fps)
