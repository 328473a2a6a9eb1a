"""The quick start, small: every stage runs, every score is there and is what its definition says."""

from __future__ import annotations

import json
from contextlib import nullcontext

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import CrossrayError
from pipeline.launch.local import run_local
from pipeline.metrics import psnr
from pipeline.quickstart import Scored, quickstart_job, run_quickstart
from pipeline.report.make import make_report

PHOTOS = {"train": 12, "val": 1, "test": 2}


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    out = tmp_path_factory.mktemp("quickstart")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(out / "cache"))
        patch.setattr("torch.multiprocessing.cpu_count", lambda: 1)  # two ranks are test_launch's subject
        summary = run_quickstart(
            out, train=run_local, tasks=lambda: nullcontext(map), seconds=8.0, size=48, photos=PHOTOS
        )
        yield out, summary, Scored(out, *(quickstart_job(out, m, 1, 8.0) for m in ("crossray", "nerf")))


@pytest.mark.slow
def test_leaves_a_summary_a_report_and_its_pictures(done):
    out, summary, _ = done
    assert json.loads((out / "summary.json").read_text()) == summary
    wanted = {"psnr", "psnr_cross", "psnr_floor", "psnr_nerf", "ssim", "mask_iou", "train_seconds", "total_seconds"}
    assert wanted | {"ranks"} <= summary.keys()
    page = (out / "report.html").read_text()
    captions = ("photo", "clean truth", "NeRF, same budget", "Crossray", "predicted mask", "true mask", "depth")
    assert all(f"<figcaption>{c}</figcaption>" in page for c in captions)
    assert "http" not in page  # offline
    assert page.count('class="stage"') == 5  # truth and rendering of two test photos and three training photos
    assert Image.open(out / "overview.png").size[0] > 1000
    assert len(list((out / "runs").glob("*/tensorboard/events*"))) == 2


@pytest.mark.slow
def test_the_report_is_made_again_from_what_is_there(done, tmp_path):
    out, _, _ = done
    page = make_report(out, tmp_path / "again.html")
    assert page.read_text() == (out / "report.html").read_text()
    (tmp_path / "summary.json").write_text('{"ranks": 1}')
    with pytest.raises(CrossrayError, match=r"summary\.json: is not what the quick start writes"):
        make_report(tmp_path)


@pytest.mark.slow
def test_both_methods_had_the_same_seconds(done):
    _, summary, _ = done
    # The clock is read every ten steps; a step of a busy machine may take long.
    assert 8 <= summary["train_seconds"] < 16
    assert 8 <= summary["nerf_train_seconds"] < 16


@pytest.mark.slow
def test_scores_follow_their_definitions(done):
    _, summary, scored = done
    test = scored.photos.indices("test")
    truths = [scored.landmark.truth(scored.name(i), scored.name(i)) for i in test]
    floors = [psnr(np.broadcast_to(t.reshape(-1, 3).mean(0) / 255, t.shape), t) for t in truths]
    assert summary["psnr_floor"] == pytest.approx(np.mean(floors))
    nerf = [psnr(scored.nerf_picture(i), t) for i, t in zip(test, truths, strict=True)]
    assert summary["psnr_nerf"] == pytest.approx(np.mean(nerf))
    predicted = np.concatenate([(scored.mask(i) > 0.5).ravel() for i in scored.photos.indices("train")])
    true = np.concatenate([scored.landmark.mask(scored.name(i)).ravel() for i in scored.photos.indices("train")])
    assert summary["mask_iou"] == pytest.approx((predicted & true).sum() / max(1, (predicted | true).sum()))


@pytest.mark.slow
def test_again_it_leaves_what_is_done_alone(done):
    out, summary, _ = done
    checkpoints = {p: p.stat().st_mtime_ns for p in out.glob("runs/*/checkpoints/*/*")}
    again = run_quickstart(out, train=run_local, tasks=lambda: nullcontext(map), seconds=8.0, size=48, photos=PHOTOS)
    assert again["psnr"] == summary["psnr"]
    assert {p: p.stat().st_mtime_ns for p in out.glob("runs/*/checkpoints/*/*")} == checkpoints
