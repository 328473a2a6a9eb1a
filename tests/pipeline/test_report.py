"""The report is one page that needs nothing else: no network, no file beside it."""

from __future__ import annotations

import base64
import io
import re

import numpy as np
from PIL import Image

from pipeline.report import Row, write_report


def test_the_page_holds_the_scores_and_the_pictures_to_the_pixel(tmp_path):
    colour = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    gray = colour[..., 0]
    rows = [Row("view <1>", {"photo": colour, "depth & mask": gray})]
    page = write_report(tmp_path / "report.html", "A <title>", [("psnr", "22.500", "what & why")], rows).read_text()
    assert "<td>psnr</td><td>22.500</td><td>what &amp; why</td>" in page
    assert "<h1>A &lt;title&gt;</h1>" in page
    assert "view &lt;1&gt;" in page
    assert "depth &amp; mask" in page
    found = [np.asarray(Image.open(io.BytesIO(base64.b64decode(d)))) for d in re.findall(r"base64,([^']+)'", page)]
    assert len(found) == 2
    for picture, expected in zip(found, (colour, gray), strict=True):
        np.testing.assert_array_equal(picture, expected)


def test_the_page_asks_for_nothing_else(tmp_path):
    page = write_report(
        tmp_path / "new" / "report.html", "t", [], [Row("a", {"b": np.zeros((2, 2), np.uint8)})]
    ).read_text()
    assert not re.search(r"https?://|src='(?!data:)|<script|<link", page)
    assert "name=viewport" in page
