"""One training step of CR-NeRF, restated from the equations: plain, slow, one patch and one ray after the other.

It is written from the description of the released code (architecture, losses), not from `model/`, of which it takes the
names of the tensors in a state dict and nothing else. Everything is float64, and torch differentiates it. The random
appearance is that of another photo, encoded in the step, where the released code keeps old embeddings
(docs/differences.md, D18).

Notation, for one patch of N = k k rays: F^cr (N, C) rendered features, F^a (C, 32, 32) the embedding of a photo, M (N,)
transient probabilities. E2, E5 encode a photo, T transforms features, D decodes them, S segments.

Random numbers are drawn as the model draws them, so that an equally seeded generator gives both the same: for all rays
of all patches together, jitter, then noise of the coarse densities, then the places u of the fine samples, then noise
of the densities at all samples of the fine level in their order along the ray. Uniform numbers are drawn in torch's
default type, normal ones in float64.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

State = Mapping[str, Tensor]


class Sizes(NamedTuple):
    """What a state dict does not tell."""

    coarse: int  # samples a ray of the coarse level
    fine: int  # further samples a ray of the fine level
    xyz_frequencies: int
    dir_frequencies: int
    noise: float  # standard deviation of the noise on densities


class Patch(NamedTuple):
    """N rays of one photo, and what is known of the photo."""

    origins: Tensor  # (N, 3)
    directions: Tensor  # (N, 3), unit
    near: Tensor  # (N,)
    far: Tensor  # (N,)
    colours: Tensor  # (N, 3)
    rows: list[int]  # N rows of pixels
    cols: list[int]
    size: tuple[int, int]  # height and width of the photo
    reference: Tensor  # (3, h, w): the photo as the networks see it
    other: Tensor  # (3, h', w'): another photo


def terms_of_step(
    state: State, sizes: Sizes, patches: list[Patch], step: int, generator: torch.Generator
) -> dict[str, Tensor]:
    """The weighted terms of the loss; patches count alike, having equally many rays."""
    rays = sum(len(patch.near) for patch in patches)
    jitter = torch.rand(rays, sizes.coarse, generator=generator).double()
    noise_coarse = torch.randn(rays, sizes.coarse, generator=generator, dtype=torch.float64)
    u = torch.rand(rays, sizes.fine, generator=generator).double()
    noise_fine = torch.randn(rays, sizes.coarse + sizes.fine, generator=generator, dtype=torch.float64)

    total: dict[str, Tensor] = {}
    first = 0
    for patch in patches:
        coarse, fine = [], []
        for j in range(len(patch.near)):
            random = (jitter[first + j], noise_coarse[first + j], u[first + j], noise_fine[first + j])
            features = render_ray(state, sizes, patch.origins[j], patch.directions[j], *bounds(patch, j), *random)
            coarse.append(features[0])
            fine.append(features[1])
        first += len(patch.near)
        for name, term in terms_of_patch(state, patch, torch.stack(coarse), torch.stack(fine), step).items():
            total[name] = total.get(name, torch.zeros((), dtype=torch.float64)) + term / len(patches)
    return total


def bounds(patch: Patch, j: int) -> tuple[float, float]:
    return float(patch.near[j]), float(patch.far[j])


def terms_of_patch(state: State, patch: Patch, coarse: Tensor, fine: Tensor, step: int) -> dict[str, Tensor]:
    """Losses of one patch from its features F^cr (N, C) of both levels, with the weights of the released script."""
    count = len(patch.near)
    k = math.isqrt(count)
    own = encode(state, "encoder", patch.reference)
    other = encode(state, "encoder", patch.other).detach()
    mask = transient_probabilities(state, patch)

    picture_coarse = decode(state, transform(state, coarse, own))
    picture_fine = decode(state, transform(state, fine, own))
    in_other = decode(state, transform(state, fine, other))
    untouched = decode(state, fine)

    c_l, f_l = torch.zeros(2, dtype=torch.float64)
    for j in range(count):
        for c in range(3):
            c_l = c_l + (1 - mask[j].detach()) * (picture_coarse[j, c] - patch.colours[j, c]) ** 2
            f_l = f_l + (1 - mask[j]) * (picture_fine[j, c] - patch.colours[j, c]) ** 2
    r_ms = torch.stack([m**2 for m in mask]).sum() / count
    read_again = encode(state, "encoder", as_photo(in_other, k))
    content_of_own = encode(state, "content_encoder", as_photo(picture_fine, k))
    content = encode(state, "content_encoder", as_photo(untouched, k))
    return {
        "coarse": 0.5 * c_l / (3 * count),
        "fine": 0.5 * f_l / (3 * count),
        "mask": max(6e-3, 5e-2 * math.exp(-1e-3 * step)) * r_ms,
        "appearance": 1e-3 * (other - read_again).abs().sum() / other.numel(),
        "content": 1e-4 * ((content - content_of_own) ** 2).sum() / content.numel(),
        "embedding": 1e-5 * (own**2).sum() / own.numel(),
    }


def as_photo(colours: Tensor, k: int) -> Tensor:
    """(k k, 3), row after row -> (3, k, k)."""
    return torch.stack([torch.stack([colours[row * k + col] for col in range(k)], dim=1) for row in range(k)], dim=1)


# ------------------------------------------------------------------------------------------------------- rays


def render_ray(
    state: State,
    sizes: Sizes,
    origin: Tensor,
    direction: Tensor,
    near: float,
    far: float,
    jitter: Tensor,
    noise_coarse: Tensor,
    u: Tensor,
    noise_fine: Tensor,
) -> tuple[Tensor, Tensor]:
    """F^cr (C,) of one ray by the coarse network, and by the fine one at its own samples and the coarse ones."""
    t = stratified(near, far, jitter.tolist())
    coarse, weights = render(state, "field.coarse", sizes, origin, direction, t, noise_coarse)
    middles = [(a + b) / 2 for a, b in pairwise(t)]
    new = [sample_histogram(middles, weights[1:-1], place) for place in u.tolist()]
    fine, _ = render(state, "field.fine", sizes, origin, direction, sorted(t + new), noise_fine)
    return coarse, fine


def stratified(near: float, far: float, jitter: list[float]) -> list[float]:
    """A sample in each bin around the even depths; bins meet half-way, and the outer ones end at near and far."""
    n = len(jitter)
    even = [near + (far - near) * i / (n - 1) for i in range(n)]
    t = []
    for i in range(n):
        lower = even[0] if i == 0 else (even[i - 1] + even[i]) / 2
        upper = even[-1] if i == n - 1 else (even[i] + even[i + 1]) / 2
        t.append(lower + (upper - lower) * jitter[i])
    return t


def sample_histogram(edges: list[float], weights: list[float], u: float) -> float:
    """The depth below which a share u of the weights lies."""
    weights = [w + 1e-5 for w in weights]
    below = 0.0
    for i, w in enumerate(weights):
        mass = w / sum(weights)
        if u < below + mass or i == len(weights) - 1:
            return edges[i] + (u - below) / (mass if mass >= 1e-5 else 1.0) * (edges[i + 1] - edges[i])
        below += mass
    raise AssertionError


def render(
    state: State, network: str, sizes: Sizes, origin: Tensor, direction: Tensor, t: list[float], noise: Tensor
) -> tuple[Tensor, list[float]]:
    """Features (C,) of a ray by volume rendering, and the samples' weights."""
    points = torch.stack([origin + depth * direction for depth in t])
    density, feature = radiance(state, network, sizes, points, direction.expand(len(t), 3))
    density = torch.relu(density + sizes.noise * noise)
    light = torch.ones((), dtype=torch.float64)
    total = torch.zeros(feature.shape[1], dtype=torch.float64)
    weights = []
    for i in range(len(t)):
        delta = t[i + 1] - t[i] if i + 1 < len(t) else 1e2
        alpha = 1 - torch.exp(-delta * density[i])
        total = total + light * alpha * feature[i]
        weights.append(float((light * alpha).detach()))
        light = light * (1 - alpha)
    return total, weights


