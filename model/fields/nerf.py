"""The faithful field: two NeRF MLPs, the coarse one tells the fine one where to look (released code)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from model.fields.base import Level, March, Rays
from model.fields.mlp import RadianceMLP
from model.methods import MLPSpec
from model.sampling import refine, stratified
from model.volume import intervals, render_weights


class NeRFField(nn.Module):
    """Hierarchical sampling over a coarse and a fine RadianceMLP; both are levels that carry a loss.

    Args:
        spec: sizes.
        channels: C of a feature, or 3 for colours; both come out of a sigmoid.
    """

    def __init__(self, spec: MLPSpec, channels: int) -> None:
        super().__init__()
        self.spec = spec
        sizes = {
            "width": spec.width,
            "xyz_frequencies": spec.xyz_frequencies,
            "dir_frequencies": spec.dir_frequencies,
        }
        self.coarse = RadianceMLP(channels, **sizes)
        self.fine = RadianceMLP(channels, **sizes)

    def points_a_ray(self, samples: tuple[int, int] | None = None) -> int:
        """See Field: the fine MLP sees both kinds of samples."""
        return sum(samples or (self.spec.coarse_samples, self.spec.fine_samples))

    def march(
        self, rays: Rays, generator: torch.Generator | None = None, samples: tuple[int, int] | None = None
    ) -> March:
        """See Field. The fine level sees the coarse samples too, in one sorted list."""
        num_coarse, num_fine = samples or (self.spec.coarse_samples, self.spec.fine_samples)
        shape = (len(rays.near), num_coarse)
        device = rays.near.device
        jitter = None if generator is None else torch.rand(shape, device=device, generator=generator)
        t = stratified(rays.near, rays.far, num_coarse, jitter)
        coarse = self.level(self.coarse, rays, t, generator)

        u = None if generator is None else torch.rand(shape[0], num_fine, device=device, generator=generator)
        fine = self.level(self.fine, rays, refine(t, coarse.weights, num_fine, u), generator)
        return March([coarse, fine], {})

    def level(self, mlp: RadianceMLP, rays: Rays, t: Tensor, generator: torch.Generator | None) -> Level:
        """One MLP at distances t (R, S); in training its densities carry noise."""
        points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
        density, features = mlp(points, rays.directions[:, None])
        density = density.float()
        if generator is not None and self.spec.density_noise > 0:
            noise = torch.randn(density.shape, device=density.device, generator=generator)
            density = density + self.spec.density_noise * noise
        return Level(t, render_weights(density, intervals(t)), features.float())
