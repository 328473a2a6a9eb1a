"""The faithful field: two NeRF MLPs, the coarse one tells the fine one where to look (released codes).

Codes enter the fine MLP only: the coarse one is unconditioned in the released codes of CR-NeRF, Ha-NeRF and NeRF-W.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from model.fields.base import (
    Codes,
    Level,
    March,
    Rays,
    TransientSamples,
    at_least_float32,
    at_points,
    points,
    transient_samples,
)
from model.fields.mlp import RadianceMLP
from model.methods import CODE, MLPSpec
from model.sampling import refine, stratified
from model.transient.uncertainty import TransientHead
from model.volume import intervals, render_weights


class NeRFField(nn.Module):
    """Hierarchical sampling over a coarse and a fine RadianceMLP; both are levels that carry a loss.

    Args:
        spec: sizes.
        channels: C of a feature, or 3 for colours; both come out of a sigmoid.
        coded: the fine MLP reads an appearance code.
        transient: beside the fine MLP's features stands a transient head.
    """

    def __init__(self, spec: MLPSpec, channels: int, coded: bool = False, transient: bool = False) -> None:
        super().__init__()
        self.spec = spec
        sizes = {
            "width": spec.width,
            "xyz_frequencies": spec.xyz_frequencies,
            "dir_frequencies": spec.dir_frequencies,
        }
        self.coarse = RadianceMLP(channels, **sizes)
        self.fine = RadianceMLP(channels, **sizes, code_channels=CODE if coded else 0)
        self.transient = TransientHead(spec.width, channels, rgb=True) if transient else None

    def points_a_ray(self, samples: tuple[int, int] | None = None) -> int:
        """See Field: the fine MLP sees both kinds of samples."""
        return sum(samples or (self.spec.coarse_samples, self.spec.fine_samples))

    def march(
        self,
        rays: Rays,
        generator: torch.Generator | None = None,
        samples: tuple[int, int] | None = None,
        codes: Codes = Codes(),
    ) -> March:
        """See Field. The fine level sees the coarse samples too, in one sorted list."""
        num_coarse, num_fine = samples or (self.spec.coarse_samples, self.spec.fine_samples)
        shape = (len(rays.near), num_coarse)
        device = rays.near.device
        jitter = None if generator is None else torch.rand(shape, device=device, generator=generator)
        t = stratified(rays.near, rays.far, num_coarse, jitter)
        coarse = self.coarse_level(rays, t, generator)

        u = None if generator is None else torch.rand(shape[0], num_fine, device=device, generator=generator)
        fine, other, transient = self.fine_level(rays, refine(t, coarse.weights, num_fine, u), generator, codes)
        return March([coarse, fine], {}, other, transient)

    def coarse_level(self, rays: Rays, t: Tensor, generator: torch.Generator | None) -> Level:
        """The coarse MLP at distances t (R, S)."""
        density, features = self.coarse(points(rays, t), rays.directions[:, None])
        weights = render_weights(self.noisy(density, generator), intervals(t))
        return Level(t, weights, at_least_float32(features))

    def fine_level(
        self, rays: Rays, t: Tensor, generator: torch.Generator | None, codes: Codes
    ) -> tuple[Level, Level | None, TransientSamples | None]:
        """The fine MLP at distances t (R, S): in the rays' appearance, in the other one, and its transient field."""
        h = self.fine.trunk(points(rays, t))
        bottleneck, directions, deltas = self.fine.bottleneck(h), rays.directions[:, None], intervals(t)
        density = self.noisy(self.fine.density_at(h), generator)
        features = self.fine.features_at(bottleneck, directions, at_points(codes.appearance))
        fine = Level(t, render_weights(density, deltas), at_least_float32(features))
        other = transient = None
        if codes.other is not None:  # released code of Ha-NeRF: only the colour layers learn from the other appearance
            seen = self.fine.features_at(bottleneck.detach(), directions, at_points(codes.other))
            other = fine._replace(features=at_least_float32(seen))
        if codes.transient is not None and self.transient is not None:
            transient = transient_samples(self.transient(bottleneck, at_points(codes.transient)), density, deltas)
        return fine, other, transient

    def noisy(self, density: Tensor, generator: torch.Generator | None) -> Tensor:
        """Densities, in training with noise."""
        density = at_least_float32(density)
        if generator is None or self.spec.density_noise == 0:
            return density
        noise = torch.randn(density.shape, dtype=density.dtype, device=density.device, generator=generator)
        return density + self.spec.density_noise * noise
