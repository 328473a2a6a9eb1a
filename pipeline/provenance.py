"""Where a number came from: every result that is recorded holds this, so that each cell of a table can be traced."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import psutil
import torch

PACKAGES = ("torch", "numpy", "pillow", "scikit-image", "ray")
CODE = ("model", "pipeline", "jobs", "benchmarks/*.py")


def provenance() -> dict[str, Any]:
    """The command of this process, the commit, the moment (UTC, ISO 8601), the hardware, and versions; JSON values.

    `commit` is None outside a git checkout, and ends with `-changed` where code has changed since. Versions are of what
    is installed of PACKAGES.
    """
    return {
        "command": command(),
        "commit": commit(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "hardware": hardware(),
        "versions": versions(),
        "python": platform.python_version(),
    }


def command() -> str:
    """The command line of this process, as a shell takes it in its folder: paths below that are relative."""
    program, words = Path(sys.argv[0]), sys.argv[1:]
    if program.name == "__main__.py":
        start = ["python", "-m", program.parent.name]
    elif program.suffix == ".py":
        start = ["python", str(Path(program.parent.name, program.name))]
    else:
        start = [program.name]
    below = f"{Path.cwd()}{os.sep}"
    return shlex.join(word.replace(below, "") for word in [*start, *words])


@cache
def commit() -> str | None:
    """The commit of the code that runs; as it was when it was first asked for."""
    root = Path(__file__).resolve().parents[1]

    def git(*words: str) -> str | None:
        try:
            found = subprocess.run(["git", "-C", root, *words], capture_output=True, text=True, check=False)
        except OSError:  # a machine without git
            return None
        return found.stdout.strip() if found.returncode == 0 else None

    head = git("rev-parse", "HEAD") if (root / ".git").exists() else None
    return head and head + ("-changed" if git("status", "--porcelain", "--", *CODE) else "")


def versions() -> dict[str, str]:
    """Package -> version."""
    found = {}
    for name in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def hardware() -> dict[str, Any]:
    """This machine: `processor`, `cores`, `memory_GiB`, and `gpus` (names, one each)."""
    return {
        "processor": device_name(torch.device("cpu")),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_GiB": round(psutil.virtual_memory().total / 2**30, 1),
        "gpus": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())],
    }


def device_name(device: torch.device) -> str:
    """The device as its maker calls it."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
