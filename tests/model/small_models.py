"""Specs, rays and batches small enough for tests, one set for all files that need a whole model."""

from __future__ import annotations

from dataclasses import replace

import torch

from model.fields.base import Rays
from model.methods import METHODS, HashSpec, MLPSpec, ModelSpec
from model.scene_model import Batch, SceneModel

MLP = MLPSpec(width=16, coarse_samples=6, fine_samples=6)
HASH = HashSpec(levels=3, log2_entries=8, max_resolution=32, width=16, proposal_samples=8, samples=6)
BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])

PHOTOS = 4  # training photos

# Every row of the table, and each once more on the fast field with the parts that its recipe picks.
ROWS = [*METHODS, *(f"{name}-fast" for name in METHODS)]
OTHER_TRANSFORMS = ("style_only", "mean_only", "closed_form")
TRANSFORMS = [name for t in OTHER_TRANSFORMS for name in (f"crnerf-{t}", f"crossray-{t}-fast")]


def small_spec(row: str) -> ModelSpec:
    """The row's choices with small parts; the released parts have one size only."""
    fast = row.endswith("-fast")
    name = row.removesuffix("-fast")
    transform = name.partition("-")[2]
    if transform in OTHER_TRANSFORMS:
        name = name.removesuffix(f"-{transform}")
    spec = ModelSpec(**METHODS[name].axes(), mlp=MLP, hash=HASH)
    if transform in OTHER_TRANSFORMS:
        spec = replace(spec, transform=transform)
    return replace(spec, field="hash", channels=8, encoder="compact", segmenter="unet") if fast else spec


def small_model(row: str) -> SceneModel:
    torch.manual_seed(0)
    model = SceneModel(small_spec(row), BOX, PHOTOS)
    if model.spec.segmenter == "unet" and model.segmenter is not None:
        # It starts with zeros in its last layer: a constant mask, and no gradient behind it.
        torch.nn.init.normal_(model.segmenter.out.weight, std=0.5)
    for name, parameter in model.named_parameters():
        if name.endswith("grid.table"):  # as if trained: a table at its start says nothing about place
            torch.nn.init.normal_(parameter)
    return model


def small_rays(count: int, seed: int = 0) -> Rays:
    """Rays from around (0, 0, -3) towards the box."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.tensor([0.0, 0.0, -3.0]) + 0.3 * torch.randn(count, 3, generator=generator)
    directions = torch.tensor([0.0, 0.0, 1.0]) + 0.3 * torch.randn(count, 3, generator=generator)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    near = 1.0 + torch.rand(count, generator=generator)
    return Rays(origins, directions, near, near + 3.0)


def small_batch(patches: int = 2, k: int = 16, seed: int = 0) -> Batch:
    generator = torch.Generator().manual_seed(seed)
    sizes = [(18, 26), (26, 18), (20, 20)]

    def photos(first: int) -> list[torch.Tensor]:
        return [torch.rand(3, *sizes[(first + i) % 3], generator=generator) for i in range(patches)]

    return Batch(
        rays=small_rays(patches * k * k, seed),
        colours=torch.rand(patches, k * k, 3, generator=generator),
        positions=torch.rand(patches, k * k, 2, generator=generator),
        photos=torch.randint(PHOTOS, (patches,), generator=generator),
        references=photos(0),
        others=photos(1),
        masks=torch.rand(patches, k * k, generator=generator),
    )
