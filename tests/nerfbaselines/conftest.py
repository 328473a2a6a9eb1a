"""What the tests share: a landmark that nerfbaselines reads, and a method that was trained on it."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Path:
    """A described landmark of 10 photos, large enough for LPIPS: half the shorter side has 31 pixels."""
    pytest.importorskip("nerfbaselines.evaluation", reason="nerfbaselines is not installed: make test-nerfbaselines")
    from pipeline.landmark import write_landmark
    from pipeline.nerfbaselines.describe import describe

    root = tmp_path_factory.mktemp("nerfbaselines") / "landmark"
    return describe(write_landmark(root, train=7, val=1, test=2, size=112))


@pytest.fixture(scope="session")
def photos(scene):
    """Its training photos."""
    from nerfbaselines_data import load

    return load(scene, "train")


@pytest.fixture(scope="session")
def views(scene):
    """Its test photos."""
    from nerfbaselines_data import load

    return load(scene, "test")


@pytest.fixture(scope="session")
def trained(photos):
    """A method after its 60 steps; not to be changed."""
    from nerfbaselines_data import tiny

    from pipeline.nerfbaselines.method import Crossray

    method = Crossray(train_dataset=photos, config_overrides=tiny(train__steps_per_epoch=30))
    for step in range(60):
        method.train_iteration(step)
    return method
