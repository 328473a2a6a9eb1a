"""The report: one page that needs nothing else, says what is there and what is not, and takes every name for text."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tiny_run import cut_tiny, tiny_job, tiny_mapping

from pipeline import cli
from pipeline.bootstrap import interval
from pipeline.config import save_job
from pipeline.errors import CrossrayError
from pipeline.evaluate import evaluate_run
from pipeline.report import Row, write_report
from pipeline.report.album import Album
from pipeline.report.dots import Numbers, make_dots
from pipeline.report.gallery import apart, spread, tinted
from pipeline.report.make import make_report
from pipeline.report.plots import Series, compact, make_plot, thinned
from pipeline.report.words import short
from pipeline.study import expand, make_study, result_of
from pipeline.study_tables import make_tables, write_results
from pipeline.train import train
from pipeline.work import Context

PROTOCOL = "crnerf-full@R2"
EVIL = "\"'></td><script>alert(1)</script><img src=x onerror=alert(1)>&amp;" + "x" * 300
VOID = {"meta", "img", "input", "br", "link", "source"}


class Reader(HTMLParser):
    """What a page is made of: tags, text, ids, rows of tables; checks that what is opened is closed."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(page)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        assert len(attrs) == len(dict(attrs)), tag
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self) -> str:
        return "".join(self.words)

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]

    def of_class(self, name):
        return [attributes for _, attributes in self.tags if name in (attributes.get("class") or "").split()]


def check(path: Path) -> Reader:
    """What holds for every page: whole, offline, described, small."""
    page = path.read_text()
    assert len(page) < 10_000_000
    assert page.startswith("<!doctype html>")
    assert not re.search(r"https?:|//[a-z]+\.|@import|url\(", page)
    reader = Reader(page)
    assert all(a["src"].startswith("data:image/webp;base64,") and a["alt"] for a in reader.all("img"))
    assert not {"link", "iframe", "object", "embed", "base"} & {tag for tag, _ in reader.tags}
    assert not any(name.startswith("on") for _, a in reader.tags for name in a)
    ids = [a["id"] for _, a in reader.tags if "id" in a]
    assert len(ids) == len(set(ids))
    assert {a["href"][1:] for a in reader.all("a") if a["href"].startswith("#")} <= set(ids)
    assert all(a["aria-labelledby"] in ids for a in reader.all("section"))
    for figure in reader.of_class("plot"):
        json.loads(figure["data-points"], parse_constant=pytest.fail)
    assert not list(path.parent.glob(f".{path.name}*"))
    return reader


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    return cut_tiny(tmp_path_factory.mktemp("report"))


@pytest.fixture(autouse=True)
def _cache(cut, monkeypatch):
    monkeypatch.setenv("CROSSRAY_CACHE", str(cut / "cache"))
    monkeypatch.delenv("CROSSRAY_LPIPS", raising=False)


def trained(cut: Path, name: str, method: str, evaluated: bool = True, **over) -> Path:
    job = tiny_job(cut, method, {"name": name, "train": {"epochs": 1, "log_every": 1}} | over)
    save_job(job, job.run / "job.yaml")
    train(job, Context())
    if evaluated:
        evaluate_run(job.run, PROTOCOL)
    return job.run


@pytest.fixture(scope="module")
def ours(cut):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(cut / "cache"))
        return trained(cut, "ours", "crossray")


@pytest.fixture
def copied(ours, tmp_path):
    """A copy of the trained run, to be spoilt."""
    return Path(shutil.copytree(ours, tmp_path / "runs" / "ours"))


def change(run: Path, edit) -> None:
    """Edit the run's metrics.json."""
    (path,) = run.glob("eval/*/*/metrics.json")
    result = json.loads(path.read_text())
    edit(result)
    path.write_text(json.dumps(result))


# --------------------------------------------------------------------------------------------------------- the page


