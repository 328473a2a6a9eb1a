"""What a rank sees in a step: the pixels and rays of its patches, and the photos that their appearance is read from."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from model.cameras import patch_grid, pixel_rays
from model.fields.base import Rays
from model.scene_model import Batch
from pipeline.errors import CrossrayError
from pipeline.patches import Patch
from pipeline.photos import Photos


class TrainingPhotos:
    """The training photos with their cameras on the training device; pixels stay in the mapped file.

    Args:
        photos: all photos of the scene.
        device: where rays and colours go.
        pixel_center: where in its pixel a ray goes through.
        masks: batches carry the masks that the shards hold.

    Raises:
        CrossrayError: masks are wanted, and a training photo has none.
    """

    def __init__(self, photos: Photos, device: torch.device, pixel_center: float, masks: bool = False) -> None:
        self.photos = photos
        self.device = device
        self.pixel_center = pixel_center
        self.masks = masks
        self.index = photos.indices("train")
        if masks:
            check_masks(photos, self.index)
        records = [photos.records[i] for i in self.index]
        self.sizes = np.array([(r.height, r.width) for r in records], dtype=np.int64)
        self.intrinsics = torch.tensor([(r.fx, r.fy, r.cx, r.cy) for r in records], device=device)
        self.c2w = torch.tensor([r.c2w for r in records], device=device)
        self.bounds = torch.tensor([(r.near, r.far) for r in records], device=device)

    def batch(self, patches: list[Patch], size: int, others: bool = True, references: bool = True) -> Batch:
        """The pixels of `patches`, each a size x size grid; with `references` their photos as a whole, with `others`
        the photos of the appearance loss.
        """
        grids = [
            patch_grid(size, p.scale, p.offset_h, p.offset_w, *(int(n) for n in self.sizes[p.photo])) for p in patches
        ]
        rows = torch.stack([g[0] for g in grids])
        cols = torch.stack([g[1] for g in grids])
        places = list(zip(patches, rows, cols, strict=True))
        colours = torch.stack([self.pixels(p.photo, r, c) for p, r, c in places])
        masks = torch.stack([self.mask(p.photo, r, c) for p, r, c in places]).to(self.device) if self.masks else None
        height, width = torch.from_numpy(self.sizes[[p.photo for p in patches]]).float().t()
        positions = torch.stack([(cols + 0.5) / width[:, None], (rows + 0.5) / height[:, None]], dim=-1)

        chosen = [p.photo for p in patches]
        origins, directions = pixel_rays(
            cols.to(self.device),
            rows.to(self.device),
            self.intrinsics[chosen],
            self.c2w[chosen],
            self.pixel_center,
        )
        near, far = self.bounds[chosen][:, None].expand(-1, rows.shape[1], -1).unbind(-1)
        rays = Rays(origins.flatten(0, 1), directions.flatten(0, 1), near.flatten(), far.flatten())
        whole = [self.reference(p.photo) for p in patches] if references else []
        lent = [self.reference(p.other) for p in patches] if others else []
        photos = torch.tensor(chosen, device=self.device)
        return Batch(rays, colours.to(self.device), positions.to(self.device), photos, whole, lent, masks)

    def pixels(self, photo: int, rows: Tensor, cols: Tensor) -> Tensor:
        """Colours (N, 3) in [0, 1] at rows and columns of one training photo."""
        image = self.photos.image(self.index[photo])
        return torch.from_numpy(image[rows.numpy(), cols.numpy()]).float() / 255

    def mask(self, photo: int, rows: Tensor, cols: Tensor) -> Tensor:
        """Transient probabilities (N,) of the data at rows and columns of one training photo."""
        mask = self.photos.mask(self.index[photo])
        assert mask is not None
        return torch.from_numpy(mask[rows.numpy(), cols.numpy()]).float() / 255

    def reference(self, photo: int) -> Tensor:
        """The appearance reference (3, h, w) in [0, 1] of one training photo."""
        return as_tensor(self.photos.reference(self.index[photo]), self.device)


def check_masks(photos: Photos, indices: tuple[int, ...]) -> None:
    """CrossrayError unless all of these photos have masks."""
    without = [photos.records[i].name for i in indices if photos.mask(i) is None]
    if without:
        more = f" and {len(without) - 1} more training photos" if len(without) > 1 else ""
        raise CrossrayError(
            f"model.transient: fixed, but the shards hold no mask of {without[0]}{more}; "
            "`crossray mask SCENE --with ...` makes masks, and the shards are then cut again"
        )


def check_references(photos: Photos, least: int) -> None:
    """CrossrayError for a reference with a side under `least` pixels, which the model's networks cannot read."""
    for i, record in enumerate(photos.records):
        height, width = photos.reference(i).shape[:2]
        if min(height, width) < least:
            factor = photos.manifest.reference_downscale
            raise CrossrayError(
                f"scene.reference_downscale: {factor} makes {record.name} {width} x {height} pixels, and the released "
                f"networks read no side under {least}; a smaller factor, or model.encoder: compact and "
                "model.segmenter: unet"
            )


def as_tensor(image: np.ndarray, device: torch.device) -> Tensor:
    """A uint8 picture (h, w, 3) as (3, h, w) in [0, 1]."""
    return torch.from_numpy(np.array(image)).to(device).permute(2, 0, 1).float() / 255


def jitter_colours(batch: Batch, strength: float, rng: np.random.Generator) -> Batch:
    """Change each photo's exposure, white balance and contrast at random, in its patch and its reference alike.

    A few dozen photos are few appearances for an encoder to learn from; these are more, and consistent.
    """
    device, count = batch.colours.device, len(batch.references)
    draws = torch.from_numpy(rng.uniform(-strength, strength, (count, 5))).float().to(device)
    gain, gamma = torch.exp(draws[:, :1] + draws[:, 1:4]), torch.exp(draws[:, 4:])

    def change(colours: Tensor, i: int, shape: tuple[int, ...]) -> Tensor:
        return (colours.pow(gamma[i]) * gain[i].view(shape)).clamp(0, 1)

    colours = torch.stack([change(c, i, (1, 3)) for i, c in enumerate(batch.colours)])
    references = [change(r, i, (3, 1, 1)) for i, r in enumerate(batch.references)]
    return batch._replace(colours=colours, references=references)
