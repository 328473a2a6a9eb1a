"""The strip of thumbnails: a group of buttons, each with its photo as its face.

viser has no picture that can be clicked. Its button groups are real buttons, which the keyboard reaches as well, and a
style sheet in an HTML element before them gives each its photo. A browser that knows no `:has` shows names instead.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence

import numpy as np

from pipeline.viewer.lights import jpeg, thumbnail

GROUP = "div:has(> .crossray-strip) + div"  # what viser draws after the style sheet: the group's buttons


def strip_style(photos: Sequence[np.ndarray]) -> str:
    """HTML that gives the buttons of the group after it the faces of uint8 photos (h, w, 3), in their order."""
    faces = "".join(
        f"{GROUP} button:nth-child({number}){{background-image:url(data:image/jpeg;base64,{encoded(photo)})}}"
        for number, photo in enumerate(photos, start=1)
    )
    return (
        '<div class="crossray-strip"></div><style>'
        f"{GROUP}>div>div:first-child:not(:only-child){{display:none}}"
        f"{GROUP} div:has(> button){{display:grid;grid-template-columns:repeat(6,1fr);gap:4px}}"
        f"{GROUP} button{{height:44px;min-width:0!important;padding:0;border:0;border-radius:3px;color:transparent;"
        "font-size:0;background-size:cover;background-position:center}"
        f"{GROUP} button:hover{{filter:brightness(1.15)}}"
        f"{faces}</style>"
    )


def chosen_style(number: int | None) -> str:
    """HTML that marks the button of this number, from 0; None: no one."""
    if number is None:
        return ""
    return f"<style>{GROUP} button:nth-child({number + 1}){{outline:3px solid #228be6;outline-offset:-1px}}</style>"


def encoded(photo: np.ndarray) -> str:
    return b64encode(jpeg(thumbnail(photo))).decode()
