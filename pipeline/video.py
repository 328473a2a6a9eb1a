"""Pictures -> an MP4 that every player shows: H.264, 8 bits, 4:2:0, in the colours of BT.709."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np

from pipeline.errors import CrossrayError
from pipeline.files import atomic_file

QUALITY = "18"  # constant rate factor of x264: visually lossless
BT709, LIMITED = 1, 1  # numbers of H.264: the colours of HD, and 16 to 235
ABOUT = "comment"  # the tag of the file that holds what the film is


def write_video(path: Path, pictures: Iterable[np.ndarray], fps: float, about: str) -> None:
    """Write uint8 pictures (h, w, 3), all of one size with even sides, as a film; memory holds one of them.

    Args:
        about: kept in the file, for `about_video`.

    Raises:
        CrossrayError: a picture is of another size than the first; nothing is written.
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
                codec = stream.codec_context  # is told its colours: players would guess them by the film's size
                codec.colorspace = codec.color_primaries = codec.color_trc = BT709
                codec.color_range = LIMITED
            if picture.shape[:2] != (stream.height, stream.width):
                raise CrossrayError(
                    f"{path}: a picture of {picture.shape[1]} x {picture.shape[0]} pixels after those of "
                    f"{stream.width} x {stream.height}: a film has one size"
                )
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            film.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace=BT709, dst_color_range=LIMITED)))
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
