"""What a rank sees in a step: the right pixels, rays and references, and how they are varied."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_scene import photo_names, write_tiny_scene

from model.cameras import patch_grid
from pipeline.batches import TrainingPhotos, as_tensor, jitter_colours
from pipeline.cutting import cut_shards
from pipeline.errors import CrossrayError
from pipeline.launch.tasks import in_process
from pipeline.manifest import CameraRecord
from pipeline.patches import Patch, PatchPlan
from pipeline.photos import Photos, open_photos

CPU = torch.device("cpu")
# Photo 3 of the training photos is photo 4 of the scene: the scene's photo 3 is a test photo.
PATCHES = [Patch(0, 1.0, 0.0, 0.0, 2), Patch(3, 0.6, 0.3, 0.1, 0)]
K = 5


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("batches")
    root = write_tiny_scene(folder / "tiny", photos=6, size=(96, 72))
    cut_shards(root, folder / "shards", downscale=2, plan=PatchPlan(), mapper=in_process)
    return open_photos(folder / "shards", folder / "cache")


@pytest.fixture(scope="module")
def data(photos):
    return TrainingPhotos(photos, CPU, pixel_center=0.5)


def test_only_training_photos(data, photos):
    assert data.index == (0, 1, 2, 4, 5)
    assert data.sizes.tolist() == [[36, 48]] * 5


def test_colours_are_the_photo_s_pixels(data, photos):
    batch = data.batch(PATCHES, K)
    assert batch.colours.shape == (2, K * K, 3)
    for patch, scene_index, colours in zip(PATCHES, (0, 4), batch.colours, strict=True):
        rows, cols, _ = patch_grid(K, patch.scale, patch.offset_h, patch.offset_w, 36, 48)
        image = photos.image(scene_index)
        for n, (row, col) in enumerate(zip(rows.tolist(), cols.tolist(), strict=True)):
            np.testing.assert_allclose(colours[n], image[row, col] / 255, atol=1e-7)


def test_positions_are_the_pixels_middles(data):
    batch = data.batch(PATCHES, K)
    for patch, positions in zip(PATCHES, batch.positions, strict=True):
        rows, cols, _ = patch_grid(K, patch.scale, patch.offset_h, patch.offset_w, 36, 48)
        torch.testing.assert_close(positions, torch.stack([(cols + 0.5) / 48, (rows + 0.5) / 36], dim=-1))


@pytest.mark.parametrize("pixel_center", [0.0, 0.5])
def test_rays_go_through_their_pixels(photos, pixel_center):
    data = TrainingPhotos(photos, CPU, pixel_center)
    rays = data.batch(PATCHES, K).rays
    assert rays.origins.shape == rays.directions.shape == (2 * K * K, 3)
    for part, (patch, scene_index) in enumerate(zip(PATCHES, (0, 4), strict=True)):
        camera = photos.records[scene_index]
        rows, cols, _ = patch_grid(K, patch.scale, patch.offset_h, patch.offset_w, camera.height, camera.width)
        here = slice(part * K * K, (part + 1) * K * K)
        c2w = np.array(camera.c2w)
        point = (rays.origins[here] + 3.5 * rays.directions[here]).double().numpy()
        x, y, z = ((point - c2w[:, 3]) @ c2w[:, :3]).T  # back into the camera
        assert (z > 0).all()
        np.testing.assert_allclose(camera.fx * x / z + camera.cx, cols + pixel_center, atol=1e-3)
        np.testing.assert_allclose(camera.fy * y / z + camera.cy, rows + pixel_center, atol=1e-3)
        np.testing.assert_allclose(rays.origins[here], np.broadcast_to(c2w[:, 3], (K * K, 3)), atol=1e-6)
        torch.testing.assert_close(rays.near[here], torch.full((K * K,), camera.near))
        torch.testing.assert_close(rays.far[here], torch.full((K * K,), camera.far))
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(2 * K * K))


def test_references_are_those_of_the_photo_and_of_the_other(data, photos):
    batch = data.batch(PATCHES, K)
    for found, scene_indices in ((batch.references, (0, 4)), (batch.others, (2, 0))):
        for image, i in zip(found, scene_indices, strict=True):
            reference = photos.reference(i)
            assert image.shape == (3, *reference.shape[:2])
            np.testing.assert_allclose(image.permute(1, 2, 0), reference / 255, atol=1e-7)


def test_as_tensor_by_hand():
    picture = np.array([[[0, 51, 255], [102, 0, 0]]], np.uint8)
    torch.testing.assert_close(as_tensor(picture, CPU), torch.tensor([[[0, 0.4]], [[0.2, 0]], [[1.0, 0]]]))


class PhotosOfManySizes:
    """Stands in for Photos: the tiny scene's photos are all of one size."""

    def __init__(self) -> None:
        self.images = [np.random.default_rng(i).integers(0, 256, (*size, 3), np.uint8) for i, size in self.sizes()]
        self.records = [
            CameraRecord(
                key=f"p{i}", name=f"p{i}.jpg", image_id=i, split="train", width=w, height=h, fx=30.0 + i, fy=31.0,
                cx=w / 2, cy=h / 2 + i, c2w=((1, 0, 0, i), (0, 1, 0, 0), (0, 0, 1, 0)), near=1 + i, far=5 + i,
                source_sha256="0" * 64,
            )
            for i, (h, w) in self.sizes()
        ]  # fmt: skip

    def sizes(self):
        return enumerate([(20, 30), (30, 20), (9, 50)])

    def indices(self, split):
        return (0, 1, 2) if split == "train" else ()

    def image(self, i):
        return self.images[i]

    reference = image


