"""Pictures -> an MP4 that every player shows: H.264, 8 bits, 4:2:0."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np

from pipeline.files import atomic_file

QUALITY = "18"  # constant rate factor of x264: visually lossless
ABOUT = "comment"  # the tag of the file that holds what the film is


def write_video(path: Path, pictures: Iterable[np.ndarray], fps: float, about: str) -> None:
    """Write uint8 pictures (h, w, 3), all of one size with even sides, as a film; memory holds one of them.

    Args:
        about: kept in the file, for `about_video`.
    """
    import av

    with atomic_file(path) as file, av.open(file, "w", format="mp4", options={"movflags": "use_metadata_tags"}) as film:
        film.metadata[ABOUT] = about
        stream = None
        for picture in pictures:
            if stream is None:
                stream = film.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.options = {"crf": QUALITY}
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        if stream is not None:
            film.mux(stream.encode())


def about_video(path: Path) -> str | None:
    """What `write_video` was told of a film; None where the file is no film, or not one of ours."""
    import av

    try:
        with av.open(str(path)) as film:
            return film.metadata.get(ABOUT)
    except (av.FFmpegError, ValueError, OSError):
        return None
