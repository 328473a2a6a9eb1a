"""Where the tests find their real data, and the environment that keeps every process on loopback."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import settings

# Set before anything imports Ray: loopback only, no usage reports.
os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")
os.environ.setdefault("OMP_NUM_THREADS", "1")

torch.set_num_threads(1)

sys.path.append(str(Path(__file__).parent / "pipeline"))  # tiny_run and tiny_scene, for the faults as well

ROOT = Path(__file__).resolve().parent.parent
TEST_DATA = Path(os.environ.get("CROSSRAY_TEST_DATA", ROOT.parent / "shared" / "data")).resolve()


# The same examples in every run: what a test finds, it finds before a change lands, and not by chance after it.
settings.register_profile("fixed", derandomize=True)
settings.load_profile("fixed")


@pytest.fixture(scope="session", autouse=True)
def own_photo_cache(tmp_path_factory):
    """No test leaves anything in the user's cache folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROSSRAY_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def test_data() -> Path:
    """The folder of real photos, weights and golden vectors; skips where it is absent."""
    if not TEST_DATA.is_dir():
        pytest.skip(f"no test data at {TEST_DATA}; set CROSSRAY_TEST_DATA")
    return TEST_DATA


@pytest.fixture(scope="session")
def golden(test_data):
    """`golden(name)`: the arrays of one golden file, as a dict of torch tensors (text stays numpy)."""
    import numpy as np

    def load(name: str) -> dict:
        with np.load(test_data / "golden" / f"{name}.npz", allow_pickle=False) as arrays:
            return {
                k: (v if v.dtype.kind in "US" else torch.from_numpy(np.array(v)))
                for k, v in ((k, arrays[k]) for k in arrays.files)
            }

    return load
