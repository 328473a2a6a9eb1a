"""The fast field: a proposal grid says where a ray meets matter, a finer grid says what is there.

Space: points are put into the scene's box, [-1, 1] an axis, and what lies outside is contracted axis by axis into
[-2, 2], so a far background costs no more than the landmark. What a ray sees behind its last sample (sky) is a feature
of its direction alone, and goes through compositing and decoding like any other sample.

Where the field reads appearance codes or has a transient head, the trunk gives a bottleneck instead of features, and a
second network makes features of bottleneck and code; the background reads the code, too.

Notation: R rays, S samples a ray, edges e (R, S+1) with t at the middle of each interval.
"""

from __future__ import annotations

from copy import deepcopy

import torch
from torch import Tensor, nn

from model.encoding import positional_encoding
from model.fields.base import Field, Placed, Rays, at_least_float32, linear, points
from model.fields.hashgrid import HashEncoding
from model.methods import CODE, HashSpec
from model.sampling import sample_pdf
from model.transient.uncertainty import TransientHead
from model.volume import render_weights

DIRECTION_FREQUENCIES = 2
PROPOSAL_LEVELS = 5
PROPOSAL_LOG2_ENTRIES = 13
PROPOSAL_RESOLUTION = (8, 128)
TRANSIENT_DEPTH = 2  # layers of the transient head
TRANSIENT_BIAS = -3.0  # the transient field starts almost empty: softplus(-3) is 0.05 a scene unit


