"""`python -m pipeline.nerfbaselines.describe SCENE`: lets nerfbaselines read a scene folder of ours, such as the
landmark, as it reads those that it downloads.

Writes into the folder `nb-info.json` (COLMAP layout, evaluation protocol `nerfw`), and `train_list.txt` and
`test_list.txt` by the scene's split table. Validation photos are in neither.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from pipeline.errors import CrossrayError
from pipeline.files import atomic_write
from pipeline.scene import find_model, find_photo_folder, read_scene

PROTOCOL = "nerfw"


def describe(root: Path) -> Path:
    """Describe the scene in the folder `root` for nerfbaselines; returns what `--data` takes.

    Raises:
        CrossrayError: the scene cannot be read, has no test photo, or its folder cannot be written.
    """
    scene = read_scene(root)
    names = {split: [p.name for p in scene.photos if p.split == split] for split in ("train", "test")}
    if not names["test"]:
        raise CrossrayError(f"{scene.root}: no test photo, and nerfbaselines needs some; see the split table")
    model = find_model(scene.root)[0]
    photos = find_photo_folder(scene.root, model)
    information = {
        "loader": "colmap",
        "loader_kwargs": {
            "images_path": os.path.relpath(photos, scene.root),
            "colmap_path": os.path.relpath(model, scene.root),
        },
        "id": None,  # no public data set: nerfbaselines then looks for no published results of it
        "scene": scene.name,
        "type": None,
        "evaluation_protocol": PROTOCOL,
    }
    try:
        for split, listed in names.items():
            atomic_write(scene.root / f"{split}_list.txt", "".join(f"{name}\n" for name in listed))
        atomic_write(scene.root / "nb-info.json", json.dumps(information, indent=2) + "\n")
    except OSError as error:
        raise CrossrayError(f"{scene.root} cannot be written ({error.strerror}): copy the scene elsewhere") from error
    return scene.root


def main(arguments: list[str]) -> int:
    """The command; returns its exit status."""
    if len(arguments) != 1:
        print("usage: python -m pipeline.nerfbaselines.describe SCENE", file=sys.stderr)
        return 2
    try:
        print(describe(Path(arguments[0])))
    except CrossrayError as error:
        print(f"crossray: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
