"""The whole training step of CR-NeRF in float64, against the equations restated: every loss, every gradient."""

from __future__ import annotations

import math

import pytest
import restatement
import torch
from torch import Tensor

from model.fields.base import Rays
from model.losses import LossWeights
from model.methods import METHODS, MLPSpec, ModelSpec
from model.scene_model import Batch, SceneModel

K = 8
SIZES = restatement.Sizes(coarse=5, fine=6, xyz_frequencies=15, dir_frequencies=4, noise=1.0)
TOLERANCE = 1e-9  # of the largest entry of a tensor


def faithful_model(seed: int) -> SceneModel:
    """CR-NeRF in training mode with a narrow field, and weights under which no part of the step is nearly constant."""
    torch.manual_seed(seed)
    mlp = MLPSpec(width=16, coarse_samples=SIZES.coarse, fine_samples=SIZES.fine)
    model = SceneModel(ModelSpec(**METHODS["crnerf"].axes(), mlp=mlp), torch.zeros(2, 3)).double().train()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            noise = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
            if parameter.ndim > 1:
                parameter.copy_(math.sqrt(2 / parameter[0].numel()) * noise)
            else:
                parameter.add_(0.1 * noise)
    return model


def random_patch(generator: torch.Generator, size: tuple[int, int], read: tuple[int, int], other: tuple[int, int]):
    """A patch of a photo of `size`; the networks see it, and another photo, reduced to `read` and `other`."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    directions = torch.tensor([0.0, 0.0, 1.0]) + 0.6 * (uniform(K * K, 3) - 0.5)
    near = 1 + uniform(K * K)
    return restatement.Patch(
        origins=torch.tensor([0.0, 0.0, -3.0]) + 0.6 * (uniform(K * K, 3) - 0.5),
        directions=directions / directions.norm(dim=-1, keepdim=True),
        near=near,
        far=near + 3,
        colours=uniform(K * K, 3),
        rows=[int(size[0] * x) for x in uniform(K * K).tolist()],
        cols=[int(size[1] * x) for x in uniform(K * K).tolist()],
        size=size,
        reference=uniform(3, *read),
        other=uniform(3, *other),
    )


def as_batch(patches: list[restatement.Patch]) -> Batch:
    """The patches as the model takes them."""
    positions = []
    for patch in patches:
        x = (torch.tensor(patch.cols, dtype=torch.float64) + 0.5) / patch.size[1]
        y = (torch.tensor(patch.rows, dtype=torch.float64) + 0.5) / patch.size[0]
        positions.append(torch.stack([x, y], dim=-1))
    return Batch(
        rays=Rays(*(torch.cat([getattr(p, name) for p in patches]) for name in Rays._fields)),
        colours=torch.stack([patch.colours for patch in patches]),
        positions=torch.stack(positions),
        photos=torch.arange(len(patches)),
        references=[patch.reference for patch in patches],
        others=[patch.other for patch in patches],
    )


def random_patches(seed: int, count: int) -> list[restatement.Patch]:
    generator = torch.Generator().manual_seed(seed)
    sizes = [
        ((50, 67), (24, 32), (17, 22)),
        ((61, 44), (29, 21), (24, 16)),
    ]  # S halves three times: 29 x 21 leaves a rest
    return [random_patch(generator, *sizes[i]) for i in range(count)]


def close(found: Tensor, expected: Tensor, name: str) -> None:
    scale = float(expected.abs().max())
    assert scale > 0, f"{name} is zero, so that nothing is tested"
    error = float((found - expected).abs().max()) / scale
    assert error < TOLERANCE, f"{name}: off by {error:.1e} of its largest entry {scale:.1e}"


@pytest.mark.parametrize(
    ("count", "step"), [(1, 0), *(pytest.param(2, step, marks=pytest.mark.slow) for step in (1500, 5000))]
)
def test_every_term_and_every_gradient(count, step):
    """Before and after the mask's weight has reached its floor, at 2,120 steps; with one patch and with two."""
    model, patches = faithful_model(seed=step), random_patches(seed=step, count=count)
    terms, _ = model(as_batch(patches), step, torch.Generator().manual_seed(7), LossWeights())
    sum(terms.values()).backward()

    names = dict(model.named_parameters()).keys()
    state = {n: v.detach().clone().requires_grad_(n in names) for n, v in model.state_dict().items()}
    expected = restatement.terms_of_step(state, SIZES, patches, step, torch.Generator().manual_seed(7))
    torch.stack(list(expected.values())).sum().backward()

    assert terms.keys() == expected.keys()
    for name, value in expected.items():
        close(terms[name].detach(), value.detach(), name)
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        gradient = state[name].grad
        assert gradient is not None, name
        close(parameter.grad, gradient, name)
