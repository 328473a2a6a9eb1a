"""A job file handed to a Ray cluster: sent there with the code, run there, its log followed from here.

What is sent is a copy of the code and the job file and nothing else, so it is small whatever lies in the user's folder.
The job belongs to the cluster: a lost connection or Ctrl-C ends the following, never the job.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
import logging
import os
import re
import secrets
import shlex
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import psutil

from pipeline.config import load_job
from pipeline.errors import CrossrayError
from pipeline.launch.home import HOME
from pipeline.reeval import load_reeval
from pipeline.study import load_study, read_kind
from pipeline.timing_job import load_timing, methods_of

HERE = "http://127.0.0.1:8265"  # where `ray start --head` listens
PACKAGES = ("model", "pipeline")
UPLOAD_LIMIT = 100 * 2**20  # bytes of a request that the Jobs API accepts; Ray's zip is not compressed
ZIP_ENTRY = 512  # bytes, about: what a zip file adds to each of its files
STOP_GRACE = 120  # seconds between `ray job stop` and the kill: enough to write a checkpoint
QUIET = 60.0  # seconds without a word after which the connection is made anew: it may have been lost unnoticed
FIRST_PAUSE = 1.0
LONGEST_PAUSE = 30.0  # seconds between two attempts to connect again
GIVE_UP = 600.0  # seconds without an answer of the cluster


class SubmitError(CrossrayError):
    """The job did not reach the cluster, or the cluster does not answer any more."""


class Submitted(NamedTuple):
    """A job on a cluster."""

    client: Any  # a connected JobSubmissionClient
    address: str
    id: str

    def command(self, words: str) -> str:
        """`ray job WORDS` for this job."""
        return f"ray job {words} --address {self.address} {self.id}"


def submit_job(
    file: Path, settings: Sequence[str] = (), address: str | None = None, home: str | None = None
) -> Submitted:
    """Hand a job file to a cluster.

    Args:
        address: URL of the cluster's dashboard; by default what RAY_API_SERVER_ADDRESS or RAY_ADDRESS says, else HERE.
        home: the folder on the cluster that the job's relative paths are meant from; by default the working directory
            for a cluster on this machine, and else what CROSSRAY_HOME is on the cluster.

    Raises:
        CrossrayError: the job file is wrong, no cluster answers there, or it refuses.
    """
    metadata = describe(file, settings)
    url = find_address(address)
    variables = {"RAY_JOB_STOP_WAIT_TIME_S": str(STOP_GRACE)}
    home = find_home(home, url)
    if home is not None:
        variables[HOME] = home
    with tempfile.TemporaryDirectory(prefix="crossray-submit-") as folder:
        entrypoint = stage(file, settings, Path(folder))
        client = connect(url)
        try:
            job = client.submit_job(
                entrypoint=entrypoint,
                submission_id=new_id(metadata),
                runtime_env={"working_dir": folder, "env_vars": variables},
                metadata=metadata,
            )
        except (RuntimeError, OSError) as error:
            if "No available agent" in str(error):
                raise SubmitError(
                    f"{url}: the cluster's head has no agent for jobs. Another Ray on that machine had its port "
                    "(52365) when it was started: start the head again"
                ) from None
            raise SubmitError(f"{url}: the cluster did not take the job: {error}") from error
    return Submitted(client, url, job)


def describe(file: Path, settings: Sequence[str]) -> dict[str, str]:
    """Metadata of a job, for `ray job list` and the dashboard; the job file is checked on the way.

    Raises:
        CrossrayError: a key or a value is wrong.
    """
    kind = read_kind(file)
    about: dict[str, str] = {"kind": kind, "version": importlib.metadata.version("crossray")}
    if kind == "study":
        study = load_study(file, settings)
        return about | {"name": study.name, "scene": " ".join(study.scenes), "method": " ".join(study.variants)}
    if kind == "reeval":
        return about | {"name": " ".join(load_reeval(file, settings).runs)}
    if kind == "timing":
        timing = load_timing(file, settings)
        return about | {"name": timing.name, "method": " ".join(methods_of(timing))}
    job = load_job(file, settings)
    return about | {"name": job.name, "scene": job.scene.path.name, "method": job.method}


def new_id(metadata: dict[str, str]) -> str:
    """A submission id that tells what it is, train-reichstag-r8-0f3a52c1, and is never the same twice."""
    words = re.findall(r"[a-z0-9]+", f"{metadata['kind']} {metadata['name'].lower()}"[:50])
    return "-".join([*words, secrets.token_hex(4)])


def stage(file: Path, settings: Sequence[str], folder: Path) -> str:
    """Copy the code and the job file to `folder`; returns the command that runs the job there.

    Raises:
        SubmitError: more than the Jobs API accepts lies in the folders of the code.
    """
    for package in PACKAGES:
        origin = Path(sys.modules[package].__file__ or "").parent
        shutil.copytree(origin, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    copy = folder / "jobs" / file.name
    copy.parent.mkdir()
    shutil.copy(file, copy)
    sizes = {path: path.stat().st_size + ZIP_ENTRY for path in folder.rglob("*") if path.is_file()}
    if sum(sizes.values()) > UPLOAD_LIMIT:
        largest = max(sizes, key=lambda path: sizes[path])
        raise SubmitError(
            f"the code is {sum(sizes.values()) / 2**20:.0f} MiB, and a cluster accepts {UPLOAD_LIMIT >> 20}: move what "
            f"is no code out of its folders, first of all {largest.relative_to(folder)}"
        )
    words = ["python", "-m", "pipeline", "run", f"jobs/{file.name}"]
    return shlex.join([*words, *(word for setting in settings for word in ("--set", setting))])


def find_address(address: str | None) -> str:
    """The address that was given, else the environment's as Ray reads it, else this machine's."""
    if address and "://" not in address:
        return f"http://{address}"
    return address or os.environ.get("RAY_API_SERVER_ADDRESS") or os.environ.get("RAY_ADDRESS") or HERE


def find_home(home: str | None, address: str) -> str | None:
    """CROSSRAY_HOME of the job; None: what it is on the cluster.

    Raises:
        SubmitError: `home` is a relative path, which says nothing on another machine.
    """
    here = address == "auto" or is_this_machine(address)
    if home is None:
        return str(Path.cwd()) if here else None
    if not Path(home).is_absolute() and not here:
        raise SubmitError(f"--home {home}: must be an absolute path, since it is meant on the cluster at {address}")
    return str(Path(home).absolute())


def is_this_machine(address: str) -> bool:
    """Whether an address, `http://host:port` or `host:port`, is one of this machine's own."""
    host = urlsplit(address if "://" in address else f"//{address}").hostname
    try:
        found = {entry[4][0] for entry in socket.getaddrinfo(host, None)}
    except OSError:
        return False
    own = {entry.address for entries in psutil.net_if_addrs().values() for entry in entries}
    return bool(found) and found <= own


