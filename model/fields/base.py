"""What a field is: it places samples along rays, and gives what is seen at them, weighted, ready to be composited."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn

from model.transient.uncertainty import Transient
from model.volume import composite, joint_weights

BLOCK_POINTS = 2**11  # points a CPU thread that go through a network at once: a layer's output stays in the cache


class Rays(NamedTuple):
    """R rays. Directions are unit vectors, so t is a distance in scene units."""

    origins: Tensor  # (R, 3)
    directions: Tensor  # (R, 3)
    near: Tensor  # (R,)
    far: Tensor  # (R,)


class Codes(NamedTuple):
    """What the photo of each ray is known by; None where the field does not ask for it."""

    appearance: Tensor | None = None  # (R, CODE)
    other: Tensor | None = None  # (R, CODE): a second appearance, for losses only
    transient: Tensor | None = None  # (R, TRANSIENT_CODE)


class Rendering(NamedTuple):
    """R rays, composited."""

    features: Tensor  # (R, C)
    depth: Tensor  # (R,) sum of w t, scene units
    accumulation: Tensor  # (R,) sum of w, in [0, 1]


class Level(NamedTuple):
    """One sampling of R rays at S points each."""

    t: Tensor  # (R, S)
    weights: Tensor  # (R, S)
    features: Tensor  # (R, S, C)
    background: Tensor | None = None  # (R, C): what a ray sees behind its last sample

    def composite(self) -> Rendering:
        """Volume rendering of any number of channels (eq. 'nerf2'); a background takes the weight that is left."""
        features = composite(self.weights, self.features)
        accumulation = self.weights.sum(dim=-1)
        if self.background is not None:
            features = features + (1 - accumulation)[:, None] * self.background
        return Rendering(features, (self.weights * self.t).sum(dim=-1), accumulation)

    def with_constant(self) -> Level:
        """One more channel that is 1 everywhere: composited, it is the sum of the weights."""
        background = None if self.background is None else append_one(self.background)
        return self._replace(features=append_one(self.features), background=background)


class TransientSamples(NamedTuple):
    """The transient field at the points of a level, seen together with the static one (NeRF-W)."""

    static_weights: Tensor  # (R, S) of the static field behind both
    weights: Tensor  # (R, S) of the transient field behind both
    passed: Tensor  # (R,) light that passes both
    features: Tensor  # (R, S, C)
    density: Tensor  # (R, S)
    beta: Tensor  # (R, S)

    def composite(self, static: Level) -> Tensor:
        """Features (R, C) of both fields together; the background is seen through both."""
        features = composite(self.static_weights, static.features) + composite(self.weights, self.features)
        if static.background is not None:
            features = features + self.passed[:, None] * static.background
        return features

    def with_constant(self) -> TransientSamples:
        """As Level.with_constant."""
        return self._replace(features=append_one(self.features))

    def opacity(self) -> Tensor:
        """(R,) share of a ray's light that comes from the transient field."""
        return self.weights.sum(dim=-1)

    def uncertainty(self) -> Tensor:
        """(R,) sum of w beta: the standard deviation of a ray's colour, without its floor."""
        return (self.weights * self.beta).sum(dim=-1)


class March(NamedTuple):
    """A field along rays: its levels, the last of which is the picture, and losses of its own."""

    levels: list[Level]
    losses: dict[str, Tensor]
    other: Level | None = None  # the last level in the other appearance
    transient: TransientSamples | None = None  # at the points of the last level


class Placed(NamedTuple):
    """Rays with their samples placed: all of a field that no code changes."""

    directions: Tensor  # (R, 3)
    t: Tensor  # (R, S)
    deltas: Tensor  # (R, S) lengths of the samples
    density: Tensor  # (R, S)
    weights: Tensor  # (R, S)
    inner: Tensor  # (R, S, .) what the field knows of each point before it is seen in an appearance
    before: list[Level]  # earlier levels
    losses: dict[str, Tensor]

    def of(self, rays: Tensor) -> Placed:
        """Some of the rays, by their numbers, without earlier levels and losses."""
        directions, t, deltas, density, weights, inner = (x[rays] for x in self[:6])
        return Placed(directions, t, deltas, density, weights, inner, [], {})