@pytest.mark.slow
def test_the_report_of_a_run_has_every_part(ours, tmp_path):
    reader = check(make_report(ours, tmp_path / "page.html"))
    sections = [a["id"] for a in reader.all("section")]
    assert sections == ["pictures", "appearances", "masks", "scores", "curves", "timing", "provenance"]
    metrics = json.loads(next(ours.glob("eval/*/*/metrics.json")).read_text())
    assert f"{metrics['mean']['psnr']:.2f}" in reader.text
    assert metrics["checkpoint_sha256"] in reader.text
    assert "steps_per_epoch: 6" in reader.text  # the resolved job
    assert len(reader.of_class("stage")) == 2 + 4  # the one test photo, at the top too; every training photo's mask
    assert {"Losses", "PSNR in training, dB"} <= {a["aria-label"].split(";")[0] for a in reader.all("svg")}
    pictures = [Image.open(io.BytesIO(base64.b64decode(a["src"].split(",")[1]))) for a in reader.all("img")]
    assert [p.size for p in pictures] == [(int(a["width"]), int(a["height"])) for a in reader.all("img")]
    assert make_report(ours) == ours / "report.html"
    (ours / "report.html").unlink()


@pytest.mark.slow
def test_names_of_photos_are_text(copied, tmp_path):
    def rename(result):
        result["images"][0]["name"] = EVIL
        result["device"] = EVIL

    change(copied, rename)
    reader = check(make_report(copied))
    assert len(reader.all("script")) == 1
    assert short(EVIL)[:20] in reader.text
    assert not any(a.get("src") == "x" for a in reader.all("img"))


@pytest.mark.slow
def test_what_is_not_finite_is_said_in_words(copied):
    def spoil(result):
        row = result["images"][0]
        result["images"] = [
            row | {"psnr": p, "name": n} for p, n in ((20.5, "b"), (float("inf"), "c"), (float("nan"), "a"))
        ]
        result["mean"]["psnr"] = float("nan")

    change(copied, spoil)
    page = make_report(copied)
    reader = check(page)
    assert "not a number" in reader.text
    assert "∞" in reader.text
    values = [a["data-value"] for a in reader.all("td") if "data-value" in a]
    assert values[1::3] == ["", "20.5", "Infinity"]  # by PSNR, as the table comes
    assert values[0::3] == ["a", "b", "c"]
    assert [a.get("aria-sort") for a in reader.all("th")] == [None, None, "ascending", None]


@pytest.mark.slow
def test_a_table_says_mean_and_interval(copied):
    scores = [18.0, 21.0, 24.0]

    def spread_out(result):
        row = result["images"][0]
        result["images"] = [row | {"psnr": p} for p in scores]
        result["mean"]["psnr"] = 21.0
        result.pop("interval", None)

    change(copied, spread_out)
    low, high = interval(scores)
    assert f"95 %: {low:.2f} to {high:.2f}" in check(make_report(copied)).text
    change(copied, lambda result: result.update(interval={"psnr": [1.25, 2.5]}))  # as recorded
    assert "95 %: 1.25 to 2.50" in check(make_report(copied)).text


@pytest.mark.slow
def test_a_run_without_photos_pictures_or_readable_scores(copied, cut, tmp_path):
    shutil.copytree(next(copied.glob("eval/*")), copied / "eval" / "cross@R2")
    next(copied.glob("eval/cross@R2/*/metrics.json")).write_text("{")
    job = (copied / "job.yaml").read_text()
    (copied / "job.yaml").write_text(job.replace(str(cut / "shards"), str(tmp_path / "moved")))
    reader = check(make_report(copied))
    assert f"crossray evaluate {copied} --protocol cross@R2" in reader.text
    assert "Nothing could be rendered" in reader.text
    assert "No pictures to compare" in reader.text
    assert "curves" in [a["id"] for a in reader.all("section")]