def test_photos_of_different_sizes_share_a_batch():
    photos = PhotosOfManySizes()
    data = TrainingPhotos(photos, CPU, 0.5)
    chosen = [Patch(2, 0.9, 0.05, 0.02, 0), Patch(1, 0.5, 0.1, 0.4, 0), Patch(2, 1.0, 0.0, 0.0, 1)]
    batch = data.batch(chosen, 4)
    assert [tuple(r.shape) for r in batch.references] == [(3, 9, 50), (3, 30, 20), (3, 9, 50)]
    for n, patch in enumerate(chosen):
        h, w = data.sizes[patch.photo]
        rows, cols, _ = patch_grid(4, patch.scale, patch.offset_h, patch.offset_w, int(h), int(w))
        x, y = batch.positions[n].T
        assert torch.equal((x * w).floor().long(), cols)
        assert torch.equal((y * h).floor().long(), rows)
        np.testing.assert_allclose(batch.colours[n], photos.images[patch.photo][rows, cols] / 255, atol=1e-7)
        camera, here = photos.records[patch.photo], slice(16 * n, 16 * (n + 1))
        x, y, z = batch.rays.directions[here].T
        torch.testing.assert_close(camera.fx * x / z + camera.cx, cols + 0.5, atol=1e-3, rtol=0)
        torch.testing.assert_close(camera.fy * y / z + camera.cy, rows + 0.5, atol=1e-3, rtol=0)
        assert (batch.rays.near[here] == camera.near).all()
        assert (batch.rays.origins[here, 0] == patch.photo).all()


# ------------------------------------------------------------------------------------------------------- masks


def with_masks(folder, unmasked: tuple[int, ...] = ()) -> Photos:
    """The tiny scene with a mask of all greys for every photo but the `unmasked` ones."""
    root = write_tiny_scene(folder / "tiny", photos=6, size=(96, 72))
    (root / "masks").mkdir()
    for i, name in enumerate(photo_names(6)):
        if i not in unmasked:
            grey = np.random.default_rng(i).integers(0, 256, (72, 96), np.uint8)
            Image.fromarray(grey).save(root / "masks" / name.replace(".jpg", ".png"))
    cut_shards(root, folder / "shards", downscale=2, plan=PatchPlan(), mapper=in_process)
    return open_photos(folder / "shards", folder / "cache")


@pytest.fixture(scope="module")
def masked(tmp_path_factory):
    return with_masks(tmp_path_factory.mktemp("masked"))


def test_masks_are_those_of_the_patches_pixels(masked):
    batch = TrainingPhotos(masked, CPU, 0.5, masks=True).batch(PATCHES, K)
    assert batch.masks.shape == (2, K * K)
    assert batch.masks.dtype == torch.float32
    for patch, scene_index, found in zip(PATCHES, (0, 4), batch.masks, strict=True):
        rows, cols, _ = patch_grid(K, patch.scale, patch.offset_h, patch.offset_w, 36, 48)
        mask = masked.mask(scene_index)
        for value, row, col in zip(found.tolist(), rows.tolist(), cols.tolist(), strict=True):
            assert value == pytest.approx(mask[row, col] / 255, abs=1e-7)
    assert batch.masks.std() > 0.05  # greys stay greys


