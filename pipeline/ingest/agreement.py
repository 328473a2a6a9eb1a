"""Whether two tries agree on the poses.

A model can be sound in every camera and inexact all the same: the photos are few, small or too much alike, and errors
that reprojection does not show are left. Another seed then ends elsewhere. Models of photos that suffice agree within
hundredths of a degree.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.colmap import import_pycolmap

LEAST_SHARED = 3  # photos that two models must share to be compared
CANDIDATES = 100  # for the turn between two worlds


def read_rotations(folder: Path) -> dict[str, np.ndarray]:
    """Photo -> world-to-camera rotation (3, 3) of the COLMAP model in a folder."""
    model = import_pycolmap().Reconstruction(str(folder))
    images = (model.images[i] for i in model.reg_image_ids())
    return {image.name: image.cam_from_world().rotation.matrix() for image in images}


def differences(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> dict[str, float]:
    """Photo -> angle in degrees between its rotations in two models, for the photos of both.

    Each model has its own world. Of the turns between the two that the photos suggest, the one is taken that most
    agree with, so that a wrong camera is told apart and does not tilt the others. Empty where fewer than LEAST_SHARED
    photos are in both.
    """
    names = sorted(a.keys() & b.keys())
    if len(names) < LEAST_SHARED:
        return {}
    turns = np.stack([b[n].T @ a[n] for n in names])  # from a's world to b's
    some = turns[:: -(-len(turns) // CANDIDATES)]
    cosines = (np.einsum("cij,nij->cn", some, turns) - 1) / 2  # of the angle between two turns: by the trace
    angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    best = angles[np.median(angles, axis=1).argmin()]
    return dict(zip(names, best.tolist(), strict=True))