def test_a_run_that_was_never_trained(cut, tmp_path):
    job = tiny_job(cut, "nerf", {"name": "new"})
    save_job(job, job.run / "job.yaml")
    reader = check(make_report(job.run, tmp_path / "page.html"))
    assert f"crossray run {job.run / 'job.yaml'}" in reader.text
    assert "not trained" in reader.text
    assert not reader.all("img")
    assert not reader.all("script")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "words"),
    [
        ("nerf", "one appearance for all photos"),
        ("nerfw", "From the appearance of"),
        ("hanerf", "From the appearance of"),
    ],
)
def test_every_kind_of_method_before_its_evaluation(cut, method, words):
    over = {"model": {"encoder": "compact"}} if method == "hanerf" else {}
    reader = check(make_report(trained(cut, method, method, evaluated=False, **over)))
    assert words in reader.text
    assert f"--protocol {PROTOCOL}" in reader.text
    assert len(reader.of_class("grid")) == 1
    assert ("it has no masks" in reader.text) == (method == "nerf")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs the browser `chromium`")
def test_the_script_of_the_page_runs(ours, tmp_path):
    page = make_report(ours, tmp_path / "page.html")
    quiet = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run")
    still = ("--disable-background-networking", "--disable-component-update", "--disable-sync")
    browser = ["chromium", *quiet, *still, f"--user-data-dir={tmp_path / 'browser'}", "--dump-dom", page.as_uri()]
    shown = subprocess.run(browser, capture_output=True, text=True, timeout=100, check=True).stdout
    before = page.read_text()
    assert shown.count('class="stage live"') == before.count('class="stage"') > 0
    assert shown.count('type="range"') == before.count('class="stage"')
    assert shown.count("<button") == before.count(" data-sort") > 0
    assert shown.count('class="cursor"') == before.count("<svg") > 0


# -------------------------------------------------------------------------------------------------------- the study


@pytest.fixture(scope="module")
def study(cut):
    """Two variants, of one of which one seed failed."""
    base = tiny_mapping(cut, "nerf", {"train": {"epochs": 1}, "evaluate": {"protocols": [PROTOCOL]}})
    scene = base.pop("scene")
    for key in ("name", "runs", "method"):
        base.pop(key)
    raw = {
        "name": "tiny",
        "runs": str(cut / "studies"),
        "base": base,
        "variants": {"plain": {"method": "nerf"}, "coded": {"method": "crnerf-b"}},
        "scenes": {"wall": {"scene": scene}},
        "seeds": [0, 1],
    }
    made = make_study(raw)
    runs = expand(made)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(cut / "cache"))
        for run in runs[:3]:
            save_job(run.job, run.job.run / "job.yaml")
            train(run.job, Context())
            evaluate_run(run.job.run, PROTOCOL)
    results = [found for run in runs if (found := result_of(run)) is not None]
    write_results(made, results, make_tables(made, runs, results), {runs[3].job.name: f"failed: {EVIL}"})
    return made


@pytest.mark.slow
def test_the_report_of_a_study_compares_its_variants(study, tmp_path):
    first = study.folder / "wall.plain.seed0" / "report.html"
    first.write_text("a page")
    page = make_report(study.folder)
    reader = check(page)
    assert [a["id"] for a in reader.all("section")] == ["tables", "charts", "pictures", "runs", "provenance"]
    assert [a["href"] for a in reader.all("a") if not a["href"].startswith("#")] == ["wall.plain.seed0/report.html"]
    assert {"photo photo_003.jpg", "photo_003.jpg by plain", "photo_003.jpg by coded"} == {
        a["alt"] for a in reader.all("img")
    }
    results = json.loads((study.folder / "study.json").read_text())["runs"]
    plain = [r["protocols"][PROTOCOL]["mean"]["psnr"] for r in results if r["variant"] == "plain"]
    assert len(plain) == 2
    assert f"{np.mean(plain):.2f} ± {np.std(plain, ddof=1):.2f} (2)" in reader.text
    assert "failed: \"'></td><script>" in reader.text
    assert len(reader.of_class("dot")) == 3 * 2  # a run each, of PSNR and of SSIM
    elsewhere = check(make_report(study.folder, tmp_path / "page.html"))
    (link,) = [a["href"] for a in elsewhere.all("a") if not a["href"].startswith("#")]
    assert (tmp_path / link).resolve() == first.resolve()
    page.unlink()
    first.unlink()