def test_masks_come_only_where_they_are_asked_for(masked):
    plain, fixed = (TrainingPhotos(masked, CPU, 0.5, masks=wanted).batch(PATCHES, K) for wanted in (False, True))
    assert plain.masks is None
    assert torch.equal(plain.colours, fixed.colours)
    assert TrainingPhotos(masked, CPU, 0.5).batch(PATCHES, K).masks is None


def test_colour_jitter_leaves_masks_alone(masked):
    batch = TrainingPhotos(masked, CPU, 0.5, masks=True).batch(PATCHES, K)
    assert jitter_colours(batch, 0.2, rng(1)).masks is batch.masks


@pytest.mark.parametrize(
    ("unmasked", "message"),
    [
        ((2,), r"model\.transient: fixed.* no mask of photo_002\.jpg; `crossray mask"),
        ((0, 3, 4, 5), r"no mask of photo_000\.jpg and 2 more training photos; `crossray mask"),
    ],
    ids=["one", "three, and one that is not trained on"],
)
def test_training_photos_without_masks_are_named(tmp_path, unmasked, message):
    photos = with_masks(tmp_path, unmasked)
    TrainingPhotos(photos, CPU, 0.5)
    with pytest.raises(CrossrayError, match=message):
        TrainingPhotos(photos, CPU, 0.5, masks=True)


def test_only_training_photos_need_masks(tmp_path):
    batch = TrainingPhotos(with_masks(tmp_path, unmasked=(3,)), CPU, 0.5, masks=True).batch(PATCHES, K)
    assert batch.masks is not None


# ------------------------------------------------------------------------------------------------ colour jitter


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def with_extremes(data):
    """A batch whose patches and references hold black and white too."""
    batch = data.batch(PATCHES, K)
    batch.colours[:, 0], batch.colours[:, 1] = 0.0, 1.0
    for reference in batch.references:
        reference[:, 0, 0], reference[:, 0, 1] = 0.0, 1.0
    return batch


def test_strength_zero_is_the_identity(data):
    batch = with_extremes(data)
    same = jitter_colours(batch, 0.0, rng())
    torch.testing.assert_close(same.colours, batch.colours, atol=1e-6, rtol=0)
    for a, b in zip(same.references, batch.references, strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=0)


def test_patch_and_reference_change_by_one_function(data):
    """Colours that are equal before are equal after, wherever they stand."""
    batch = data.batch(PATCHES, K)
    # Each reference's first row becomes the colours of its patch.
    references = [c[: r.shape[2]].T[:, None].clone() for c, r in zip(batch.colours, batch.references, strict=True)]
    changed = jitter_colours(batch._replace(references=references), 0.2, rng(3))
    for i in range(2):
        width = references[i].shape[2]
        torch.testing.assert_close(changed.references[i][:, 0].T, changed.colours[i][:width])
    assert (changed.colours - batch.colours).abs().amax(dim=(1, 2)).min() > 0.02  # every photo changes
    assert changed.colours.min() >= 0
    assert changed.colours.max() <= 1
    assert changed.others is batch.others
    assert changed.rays is batch.rays


def test_each_photo_has_its_own_change_a_gain_and_a_gamma(data):
    batch = data.batch(PATCHES, K)
    ramp = torch.linspace(0.1, 0.6, K * K)[:, None].expand(-1, 3)
    changed = jitter_colours(batch._replace(colours=torch.stack([ramp, ramp])), 0.15, rng(1)).colours
    assert not torch.allclose(changed[0], changed[1], atol=1e-3)
    for colours in changed:  # log y = log gain + gamma log x, one gamma for all channels, a gain for each
        x, y = ramp.log(), colours.log()
        slopes = (y[-1] - y[0]) / (x[-1] - x[0])
        torch.testing.assert_close(slopes, slopes[:1].expand(3), atol=1e-4, rtol=0)
        assert slopes[0].log().abs() <= 0.15 + 1e-4
        gains = y - slopes * x
        torch.testing.assert_close(gains, gains[:1].expand_as(gains), atol=1e-4, rtol=0)
        assert gains.abs().max() <= 0.3 + 1e-4
        assert gains[0].std() > 1e-3  # the white balance


def test_the_jitter_depends_on_its_generator_alone(data):
    batch = data.batch(PATCHES, K)
    first, same, other = (jitter_colours(batch, 0.1, rng(s)) for s in (1, 1, 2))
    assert torch.equal(first.colours, same.colours)
    assert all(torch.equal(a, b) for a, b in zip(first.references, same.references, strict=True))
    assert not torch.equal(first.colours, other.colours)
