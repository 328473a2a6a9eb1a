"""The faithful field: two NeRF MLPs, the coarse one tells the fine one where to look (released codes).

Codes enter the fine MLP only: the coarse one is unconditioned in the released codes of CR-NeRF, Ha-NeRF and NeRF-W.
"""

from __future__ import annotations

from copy import deepcopy

import torch
from torch import Tensor, nn

from model.fields.base import Field, Level, Placed, Rays, at_least_float32, in_blocks, linear, points
from model.fields.mlp import RadianceMLP
from model.methods import CODE, MLPSpec
from model.sampling import refine, stratified
from model.transient.uncertainty import TransientHead
from model.volume import intervals, render_weights


class NeRFField(Field):
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
        self.coded = coded
        self.transient = TransientHead(spec.width, channels, bounded=True) if transient else None
        self.fold: nn.Linear | None = None  # see `folded`

    def points_a_ray(self, samples: tuple[int, int] | None = None) -> int:
        """See Field: the fine MLP sees both kinds of samples."""
        return sum(samples or (self.spec.coarse_samples, self.spec.fine_samples))

    def place(
        self, rays: Rays, generator: torch.Generator | None = None, samples: tuple[int, int] | None = None
    ) -> Placed:
        """See Field. The fine level sees the coarse samples too, in one sorted list."""
        num_coarse, num_fine = samples or (self.spec.coarse_samples, self.spec.fine_samples)
        count, device = len(rays.near), rays.near.device
        jitter = None if generator is None else torch.rand(count, num_coarse, device=device, generator=generator)
        t = stratified(rays.near, rays.far, num_coarse, jitter)
        coarse = self.coarse_level(rays, t, generator)

        u = None if generator is None else torch.rand(count, num_fine, device=device, generator=generator)
        t = refine(t, coarse.weights, num_fine, u)
        density, inner = in_blocks(self.fine.density_and_bottleneck, points(rays, t))
        density, deltas = self.noisy(density, generator), intervals(t)
        return Placed(rays.directions, t, deltas, density, render_weights(density, deltas), inner, [coarse], {})

    def coarse_level(self, rays: Rays, t: Tensor, generator: torch.Generator | None) -> Level:
        """The coarse MLP at distances t (R, S)."""
        density, features = in_blocks(self.coarse, points(rays, t), rays.directions[:, None])
        weights = render_weights(self.noisy(density, generator), intervals(t))
        return Level(t, weights, at_least_float32(features))

    def seen(self, inner: Tensor, directions: Tensor, code: Tensor | None) -> tuple[Tensor, None]:
        """See Field. There is no background: light that meets nothing is lost."""
        code = None if code is None else code[:, None]
        (features,) = in_blocks(lambda *x: (self.fine.features_at(*x),), inner, directions[:, None], code)
        features = at_least_float32(features)
        return features if self.fold is None else self.fold(features), None

    def folded(self, A: Tensor, shift: Tensor) -> NeRFField:
        """See Field. Features come out of a sigmoid, so A is one more layer, applied at each point of the fine level;
        it saves what compositing C channels would cost, and the coarse level stays as it is.
        """
        if self.coded:
            raise ValueError("a field that reads appearance codes cannot be folded")
        field = deepcopy(self).requires_grad_(False)
        field.transient = None
        field.fold = linear(A, shift)
        return field

    def noisy(self, density: Tensor, generator: torch.Generator | None) -> Tensor:
        """Densities, in training with noise."""
        density = at_least_float32(density)
        if generator is None or self.spec.density_noise == 0:
            return density
        noise = torch.randn(density.shape, dtype=density.dtype, device=density.device, generator=generator)
        return density + self.spec.density_noise * noise