class HashField(Field):
    """Hash-grid density and features with proposal sampling (Zip-NeRF's and Instant-NGP's parts, small).

    Args:
        spec: sizes.
        channels: C of a feature; 3 with `rgb`.
        rgb: features are colours, kept in (0, 1) by a sigmoid.
        box: (2, 3) lower and upper corner of the scene's box, scene units.
        coded: features depend on an appearance code.
        transient: beside the features stands a transient head.
    """

    box: Tensor

    def __init__(
        self, spec: HashSpec, channels: int, rgb: bool, box: Tensor, coded: bool = False, transient: bool = False
    ) -> None:
        super().__init__()
        self.spec = spec
        self.rgb = rgb
        self.register_buffer("box", box.float())
        self.proposal_grid = HashEncoding(PROPOSAL_LEVELS, PROPOSAL_LOG2_ENTRIES, *PROPOSAL_RESOLUTION)
        self.proposal = mlp(self.proposal_grid.out_channels, 16, 1)
        self.grid = HashEncoding(spec.levels, spec.log2_entries, spec.min_resolution, spec.max_resolution)
        apart = coded or transient  # what is known of a point is then not yet what is seen of it
        inner = spec.width if apart else channels
        self.trunk = mlp(self.grid.out_channels, spec.width, 1 + inner)
        self.background = mlp(3 * (1 + 2 * DIRECTION_FREQUENCIES) + (CODE if coded else 0), 32, channels)
        self.coded = coded
        self.coloured = mlp(inner + (CODE if coded else 0), spec.width, channels) if apart else None
        self.transient = (
            TransientHead(inner, channels, rgb, spec.width, TRANSIENT_DEPTH, TRANSIENT_BIAS) if transient else None
        )

    def points_a_ray(self, samples: tuple[int, int] | None = None) -> int:
        """See Field."""
        return max(samples or (self.spec.proposal_samples, self.spec.samples))

    def place(
        self, rays: Rays, generator: torch.Generator | None = None, samples: tuple[int, int] | None = None
    ) -> Placed:
        """See Field. The loss `interlevel` keeps the proposal's weights an upper bound of the field's."""
        num_proposal, num_samples = samples or (self.spec.proposal_samples, self.spec.samples)
        edges = uniform_edges(rays.near, rays.far, num_proposal, generator)
        middle, width = 0.5 * (edges[:, 1:] + edges[:, :-1]), edges.diff(dim=-1)
        proposal_weights = render_weights(self.proposal_density(points(rays, middle)), width)

        fine_edges = self.resample(edges, proposal_weights.detach(), num_samples, generator)
        t, deltas = 0.5 * (fine_edges[:, 1:] + fine_edges[:, :-1]), fine_edges.diff(dim=-1)
        density, inner = self.density_and_inner(points(rays, t))
        weights = render_weights(density, deltas)
        losses = {}
        if generator is not None:
            losses["interlevel"] = interlevel_loss(fine_edges, weights.detach(), edges, proposal_weights)
        return Placed(rays.directions, t, deltas, density, weights, inner, [], losses)

    def seen(self, inner: Tensor, directions: Tensor, code: Tensor | None) -> tuple[Tensor, Tensor]:
        """See Field."""
        looked = positional_encoding(directions, DIRECTION_FREQUENCIES)
        known = [inner]
        if self.coded:
            if code is None:
                raise ValueError("this field reads appearance codes, and none was given")
            looked = torch.cat([looked, code], dim=-1)
            known.append(code[:, None].expand(-1, inner.shape[1], -1))
        if self.coloured is not None:
            inner = self.coloured(torch.cat(known, dim=-1))
        background = self.background(looked)
        return self.activate(at_least_float32(inner)), self.activate(at_least_float32(background))

    def folded(self, A: Tensor, shift: Tensor) -> HashField:
        """See Field. Features come out of linear layers, so A goes into these: the networks are narrower than before.

        Where the trunk gives the features, its first output is the density, which stays.
        """
        if self.coded or self.rgb:
            raise ValueError("a field that reads appearance codes, or gives colours, cannot be folded")
        field = deepcopy(self).requires_grad_(False)
        field.transient = None
        if field.coloured is None:
            last = field.trunk[-1]
            assert isinstance(last, nn.Linear)
            weight = torch.cat([last.weight[:1], A @ last.weight[1:]])
            bias = torch.cat([last.bias[:1], A @ last.bias[1:] + shift])
            field.trunk[-1] = linear(weight, bias)
        else:
            fold_last(field.coloured, A, shift)
        fold_last(field.background, A, shift)
        return field

    def freeze_proposal(self) -> None:
        """Without its loss the proposal stays as it is."""
        self.proposal.requires_grad_(False)
        self.proposal_grid.requires_grad_(False)

    def proposal_density(self, x: Tensor) -> Tensor:
        """Density (...,) of the proposal at points (..., 3)."""
        raw = self.proposal(self.proposal_grid(self.contract(x).flatten(0, -2)))
        return self.density(raw[..., 0]).view(x.shape[:-1])

    def density_and_inner(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Density (...,) at points (..., 3), and (..., .): features without their activation, or the bottleneck."""
        raw = at_least_float32(self.trunk(self.grid(self.contract(x).flatten(0, -2)))).view(*x.shape[:-1], -1)
        density, inner = raw.split([1, raw.shape[-1] - 1], dim=-1)
        return self.density(density[..., 0]), inner

    def density(self, raw: Tensor) -> Tensor:
        """exp(raw + bias): unlike softplus it starts low and moves fast, so no fog is left between the cameras."""
        return torch.exp((at_least_float32(raw) + self.spec.density_bias).clamp(max=12))

    def activate(self, features: Tensor) -> Tensor:
        """Colours are kept in (0, 1); features are free."""
        return torch.sigmoid(features) if self.rgb else features

    def contract(self, x: Tensor) -> Tensor:
        """Points (..., 3) in scene units -> [0, 1]^3: linear inside the box, 2 - 1/|x| outside, axis by axis."""
        low, high = self.box
        x = (x - 0.5 * (low + high)) / (0.5 * (high - low)).clamp(min=1e-6)
        size = x.abs().clamp(min=1)
        return 0.25 * torch.where(x.abs() <= 1, x, x.sign() * (2 - 1 / size)) + 0.5

    def resample(self, edges: Tensor, weights: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
        """count + 1 edges (R, count + 1) from the histogram `weights` (R, S) over `edges` (R, S + 1).

        In training all quantiles move together by up to half a step, so the outermost edges may stop short of the ends.
        """
        # The floor keeps every interval reachable: a field that the proposal misses could never be found again.
        histogram = weights + 0.01 / weights.shape[-1]
        u = torch.linspace(0, 1, count + 1, device=edges.device).expand(len(edges), -1)
        if generator is not None:
            jitter = torch.rand(len(edges), 1, device=edges.device, generator=generator) - 0.5
            u = (u + jitter / count).clamp(0, 1)
        return sample_pdf(edges, histogram, count + 1, u)


def mlp(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """One hidden layer, ReLU."""
    return nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, outputs))


def fold_last(network: nn.Sequential, A: Tensor, shift: Tensor) -> None:
    """Let a network that gave f give A f + shift, by its last layer."""
    last = network[-1]
    assert isinstance(last, nn.Linear)
    network[-1] = linear(A @ last.weight, A @ last.bias + shift)


def uniform_edges(near: Tensor, far: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """count + 1 edges (R, count + 1) from near to far; in training the inner ones move by up to half an interval."""
    s = torch.linspace(0, 1, count + 1, device=near.device).expand(len(near), -1)
    if generator is not None:
        jitter = torch.rand(s[:, 1:-1].shape, device=s.device, generator=generator) - 0.5
        s = torch.cat([s[:, :1], s[:, 1:-1] + jitter / count, s[:, -1:]], dim=-1)
    return near[:, None] + (far - near)[:, None] * s


def interlevel_loss(edges: Tensor, weights: Tensor, outer_edges: Tensor, outer_weights: Tensor) -> Tensor:
    """mean over rays of sum max(0, w - bound)^2 / w (mip-NeRF 360, Barron et al. 2022, eq. 13; 1e-5 is added to w).

    `bound` is the total proposal weight of the intervals that overlap a field's interval: where the field sees matter,
    the proposal must have seen at least as much.

    Args:
        edges (R, S+1), weights (R, S): the field's histogram, without gradient.
        outer_edges (R, P+1), outer_weights (R, P): the proposal's.
    """
    total = torch.cat([torch.zeros_like(outer_weights[:, :1]), outer_weights.cumsum(dim=-1)], dim=-1)
    last = outer_weights.shape[-1]
    first = (torch.searchsorted(outer_edges, edges[:, :-1].contiguous(), right=True) - 1).clamp(0, last)
    end = torch.searchsorted(outer_edges, edges[:, 1:].contiguous(), right=False).clamp(0, last)
    bound = total.gather(-1, end) - total.gather(-1, first)
    return ((weights - bound).clamp(min=0).square() / (weights + 1e-5)).sum(dim=-1).mean()
