"""Which appearance each picture of a film or of a set of stills has: chosen once, by names of photos or image files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from pipeline.errors import CrossrayError
from pipeline.painter import Painter
from pipeline.views.choose import BETWEEN, guess, readings

OWN = "own"  # each photo's view in what is read from the photo itself


class Looks(NamedTuple):
    """The appearances of N pictures."""

    names: tuple[str, ...]  # of the appearances that are used
    sources: list[dict[str, str]]  # of each of them: photo, sha256 of its file
    weights: list[tuple[float, ...] | None]  # (N) of them, how they are blended
    codes: list[Tensor | None]  # of each of them, F^a
    own: bool = False  # instead: each picture is a photo's view, in the appearance of that photo

    def of(self, i: int) -> Tensor | None:
        """F^a of picture `i`: the sum of weights times appearances, linear as in the paper's interpolation."""
        weights = self.weights[i]
        known = [F for F in self.codes if F is not None]
        if weights is None or not known:
            return None
        return torch.stack([w * F for w, F in zip(weights, known, strict=True)]).sum(0)


def read_looks(painter: Painter, names: Sequence[str], weights: list[tuple[float, ...] | None]) -> Looks:
    """The appearances `names`, read once. CrossrayError: one of them cannot be used."""
    read = [painter.read(name) for name in names]
    return Looks(tuple(names), [r.source for r in read], weights, [r.F for r in read])


def looks_of(painter: Painter, text: str | None, names: Sequence[str], film: bool) -> Looks:
    """What `--appearance` says for pictures of the photos `names`, or for as many frames of a film.

    `PHOTO` is the name of a photo of the scene or an image file; `A..B` goes evenly from one to the other over the
    pictures; `own`, the default of stills, is each photo's own. A film's default is the first training photo.

    Raises:
        CrossrayError: no such appearance, `own` in a film, or the run has no appearance to choose.
    """
    if not painter.has_appearance:
        if text is not None:
            raise CrossrayError(
                f"--appearance {text}: {painter.run} has none to choose (model.appearance: none); leave it out"
            )
        return Looks((), [], [None] * len(names), [])
    if text is None:
        text = painter.photos.records[painter.photos.indices("train")[0]].name if film else OWN
    if text == OWN:
        if film:
            raise CrossrayError("--appearance own: a frame of a film is no photo's view; name a photo")
        return Looks((), [], [None] * len(names), [], own=True)
    stops = stops_of(text, [record.name for record in painter.photos.records])
    return read_looks(painter, stops, even_weights(len(stops), len(names)))


def stops_of(text: str, photos: Sequence[str]) -> list[str]:
    """The appearances of `A`, `A..B` or `A..B..C`, photos of the scene or files; names may hold `..` themselves.

    Raises:
        CrossrayError: a part is neither, or the text can be read in two ways.
    """
    ends = [i for i in range(len(text)) if text.startswith(BETWEEN, i)] + [len(text)]
    parts = {text[a:b] for a in [0, *(i + len(BETWEEN) for i in ends)] for b in ends if b > a}
    known = [part for part in parts if part in photos or Path(part).is_file()]
    found = readings(text, known)
    if len(found) > 1:
        raise CrossrayError(
            f"--appearance {text} can be read as {' to '.join(found[0])} and as {' to '.join(found[1])}"
        )
    if not found:
        strange = next(part for part in [*text.split(BETWEEN), text] if part not in known)
        raise CrossrayError(
            f"--appearance {text}: {strange!r} is neither an image file nor a photo of the scene"
            f"{guess(strange, photos)}"
        )
    return found[0]


def even_weights(stops: int, pictures: int) -> list[tuple[float, ...] | None]:
    """Weights of `stops` appearances along `pictures`: the first picture has the first alone, the last the last.

    >>> even_weights(2, 3)
    [(1.0, 0.0), (0.5, 0.5), (0.0, 1.0)]
    """
    places = torch.linspace(0, stops - 1, pictures) if stops > 1 else torch.zeros(pictures)
    rows = (1 - (places[:, None] - torch.arange(stops)).abs()).clamp(min=0)
    return [tuple(row) for row in rows.tolist()]