def radiance(state: State, network: str, sizes: Sizes, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Densities (S,) and features (S, C) of points x (S, 3), seen in directions d (S, 3)."""
    place = waves(x, sizes.xyz_frequencies)
    h = place
    for layer in range(8):
        if layer == 4:
            h = torch.cat([place, h], dim=1)
        h = torch.relu(linear(state, f"{network}.layers.{layer}", h))
    density = torch.log1p(torch.exp(linear(state, f"{network}.density", h)))[:, 0]
    seen = torch.cat([linear(state, f"{network}.bottleneck", h), waves(d, sizes.dir_frequencies)], dim=1)
    hidden = torch.relu(linear(state, f"{network}.directional", seen))
    return density, logistic(linear(state, f"{network}.head", hidden))


def waves(v: Tensor, frequencies: int) -> Tensor:
    """[v, sin v, cos v, sin 2v, cos 2v, sin 4v, ...] for each row v."""
    parts = [v]
    for k in range(frequencies):
        parts += [torch.sin(2**k * v), torch.cos(2**k * v)]
    return torch.cat(parts, dim=1)


def linear(state: State, name: str, x: Tensor) -> Tensor:
    """W x + b for each row x."""
    return x @ state[f"{name}.weight"].T + state[f"{name}.bias"]


def logistic(x: Tensor) -> Tensor:
    return 1 / (1 + torch.exp(-x))


# ------------------------------------------------------------------------------------------ T, D and their reference


def transform(state: State, features: Tensor, embedding: Tensor) -> Tensor:
    """T(F^cr, F^a): features (N, C), embedding (C, 32, 32) -> (N, C)."""
    cells = torch.stack([embedding[:, i, j] for i in range(embedding.shape[1]) for j in range(embedding.shape[2])])
    mean_rays, mean_cells = features.sum(0) / len(features), cells.sum(0) / len(cells)
    style = moment_matrix(state, "transform.style", cells - mean_cells)
    matrix = style @ moment_matrix(state, "transform.content", features - mean_rays)
    compressed = linear(state, "transform.compress", features - mean_rays)
    mixed = torch.stack([matrix @ ray for ray in compressed])
    return linear(state, "transform.expand", mixed) + mean_cells


def moment_matrix(state: State, net: str, x: Tensor) -> Tensor:
    """The matrix read off the second moment of what a small network makes of each row of x; that is not centred."""
    z = leaky(linear(state, f"{net}.per_ray.0", x))
    z = leaky(linear(state, f"{net}.per_ray.2", z))
    z = linear(state, f"{net}.per_ray.4", z)
    moment = torch.zeros(z.shape[1], z.shape[1], dtype=torch.float64)
    for row in z:
        moment = moment + row[:, None] * row[None, :] / len(z)
    return linear(state, f"{net}.read_off", moment.reshape(1, -1)).reshape(moment.shape)


def decode(state: State, features: Tensor) -> Tensor:
    """D: (N, C) -> rgb (N, 3)."""
    return logistic(linear(state, "decoder.linear", features))


def leaky(x: Tensor) -> Tensor:
    return torch.where(x > 0, x, 0.2 * x)


# ----------------------------------------------------------------------------------------------------- E2 and E5


def encode(state: State, network: str, photo: Tensor) -> Tensor:
    """(3, h, w) in [0, 1] -> (64, 32, 32)."""

    def convolve(x: Tensor, layer: int) -> Tensor:
        return F.conv2d(x, state[f"{network}.layers.{layer}.weight"], state[f"{network}.layers.{layer}.bias"])

    def block(x: Tensor, layer: int) -> Tensor:
        return leaky(convolve(F.pad(x, (1, 1, 1, 1), mode="reflect"), layer))

    x = convolve(photo[None], 0)
    x = F.max_pool2d(block(block(x, 1), 3), 2)
    x = F.max_pool2d(block(block(x, 6), 8), 2)
    x = block(x, 11)
    return leaky(convolve(averages(x[0], 32)[None], 14))[0]


def averages(x: Tensor, cells: int) -> Tensor:
    """(C, h, w) -> (C, cells, cells): cell i averages rows floor(i h / cells) to ceil((i + 1) h / cells) - 1."""

    def span(i: int, size: int) -> slice:
        return slice(i * size // cells, -((i + 1) * size // -cells))

    height, width = x.shape[1:]
    rows = []
    for i in range(cells):
        band = x[:, span(i, height)]
        rows.append(torch.stack([band[:, :, span(j, width)].mean(dim=(1, 2)) for j in range(cells)], dim=1))
    return torch.stack(rows, dim=1)


# ------------------------------------------------------------------------------------------------------------- S


def transient_probabilities(state: State, patch: Patch) -> list[Tensor]:
    """M at the patch's pixels: the logit enlarged to what S read, its logistic resized to the photo."""
    logit = segment(state, patch.reference)
    height, width = patch.reference.shape[1:]
    read = [[logistic(resized(logit, i, j, (height, width))) for j in range(width)] for i in range(height)]
    probability = torch.stack([torch.stack(row) for row in read])
    return [resized(probability, row, col, patch.size) for row, col in zip(patch.rows, patch.cols, strict=True)]


def resized(image: Tensor, row: int, col: int, size: tuple[int, int]) -> Tensor:
    """A pixel of `image` (h, w) as it is when resized to `size`, bilinearly; pixels are squares, not corner points."""

    def neighbours(at: int, ours: int, theirs: int) -> tuple[int, int, float]:
        place = min(max((at + 0.5) * ours / theirs - 0.5, 0.0), ours - 1.0)
        return int(place), min(int(place) + 1, ours - 1), place - int(place)

    top, bottom, down = neighbours(row, image.shape[0], size[0])
    left, right, across = neighbours(col, image.shape[1], size[1])
    above = (1 - across) * image[top, left] + across * image[top, right]
    below = (1 - across) * image[bottom, left] + across * image[bottom, right]
    return (1 - down) * above + down * below


def segment(state: State, photo: Tensor) -> Tensor:
    """CGNet with two blocks in each of its later stages, in training: (3, h, w) -> logit (h / 8, w / 8)."""

    def convolve(x: Tensor, name: str, stride: int = 1, dilation: int = 1) -> Tensor:
        weight = state[f"segmenter.{name}.weight"]
        groups = len(weight) if weight.shape[1] == 1 and len(weight) > 1 else 1
        padding = (weight.shape[-1] - 1) // 2 * dilation
        return F.conv2d(x, weight, stride=stride, padding=padding, dilation=dilation, groups=groups)

    def normalise(x: Tensor, name: str) -> Tensor:
        """By the statistics of this photo alone; then a leaky ReLU whose slope is learned for each channel."""
        channels = []
        for c in range(x.shape[1]):
            mean = x[0, c].mean()
            variance = ((x[0, c] - mean) ** 2).mean()
            y = (x[0, c] - mean) / torch.sqrt(variance + 1e-3)
            y = y * state[f"segmenter.{name}.0.weight"][c] + state[f"segmenter.{name}.0.bias"][c]
            channels.append(torch.where(y > 0, y, state[f"segmenter.{name}.1.weight"][c] * y))
        return torch.stack(channels)[None]

    def layer(x: Tensor, name: str, stride: int = 1) -> Tensor:
        return normalise(convolve(x, f"{name}.0", stride), f"{name}.1")

    def near_and_around(x: Tensor, name: str, dilation: int) -> Tensor:
        near = convolve(x, f"{name}.context.local")
        return torch.cat([near, convolve(x, f"{name}.context.surrounding", dilation=dilation)], dim=1)

    def gate(x: Tensor, name: str) -> Tensor:
        means = x[0].mean(dim=(1, 2))
        hidden = torch.relu(linear(state, f"segmenter.{name}.gate.squeeze", means[None]))
        return x * logistic(linear(state, f"segmenter.{name}.gate.excite", hidden))[:, :, None, None]

    def halving_block(x: Tensor, name: str, dilation: int) -> Tensor:
        x = near_and_around(layer(x, f"{name}.halve", stride=2), name, dilation)
        return gate(convolve(normalise(x, f"{name}.join"), f"{name}.reduce"), name)

    def block(x: Tensor, name: str, dilation: int) -> Tensor:
        return x + gate(normalise(near_and_around(layer(x, f"{name}.narrow"), name, dilation), f"{name}.join"), name)

    def halved(x: Tensor) -> Tensor:
        return F.avg_pool2d(x, 3, stride=2, padding=1)

    image = photo[None]
    x = layer(layer(layer(image, "stage1.0", stride=2), "stage1.1"), "stage1.2")
    down = halving_block(normalise(torch.cat([x, halved(image)], dim=1), "join1"), "down2", 2)
    x = torch.cat([block(down, "stage2.0", 2), down, halved(halved(image))], dim=1)
    down = halving_block(normalise(x, "join2"), "down3", 4)
    x = normalise(torch.cat([down, block(down, "stage3.0", 4)], dim=1), "join3")
    return convolve(x, "classifier")[0, 0]