@pytest.mark.slow
def test_a_damaged_study_is_refused(study, tmp_path):
    (tmp_path / "study.json").write_text(json.dumps({"study": {"name": "x"}, "runs": [], "failures": {}}))
    with pytest.raises(CrossrayError, match=r"study\.json: cannot be read .* writes it anew"):
        make_report(tmp_path)


# ------------------------------------------------------------------------------------------------ the command line


def command(monkeypatch, capsys, *words) -> tuple[int, str]:
    monkeypatch.setattr("sys.argv", ["crossray", *map(str, words)])
    monkeypatch.setenv("COLUMNS", "500")
    try:
        cli.main()
        status = 0
    except SystemExit as end:
        status = int(end.code or 0)
    found = capsys.readouterr()
    return status, found.out + found.err


def test_the_command_writes_the_page_where_it_is_told(cut, tmp_path, monkeypatch, capsys):
    job = tiny_job(cut, "nerf", {"name": "asked"})
    save_job(job, job.run / "job.yaml")
    status, text = command(monkeypatch, capsys, "report", job.run, "--out", tmp_path / "new" / "a page.html")
    assert status == 0
    assert "a page.html" in text
    check(tmp_path / "new" / "a page.html")


def test_what_is_no_run_is_one_message(tmp_path, monkeypatch, capsys):
    (tmp_path / "job.yaml").write_text("name: x\nmethod: nerv\nscene: {path: a}\n")
    (tmp_path / "empty").mkdir()
    for words, part in (
        ([tmp_path], "nerv"),
        ([tmp_path / "empty"], "has no job.yaml (a run), study.json (a study) or summary.json"),
        ([tmp_path / "none"], "is not there"),
        ([tmp_path, "--out", tmp_path / "empty"], "is a folder"),
    ):
        status, text = command(monkeypatch, capsys, "report", *words)
        assert status == 2
        assert part in text
        assert "Traceback" not in text
    assert not list(tmp_path.rglob("*.html"))


# ------------------------------------------------------------------------------------------------------- the parts


def test_the_page_of_rows_holds_scores_and_pictures_to_the_pixel(tmp_path):
    colour = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    rows = [Row("view <1>", {"photo": colour, "depth & mask": colour[..., 0]})]
    path = write_report(tmp_path / "new" / "report.html", "A <title>", [("psnr", "22.500", "what & why")], rows)
    reader = check(path)
    assert {"psnr", "22.500", "what & why", "view <1>", "depth & mask"} <= set(reader.words)
    found = [np.asarray(Image.open(io.BytesIO(base64.b64decode(a["src"][23:])))) for a in reader.all("img")]
    for picture, expected in zip(found, (colour, np.repeat(colour[..., :1], 3, axis=-1)), strict=True):
        np.testing.assert_array_equal(picture, expected)


def test_a_full_album_leaves_pictures_out_and_says_so():
    picture = np.random.default_rng(0).integers(0, 256, (64, 48, 3), np.uint8)
    size = len(Album().add(picture, "a", 640).source)
    album = Album(room=2 * size + 1)
    found = [album.add(picture, "a", 640) for _ in range(4)]
    assert [bool(p.source) for p in found] == [True, True, False, False]
    assert album.foot.startswith("2 pictures were left out")
    small = Album().add(picture, "a", 32)
    assert (small.width, small.height) == (24, 32)
    assert Album().foot == ""


def test_a_line_is_thinned_to_means_with_what_they_span():
    steps = np.arange(10)
    found = thinned(steps, np.array([1, 3, 5, np.nan, np.inf, np.nan, 2, 2, 0, 8.0]), most=5)
    np.testing.assert_array_equal(found.steps, [1, 3, 5, 7, 9])
    np.testing.assert_array_equal(found.mean, [2, 5, np.nan, 2, 4])
    np.testing.assert_array_equal(found.low, [1, 5, np.nan, 2, 0])
    np.testing.assert_array_equal(found.high, [3, 5, np.nan, 2, 8])