class Field(nn.Module):
    """(x, d) -> density, feature, along rays, with its own way of choosing samples."""

    transient: nn.Module | None  # a TransientHead, or none

    def points_a_ray(self, samples: tuple[int, int] | None = None) -> int:
        """Points at which the field is evaluated for each ray, at most, in one pass of its networks."""
        raise NotImplementedError

    def chunks(self, rays: Rays, chunk: int | None, samples: tuple[int, int] | None) -> Iterator[Rays]:
        """The rays, `chunk` at a time, or as many as `render_points` allows."""
        chunk = chunk or max(1, render_points(rays.near.device) // self.points_a_ray(samples))
        for start in range(0, len(rays.near), chunk):
            yield Rays(*(r[start : start + chunk] for r in rays))

    def folded(self, A: Tensor, shift: Tensor) -> Field:
        """A copy of this field that gives A f + shift for each feature f, of points and background alike: the same
        places and weights with K channels. It shares no memory with this one, and has no transient field.

        Args:
            A: (K, C).
            shift: (K,).

        Raises:
            ValueError: this field reads appearance codes, or gives colours, which a sigmoid has bounded.
        """
        raise NotImplementedError

    def place(
        self, rays: Rays, generator: torch.Generator | None = None, samples: tuple[int, int] | None = None
    ) -> Placed:
        """Choose samples along R rays and evaluate what no code changes; arguments as in `march`."""
        raise NotImplementedError

    def seen(self, inner: Tensor, directions: Tensor, code: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Features (R, S, C) at points, and (R, C) of the background where there is one, in the rays' appearance.

        Args:
            inner: (R, S, .) as `place` gives it.
            directions: (R, 3).
            code: (R, CODE), for a field that reads one.
        """
        raise NotImplementedError

    def march(
        self,
        rays: Rays,
        generator: torch.Generator | None = None,
        samples: tuple[int, int] | None = None,
        codes: Codes = Codes(),
    ) -> March:
        """Sample rays and evaluate.

        Args:
            rays: R rays.
            generator: source of jitter and density noise in training; None renders without either.
            samples: (first, second) numbers of samples instead of the training ones.
            codes: the appearance code where the field was made for one; the transient field and the other appearance
                are evaluated where their codes are given.
        """
        return self.look(self.place(rays, generator, samples), codes)

    def look(self, placed: Placed, codes: Codes) -> March:
        """What is seen at placed samples: in the rays' appearance, in the other one, and of the transient field."""
        directions, inner = placed.directions, placed.inner
        level = Level(placed.t, placed.weights, *self.seen(inner, directions, codes.appearance))
        other = None
        if codes.other is not None:
            # As in Ha-NeRF's released code, it teaches colours and weights, but not the trunk's output.
            other = Level(placed.t, placed.weights, *self.seen(inner.detach(), directions, codes.other))
        transient = None
        if codes.transient is not None and self.transient is not None:
            transient = self.look_at_transients(placed, codes.transient)
        return March([*placed.before, level], placed.losses, other, transient)

    def look_at_transients(self, placed: Placed, code: Tensor) -> TransientSamples:
        """The transient field of the rays' photos, codes (R, TRANSIENT_CODE)."""
        assert self.transient is not None
        seen = Transient(*in_blocks(self.transient, placed.inner, code[:, None]))
        return transient_samples(seen, placed.density, placed.deltas)


def render_points(device: torch.device) -> int:
    """Points that go through a field at once when no gradient is needed: what keeps a GPU busy, and on a CPU what its
    allocator does not ask the system for each time.
    """
    return 2**16 if device.type == "cpu" else 2**18


def linear(weight: Tensor, bias: Tensor) -> nn.Linear:
    """x -> weight x + bias: weight (K, C), bias (K,)."""
    outputs, inputs = weight.shape
    layer = nn.Linear(inputs, outputs, device=weight.device, dtype=weight.dtype)
    layer.weight = nn.Parameter(weight.detach().clone(), requires_grad=False)
    layer.bias = nn.Parameter(bias.detach().clone(), requires_grad=False)
    return layer


def in_blocks(network: Callable[..., tuple[Tensor, ...]], x: Tensor, *others: Tensor | None) -> tuple[Tensor, ...]:
    """network(x, *others), on a CPU a block of rays at a time.

    The numbers are the same. A layer of all points at once writes what no cache holds into memory that the system has
    to hand out page by page; benchmarks/results/steps.json has the times of both.

    Args:
        network: gives tensors of as many rays as it gets.
        x: (R, S, .) of R rays at S points each.
        others: (R, ...), or None.
    """
    count = max(1, BLOCK_POINTS * torch.get_num_threads() // x.shape[1])
    if x.device.type != "cpu" or len(x) <= count:
        return network(x, *others)
    number = -(-len(x) // count)
    # split, not slices: each of these would make a gradient as large as the whole.
    pieces = [(None,) * number if a is None else a.split(count) for a in (x, *others)]
    blocks = [network(*piece) for piece in zip(*pieces, strict=True)]
    return tuple(torch.cat(parts) for parts in zip(*blocks, strict=True))


def append_one(x: Tensor) -> Tensor:
    """(..., C) -> (..., C + 1)."""
    return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)


def at_least_float32(x: Tensor) -> Tensor:
    """bfloat16 -> float32; float32 and float64 stay what they are."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


def points(rays: Rays, t: Tensor) -> Tensor:
    """Points (R, S, 3) at distances t (R, S)."""
    return rays.origins[:, None] + t[..., None] * rays.directions[:, None]


def transient_samples(head: Transient, static_density: Tensor, deltas: Tensor) -> TransientSamples:
    """What a transient head gives at the points of a level, with both fields' weights behind one another."""
    density = at_least_float32(head.density)
    static_weights, weights = joint_weights(static_density, density, deltas)
    passed = torch.exp(-(deltas * (torch.relu(static_density) + density)).sum(dim=-1))
    return TransientSamples(
        static_weights, weights, passed, at_least_float32(head.features), density, at_least_float32(head.beta)
    )
