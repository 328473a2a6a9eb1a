"""The home folder, from which a job's relative paths are meant: `$CROSSRAY_HOME` where it is set, else the working
directory. All nodes of a cluster see it under the same path; whatever runs on them goes there first."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from pathlib import Path

from pipeline.errors import CrossrayError

HOME = "CROSSRAY_HOME"
UNPACKED = Path("runtime_resources") / "working_dir_files"  # where Ray unpacks the working_dir of a submitted job


def go_home(paths: Mapping[str, Path]) -> None:
    """Make the home folder this process's own.

    Args:
        paths: the job's folders, by the key that names them; the job file is read by now.

    Raises:
        CrossrayError: `$CROSSRAY_HOME` is not a folder, or a relative path would be lost with Ray's copy of the
            working directory.
    """
    home = os.environ.get(HOME)
    if home:
        if not Path(home).is_absolute() or not Path(home).is_dir():
            raise CrossrayError(
                f"{HOME}: {home} is not the absolute path of a folder on {socket.gethostname()}; all nodes have to see "
                "this folder under the same path"
            )
        os.chdir(home)
        return
    here = Path.cwd()
    relative = [key for key, path in paths.items() if not path.is_absolute()]
    if relative and str(UNPACKED) in str(here):
        raise CrossrayError(
            f"{relative[0]}: {paths[relative[0]]} would lie in Ray's copy of the job's working directory, which is "
            f"removed after the job. Set {HOME} to a folder that all nodes share: ray job submit --runtime-env-json "
            f'\'{{"env_vars": {{"{HOME}": "/shared"}}}}\' ...; or give full paths: '
            + " ".join(f"--set {key}=/shared/{paths[key]}" for key in relative)
        )


def follow(folder: Path) -> None:
    """Go to the driver's folder, in a process that Ray has started somewhere.

    Raises:
        CrossrayError: this node has no such folder.
    """
    try:
        os.chdir(folder)
    except OSError as error:
        raise CrossrayError(
            f"node {socket.gethostname()} has no folder {folder} ({error.strerror}), from which the job's paths are "
            f"meant; mount it there under the same path, or set {HOME} to a folder that all nodes share"
        ) from None