def connect(address: str) -> Any:
    """A JobSubmissionClient.

    Raises:
        SubmitError: nobody answers at `address`, or it wants another token.
    """
    os.environ["RAY_API_SERVER_ADDRESS"] = address  # the client lets the environment overrule its argument
    try:
        from ray.exceptions import AuthenticationError
        from ray.job_submission import JobSubmissionClient
    except ImportError as error:
        raise SubmitError(f"submitting needs Ray ({error}): pip install 'ray[default]'") from error
    for module in ("dashboard.modules.dashboard_sdk", "dashboard.modules.job.sdk", "_private.runtime_env.packaging"):
        logging.getLogger(f"ray.{module}").setLevel(logging.WARNING)
    try:
        return JobSubmissionClient(address)
    except AuthenticationError as error:
        wrong = "invalid" in str(error).lower()
        what = "it does not take the one that is set here" if wrong else "none is set here"
        raise SubmitError(
            f"{address}: the cluster asks for a token, and {what}. Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN_PATH to "
            "a file that holds the cluster's token (or RAY_AUTH_TOKEN to the token itself)"
        ) from None
    except (RuntimeError, ValueError, OSError) as error:  # requests' errors are among the last
        reason = str(error).strip().partition("\n")[0].rstrip(".")
        raise SubmitError(
            f"no Ray cluster answers at {address} ({reason}). `ray start --head` starts one on this machine; "
            "--address http://HEAD:8265, or RAY_API_SERVER_ADDRESS, names another"
        ) from None


class Log:
    """Hands on a text that may be read from its beginning several times, each character once."""

    def __init__(self, write: Callable[[str], object]) -> None:
        self.write = write
        self.written = self.read = 0

    def begin(self) -> None:
        """The text is read from its beginning."""
        self.read = 0

    def add(self, text: str) -> None:
        """The next piece that was read.

        Raises:
            SubmitError: it cannot be written.
        """
        fresh = text[max(self.written - self.read, 0) :]
        self.read += len(text)
        try:
            self.write(fresh)
        except OSError as error:
            raise SubmitError(f"the log cannot be written here ({error}); the job goes on without a reader") from None
        self.written += len(fresh)


def follow(job: Submitted, write: Callable[[str], object]) -> Any:
    """Hand the job's log to `write` as it grows, nothing twice, until the job has ended.

    A lost connection is made again, after pauses that grow while the cluster does not answer.

    Returns:
        Ray's JobDetails.

    Raises:
        SubmitError: the cluster does not know the job any more, or has not answered for GIVE_UP seconds.
    """
    import aiohttp

    log, answered, pause = Log(write), time.monotonic(), FIRST_PAUSE
    while True:
        with suppress(RuntimeError, OSError, aiohttp.ClientError):
            asyncio.run(read_log(job, log))
        try:
            details = job.client.get_job_info(job.id)
            if details.status.is_terminal():
                with suppress(RuntimeError):  # what was read is all that there is
                    log.begin()
                    log.add(job.client.get_job_logs(job.id))  # the connection may have been lost just before the end
                return details
            answered, pause = time.monotonic(), FIRST_PAUSE
        except (RuntimeError, OSError) as error:
            if "status code 404" in str(error):
                raise SubmitError(f"{job.id}: the cluster at {job.address} does not know this job any more") from None
            if time.monotonic() - answered > GIVE_UP:
                raise SubmitError(
                    f"{job.address} has not answered for {GIVE_UP / 60:.0f} minutes; the job may be running there. "
                    f"`{job.command('logs --follow')}` follows it again"
                ) from None
            pause = min(2 * pause, LONGEST_PAUSE)
        time.sleep(pause)


async def read_log(job: Submitted, log: Log) -> None:
    """Read the log from its beginning, until the job ends or the connection does."""
    log.begin()
    pieces = job.client.tail_job_logs(job.id)
    with suppress(StopAsyncIteration):
        while True:
            log.add(await asyncio.wait_for(anext(pieces), QUIET))


def how_it_ended(details: Any) -> str:
    """The end of a job in words."""
    status = details.status.value
    if status == "SUCCEEDED":
        return "succeeded"
    if status == "STOPPED":
        return "was stopped; submit it again to go on"
    if details.driver_exit_code:
        return f"failed (exit status {details.driver_exit_code}); its log above says why"
    return f"failed: {details.message}"
