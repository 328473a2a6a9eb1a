"""Which checkpoint of a run scored best under a protocol: `<run>/eval/<protocol>/best.json`.

It is chosen by PSNR on the test photos, so the score that stands in it is no fair score of the method: a number to
report is that of a checkpoint chosen without the test photos, as the last one is. It is for those who want a good model
to look at.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from filelock import FileLock

from pipeline.checkpoint import folder_name
from pipeline.files import atomic_write

BEST = "best.json"


def lock_of_best(run: Path) -> FileLock:
    """Held by whoever points to the best checkpoints of a run, or removes others."""
    folder = run / ".evaluating"
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / "best.lock")


def write_best(folder: Path, results: Iterable[dict[str, Any]]) -> None:
    """Point `folder/best.json` to the best of a protocol's `results` (as metrics.json holds them), the earliest of
    equal ones; without any there is no such file."""
    scored = [r for r in results if not math.isnan(r["mean"]["psnr"])]
    if not scored:
        (folder / BEST).unlink(missing_ok=True)
        return
    best = max(scored, key=lambda r: (r["mean"]["psnr"], -r["step"]))
    record = {
        "step": best["step"],
        "checkpoint": folder_name(best["step"]),
        "checkpoint_sha256": best["checkpoint_sha256"],
        **best["mean"],
        "of": len(scored),
        "chosen": "by PSNR on the test photos: not a fair score",
    }
    text = json.dumps(record, indent=2)
    if read_text(folder / BEST) != text:
        atomic_write(folder / BEST, text)


def best_steps(run: Path) -> set[int]:
    """The steps of the checkpoints that are the run's best under some protocol; `prune` keeps them."""
    steps = set()
    for path in run.glob(f"eval/*/{BEST}"):
        try:
            steps.add(int(json.loads(path.read_text())["step"]))
        except (OSError, ValueError, KeyError, TypeError):
            continue  # the next evaluation writes it anew
    return steps


def read_text(path: Path) -> str | None:
    """What a file holds, None where there is none."""
    try:
        return path.read_text()
    except (OSError, ValueError):
        return None
