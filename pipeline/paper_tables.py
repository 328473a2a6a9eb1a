"""The paper's tables of scores, as plans: rows, scenes, published numbers, and what may stand beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from pipeline.cells import METRICS
from pipeline.records import Budget, Design, Score

PAPER_SCENES = {
    "brandenburg_gate": "Brandenburg Gate",
    "sacre_coeur": "Sacre Coeur",
    "trevi_fountain": "Trevi Fountain",
}
PAPER = Budget(None, 20, 17200, 8, 1, "cuda")  # section 4: 20 epochs of 17,200 iterations on 8 GPUs
PAPER_REFERENCE = 8  # the downscale of what the released encoder reads
LABELS = {
    "nerf": "NeRF",
    "nerfw": "NeRF-W",
    "hanerf": "Ha-NeRF",
    "crnerf-b": "CR-NeRF-B",
    "crnerf-a": "CR-NeRF-A",
    "crnerf-t": "CR-NeRF-T",
    "crnerf-u": "CR-NeRF-U",
    "crnerf-r": "CR-NeRF-R",
    "crnerf-a-masks": "CR-NeRF-A + masks",
    "crnerf": "CR-NeRF",
    "crossray": "crossray (CR-NeRF on the fast field)",
}
SEGMENTERS = {"deeplabv3": "DeepLabV3", "maskrcnn": "Mask R-CNN"}
FIELDS = {"mlp": "the paper's MLPs", "hash": "fast field"}
RAYS = (400, 576, 784, 1024, 1600)


@dataclass(frozen=True)
class Wanted:
    """A row of a table of scores."""

    method: str
    label: str
    published: str | None = None
    """The row's name in the published table."""
    field: str | None = None
    """Where the row only makes sense on one field."""
    changes: tuple[str, ...] = ()
    masks: str = ""
    rays: int | None = None
    """Rays of a patch; None: as the recipe has it."""
    beyond: bool = False

    def takes(self, score: Score) -> bool:
        """Whether a score belongs into this row."""
        design = Design(self.method, self.field or score.design.field, self.changes, self.masks)
        return design == score.design and (score.usual_patch if self.rays is None else score.rays == self.rays)


class Plan(NamedTuple):
    """A table of scores before anything is filled in."""

    title: str
    text: str
    published: str | tuple[str, ...]
    """Tables of pipeline/published.yaml; rows are looked for in the first that has them and the row's method."""
    downscale: int
    metrics: tuple[str, ...]
    rows: tuple[Wanted, ...]
    further: Callable[[Score], bool]
    """Which measured designs that no row names become rows of their own."""
    scenes: tuple[str, ...] = tuple(PAPER_SCENES)
    others: bool = True
    """Whether what was measured elsewhere, or otherwise than in the paper, has columns here."""
    but: tuple[int, ...] = ()
    """Downscales at which the paper's columns have a table of their own."""


def paper_row(method: str, **more: str) -> Wanted:
    """A row of the paper."""
    return Wanted(method, more.get("label", LABELS[method]), more.get("published", method), masks=more.get("masks", ""))


CROSSRAY = Wanted("crossray", LABELS["crossray"], field="hash", beyond=True)


def is_variant(score: Score) -> bool:
    """CR-NeRF with something of its model changed."""
    return score.design.method in ("crnerf", "crossray") and bool(score.design.changes)


def is_transform(score: Score) -> bool:
    """CR-NeRF with another transform."""
    return is_variant(score) and all(change.startswith("transform=") for change in score.design.changes)


def is_handler(score: Score) -> bool:
    """CR-NeRF-A with another transient handler."""
    design = score.design
    return design.method in ("crnerf-a-masks", "crnerf-u") or (
        design.method == "crnerf-a" and any(change.startswith("transient=") for change in design.changes)
    )


def nothing(_: Score) -> bool:
    """No further rows."""
    return False


def plans() -> list[Plan]:
    """The paper's tables of scores, in its order."""
    compared = (*map(paper_row, ("nerf", "nerfw", "hanerf", "crnerf-r", "crnerf")), CROSSRAY)
    elsewhere = "Scenes that the paper does not have are further columns, at sizes of their own."
    comparisons = [
        Plan(
            f"1. Comparison at R/{n}",
            f"The paper's table \"comparison\", its half at R/{n}. NeRF-W's rows have codes fitted to the test "
            "photos, in the paper in a way that it does not tell, here to their left halves. "
            + (elsewhere if n == 4 else "What was measured on other scenes stands beside the half at R/4."),
            f"comparison-R{n}",
            n,
            METRICS,
            compared,
            is_variant if n == 4 else nothing,
            others=n == 4,
            but=(2,) if n == 4 else (),
        )
        for n in (4, 2)
    ]
    masks = [
        paper_row(
            "crnerf-a-masks",
            label=f"CR-NeRF-A + {title}",
            published=f"crnerf-a-{kind}",
            masks=kind,
        )
        for kind, title in SEGMENTERS.items()
    ]
    rays = tuple(
        Wanted(method, f"{LABELS[method]}, {count} rays", f"rays{count}", rays=count)
        for method in ("hanerf", "crnerf")
        for count in RAYS
    )
    return [
        *comparisons,
        Plan(
            "2. Ablation",
            'The paper\'s table "ablation": -B is the baseline, -A adds the appearance, -T the transient handler.',
            "ablation-R4",
            4,
            METRICS,
            (*map(paper_row, ("crnerf-b", "crnerf-a", "crnerf-t", "crnerf")), CROSSRAY),
            is_transform,
        ),
        Plan(
            "3. Transient handlers",
            'The paper\'s table "mask", of Brandenburg Gate alone.',
            "masks-R4",
            4,
            METRICS,
            (paper_row("crnerf-a"), *masks, paper_row("crnerf"), CROSSRAY),
            is_handler,
            scenes=("brandenburg_gate",),
        ),
        Plan(
            "4. Number of rays",
            "The paper's table of its appendix, of Brandenburg Gate alone. At 1,024 rays it gives Ha-NeRF 24.51 "
            "here and 24.58 in its comparison.",
            ("num-rays-hanerf-R4", "num-rays-R4"),
            4,
            ("psnr",),
            rays,
            nothing,
            scenes=("brandenburg_gate",),
        ),
        Plan(
            "5. Uncertainty in place of masks",
            'The paper\'s table "ablation_uncertainty".',
            "uncertainty-R4",
            4,
            ("psnr", "ssim"),
            (paper_row("crnerf-u"), paper_row("crnerf"), CROSSRAY),
            nothing,
        ),
    ]
