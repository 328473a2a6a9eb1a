"""One model for every method: a field, a decoder, an appearance part and a transient part, put together.

Notation: a training step sees P patches of N = k k rays, each patch from its own photo. F (P, N, C) are rendered
features, F^a (P, C, g, g) appearance embeddings, M (P, N) transient probabilities (1 = transient).

The four networks of the paper are E2 (`encoder`), E5 (`content_encoder`), T (`transform`) and D (`decoder`);
S is `segmenter`. E5 and S serve training only.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from model.appearance.compact import CompactEncoder, CompactTransform, at_size
from model.appearance.crossray import AffineDecoder, ContentStatistics, ReleasedTransform, recolour
from model.appearance.encoder import ReleasedEncoder
from model.cameras import patch_grid
from model.fields.base import Field, Rays, Rendering
from model.fields.hash import HashField
from model.fields.nerf import NeRFField
from model.losses import (
    LossWeights,
    appearance_consistency,
    content_preservation,
    embedding_size,
    mask_size,
    photometric,
)
from model.methods import ModelSpec, check_spec
from model.transient.cgnet import CGNet, transient_probability
from model.transient.unet import UNet

StatisticsPolicy = Literal["view", "patch", "running"]

COMPACT_SIZE = (64, 96)  # height and width at which the compact encoder and the U-Net see a photo
RUNNING_MOMENTUM = 0.01
RENDER_POINTS = 2**18  # points that go through a field at once when no gradient is needed


class Batch(NamedTuple):
    """What one rank sees in one step."""

    rays: Rays  # P N rays, patch by patch
    colours: Tensor  # (P, N, 3) in [0, 1]
    positions: Tensor  # (P, N, 2): (x, y) of the pixel's middle in its photo, in (0, 1)
    references: list[Tensor]  # P photos (3, h, w) in [0, 1], as the encoder and the segmenter see them
    others: list[Tensor]  # P random other photos, for the appearance loss


class ColourMap(NamedTuple):
    """One appearance for one set of statistics: rgb = sigmoid(A F + b)."""

    A: Tensor  # (P, 3, C)
    b: Tensor  # (P, 3)


class SceneModel(nn.Module):
    """The parts that `spec` names.

    Args:
        spec: the choices and sizes; `check_spec` has accepted them.
        box: (2, 3) lower and upper corner of the scene's points, scene units.
    """

    running_mean: Tensor
    running_gram: Tensor
    running_count: Tensor

    def __init__(self, spec: ModelSpec, box: Tensor) -> None:
        super().__init__()
        check_spec(spec)
        self.spec = spec
        self.use_bfloat16 = False  # set by whoever runs the model on hardware where it pays
        head = spec.colour == "head"
        channels = 3 if head else spec.channels
        self.field: Field = (
            HashField(spec.hash, channels, head, box) if spec.field == "hash" else NeRFField(spec.mlp, channels)
        )
        self.decoder = None if head else AffineDecoder(channels)
        self.encoder: nn.Module | None = None
        self.content_encoder: nn.Module | None = None
        self.transform: ReleasedTransform | CompactTransform | None = None
        if spec.appearance == "crossray":
            compact = spec.encoder == "compact"
            self.encoder = CompactEncoder(channels) if compact else ReleasedEncoder()
            self.content_encoder = CompactEncoder(channels) if compact else ReleasedEncoder()
            self.transform = CompactTransform(channels) if compact else ReleasedTransform(channels)
            side = self.transform.compress.out_features
            self.register_buffer("running_mean", torch.zeros(1, channels))
            self.register_buffer("running_gram", torch.zeros(1, side, side))
            self.register_buffer("running_count", torch.zeros(()))
        self.segmenter: CGNet | UNet | None = None
        if spec.transient == "segmenter":
            self.segmenter = UNet() if spec.segmenter == "unet" else CGNet()

    # ------------------------------------------------------------------------------------------------ training

    def forward(
        self, batch: Batch, step: int, generator: torch.Generator, weights: LossWeights
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The weighted loss terms of one step, whose sum is minimised, and what is worth watching.

        Returns:
            terms: name -> scalar with gradient.
            watched: name -> scalar without: `mse` of the fine picture, `mask` the mean transient probability.
        """
        patches = batch.colours.shape[:2]
        with self.autocast(batch.colours.device):
            march = self.field.march(batch.rays, generator)
        features = [level.composite().features.float().unflatten(0, patches) for level in march.levels]
        terms = {}
        if "interlevel" in march.losses and weights.interlevel > 0:
            terms["interlevel"] = weights.interlevel * march.losses["interlevel"]

        mask = self.masks(batch)
        if mask is not None and weights.mask_weight(step) > 0:
            terms["mask"] = weights.mask_weight(step) * mask_size(mask)

        embedding = None
        if self.encoder is not None:
            embedding = self.encode(batch.references)
            self.track(features[-1])
            if weights.embedding > 0:
                terms["embedding"] = weights.embedding * embedding_size(embedding)
        pictures = [self.colours(f, embedding) for f in features]
        terms["fine"] = photometric(pictures[-1], batch.colours, mask)
        if len(pictures) > 1:
            coarse_mask = None if mask is None else mask.detach()  # released code: only the fine level teaches S
            terms["coarse"] = photometric(pictures[0], batch.colours, coarse_mask)

        if self.encoder is not None:
            terms |= self.appearance_losses(features[-1], pictures[-1], batch.others, weights)
        watched = {"mse": (pictures[-1].detach() - batch.colours).square().mean()}
        if mask is not None:
            watched["mask"] = mask.detach().mean()
        return terms, watched

    def appearance_losses(
        self, features: Tensor, picture: Tensor, others: list[Tensor], weights: LossWeights
    ) -> dict[str, Tensor]:
        """L_a (eq. 'transfer') in its released form: a random other photo's appearance, and content."""
        assert self.content_encoder is not None
        assert self.decoder is not None
        terms = {}
        if weights.appearance > 0:
            with torch.no_grad():
                other = self.encode(others)
            re_encoded = self.encode(as_images(self.colours(features, other)))
            terms["appearance"] = weights.appearance * appearance_consistency(other, re_encoded)
        if weights.content > 0:
            plain, transformed = (embed(self.content_encoder, as_images(c)) for c in (self.decoder(features), picture))
            terms["content"] = weights.content * content_preservation(plain, transformed)
        return terms

    def autocast(self, device: torch.device) -> AbstractContextManager:
        """bfloat16 inside the field where it pays; statistics, transform and losses stay in float32."""
        return torch.autocast(device.type, torch.bfloat16, enabled=self.use_bfloat16)

    def track(self, features: Tensor) -> None:
        """Running averages of the content statistics, for the policy `running`."""
        assert self.transform is not None
        with torch.no_grad():
            new = self.transform.content_statistics(features)
            self.running_count += 1
            # Plain averages at first: an average that starts at zero would be biased towards it for long.
            momentum = torch.clamp(1 / self.running_count, min=RUNNING_MOMENTUM)
            self.running_mean += momentum * (new.mean.mean(0, keepdim=True) - self.running_mean)
            self.running_gram += momentum * (new.gram.mean(0, keepdim=True) - self.running_gram)

    # -------------------------------------------------------------------------------------- appearance, colour

    def encode(self, images: list[Tensor]) -> Tensor:
        """F^a (P, C, g, g) of photos (3, h, w) in [0, 1] (E2)."""
        if self.encoder is None:
            raise ValueError("this model has no appearance: model.appearance is none")
        return embed(self.encoder, images)

    def colours(self, features: Tensor, embedding: Tensor | None, content: ContentStatistics | None = None) -> Tensor:
        """rgb (P, N, 3) of features (P, N, C) in the appearances F^a (P, C, g, g).

        Args:
            embedding: None where the model has no appearance.
            content: statistics to use; None takes them from these features.
        """
        if self.decoder is None:
            return features
        if self.transform is None:
            return self.decoder(features)
        content = content or self.transform.content_statistics(features)
        assert embedding is not None
        return recolour(features, *self.colour_map(content, embedding))

    def colour_map(self, content: ContentStatistics, embedding: Tensor) -> ColourMap:
        """Transform and decoder as one affine map for each of P appearances."""
        assert self.transform is not None
        assert self.decoder is not None
        W, b = self.transform.affine(content, self.transform.style_statistics(embedding))
        return ColourMap(*self.decoder.fold(W, b))

    def content_statistics(
        self, features: Tensor, size: tuple[int, int], policy: StatisticsPolicy, patch: int = 32
    ) -> ContentStatistics | None:
        """Statistics of one view's features (N, C) in row order, h w = N, by policy.

        `view`: over all its rays. `patch`: over one patch x patch grid that spans it, as in training.
        `running`: the averages kept in training, the same for every view. None where the model has no transform.
        """
        if self.transform is None:
            return None
        if policy == "running":
            if self.running_count == 0:
                raise ValueError("statistics: running, but this model has not been trained")
            return ContentStatistics(self.running_mean, self.running_gram)
        if policy == "patch":
            rows, cols, _ = patch_grid(patch, 1.0, 0.0, 0.0, *size)
            features = features[(rows * size[1] + cols).to(features.device)]
        return self.transform.content_statistics(features[None])

    # ---------------------------------------------------------------------------------------------- transients

    def masks(self, batch: Batch) -> Tensor | None:
        """M (P, N) at the batch's pixels; None where the model handles no transients."""
        if self.segmenter is None:
            return None
        maps = self.transient_maps(batch.references)
        grid = 2 * batch.positions[:, None] - 1
        # Sampling at pixel centres is the released code's resize to the photo's size, at the needed pixels only.
        looked_up = [
            F.grid_sample(m[None], g[None], padding_mode="border", align_corners=False)
            for m, g in zip(maps, grid, strict=True)
        ]
        return torch.cat(looked_up)[:, 0, 0]

    def transient_maps(self, images: list[Tensor]) -> list[Tensor]:
        """Transient probabilities (1, h', w') of photos (3, h, w), at the size that the segmenter reads."""
        assert self.segmenter is not None
        maps = []
        for batch in in_batches(images, isinstance(self.segmenter, UNet)):
            seen = (batch.shape[-2], batch.shape[-1])
            maps += list(transient_probability(self.segmenter(batch), seen, seen))
        return maps

    @torch.no_grad()
    def transient_mask(self, image: Tensor, size: tuple[int, int]) -> Tensor:
        """M (h, w) at `size` of one photo (3, h', w') in [0, 1]."""
        (found,) = self.transient_maps([image])
        return F.interpolate(found[None], size=size, mode="bilinear", align_corners=False)[0, 0]

    # ----------------------------------------------------------------------------------------------- rendering

    @torch.no_grad()
    def render(self, rays: Rays, chunk: int | None = None, samples: tuple[int, int] | None = None) -> Rendering:
        """Features, depth and accumulation of R rays, `chunk` at a time; without a number, as many as RENDER_POINTS
        allows. Beside the result, memory holds one chunk, whatever the view's size: an activation of the paper's MLP
        is RENDER_POINTS x 256 floats (0.27 GB), and a few of them live at once.
        """
        chunk = chunk or max(1, RENDER_POINTS // self.field.points_a_ray(samples))
        parts = []
        for start in range(0, len(rays.near), chunk):
            with self.autocast(rays.near.device):
                march = self.field.march(Rays(*(r[start : start + chunk] for r in rays)), samples=samples)
            parts.append(Rendering(*(x.float() for x in march.levels[-1].composite())))
        return Rendering(*(torch.cat(x) for x in zip(*parts, strict=True)))

    def freeze_idle(self, weights: LossWeights) -> None:
        """Parts whose only loss has weight 0 learn nothing; DDP must know that no gradient will come."""
        if weights.content == 0 and self.content_encoder is not None:
            self.content_encoder.requires_grad_(False)
        if weights.interlevel == 0 and isinstance(self.field, HashField):
            self.field.freeze_proposal()

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters that learn, by the part whose learning rate they share: grid, field, appearance, transient."""
        groups: dict[str, list[nn.Parameter]] = {"grid": [], "field": [], "appearance": [], "transient": []}
        for name, parameter in self.named_parameters():
            part = name.split(".")[0]
            if not parameter.requires_grad:
                continue
            if name.endswith("grid.table"):
                groups["grid"].append(parameter)
            elif part == "segmenter":
                groups["transient"].append(parameter)
            elif part in ("field", "decoder"):
                groups["field"].append(parameter)
            else:
                groups["appearance"].append(parameter)
        return {name: group for name, group in groups.items() if group}


def embed(encoder: nn.Module, images: list[Tensor]) -> Tensor:
    """An encoder's maps (P, C, g, g) of photos (3, h, w) in [0, 1]."""
    return torch.cat([encoder(batch) for batch in in_batches(images, isinstance(encoder, CompactEncoder))])


def in_batches(images: list[Tensor], compact: bool) -> list[Tensor]:
    """Photos (3, h, w) of any size as batches (B, 3, h', w'): all at one small size, or each at its own."""
    return [at_size(images, COMPACT_SIZE)] if compact else [image[None] for image in images]


def as_images(colours: Tensor) -> list[Tensor]:
    """Colours (P, k k, 3) of square patches as P pictures (3, k, k)."""
    k = round(colours.shape[1] ** 0.5)
    return list(colours.transpose(1, 2).unflatten(2, (k, k)))
