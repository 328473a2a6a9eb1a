"""What became of each photo, and of the scene: summary.json, and a table to read."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from pipeline.ingest.folder import Seen
from pipeline.ingest.mapping import AGREE, Found, Model, Try
from pipeline.log import plain

LEAST_MATCHES = 15  # inliers: fewer of a pair do not count as overlap
SHOWN = 30  # rejected photos in the table


@dataclass(frozen=True)
class Summary:
    """How an ingest ended. Lengths are in COLMAP units, errors and focal lengths in pixels of the scene's photos."""

    scene: str
    registered: dict[str, str]  # the scene's photo -> the file that it was made of
    rejected: dict[str, str]  # file -> why
    points: int
    reprojection_error: float
    track_length: float  # photos that see a point, on average
    focal_lengths: dict[str, float]  # of each photo, in its longer sides
    other_models: list[list[str]]  # files of photos that fell into another model
    tries: list[str]
    seconds: dict[str, float]  # of each step, as far as this run did it
    apart: dict[str, float] = field(default_factory=dict)  # photo -> degrees between its poses in two tries

    def write(self, path: Path) -> None:
        """As JSON."""
        from pipeline.files import atomic_write

        atomic_write(path, json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def read(cls, path: Path) -> Summary:
        """What `write` wrote."""
        return cls(**json.loads(path.read_text()))

    @property
    def inexact(self) -> str:
        """What to tell where two tries do not agree on the poses, or empty."""
        if not self.apart or (middle := median(self.apart.values())) <= AGREE:
            return ""
        return (
            f"the poses are not exact: two tries differ by {middle:.1f} degrees in the median, and a trained "
            "scene would be blurred. More photos, larger ones, or more steps between standpoints help"
        )

    def agreement(self) -> str:
        """How well a second try agrees, in words."""
        if not self.apart:
            return "of one try alone"
        worst, most = max(self.apart.items(), key=lambda item: item[1])
        middle = median(self.apart.values())
        return f"two tries differ by {middle:.2f} degrees in the median, {most:.2f} at most ({self.registered[worst]})"

    def table(self) -> Group:
        """For a terminal."""
        focal = sorted(self.focal_lengths.values())
        facts = Table(show_header=False, box=None)
        for what, value in (
            ("registered", f"{len(self.registered)} of {len(self.registered) + len(self.rejected)} files"),
            ("points", f"{self.points}, each seen by {self.track_length:.1f} photos on average"),
            ("reprojection error", f"{self.reprojection_error:.2f} pixels"),
            ("focal lengths", f"{focal[0]:.2f} to {focal[-1]:.2f} of the longer side"),
            ("poses", self.agreement()),
            ("tries", "\n".join(self.tries)),
            ("time", ", ".join(f"{step} {s:.0f} s" for step, s in self.seconds.items())),
        ):
            facts.add_row(what, Text(plain(value)))
        for number, names in enumerate(self.other_models, start=2):
            facts.add_row(f"place {number}", Text(plain(f"{len(names)} photos are of another one: {', '.join(names)}")))
        if not self.rejected:
            return Group(facts)
        rejected = Table("rejected", "why")
        for name, why in list(self.rejected.items())[:SHOWN]:
            rejected.add_row(Text(plain(name)), Text(plain(why)))
        if len(self.rejected) > SHOWN:
            rejected.add_row(f"... and {len(self.rejected) - SHOWN} more", "summary.json names them")
        return Group(facts, rejected)


def reasons(seen: list[Seen], chosen: Model, others: list[Model], pairs: dict[tuple[str, str], int]) -> dict[str, str]:
    """File -> why it is not in the scene, of all that are not."""
    best: dict[str, tuple[int, str]] = {}
    for (a, b), count in pairs.items():
        for one, other in ((a, b), (b, a)):
            best[one] = max(best.get(one, (0, "")), (count, other))
    files = {s.photo: s.name for s in seen}
    result = {}
    for s in seen:
        if not s.photo:
            result[s.name] = s.reason
        elif s.photo in chosen.bad:
            result[s.name] = f"bad camera: {chosen.bad[s.photo]}"
        elif s.photo not in chosen.photos:
            count, other = best.get(s.photo, (0, ""))
            elsewhere = next((m for m in others if s.photo in m.photos), None)
            if elsewhere:
                result[s.name] = f"registered in another model, of {len(elsewhere.photos)} photos"
            elif count < LEAST_MATCHES:
                result[s.name] = f"no overlap: {count} verified matches at most with any other photo"
            else:
                result[s.name] = f"no pose found: {count} verified matches at most, with {files[other]}"
    return result


def other_places(tried: Try, chosen: Model) -> list[Model]:
    """The sound models of a try beside the chosen one that share no photo with it."""
    return [m for m in tried.models if m is not chosen and not m.unsound and not set(m.photos) & set(chosen.photos)]


def summarise(
    scene: Path,
    seen: list[Seen],
    model: Any,
    found: Found,
    pairs: dict[tuple[str, str], int],
    seconds: dict[str, float],
) -> Summary:
    """The summary of a scene whose undistorted model is `model` (a `pycolmap.Reconstruction`)."""
    files = {s.photo: s.name for s in seen if s.photo}
    others = other_places(found.tried, found.model)
    focal = {}
    for image in (model.images[i] for i in model.reg_image_ids()):
        camera = model.cameras[image.camera_id]
        focal[image.name] = float(camera.focal_length_x / max(camera.width, camera.height))
    return Summary(
        scene=str(scene),
        registered={name: files[name] for name in sorted(focal)},
        rejected=reasons(seen, found.model, others, pairs),
        points=len(model.points3D),
        reprojection_error=found.model.error,
        track_length=float(model.compute_mean_track_length()),
        focal_lengths=dict(sorted(focal.items())),
        other_models=[sorted(files[n] for n in m.photos) for m in others],
        tries=[t.told() for t in found.tries],
        seconds=seconds,
        apart={name: round(degrees, 3) for name, degrees in found.apart.items()},
    )
