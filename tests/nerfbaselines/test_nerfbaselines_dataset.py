"""nerfbaselines' data sets become the same photos, cameras and bounds as our own shards of the scene."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("nerfbaselines.evaluation", reason="nerfbaselines is not installed: make test-nerfbaselines")

from nerfbaselines_data import TINY

from pipeline.batches import TrainingPhotos
from pipeline.config import make_job, merge
from pipeline.cutting import cut_shards
from pipeline.errors import CrossrayError
from pipeline.launch.tasks import in_process
from pipeline.nerfbaselines.dataset import DatasetPhotos, picture_of
from pipeline.nerfbaselines.describe import main
from pipeline.nerfbaselines.method import USUAL
from pipeline.photos import open_photos
from pipeline.record import LossRecord
from pipeline.train import build_model, build_optimiser, set_up_torch, training_step
from pipeline.work import Context, Work


def job(**scene):
    return make_job(merge(merge(USUAL, TINY), {"model": {"channels": 8}, "scene": scene}))


def shards(root, folder, wanted):
    """Our own way from the scene's folder to photos in memory."""
    cut_shards(
        root,
        folder / "shards",
        downscale=wanted.scene.downscale,
        reference_downscale=wanted.scene.reference_downscale,
        plan=wanted.patch,
        mapper=in_process,
    )
    return open_photos(folder / "shards", folder / "cache")


@pytest.mark.parametrize("scene_job", [{"downscale": 1, "reference_downscale": 4}, {"downscale": 2}])
def test_photos_and_cameras_are_those_of_our_shards(scene, photos, tmp_path, scene_job):
    wanted = job(**scene_job)
    theirs, ours = DatasetPhotos(photos, wanted), shards(scene, tmp_path, wanted)
    train = ours.indices("train")
    assert len(theirs) == len(train) == 7
    assert theirs.indices("train") == tuple(range(7))
    for i, k in enumerate(train):
        one, other = theirs.records[i], ours.records[k]
        assert one.name == other.name
        assert np.array_equal(theirs.image(i), ours.image(k))
        assert np.array_equal(theirs.reference(i), ours.reference(k))
        assert theirs.mask(i) is None
        numbers = ("width", "height", "fx", "fy", "cx", "cy", "near", "far")
        assert [getattr(one, n) for n in numbers] == pytest.approx([getattr(other, n) for n in numbers], rel=1e-5)
        np.testing.assert_allclose(one.c2w, other.c2w, atol=2e-5)
    # Here only the training photos are known; in this scene one of them sees the farthest, so the scale is the same.
    assert theirs.manifest.scene.scale == pytest.approx(ours.manifest.scene.scale, rel=1e-5)
    np.testing.assert_allclose(theirs.manifest.scene.box, ours.manifest.scene.box, rtol=1e-4)


def test_a_step_is_that_of_our_training(scene, photos, tmp_path):
    """The first step's losses from nerfbaselines' photos and from our shards."""
    wanted, losses = job(), []
    for source in (DatasetPhotos(photos, wanted), shards(scene, tmp_path, wanted)):
        set_up_torch(wanted, Context().device)
        work = Work(wanted, Context(), TrainingPhotos(source, Context().device, 0.5), 6)
        model = build_model(wanted, source, Context().device)
        record = LossRecord(tmp_path / "losses", 0)
        terms, _ = training_step(work, model, build_optimiser(model, wanted.train), 0, record)
        losses.append({name: float(term) for name, term in terms.items()})
    assert losses[0] == pytest.approx(losses[1], rel=1e-3, abs=1e-7)
    assert losses[0]["fine"] > 0


def test_the_same_photos_have_the_same_hash_and_others_another(photos):
    changed = photos.copy()
    changed["images"] = [image.copy() for image in photos["images"]]
    changed["images"][3][0, 0, 0] ^= 1
    hashes = [DatasetPhotos(d, job()).manifest.content_hash for d in (photos, photos, changed)]
    assert hashes[0] == hashes[1] != hashes[2]


def test_photos_that_are_padded_to_one_size_lose_their_border(photos):
    padded = photos.copy()
    padded["images"] = np.zeros((7, 120, 120, 3), np.uint8)
    for i, image in enumerate(photos["images"]):
        padded["images"][i, : image.shape[0], : image.shape[1]] = image
    for i in range(7):
        assert np.array_equal(picture_of(padded, i), photos["images"][i])


def test_what_cannot_be_read_is_said(photos):
    for images in (
        [image / np.float32(255) for image in photos["images"]],
        [np.dstack([image, image[..., :1]]) for image in photos["images"]],
        [image[:-1] for image in photos["images"]],
    ):
        with pytest.raises(CrossrayError, match="8-bit RGB"):
            DatasetPhotos({**photos, "images": images}, job())
    for points in (None, np.zeros((0, 3), np.float32)):
        with pytest.raises(CrossrayError, match="points3D_xyz"):
            DatasetPhotos({**photos, "points3D_xyz": points}, job())


def test_describing_a_scene_that_is_none(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "no COLMAP model" in capsys.readouterr().err
    assert main([]) == 2


def test_validation_photos_are_in_no_list(scene):
    listed = [(scene / f"{split}_list.txt").read_text().split() for split in ("train", "test")]
    rows = [line.split("\t") for line in (scene / "landmark.tsv").read_text().splitlines()[1:]]
    assert [sorted(names) for names in listed] == [
        sorted(row[0] for row in rows if row[2] == split) for split in ("train", "test")
    ]
    assert (len(listed[0]), len(listed[1])) == (7, 2)
