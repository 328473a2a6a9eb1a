"""Baked appearances: one appearance folded into the field, so that compositing carries 3 channels instead of C.

For one appearance and fixed statistics a picture is rgb = sigmoid(A F + b), F = sum_i w_i f_i. Compositing is linear,
so A may go to the points: F' = sum_i w_i A f_i has 3 channels, and rgb = sigmoid(F' + b). Where appearance is fused at
points, A has one more column, c, that the sum of weights is multiplied with (`SceneModel.colour_map`): then the field
gives A f_i + c. What a field does with A is its own matter (`Field.folded`).

Whatever reads appearances, and all that serves training, is left behind: a baked model is a field and three numbers.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from model.fields.base import Field, Rays, Rendering, at_least_float32
from model.methods import ModelSpec
from model.scene_model import ColourMap, SceneModel, make_field


class Baked(nn.Module):
    """A field of 3 channels, and the shift b that is added to them once they are composited.

    Args:
        spec: of the model that was baked.
        field: gives A f for each of its features f; from `Field.folded`.
        b: (3,).
    """

    b: Tensor

    def __init__(self, spec: ModelSpec, field: Field, b: Tensor) -> None:
        super().__init__()
        self.spec = spec
        self.field = field
        self.register_buffer("b", b.detach().clone())

    @torch.no_grad()
    def render(self, rays: Rays, chunk: int | None = None, samples: tuple[int, int] | None = None) -> Rendering:
        """R rays: rgb (R, 3) in (0, 1) as `features`, depth and accumulation. Arguments and memory as
        SceneModel.render.
        """
        parts = []
        for part in self.field.chunks(rays, chunk, samples):
            composited = self.field.march(part, samples=samples).levels[-1].composite()
            features, depth, accumulation = (at_least_float32(x) for x in composited)
            parts.append(Rendering(torch.sigmoid(features + self.b), depth, accumulation))
        return Rendering(*(torch.cat(x) for x in zip(*parts, strict=True)))


@torch.no_grad()
def bake(model: SceneModel, colours: ColourMap) -> Baked:
    """A model in one appearance, which `colours` (P = 1) holds for statistics that no view decides
    (`SceneModel.colour_map`). It shares no memory with the model.

    Raises:
        ValueError: the model cannot be baked (`check_bakeable`), or `colours` are not those of one appearance.
    """
    check_bakeable(model.spec)
    channels = model.spec.channels + model.fuses_points
    if colours.A.shape != (1, 3, channels) or colours.b.shape != (1, 3):
        raise ValueError(
            f"one appearance of this model is A (1, 3, {channels}) and b (1, 3), not {tuple(colours.A.shape)} and "
            f"{tuple(colours.b.shape)}"
        )
    A, b = colours.A[0], colours.b[0]
    shift = A[:, -1] if model.fuses_points else torch.zeros_like(b)
    return Baked(model.spec, model.field.folded(A[:, : model.spec.channels], shift), b).eval()


def blank(spec: ModelSpec) -> Baked:
    """A baked model of this spec with parameters of no meaning, to be filled from a file.

    Raises:
        ValueError: no model of this spec can be baked.
    """
    check_bakeable(spec)
    field = make_field(spec, torch.zeros(2, 3))  # the scene's box is one of its buffers
    return Baked(spec, field.folded(torch.zeros(3, spec.channels), torch.zeros(3)), torch.zeros(3)).eval()


def check_bakeable(spec: ModelSpec) -> None:
    """ValueError, with the reason, where an appearance is no affine map of what the field gives."""
    if spec.appearance in ("embedding", "code"):
        raise ValueError(
            f"model.appearance: {spec.appearance} cannot be baked: its code is an input of the network that gives each "
            "point its colour; no map of the rendered colours replaces it"
        )
    if spec.colour == "head":
        raise ValueError(
            "model.colour: head cannot be baked: the field gives colours already, in one appearance, and there is "
            "nothing to fold"
        )
