"""Which patches step s of rank r trains on: pure functions of (plan, step, rank), so that a run can resume
anywhere.

A patch is a k x k grid of rays spread over a part of one training photo (`model.cameras.patch_grid` makes the
pixels). An epoch is cut into visits, `photos` of them a rank and step; visit number g of an epoch goes to
photo P[g mod N], where P is a permutation of the N training photos, another one for each epoch and each pass
(g div N) over the photos. So within an epoch the numbers of visits differ by at most one, over all ranks
together. The released code replays one sequence of photos in every epoch by mistake; this one does not.

Draws are counter-based (Philox): the key is (seed, purpose), the counter says which draw it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

if TYPE_CHECKING:  # torch takes seconds to import, and the tasks that cut shards need none of it
    import torch

# Purposes: no two kinds of draws share a key.
ORDER, WINDOW, RAYS = 1, 2, 3


class PatchPlan(BaseModel):
    """How training photos are cut into patches; the defaults are those of the paper's training."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    size: int = Field(32, ge=2, le=1024, description="k: a patch is a grid of k x k rays")
    photos: int = Field(1, ge=1, le=4096, description="patches a rank and step, each of its own photo")
    min_scale: float = Field(0.5, gt=0, le=1, description="smallest part of a photo's sides that a grid spans")
    max_scale: float = Field(1.0, gt=0, le=1, description="largest part of a photo's sides that a grid spans")
    seed: int = Field(0, ge=0, lt=2**63, description="of the order of photos and of all draws")

    @model_validator(mode="after")
    def _scales_in_order(self) -> PatchPlan:
        if self.min_scale > self.max_scale:
            raise ValueError(f"min_scale {self.min_scale} is larger than max_scale {self.max_scale}")
        return self


@dataclass(frozen=True)
class Patch:
    """One patch. `photo` and `other` number the training photos; the other three are float32 values.

    `scale` is the part of both sides that the grid spans; offsets are those of its first row and column as
    parts of the photo's height and width (reference: released code, `patch_grid`).
    """

    photo: int
    scale: float
    offset_h: float
    offset_w: float
    other: int  # whose appearance the appearance loss reads


def patches(
    plan: PatchPlan, sizes: np.ndarray, *, step: int, rank: int, world_size: int, steps_per_epoch: int
) -> list[Patch]:
    """The `plan.photos` patches of `rank` at global `step`.

    `sizes`: (N, 2) integers, (height, width) of the training photos. scale ~ U(min_scale, max_scale),
    offset_h ~ U(0, (1 - scale)(1 - 1/height)), offset_w likewise, in float32; `other` is uniform over the N
    photos.

    Raises:
        ValueError: no photos, or a rank that is not in the world.
    """
    photos = len(sizes)
    if photos == 0 or not 0 <= rank < world_size:
        raise ValueError(f"no patches of {photos} photos for rank {rank} of {world_size}")
    epoch, step_of_epoch = divmod(step, steps_per_epoch)
    first = (step_of_epoch * world_size + rank) * plan.photos
    draws = _generator(plan.seed, WINDOW, step, rank)
    uniform = draws.random((plan.photos, 3), dtype=np.float32)
    others = draws.integers(photos, size=plan.photos)
    found = []
    for j, (u_scale, u_h, u_w) in enumerate(uniform):
        passed, place = divmod(first + j, photos)
        photo = int(_order(plan.seed, epoch, passed, photos)[place])
        height, width = np.asarray(sizes[photo], np.float32)
        lowest, highest = np.float32(plan.min_scale), np.float32(plan.max_scale)
        scale = lowest + u_scale * (highest - lowest)
        room = np.float32(1) - scale
        offset_h = u_h * room * (1 - 1 / height)
        offset_w = u_w * room * (1 - 1 / width)
        found.append(Patch(photo, float(scale), float(offset_h), float(offset_w), int(others[j])))
    return found


def steps_per_epoch(plan: PatchPlan, sizes: np.ndarray, world_size: int) -> int:
    """floor(training pixels / rays a step over all ranks), at least 1; `sizes` (N, 2) as in `patches`."""
    pixels = int(np.prod(np.asarray(sizes, np.int64), axis=1).sum())
    return max(1, pixels // (plan.photos * plan.size**2 * world_size))


def step_generator(seed: int, step: int, rank: int, device: torch.device | str) -> torch.Generator:
    """The generator of everything else that a step draws (jitter along rays, density noise), on `device`."""
    import torch

    state = np.random.SeedSequence([RAYS, seed, step, rank]).generate_state(1, np.uint64)[0]
    return torch.Generator(device).manual_seed(int(state >> np.uint64(1)))


class PatchRow(NamedTuple):
    """A patch as listed for people: global step, rank, and photos by key."""

    step: int
    rank: int
    photo: str
    scale: float
    offset_h: float
    offset_w: float
    other: str


def list_patches(
    plan: PatchPlan, keys: Sequence[str], sizes: np.ndarray, epoch: int, world_size: int
) -> Iterator[PatchRow]:
    """Every patch of one epoch of automatic length, in order of step and rank; `keys` (N) and `sizes` (N, 2)
    agree.
    """
    steps = steps_per_epoch(plan, sizes, world_size)
    for step in range(epoch * steps, (epoch + 1) * steps):
        for rank in range(world_size):
            for p in patches(plan, sizes, step=step, rank=rank, world_size=world_size, steps_per_epoch=steps):
                yield PatchRow(step, rank, keys[p.photo], p.scale, p.offset_h, p.offset_w, keys[p.other])


@lru_cache(maxsize=64)
def _order(seed: int, epoch: int, passed: int, photos: int) -> np.ndarray:
    """The permutation of the photos for one pass of one epoch."""
    order = _generator(seed, ORDER, epoch, passed).permutation(photos)
    order.flags.writeable = False
    return order


def _generator(seed: int, purpose: int, a: int, b: int) -> np.random.Generator:
    # The lowest word of the counter is Philox's own: it counts the numbers drawn.
    counter: Any = np.array([0, a, b, 0], np.uint64)
    key: Any = np.array([seed, purpose], np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))
