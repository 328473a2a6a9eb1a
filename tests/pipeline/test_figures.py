"""`crossray figure`: what stands on each figure, where it goes on paper, what the files hold, what is refused."""

from __future__ import annotations

import io
import json
import re
import zlib
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tiny_run import MLP, cut_tiny, tiny_job

from pipeline.checkpoint import MODEL
from pipeline.errors import CrossrayError
from pipeline.figures import KINDS, Order, make_figure
from pipeline.figures import choose as choosing
from pipeline.figures.appearance import interpolation, transfer, unseen
from pipeline.figures.choose import different, views_of
from pipeline.figures.curve import charts_of, read_study
from pipeline.figures.depth import ACCUMULATION, depth, depth_bar
from pipeline.figures.draw import fitted, length
from pipeline.figures.grids import grids
from pipeline.figures.layout import COLUMN, EDGE, GAP, HEAD, LABEL, PAGE, TEXT, lay_out
from pipeline.figures.masks import BAR, masks
from pipeline.figures.sheet import Bar, Panel, Row, Sheet, coloured
from pipeline.files import sha256_of
from pipeline.launch.run import claim_run
from pipeline.painter import Painter, Picture
from pipeline.patches import list_patches
from pipeline.render import predicted_mask
from pipeline.report.gallery import tinted
from pipeline.study import make_study
from pipeline.train import train
from pipeline.views.camera import camera_of
from pipeline.work import Context


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A tiny scene with its shards."""
    folder = cut_tiny(tmp_path_factory.mktemp("figures"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(folder / "cache"))
        yield folder


def trained(scene: Path, name: str, method: str = "crossray", model: dict | None = None) -> Path:
    """A run of two steps."""
    over = {"name": name, "model": model or {}, "train": {"epochs": 1, "steps_per_epoch": 2}}
    job = tiny_job(scene, method, over)
    claim_run(job)
    train(job, Context())
    return job.run


@pytest.fixture(scope="module")
def run(scene):
    return trained(scene, "crossray")


@pytest.fixture(scope="module")
def plain(scene):
    return trained(scene, "plain", "nerf", {"field": "hash"})


@pytest.fixture(scope="module")
def painter(run):
    return Painter(run)


@pytest.fixture
def outside(tmp_path):
    """An image file of another place, portrait, with a name that is hard to print."""
    path = tmp_path / "a_very_long name $x_1$ 凱旋門 of a photo of another place.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (40, 30, 3), np.uint8)).save(path)
    return path


def pictures(row: Row) -> list[np.ndarray]:
    return [panel.picture for panel in row.panels if panel is not None]


def painted(painter: Painter, index: int, name: str) -> np.ndarray:
    return painter.picture(camera_of(painter.photos.records[index]), painter.read(name).F).rgb


# What stands on the figures


def test_transfer_shows_each_view_in_each_appearance(painter, outside):
    names = ["photo_001.jpg", "photo_005.jpg"]
    composed = transfer(painter, names, ["photo_003.jpg", "photo_000.jpg"], others=[str(outside)])
    head, *rows = composed.sheet.rows
    assert head.panels[0] is None
    assert np.array_equal(head.panels[1].picture, painter.photos.image(1))
    assert np.array_equal(head.panels[3].picture, np.asarray(Image.open(outside)))
    assert [p.head for p in head.panels[1:3]] == ["photo_001", "photo_005"]
    assert [row.label for row in rows] == ["photo_003", "photo_000"]
    for row, index in zip(rows, (3, 0), strict=True):
        photo, *shown = pictures(row)
        assert np.array_equal(photo, painter.photos.image(index))
        for picture, name in zip(shown, [*names, str(outside)], strict=True):
            assert np.array_equal(picture, painted(painter, index, name))
    assert composed.about["appearances"][2] == {"photo": outside.name, "sha256": sha256_of(outside)}
    assert [s["photo"] for s in composed.about["views"]] == ["photo_003.jpg", "photo_000.jpg"]


def test_by_default_photos_differ_and_views_are_of_the_test(painter, monkeypatch):
    composed = transfer(painter, columns=3)
    assert [row.label for row in composed.sheet.rows[1:]] == ["photo_003"]
    means = {0: (0, 0, 0), 1: (10, 0, 0), 2: (100, 0, 0), 5: (40, 0, 0)}
    monkeypatch.setattr(type(painter.photos), "reference", lambda self, i: np.full((2, 2, 3), means[i], np.uint8))
    assert different(painter.photos, [0, 1, 2, 5], 3) == ["photo_000.jpg", "photo_002.jpg", "photo_005.jpg"]
    assert different(painter.photos, [0, 1, 2, 5], 1) == ["photo_000.jpg"]
    assert views_of(painter.photos, ["photo_004.jpg"]) == [4]


def test_unseen_shows_photos_that_were_not_trained_on_and_their_own_views(painter):
    composed = unseen(painter)
    assert not composed.sheet.even
    photo, rendered = composed.sheet.rows
    assert sorted(panel.head for panel in photo.panels) == ["photo_003", "photo_004"]
    for panel, picture in zip(photo.panels, pictures(rendered), strict=True):
        index = int(panel.head[-3:])
        assert np.array_equal(panel.picture, painter.photos.image(index))
        assert np.array_equal(picture, painted(painter, index, f"{panel.head}.jpg"))


def test_unseen_image_files_have_no_view_of_their_own(painter, outside):
    composed = unseen(painter, [str(outside)])
    assert [row.label for row in composed.sheet.rows] == ["as in", "photo_003"]
    assert np.array_equal(pictures(composed.sheet.rows[1])[1], painted(painter, 3, str(outside)))
    named = unseen(painter, ["photo_004.jpg"], ["photo_000.jpg"])
    assert [row.label for row in named.sheet.rows] == ["as in", "photo_000"]


def test_interpolation_goes_from_one_appearance_to_the_other(painter):
    composed = interpolation(painter, ["photo_001.jpg", "photo_005.jpg"], ["photo_003.jpg"], 3)
    ends, row = composed.sheet.rows
    assert (ends.panels[0].head, ends.panels[1], ends.panels[2].head) == ("photo_001", None, "photo_005")
    assert [panel.head for panel in row.panels] == ["0 %", "50 %", "100 %"]
    first, middle, last = pictures(row)
    assert np.array_equal(first, painted(painter, 3, "photo_001.jpg"))
    assert np.array_equal(last, painted(painter, 3, "photo_005.jpg"))
    a, b = (painter.read(f"photo_00{i}.jpg") for i in (1, 5))
    half = painter.picture(camera_of(painter.photos.records[3]), painter.between(a, b, 0.5)).rgb
    assert np.array_equal(middle, half)
    assert composed.about["shares"] == [0, 0.5, 1]


def test_masks_show_what_training_left_out(painter):
    composed = masks(painter, ["photo_005.jpg", "photo_000.jpg"])
    photo, mask, both, rendered = composed.sheet.rows
    for j, index in enumerate((5, 0)):
        found = predicted_mask(painter.model, painter.photos, index)
        assert found is not None
        image = painter.photos.image(index)
        assert np.array_equal(pictures(photo)[j], image)
        assert np.array_equal(pictures(mask)[j], coloured(found, BAR))
        assert np.array_equal(pictures(both)[j], tinted(image, found))
        assert np.array_equal(pictures(rendered)[j], painted(painter, index, f"photo_00{index}.jpg"))
    assert mask.bar == BAR


def test_by_default_masks_are_those_with_most_that_is_transient(painter, monkeypatch):
    share = {0: 0.1, 1: 0.7, 2: 0.2, 5: 0.6}
    monkeypatch.setattr(
        "pipeline.figures.masks.predicted_mask",
        lambda model, photos, i, stride: np.full((18, 24), share[i], np.float32),
    )
    composed = masks(painter, columns=2)
    assert [panel.head for panel in composed.sheet.rows[0].panels] == ["photo_001", "photo_005"]


def test_depth_is_in_scene_units_on_one_scale(painter, plain):
    for p in (painter, Painter(plain)):
        composed = depth(p, views=["photo_003.jpg", "photo_000.jpg"])
        rgb, deep, seen = composed.sheet.rows
        name = p.photos.records[p.photos.indices("train")[0]].name
        views = [p.picture(camera_of(p.photos.records[i]), p.read(name).F) for i in (3, 0)]
        assert deep.bar is not None
        low, high = composed.about["depth_range"]
        assert (deep.bar.low, deep.bar.high, deep.bar.title) == (low, high, "scene units")
        for j, view in enumerate(views):
            assert np.array_equal(pictures(rgb)[j], view.rgb)
            assert np.array_equal(pictures(deep)[j], coloured(view.depth, deep.bar, view.accumulation >= 0.5))
            assert np.array_equal(pictures(seen)[j], coloured(view.accumulation, ACCUMULATION))


def test_there_is_no_depth_where_little_is_seen(painter, monkeypatch):
    deep = np.tile(np.linspace(1, 3, 24, dtype=np.float32), (18, 1))
    seen = np.where(np.arange(18)[:, None] < 9, 0.49, 0.51) * np.ones((1, 24))
    picture = Picture(np.zeros((18, 24, 3), np.uint8), deep, seen.astype(np.float32))
    monkeypatch.setattr(painter, "picture", lambda camera, F: picture)
    composed = depth(painter, views=["photo_003.jpg"])
    (found,) = pictures(composed.sheet.rows[1])
    assert (found[:9] == 255).all()
    assert (found[9:] < 255).any(axis=-1).all()
    assert composed.about["depth_range"] == pytest.approx(np.percentile(deep[9:], (1, 99)))


def test_rays_are_those_that_the_last_steps_drew(painter, scene):
    composed = grids(painter, 3)
    photos, k = painter.photos, 8
    keys = [photos.records[i].name for i in photos.indices("train")]
    drawn = list(list_patches(tiny_job(scene).patch, keys, photos.sizes("train"), 0, 1))
    steps = painter.checkpoint.meta["steps_per_epoch"]
    assert steps == 2
    # a step has two patches: the last one's, then the first of the one before
    expected = [
        next(r for r in drawn if (r.step, r.photo) == (s["step"], s["photo"])) for s in composed.about["patches"]
    ]
    assert [r.step for r in expected] == [1, 1, 0]
    top, bottom = composed.sheet.rows
    for panel, patch, row in zip(top.panels, bottom.panels, expected, strict=True):
        image = photos.image(keys.index(row.photo) if row.photo in keys[:3] else 5)
        assert np.array_equal(panel.picture, image)
        columns, rows = panel.dots.T.astype(int)
        assert np.array_equal(patch.picture, image[rows, columns].reshape(k, k, 3))
        assert columns[0] == int(row.offset_w * 24)
        assert rows[0] == int(row.offset_h * 18)
        assert np.ptp(columns) / 24 == pytest.approx(row.scale, abs=0.1)
        assert patch.ratio == panel.ratio


def test_pictures_are_made_no_larger_than_print_needs(painter, monkeypatch):
    monkeypatch.setattr(choosing, "SIDE", 12)
    composed = depth(painter, views=["photo_003.jpg"])
    assert pictures(composed.sheet.rows[0])[0].shape == (9, 12, 3)
    shown = transfer(painter, ["photo_001.jpg"], ["photo_003.jpg"]).sheet.rows[1]
    assert [p.shape for p in pictures(shown)] == [(9, 12, 3)] * 2


# Colours and words


def test_colours_of_numbers():
    bar = Bar("", 1, 3, "gray")
    values = np.array([[0.0, 1, 2, 3, 9]])
    assert coloured(values, bar)[0, :, 0].tolist() == [0, 0, 128, 255, 255]
    shown = np.array([[True, False, True, True, True]])
    assert coloured(values, bar, shown)[0, :, 0].tolist() == [0, 255, 128, 255, 255]


def test_the_scale_of_depth():
    bar = depth_bar([np.arange(51.0), np.arange(51.0, 101.0)])
    assert (bar.low, bar.high) == (1, 99)
    assert (depth_bar([np.full(3, 2.0)]).low, depth_bar([np.full(3, 2.0)]).high) == (2, 3)
    assert depth_bar([np.zeros(0)]).high == 1


def test_words_are_cut_in_their_middle():
    assert fitted("short", 1) == "short"
    assert fitted("two\nlines  of it", 2) == "two lines of it"
    assert fitted("凱旋門 $x_1$", 2) == "□□□ $x_1$"
    cut = fitted("83739389_5480438404_and_much_more", 0.8)
    assert re.fullmatch(r"837\d+…\w+more", cut)
    assert length(cut) <= 0.8 < length(cut + "mm")


# Where it goes on paper


def blank(width: int, height: int, head: str = "") -> Panel:
    return Panel(np.zeros((height, width, 3), np.uint8), head)


def test_even_columns_by_hand():
    layout = lay_out(Sheet((Row("a", (blank(4, 3, "x"), blank(4, 3))), Row("", (blank(3, 6), None))), even=True))
    width = (COLUMN - 2 * EDGE - LABEL - GAP) / 2
    assert layout.width == COLUMN
    assert layout.panels[0, 0] == pytest.approx((EDGE + LABEL, EDGE + HEAD, width, 0.75 * width))
    assert layout.panels[0, 1].x == pytest.approx(EDGE + LABEL + width + GAP)
    tall = layout.panels[1, 0]  # no higher than 1.5 columns, in the middle of its own
    assert (tall.h, tall.w) == pytest.approx((1.5 * width, 0.75 * width))
    assert tall.x == pytest.approx(EDGE + LABEL + width / 8)
    assert layout.height == pytest.approx(2 * EDGE + HEAD + 2.25 * width + GAP)
    assert (1, 1) not in layout.panels


def test_even_rows_by_hand():
    row = Row("", (blank(4, 2), blank(1, 2), blank(3, 2)))
    layout = lay_out(Sheet((row, row), even=False))
    height = (TEXT - 2 * EDGE - 2 * GAP) / 4  # ratios 2, 0.5 and 1.5
    assert layout.width == TEXT  # in one column the portrait would be too narrow
    assert [layout.panels[0, j].h for j in range(3)] == pytest.approx([height] * 3)
    assert layout.panels[1, 2].x + layout.panels[1, 2].w == pytest.approx(TEXT - EDGE)


sides = st.integers(1, 40)


@given(st.lists(st.lists(st.tuples(sides, sides), min_size=3, max_size=3), min_size=1, max_size=4), st.booleans())
def test_no_panel_leaves_the_page_or_covers_another(shapes, even):
    rows = tuple(Row("r", tuple(blank(w, h, "x") for w, h in row)) for row in shapes)
    try:
        layout = lay_out(Sheet(rows, even))
    except CrossrayError:
        assert even
        return
    boxes = list(layout.panels.items())
    assert layout.height <= PAGE
    for (i, j), box in boxes:
        w, h = shapes[i][j]
        assert box.w / box.h == pytest.approx(w / h)
        assert box.x >= 0.999 * (EDGE + LABEL)
        assert box.x + box.w <= layout.width - 0.999 * EDGE
        assert box.y * 1.001 >= EDGE + HEAD
        assert box.y + box.h <= layout.height - 0.999 * EDGE
    for n, (_, a) in enumerate(boxes):
        for _, b in boxes[n + 1 :]:
            beside = a.x + a.w < b.x or b.x + b.w < a.x
            assert beside or a.y + a.h < b.y or b.y + b.h < a.y


def test_a_figure_is_never_cut_into_pages():
    with pytest.raises(CrossrayError, match=r"the figure would be \d+\.\d inches high, and a page has 9; name fewer"):
        lay_out(Sheet(tuple(Row("", (blank(4, 3),)) for _ in range(5)), even=True))


# Files


ESCAPED = {b"n": b"\n", b"r": b"\r", b"t": b"\t", b"b": b"\b", b"f": b"\f"}
IMAGE = re.compile(
    rb"/Subtype /Image /Width (\d+) /Height (\d+)\s"
    rb"/ColorSpace (/DeviceRGB|\[ /Indexed /DeviceRGB \d+\s\((.*?)\)\s\])\s"
    rb"/BitsPerComponent (\d).*?/Predictor 10.*?>>\nstream\n(.*?)\nendstream",
    re.DOTALL,
)


def images_in(pdf: bytes) -> list[np.ndarray]:
    """The pictures of a PDF, uint8 (h, w, 3), read by Pillow: each is a PNG's data without its head. They lie there
    from the bottom up, and a matrix that turns them over draws them.
    """
    found = []
    for width, height, _, palette, bits, data in IMAGE.findall(pdf):
        colours = re.sub(rb"\\(.)", lambda m: ESCAPED.get(m[1], m[1]), palette, flags=re.DOTALL)
        header = int(width).to_bytes(4, "big") + int(height).to_bytes(4, "big")
        header += bytes([int(bits), 3 if palette else 2, 0, 0, 0])
        png = b"\x89PNG\r\n\x1a\n"
        for name, body in ((b"IHDR", header), (b"PLTE", colours), (b"IDAT", data), (b"IEND", b"")):
            if name != b"PLTE" or palette:
                png += len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")
        found.append(np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))[::-1])
    return found


def test_files_hold_the_figure_at_its_size(run, painter, tmp_path):
    order = Order(photos=("photo_001.jpg", "photo_005.jpg"), views=("photo_003.jpg",))
    png, pdf, record = make_figure("transfer", run, tmp_path / "out", order)
    assert [p.name for p in (png, pdf, record)] == ["transfer.png", "transfer.pdf", "transfer.json"]
    said = json.loads(record.read_text())
    assert (said["figure"], said["run"], said["method"], said["step"]) == ("transfer", "crossray", "crossray", 2)
    assert said["checkpoint_sha256"] == painter.checkpoint.meta["sha256"][MODEL]
    assert said["sha256"] == {path.name: sha256_of(path) for path in (png, pdf)}
    assert said["appearances"][0]["sha256"] == painter.photos.records[1].source_sha256
    assert said["caption"].startswith("Appearance transfer.")
    assert said["provenance"]["command"]
    width, height = said["inches"]
    assert width == COLUMN  # three pictures side by side are wide enough there
    with Image.open(png) as image:
        assert image.size == (round(width * 300), round(height * 300))
        assert image.info["dpi"] == pytest.approx((300, 300), abs=0.01)
        assert f"checkpoint {said['checkpoint_sha256']}" in image.info["Description"]
    content = pdf.read_bytes()
    assert content.startswith(b"%PDF-1.")
    assert content.endswith(b"%%EOF\n")
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", content)
    assert [float(x) / 72 for x in box.groups()] == pytest.approx([width, height], abs=1e-3)
    assert b"CreationDate" not in content
    assert b"/Type3" not in content  # publishers refuse these fonts
    assert b"/FontFile2" in content
    sheet = transfer(painter, order.photos, order.views).sheet
    expected = [p.picture.tobytes() for row in sheet.rows for p in row.panels if p is not None]
    inside = [picture.tobytes() for picture in images_in(content)]
    assert sorted(inside) == sorted(expected)


def test_the_png_shows_pixels_where_the_layout_says(run, painter, tmp_path):
    order = Order(photos=("photo_001.jpg",), views=("photo_003.jpg",))
    png = make_figure("transfer", run, tmp_path, order)[0]
    sheet = transfer(painter, order.photos, order.views).sheet
    box = lay_out(sheet).panels[1, 1]
    found = np.asarray(Image.open(png))[..., :3]
    picture = pictures(sheet.rows[1])[1]
    for row, column in ((0, 0), (5, 20), (17, 23)):
        y = round(300 * (box.y + box.h * (row + 0.5) / 18))
        x = round(300 * (box.x + box.w * (column + 0.5) / 24))
        assert found[y, x].tolist() == picture[row, column].tolist()


@pytest.mark.parametrize("kind", ["rays", pytest.param("depth", marks=pytest.mark.slow)])
def test_the_same_bytes_twice_whatever_the_user_s_style(run, tmp_path, kind):
    first = make_figure(kind, run, tmp_path / "a")
    with matplotlib.rc_context({"font.size": 20, "axes.linewidth": 3, "pdf.fonttype": 3, "savefig.bbox": "tight"}):
        second = make_figure(kind, run, tmp_path / "b")
    for a, b in zip(first[:2], second[:2], strict=True):
        assert a.read_bytes() == b.read_bytes()
    assert make_figure(kind, run, tmp_path / "a") == first  # again: made anew


def test_out_may_name_a_file(run, tmp_path):
    files = make_figure("rays", run, tmp_path / "new" / "fig3.pdf", Order(columns=1))
    assert [p.name for p in files] == ["fig3.png", "fig3.pdf", "fig3.json"]
    assert {p.name for p in (tmp_path / "new").iterdir()} == {p.name for p in files}


def test_what_is_there_is_left_alone(run, tmp_path):
    (tmp_path / "rays.pdf").write_text("mine")
    with pytest.raises(CrossrayError, match=r"rays.pdf is there, and is no figure rays of ours"):
        make_figure("rays", run, tmp_path)
    assert (tmp_path / "rays.pdf").read_text() == "mine"
    for out in (tmp_path / "rays.pdf" / "deep", tmp_path / "rays.pdf" / "f.png"):
        with pytest.raises(CrossrayError, match=r"rays.pdf is a file; name a folder"):
            make_figure("rays", run, out)
    files = make_figure("rays", run, tmp_path / "f.png", Order(columns=1))
    with pytest.raises(CrossrayError, match=r"f.png is there, and is no figure depth of ours"):
        make_figure("depth", run, tmp_path / "f.png")
    files[0].unlink()  # half of it, as after a power cut
    assert make_figure("rays", run, tmp_path / "f.png", Order(columns=1)) == files
    assert files[0].exists()


# What is refused

NAMES = ("photo_000.jpg", "photo_001.jpg")


@pytest.mark.parametrize(
    ("kind", "order", "part"),
    [
        ("transfr", Order(), "there is no figure of this name; did you mean 'transfer'"),
        (
            "transfer",
            Order(views=("photo_03.jpg",)),
            "photo_03.jpg: not the name of a photo of the scene; did you mean",
        ),
        ("transfer", Order(photos=("none.jpg",)), "none.jpg: neither an image file nor the name"),
        ("transfer", Order(appearance=("none.jpg",)), "none.jpg: neither"),
        ("transfer", Order(photos=NAMES, columns=3), "--columns 3: --photos names them already"),
        ("transfer", Order(columns=0), "--columns 0: a figure has 1 to 12"),
        ("transfer", Order(views=("photo_000.jpg",) * 13), "13 views: a figure takes 12, and is never cut into pages"),
        ("transfer", Order(photos=("photo_000.jpg",) * 12, appearance=NAMES), "14 photos: a figure takes 12"),
        ("transfer", Order(step=7), "no checkpoint of step 7; there are 2"),
        ("unseen", Order(photos=NAMES), "photo_000.jpg: was trained on; name test or validation photos"),
        ("unseen", Order(appearance=NAMES), "--appearance: figure unseen has no use for it; it takes --photos"),
        ("interpolation", Order(photos=NAMES[:1]), "1 photos, and an interpolation goes from one to another"),
        ("interpolation", Order(columns=1), "--columns 1: an interpolation has two ends"),
        ("masks", Order(photos=("photo_003.jpg",)), "photo_003.jpg: is no training photo"),
        ("masks", Order(views=NAMES), "--views: figure masks has no use for it"),
        ("depth", Order(photos=NAMES), "2 photos: --photos names the one whose appearance"),
        ("rays", Order(photos=NAMES), "--photos: figure rays has no use for it; it takes --columns, --step"),
    ],
)
def test_wrong_orders_are_one_message_and_write_nothing(run, tmp_path, kind, order, part):
    with pytest.raises(CrossrayError, match=re.escape(part)):
        make_figure(kind, run, tmp_path / "out", order)
    assert not (tmp_path / "out").exists()


def test_other_places_and_formats_are_refused(run, tmp_path):
    with pytest.raises(CrossrayError, match="is not a run"):
        make_figure("rays", tmp_path, tmp_path / "out")
    with pytest.raises(CrossrayError, match=r"fig.svg: a figure is a PNG and a PDF"):
        make_figure("rays", run, tmp_path / "fig.svg")
    text = tmp_path / "text.png"
    text.write_text("no picture")
    with pytest.raises(CrossrayError, match=r"text.png: cannot be read as an image"):
        make_figure("transfer", run, tmp_path / "out", Order(photos=(str(text),)))


def test_a_method_without_the_thing_is_refused_with_the_reason(plain, tmp_path):
    for kind in ("transfer", "unseen", "interpolation"):
        with pytest.raises(CrossrayError, match=r"method nerf has no appearance \(model.appearance: none\)"):
            make_figure(kind, plain, tmp_path)
    with pytest.raises(CrossrayError, match=r"method nerf has no masks \(model.transient: none\)"):
        make_figure("masks", plain, tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_checkpoint_that_was_not_trained_drew_no_rays(painter, monkeypatch):
    monkeypatch.setitem(painter.checkpoint.meta, "seconds", 0.0)
    with pytest.raises(CrossrayError, match="was not trained here for a single step"):
        grids(painter)


@pytest.mark.slow
def test_methods_whose_views_depend_on_a_code(scene, tmp_path):
    small = {"field": "mlp", "mlp": MLP}
    coded = trained(scene, "coded", "hanerf", small)
    learned = trained(scene, "learned", "nerfw", small)
    for kind in KINDS:
        if kind == "unseen":
            with pytest.raises(CrossrayError, match="nerfw learned the appearance of each training photo"):
                make_figure(kind, learned, tmp_path / "learned")
        else:
            make_figure(kind, learned, tmp_path / "learned")
        make_figure(kind, coded, tmp_path / "coded")
    with pytest.raises(CrossrayError, match="has learned the appearances of the training photos"):
        make_figure("transfer", learned, tmp_path / "x", Order(photos=("photo_003.jpg",)))
    painter = Painter(coded)
    sheet = transfer(painter, NAMES, ["photo_003.jpg"]).sheet
    for picture, name in zip(pictures(sheet.rows[1])[1:], NAMES, strict=True):
        assert np.array_equal(picture, painted(painter, 3, name))


@pytest.mark.slow
def test_masks_that_were_made_elsewhere(scene, tmp_path):
    fixed = trained(scene, "fixed", "crossray", {"transient": "fixed"})
    make_figure("masks", fixed, tmp_path)
    mask = masks(Painter(fixed), ["photo_000.jpg"]).sheet.rows[1].panels[0].picture
    assert mask[2, 2].tolist() == coloured(np.ones((1, 1)), BAR)[0, 0].tolist()  # the corner that tiny_run masks
    assert mask[15, 20].tolist() == coloured(np.zeros((1, 1)), BAR)[0, 0].tolist()


# Studies


def study_folder(folder: Path, scene: str = "place", sizes: tuple[int, int] = (20, 28), published: bool = True) -> Path:
    """A folder as a study leaves it: two variants, two seeds, PSNR 20 and 22 for the first, 25 and 25 for the other."""
    study = {
        "name": "s",
        "base": {"method": "crossray"},
        "variants": {f"rays{k * k}": {"patch": {"size": size}} for k, size in zip((20, 28), sizes, strict=True)},
        "scenes": {scene: {"scene": {"path": "data"}, "evaluate": {"protocols": ["crnerf-full@R2"]}}},
        "seeds": [0, 1],
        "published": "num-rays-R4" if published else None,
    }
    psnr = {("rays400", 0): 20.0, ("rays400", 1): 22.0, ("rays784", 0): 25.0, ("rays784", 1): 25.0}
    runs = [
        {
            "run": f"runs/s/{scene}.{variant}.seed{seed}",
            "scene": scene,
            "variant": variant,
            "seed": seed,
            "checkpoint_sha256": "00",
            "protocols": {"crnerf-full@R2": {"mean": {"psnr": value, "ssim": 0.5, "lpips": None}}},
        }
        for (variant, seed), value in psnr.items()
    ]
    folder.mkdir(parents=True)
    dumped = make_study(study).model_dump(mode="json")
    (folder / "study.json").write_text(json.dumps({"study": dumped, "runs": runs, "failures": {}}))
    return folder


def test_a_study_is_a_curve_over_rays(tmp_path):
    studied = read_study(study_folder(tmp_path / "s"))
    ours, theirs, ssim = charts_of(studied)
    (curve,) = ours.curves
    assert (curve.name, curve.rays) == ("place", [400, 784])
    assert [s.mean for s in curve.scores] == [21, 25]
    assert curve.scores[0].sd == pytest.approx(2**0.5)
    (published,) = theirs.curves  # of another scene: not comparable, so in a chart of its own
    assert (published.name, published.published) == ("brandenburg_gate, published", True)
    assert [s.mean for s in published.scores] == [26.82, 27.12]
    assert (ssim.metric, len(ssim.curves)) == ("ssim", 1)


def test_published_numbers_of_the_same_scene_stand_beside(tmp_path):
    charts = charts_of(read_study(study_folder(tmp_path / "s", "brandenburg_gate")))
    assert [(chart.metric, [c.published for c in chart.curves]) for chart in charts] == [
        ("psnr", [False, True]),
        ("ssim", [False]),
    ]


def test_the_figure_of_a_study(tmp_path):
    folder = study_folder(tmp_path / "s")
    png, pdf, record = make_figure("rays", folder, tmp_path / "a")
    assert Image.open(png).size == (round(300 * TEXT), 555)
    said = json.loads(record.read_text())
    assert (said["study"], said["protocol"], said["published"]) == ("s", "crnerf-full@R2", "num-rays-R4")
    assert len(said["runs"]) == 4
    assert make_figure("rays", folder, tmp_path / "b")[1].read_bytes() == pdf.read_bytes()
    with pytest.raises(CrossrayError, match=r"--columns: figure rays has no use for it, of a study"):
        make_figure("rays", folder, tmp_path / "c", Order(columns=2))


@pytest.mark.parametrize("damage", ["cut", "list", "no runs", "one size", "other variant", "no protocol"])
def test_a_study_that_is_none_is_refused(tmp_path, damage):
    folder = study_folder(tmp_path / "s", sizes=(20, 20) if damage == "one size" else (20, 28))
    file = folder / "study.json"
    record = json.loads(file.read_text())
    part = "cannot be read as a study's results"
    if damage == "cut":
        file.write_text(file.read_text()[:50])
    elif damage == "list":
        file.write_text("[]")
    elif damage == "no runs":
        part = "no protocol under which all its runs were evaluated"
        file.write_text(json.dumps(record | {"runs": []}))
    elif damage == "one size":
        part = "no two of its runs differ in patch.size"
    elif damage == "other variant":
        record["runs"][0]["variant"] = "none"
        file.write_text(json.dumps(record))
    else:
        part = "no protocol under which all its runs were evaluated"
        record["runs"][0]["protocols"] = {}
        file.write_text(json.dumps(record))
    with pytest.raises(CrossrayError, match=part):
        make_figure("rays", folder, tmp_path / "out")
