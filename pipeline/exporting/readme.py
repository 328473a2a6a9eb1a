"""README.txt of an export: what is in the folder and in which units, for whoever gets it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pipeline.exporting.shown import OPAQUE

TOLD = {
    "views": """\
views/*.png        The scene as the model sees it from the cameras of its photos.
""",
    "depth": f"""\
depth/*.npy        Depth z of each pixel of a view, along the viewing direction of the camera (not along the ray):
                   float32, COLMAP units. 0 where less than {OPAQUE:.0%} of the light comes from matter, or from the
                   far end of the ray: sky, mist. For nerfstudio: --depth-unit-scale-factor 1.
depth/*.png        A picture of it: blue is near, red is far, black is nothing. Not to be measured in.
""",
    "points": """\
points.ply         Surface points of the training views that another view agrees to, with their colours.
""",
    "cameras": """\
colmap/            The cameras of the views as a COLMAP text model without points; its image folder is views/.
transforms.json    The same for nerfstudio: camera-to-world, x right, y up, looking along -z.
""",
}


def readme(run: str, appearance: Mapping[str, str] | None, what: Sequence[str]) -> str:
    """The text.

    Args:
        run: the run in words.
        appearance: where it comes from; None: the method has none.
        what: is in the folder, of TOLD.
    """
    light = f"in the appearance of {appearance['photo']}" if appearance else "without a choice of appearance"
    parts = "".join(text for word, text in TOLD.items() if word in what)
    return f"""{run}, {light}.
Made by `crossray export`.

{parts}export.json        What this was made from, and the SHA-256 of each file.

Lengths are in the units of the scene's COLMAP model, positions in its world. Pixel centres are at +0.5.
"""