def test_a_plot_has_gaps_where_nothing_is_finite():
    plot = make_plot("t", [Series("a", np.arange(1, 6), np.array([1.0, 2, np.nan, 4, 5]))])
    assert plot.lines[0].path.count("M") == 2
    assert plot.note == "Not finite, and left out: 1 numbers."
    (line,) = json.loads(plot.data)
    assert [point[2:] for point in line["points"]] == [[1, 1.0], [2, 2.0], [4, 4.0], [5, 5.0]]
    ys = [point[1] for point in line["points"]]
    assert ys == sorted(ys, reverse=True)
    assert 10 <= min(ys) <= max(ys) <= 200
    assert make_plot("t", [Series("a", np.arange(3), np.full(3, np.nan))]) is None
    assert make_plot("t", []) is None


@pytest.mark.parametrize("values", [[3.0], [0.0, 0.0], [1e-12, 1.0, 1e6], [-5.0, 5.0], [1e30, 2e30]])
def test_any_finite_numbers_can_be_drawn(values):
    plot = make_plot("t", [Series("a", np.arange(len(values)), np.array(values))])
    numbers = [float(n) for n in re.findall(r"-?[\d.]+", plot.lines[0].path)]
    assert all(0 <= n <= 420 for n in numbers)
    assert len(plot.y_ticks) >= 2


def test_numbers_are_short():
    numbers = [0, 1, 0.25, 999, 1500, 12340, 2.5e6, 3e9, 0.00042, -0.5, 1e-12]
    assert [compact(n) for n in numbers] == (
        ["0", "1", "0.25", "999", "1.5k", "12.3k", "2.5M", "3G", "4.2e-4", "-0.5", "1e-12"]
    )


def test_dots_are_where_their_numbers_are():
    rows = [Numbers("a", [("x", 10.0), ("y", float("inf")), ("z", 20.0)], 15.0, (12.0, 18.0), "15")]
    found = make_dots("t", "c", rows)
    (row,) = found.rows
    scale = dict(zip([float(label) for _, label in found.ticks], [at for at, _ in found.ticks], strict=True))
    assert [at for at, _ in row.dots] == [scale[10], scale[20]]
    assert row.mean == pytest.approx((scale[10] + scale[20]) / 2)
    assert row.bar[1] - row.bar[0] == pytest.approx(0.6 * (scale[20] - scale[10]))
    assert make_dots("t", "c", [Numbers("a", [("x", float("nan"))], float("nan"), None, "-")]) is None


def test_what_is_chosen_is_spread_and_apart():
    assert spread(range(10), 3) == [0, 4, 9]
    assert spread([5, 7], 3) == [5, 7]

    class Photos:
        colours = (0, 10, 200, 100, 205)

        def reference(self, i):
            return np.full((2, 2, 3), self.colours[i], np.uint8)

    assert sorted(apart(Photos(), range(5), 2)) == [0, 4]
    assert sorted(apart(Photos(), range(5), 3)) == [0, 3, 4]
    assert sorted(apart(Photos(), range(5), 9)) == [0, 1, 2, 3, 4]
    assert apart(Photos(), [2], 3) == [2]


def test_a_mask_colours_what_it_marks_alone():
    picture = np.full((1, 2, 3), 100, np.uint8)
    found = tinted(picture, np.array([[0.0, 1.0]], np.float32))
    assert found[0, 0].tolist() == [80, 80, 80]
    assert found[0, 1, 0] > 2 * found[0, 1, 1]


def test_a_long_name_keeps_both_ends():
    assert short("a" * 60) == "a" * 60
    assert short("b" * 200 + ".jpg").endswith(".jpg")
    assert len(short("b" * 200 + ".jpg")) == 51
