"""One model for every method: a field, a decoder, an appearance part and a transient part, put together.

Notation: a training step sees P patches of N = k k rays, each patch from its own photo. F (P, N, C) are rendered
features, F^a appearances: embeddings (P, C, g, g) of `crossray`, codes (P, CODE) of `embedding` and `code`; M (P, N)
are transient probabilities (1 = transient).

The four networks of the paper are E2 (`encoder`), E5 (`content_encoder`), T (`transform`) and D (`decoder`);
S is `segmenter`. E5 and S serve training only.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from model.appearance.closed_form import ClosedFormTransform
from model.appearance.code import CompactCode, ReleasedCode
from model.appearance.compact import CompactEncoder, CompactTransform, at_size
from model.appearance.crossray import AffineDecoder, ContentStatistics, ReleasedTransform, recolour
from model.appearance.encoder import ReleasedEncoder
from model.cameras import patch_grid
from model.fields.base import (
    Codes,
    Field,
    Level,
    March,
    Placed,
    Rays,
    Rendering,
    at_least_float32,
    render_points,
)
from model.fields.hash import HashField
from model.fields.nerf import NeRFField
from model.losses import (
    LossWeights,
    appearance_consistency,
    content_preservation,
    embedding_size,
    log_uncertainty,
    mask_size,
    mode_seeking,
    photometric,
    uncertain_photometric,
)
from model.methods import CODE, TRANSIENT_CODE, ModelSpec, StatisticsPolicy, check_spec
from model.transient.cgnet import CGNet, transient_probability
from model.transient.unet import UNet
from model.transient.uvmask import UVMask

Module = TypeVar("Module", bound=nn.Module)
Transform = ReleasedTransform | CompactTransform | ClosedFormTransform

COMPACT_SIZE = (64, 96)  # height and width at which the compact networks and the U-Net see a photo
RUNNING_MOMENTUM = 0.01


class Batch(NamedTuple):
    """What one rank sees in one step."""

    rays: Rays  # P N rays, patch by patch
    colours: Tensor  # (P, N, 3) in [0, 1]
    positions: Tensor  # (P, N, 2): (x, y) of the pixel's middle in its photo, in (0, 1)
    photos: Tensor  # (P,) int64: which training photos
    references: list[Tensor]  # P photos (3, h, w) in [0, 1], as the encoder and the segmenter see them; or none
    others: list[Tensor]  # P photos drawn at random, for the appearance loss and mode seeking
    masks: Tensor | None = None  # (P, N) transient probabilities of the data, for transient `fixed`


class ColourMap(NamedTuple):
    """One appearance for one set of statistics: rgb = sigmoid(A F + b)."""

    A: Tensor  # (P, 3, C); fused at points (P, 3, C + 1), as F then has the sum of weights as one more channel
    b: Tensor  # (P, 3)


class Seen(NamedTuple):
    """One level of a step, composited: all that a picture of it in any appearance needs."""

    features: Tensor  # (P, N, C); where appearance is fused at points, one channel more: the sum of weights
    content: ContentStatistics | None  # None where the model has no transform


class SceneModel(nn.Module):
    """The parts that `spec` names.

    Args:
        spec: the choices and sizes; `check_spec` has accepted them.
        box: (2, 3) lower and upper corner of the scene's points, scene units.
        photos: number of training photos, for what is learned of each.
    """

    running_mean: Tensor
    running_gram: Tensor
    running_count: Tensor

    def __init__(self, spec: ModelSpec, box: Tensor, photos: int = 1) -> None:
        super().__init__()
        check_spec(spec)
        self.spec = spec
        self.use_bfloat16 = False  # set by whoever runs the model on hardware where it pays
        self.coded = spec.appearance in ("embedding", "code")
        self.fuses_points = spec.appearance == "crossray" and spec.fused == "point"
        self.field = make_field(spec, box)
        channels = spec.channels
        self.decoder = None if spec.colour == "head" else AffineDecoder(channels)
        self.encoder: nn.Module | None = None
        self.content_encoder: nn.Module | None = None
        self.embedding: nn.Embedding | None = None
        self.transform: Transform | None = None
        compact = spec.encoder == "compact"
        if spec.appearance == "crossray":
            self.encoder = channels_last(CompactEncoder(channels)) if compact else ReleasedEncoder()
            self.content_encoder = channels_last(CompactEncoder(channels)) if compact else ReleasedEncoder()
            self.transform = make_transform(spec)
            side = self.transform.moment_size
            self.register_buffer("running_mean", torch.zeros(1, channels))
            self.register_buffer("running_gram", torch.zeros(1, side, side))
            self.register_buffer("running_count", torch.zeros(()))
        elif spec.appearance == "code":
            self.encoder = channels_last(CompactCode()) if compact else ReleasedCode()
        elif spec.appearance == "embedding":
            self.embedding = nn.Embedding(photos, CODE)
        self.segmenter: CGNet | UNet | None = None
        self.uvmask: UVMask | None = None
        self.transient_embedding: nn.Embedding | None = None
        if spec.transient == "segmenter":
            self.segmenter = channels_last(UNet()) if spec.segmenter == "unet" else CGNet()
        elif spec.transient == "uvmask":
            self.uvmask = UVMask(photos)
        elif spec.transient == "uncertainty":
            self.transient_embedding = nn.Embedding(photos, TRANSIENT_CODE)

    # ------------------------------------------------------------------------------------------------ training

    def forward(
        self, batch: Batch, step: int, generator: torch.Generator, weights: LossWeights
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The weighted loss terms of one step, whose sum is minimised, and what is worth watching.

        Returns:
            terms: name -> scalar with gradient.
            watched: name -> scalar without: `mse` of the fine picture, `mask` the mean transient probability.
        """
        appearance = self.appearances(batch)
        other = None
        if batch.others and self.encoder is not None:
            with torch.no_grad():
                other = self.encode(batch.others)
        with self.autocast(batch.colours.device):
            march = self.field.march(batch.rays, generator, codes=self.codes(batch, appearance, other))
        levels = [self.seen(level, batch) for level in march.levels]
        pictures = [self.colours(seen.features, appearance, seen.content) for seen in levels]
        static = levels[-1]

        terms = {}
        if "interlevel" in march.losses and weights.interlevel > 0:
            terms["interlevel"] = weights.interlevel * march.losses["interlevel"]
        mask = self.masks(batch)
        if self.spec.transient in ("segmenter", "uvmask") and mask is not None and weights.mask_weight(step) > 0:
            terms["mask"] = weights.mask_weight(step) * mask_size(mask)
        if len(pictures) > 1:
            coarse_mask = None if mask is None else mask.detach()  # released code: only the fine level teaches S
            terms["coarse"] = weights.photometric * photometric(pictures[0], batch.colours, coarse_mask)
        if march.transient is None:
            terms["fine"] = weights.photometric * photometric(pictures[-1], batch.colours, mask)
        if self.encoder is not None:
            assert appearance is not None
            if weights.embedding > 0:
                terms["embedding"] = weights.embedding * embedding_size(appearance)
            terms |= self.appearance_losses(static, pictures[-1], appearance, other, march, weights)
        if march.transient is not None:
            terms |= self.uncertain_losses(march, static, appearance, batch, weights)
        if self.transform is not None:
            assert static.content is not None
            self.track(static.content)
        watched = {"mse": (pictures[-1].detach() - batch.colours).square().mean()}
        if march.transient is not None:
            mask = march.transient.opacity()
        if mask is not None:
            watched["mask"] = mask.detach().mean()
        return terms, watched

    def seen(self, level: Level, batch: Batch) -> Seen:
        """A level composited, with the statistics of its rays, or of its points where appearance is fused there."""
        patches = batch.colours.shape[:2]
        features = self.rendered(level, patches)
        if self.transform is None:
            return Seen(features, None)
        of = level.features.unflatten(0, patches).flatten(1, 2) if self.fuses_points else features
        return Seen(features, self.transform.content_statistics(of))

    def rendered(self, level: Level, patches: torch.Size) -> Tensor:
        """Features (P, N, C) of a level; fused at points, with the sum of weights as one more channel."""
        if self.fuses_points:
            level = level.with_constant()
        return at_least_float32(level.composite().features).unflatten(0, patches)

    def appearance_losses(
        self,
        static: Seen,
        picture: Tensor,
        appearance: Tensor,
        other: Tensor | None,
        march: March,
        weights: LossWeights,
    ) -> dict[str, Tensor]:
        """L_a (eq. 'transfer'): the appearance that was put in can be read again, and content stays; for codes, other
        codes give other pictures (Ha-NeRF).
        """
        terms = {}
        other_picture = None
        if other is not None:
            if march.other is None:
                other_picture = self.colours(static.features, other, static.content)
            else:
                other_picture = self.colours(self.rendered(march.other, picture.shape[:2]), other)
        if weights.appearance > 0:
            own = weights.appearance_target == "own"
            asked, shown = (appearance, picture) if own else (other, other_picture)
            assert asked is not None
            assert shown is not None
            terms["appearance"] = weights.appearance * appearance_consistency(
                asked, self.encode(as_images(shown)), weights.appearance_target
            )
        if self.coded and weights.mode_seeking > 0:
            assert other is not None
            assert other_picture is not None
            terms["mode_seeking"] = weights.mode_seeking * mode_seeking(picture, other_picture, appearance, other)
        if self.content_encoder is not None and weights.content > 0:
            assert self.decoder is not None
            untouched = self.decoder(static.features[..., : self.spec.channels])
            plain, transformed = (embed(self.content_encoder, as_images(c)) for c in (untouched, picture))
            terms["content"] = weights.content * content_preservation(plain, transformed)
        return terms

    def uncertain_losses(
        self, march: March, static: Seen, appearance: Tensor | None, batch: Batch, weights: LossWeights
    ) -> dict[str, Tensor]:
        """NeRF-W's loss: the picture of both fields is Gaussian around the photo, with a deviation for each ray."""
        transient, level = march.transient, march.levels[-1]
        assert transient is not None
        patches = batch.colours.shape[:2]
        if self.fuses_points:
            level, transient = level.with_constant(), transient.with_constant()
        both = at_least_float32(transient.composite(level)).unflatten(0, patches)
        picture = self.colours(both, appearance, static.content)
        beta = transient.uncertainty().unflatten(0, patches) + weights.beta_min
        terms = {
            "fine": weights.photometric * uncertain_photometric(picture, batch.colours, beta),
            "uncertainty": 2 * weights.photometric * log_uncertainty(beta),
        }
        if weights.transient_density > 0:
            terms["transient_density"] = weights.transient_density * transient.density.mean()
        return terms

    def autocast(self, device: torch.device) -> AbstractContextManager:
        """bfloat16 inside the field where it pays; statistics, transform and losses stay in float32."""
        # The cached copy of a weight would sum the gradients of all blocks (`in_blocks`) in bfloat16.
        cached = device.type != "cpu"
        return torch.autocast(device.type, torch.bfloat16, enabled=self.use_bfloat16, cache_enabled=cached)

    @torch.no_grad()
    def track(self, new: ContentStatistics) -> None:
        """Running averages of the content statistics, for the policy `running`."""
        self.running_count += 1
        # Plain averages at first: an average that starts at zero would be biased towards it for long.
        momentum = torch.clamp(1 / self.running_count, min=RUNNING_MOMENTUM)
        self.running_mean += momentum * (new.mean.mean(0, keepdim=True) - self.running_mean)
        self.running_gram += momentum * (new.gram.mean(0, keepdim=True) - self.running_gram)

    # -------------------------------------------------------------------------------------- appearance, colour

    def appearances(self, batch: Batch) -> Tensor | None:
        """F^a of a step's photos; None where the model has no appearance."""
        if self.embedding is not None:
            return self.embedding(batch.photos)
        return None if self.encoder is None else self.encode(batch.references)

    def encode(self, images: list[Tensor]) -> Tensor:
        """F^a of photos (3, h, w) in [0, 1]: (P, C, g, g), or (P, CODE) (E2; Ha-NeRF's CNN)."""
        if self.encoder is None:
            raise ValueError(f"model.appearance: {self.spec.appearance} reads nothing from a photo")
        return embed(self.encoder, images)

    def codes(self, batch: Batch, appearance: Tensor | None, other: Tensor | None) -> Codes:
        """What the field is told of each ray's photo."""
        rays = batch.colours.shape[1]

        def of_rays(codes: Tensor | None) -> Tensor | None:
            return None if codes is None else codes.repeat_interleave(rays, dim=0)

        transient = None if self.transient_embedding is None else self.transient_embedding(batch.photos)
        if not self.coded:
            return Codes(transient=of_rays(transient))
        return Codes(of_rays(appearance), of_rays(other), of_rays(transient))

    def colours(self, features: Tensor, appearance: Tensor | None, content: ContentStatistics | None = None) -> Tensor:
        """rgb (P, N, 3) of rendered features (P, N, C) in the appearances F^a.

        Args:
            appearance: None where the model has no appearance; codes have done their work in the field.
            content: statistics to use; None takes them from these features (not where appearance is fused at points).
        """
        if self.decoder is None:
            return features
        if self.transform is None:
            return self.decoder(features)
        assert appearance is not None
        return recolour(features, *self.colour_map(content or self.transform.content_statistics(features), appearance))

    def colour_map(self, content: ContentStatistics | None, appearance: Tensor | None) -> ColourMap:
        """Transform and decoder as one affine map for each of P appearances, for one set of statistics or P; without
        an appearance, the decoder's alone (P = 1).

        Fused at points, sum_i w_i T(f_i) = W F + b sum_i w_i: the shift of T is the column of the channel that holds
        the sum of weights, and only the decoder's own shift is left.

        Raises:
            ValueError: the model gives colours, not features.
        """
        if self.decoder is None:
            raise ValueError("model.colour: head gives colours at points; there is no map from features to colours")
        if self.transform is None:
            return ColourMap(self.decoder.linear.weight[None], self.decoder.linear.bias[None])
        assert content is not None
        assert appearance is not None
        W, b = self.transform.affine(content, self.transform.style_statistics(appearance))
        if self.fuses_points:
            A, shift = self.decoder.fold(torch.cat([W, b[..., None]], dim=-1), torch.zeros_like(b))
            return ColourMap(A, shift)
        return ColourMap(*self.decoder.fold(W, b))

    def content_statistics(
        self,
        features: Tensor,
        size: tuple[int, int],
        policy: StatisticsPolicy | None = None,
        patch: int = 32,
        points: Tensor | None = None,
    ) -> ContentStatistics | None:
        """Statistics of one view's features (N, C) in row order, h w = N, by policy, by default the spec's.

        `view`: over all its rays. `patch`: over one patch x patch grid that spans it, as in training.
        `running`: the averages kept in training, the same for every view. None where the model has no transform.
        Fused at points, `points` (M, C) are the features whose statistics are taken by `view` and `patch` alike.
        """
        if self.transform is None:
            return None
        policy = policy or self.spec.statistics
        if policy == "running":
            if self.running_count == 0:
                raise ValueError("statistics: running, but this model has not been trained: it has no averages")
            return ContentStatistics(self.running_mean, self.running_gram)
        if self.fuses_points:
            if points is None:
                raise ValueError("statistics of points: the view has none")
            return self.transform.content_statistics(points[None])
        if policy == "patch":
            rows, cols, _ = patch_grid(patch, 1.0, 0.0, 0.0, *size)
            features = features[(rows * size[1] + cols).to(features.device)]
        return self.transform.content_statistics(features[None])

    # ---------------------------------------------------------------------------------------------- transients

    def masks(self, batch: Batch) -> Tensor | None:
        """M (P, N) at the batch's pixels; None where the model masks nothing."""
        if self.spec.transient == "fixed":
            if batch.masks is None:
                raise ValueError("model.transient: fixed, but the batch has no masks")
            return batch.masks
        if self.uvmask is not None:
            return self.uvmask(batch.photos, batch.positions.flip(-1))
        return None if self.segmenter is None else self.segmented(batch)

    def segmented(self, batch: Batch) -> Tensor:
        """The segmenter's M (P, N)."""
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
    def transient_mask(self, size: tuple[int, int], image: Tensor, photo: int | None) -> Tensor | None:
        """M (h, w) at `size` of one photo, None where this model draws no mask of it.

        Args:
            image: (3, h', w') in [0, 1], for a segmenter.
            photo: which training photo it is, for a uv mask; None if it is none.
        """
        if self.segmenter is not None:
            (found,) = self.transient_maps([image])
            return F.interpolate(found[None], size=size, mode="bilinear", align_corners=False)[0, 0]
        if self.uvmask is None or photo is None:
            return None
        v, u = ((torch.arange(n, device=image.device) + 0.5) / n for n in size)
        uv = torch.stack(torch.meshgrid(v, u, indexing="ij"), dim=-1)
        number = torch.tensor([photo], device=image.device)
        parts = uv.view(1, -1, 2).split(render_points(image.device), dim=1)
        return torch.cat([self.uvmask(number, part) for part in parts], dim=1).view(size)

    # ----------------------------------------------------------------------------------------------- rendering

    @torch.no_grad()
    def render(
        self, rays: Rays, chunk: int | None = None, samples: tuple[int, int] | None = None, code: Tensor | None = None
    ) -> Rendering:
        """Features (R, C; C + 1 fused at points), depth and accumulation of R rays, `chunk` at a time, without a number
        as many as `render_points` allows. Memory holds one chunk beside the result, whatever the view's size: an
        activation of the paper's MLP is 256 floats a point (67 MB, on a GPU 0.27 GB), and a few of them live at once.

        Args:
            code: (1, CODE) appearance, for a field that reads one.
        """
        whole: Rendering | None = None
        done = 0
        for march in self.marches(rays, chunk, samples, code):
            level = march.levels[-1]
            del march
            if self.fuses_points:
                level = level.with_constant()
            part = Rendering(*(at_least_float32(x) for x in level.composite()))
            del level  # a chunk's samples are gone before the next one's come
            whole = whole or Rendering(*(x.new_empty(len(rays.near), *x.shape[1:]) for x in part))
            for out, x in zip(whole, part, strict=True):
                out[done : done + len(x)] = x
            done += len(part.depth)
        assert whole is not None
        return whole

    @torch.no_grad()
    def point_features(self, rays: Rays, samples: tuple[int, int] | None = None) -> Tensor:
        """Features (M, C) at all points of the rays, for the statistics of appearance that is fused there."""
        return torch.cat([m.levels[-1].features.flatten(0, 1) for m in self.marches(rays, None, samples)])

    @torch.no_grad()
    def transient_opacity(self, rays: Rays, photo: int) -> Tensor:
        """(R,) share of each ray's light that a training photo's transient field gives: NeRF-W's counterpart of M."""
        assert self.transient_embedding is not None
        code = self.transient_embedding(torch.tensor([photo], device=rays.near.device))
        parts = []
        for part in self.field.chunks(rays, None, None):
            with self.autocast(rays.near.device):
                found = self.field.look_at_transients(self.field.place(part), code.expand(len(part.near), -1))
            parts.append(found.opacity())
        return torch.cat(parts)

    def marches(
        self, rays: Rays, chunk: int | None, samples: tuple[int, int] | None, code: Tensor | None = None
    ) -> Iterator[March]:
        """The field along all rays, chunk by chunk, in one appearance code (1, CODE) where it reads one."""
        if self.coded and code is None:
            raise ValueError(f"model.appearance: {self.spec.appearance} needs the code of an appearance to render")
        for part in self.field.chunks(rays, chunk, samples):
            codes = Codes(None if code is None else code.expand(len(part.near), -1))
            with self.autocast(rays.near.device):
                march = self.field.march(part, samples=samples, codes=codes)
            yield march  # outside: a generator's context would stay open while its caller composites
            del march  # else it would live while the next one is made

    def picture(self, placed: Placed, code: Tensor, transient: Tensor | None) -> Tensor:
        """rgb (R, 3) at placed samples, with gradient to the codes (1, .): what a code is fitted with."""
        codes = Codes(*(None if c is None else c.expand(len(placed.t), -1) for c in (code, None, transient)))
        with self.autocast(placed.t.device):
            march = self.field.look(placed, codes)
        level = march.levels[-1]
        features = level.composite().features if march.transient is None else march.transient.composite(level)
        return self.colours(at_least_float32(features)[None], None)[0]

    def freeze_idle(self, weights: LossWeights) -> None:
        """Parts whose only loss has weight 0 learn nothing; DDP must know that no gradient will come."""
        if weights.content == 0 and self.content_encoder is not None:
            self.content_encoder.requires_grad_(False)
        if weights.interlevel == 0 and isinstance(self.field, HashField):
            self.field.freeze_proposal()

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters that learn, by the part whose learning rate they share."""
        groups: dict[str, list[nn.Parameter]] = {part: [] for part in PARTS}
        for name, parameter in self.named_parameters():
            if parameter.requires_grad:
                groups[part_of(name)].append(parameter)
        return {name: group for name, group in groups.items() if group}


PARTS = ("grid", "field", "appearance", "embedding", "transient")


def part_of(name: str) -> str:
    """The part of the model, one of PARTS, that a parameter belongs to."""
    top = name.split(".")[0]
    if name.endswith("grid.table"):
        return "grid"
    if name.endswith("embedding.weight"):
        return "embedding"
    if top in ("segmenter", "uvmask"):
        return "transient"
    return "field" if top in ("field", "decoder") else "appearance"


def needs_references(spec: ModelSpec) -> bool:
    """Whether a step looks at its photos as a whole."""
    return spec.appearance in ("code", "crossray") or spec.transient == "segmenter"


def needs_other(spec: ModelSpec, weights: LossWeights) -> bool:
    """Whether a step looks at random other photos."""
    reads = spec.appearance in ("code", "crossray") and weights.appearance > 0 and weights.appearance_target == "other"
    return reads or (spec.appearance == "code" and weights.mode_seeking > 0)


def as_read(spec: ModelSpec, images: list[Tensor]) -> list[Tensor]:
    """Photos (3, h, w) at the one size at which all networks read them, as they are where there is none: what is done
    to a step's references is then done to few pixels, and they are reduced once for all networks.
    """
    at_their_own = spec.encoder != "compact" or (spec.transient == "segmenter" and spec.segmenter != "unet")
    return images if at_their_own or not images else list(at_size(images, COMPACT_SIZE))


def make_field(spec: ModelSpec, box: Tensor) -> Field:
    """The field as `spec` wants it; `box` (2, 3) as SceneModel takes it."""
    head = spec.colour == "head"
    channels = 3 if head else spec.channels
    coded, uncertain = spec.appearance in ("embedding", "code"), spec.transient == "uncertainty"
    if spec.field == "hash":
        return HashField(spec.hash, channels, head, box, coded=coded, transient=uncertain)
    return NeRFField(spec.mlp, channels, coded=coded, transient=uncertain)


def make_transform(spec: ModelSpec) -> Transform:
    """T as `spec` wants it."""
    if spec.transform == "closed_form":
        return ClosedFormTransform(spec.channels)
    moments = {"content": spec.transform == "learned", "style": spec.transform != "mean_only"}
    if spec.encoder == "compact":
        return CompactTransform(spec.channels, **moments)
    return ReleasedTransform(spec.channels, **moments)


def channels_last(network: Module) -> Module:
    """The network with its weights in the memory format in which small convolutions are fastest."""
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def embed(encoder: nn.Module, images: list[Tensor]) -> Tensor:
    """An encoder's appearances of photos (3, h, w) in [0, 1]: P maps or codes."""
    return torch.cat(
        [encoder(batch) for batch in in_batches(images, isinstance(encoder, (CompactEncoder, CompactCode)))]
    )


def in_batches(images: list[Tensor], compact: bool) -> list[Tensor]:
    """Photos (3, h, w) of any size as batches (B, 3, h', w'): all at one small size, or each at its own."""
    return [at_size(images, COMPACT_SIZE)] if compact else [image[None] for image in images]


def as_images(colours: Tensor) -> list[Tensor]:
    """Colours (P, k k, 3) of square patches as P pictures (3, k, k)."""
    k = round(colours.shape[1] ** 0.5)
    return list(colours.transpose(1, 2).unflatten(2, (k, k)))
