"""Jobs on a real cluster of several nodes, submitted as a user does it: through lost nodes, stops, lost connections.

Everything is compared with a run that nothing disturbed, on this machine and without Ray.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml
from ray_cluster import Cluster, Node, wait_until
from tiny_run import assert_same_bits, final_state, tiny_mapping
from tiny_scene import write_tiny_scene

from pipeline.checkpoint import committed, read_checkpoint
from pipeline.config import Job, load_job
from pipeline.heartbeat import rank_path, read_beat
from pipeline.resume import checkpoints

pytestmark = pytest.mark.cluster

RANKS = 4
VIEWS = 5  # that are scored
STEPS = 200
SPLITS = ("train",) * 5 + ("val",) + ("test",) * VIEWS
GRACE = 120  # seconds until Ray kills a job that was stopped
JOB = Path("jobs") / "train_tiny.yaml"
BIN = Path(sys.executable).parent
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def project(tmp_path_factory) -> Path:
    """A project's folder, the home of all that is submitted: a scene, and a job file that is a program."""
    folder = tmp_path_factory.mktemp("project")
    write_tiny_scene(folder / "scene", photos=len(SPLITS), splits=SPLITS)
    mapping = tiny_mapping(
        folder,
        over={
            "scene": {"path": "scene", "shards": "shards/tiny"},
            "runs": "runs",
            "ranks": RANKS,
            "patch": {"size": 4},
            "train": {"epochs": 2, "steps_per_epoch": STEPS // 2},
            "evaluate": {"protocols": ["crnerf-full@R2", "nerfw-half@R2"]},
        },
    )
    (folder / "jobs").mkdir()
    (folder / JOB).write_text("#!/usr/bin/env -S python -m pipeline run\n" + yaml.safe_dump(mapping))
    (folder / JOB).chmod(0o755)
    return folder


@pytest.fixture(scope="module")
def cluster(project) -> Iterator[Cluster]:
    """A head and four nodes of one CPU each: one more than there are ranks."""
    with Cluster(project, nodes=4, env={"CROSSRAY_CACHE": str(project / "cache")}) as cluster:
        yield cluster


def job_of(project: Path, name: str) -> Job:
    """The job of a run that has begun, its paths made absolute."""
    where = [f"{key}={project / folder}" for key, folder in (("runs", "runs"), ("scene.shards", "shards/tiny"))]
    return load_job(project / "runs" / name / "job.yaml", where)


@pytest.fixture(scope="module")
def straight(project) -> Job:
    """The undisturbed run: as many ranks, on this machine, without Ray."""
    words = [sys.executable, "-m", "pipeline", "run", str(JOB), "--launcher", "local", "--set", "name=straight"]
    ended = run(words, project, os.environ | {"CROSSRAY_CACHE": str(project / "cache")})
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return job_of(project, "straight")


def run(words: list[str], cwd: Path, env: Any) -> subprocess.CompletedProcess:
    return subprocess.run(words, cwd=cwd, env=env, capture_output=True, text=True, timeout=300, check=False)


def ray(cluster: Cluster, *words: str) -> subprocess.CompletedProcess:
    """The `ray` command, from a folder where nothing of the project is."""
    return run([str(BIN / "ray"), *words], cluster.folder, cluster.env)


def submit(cluster: Cluster, *words: str) -> list[str]:
    return [str(BIN / "crossray"), "submit", str(JOB), *words]


def newest_id(cluster: Cluster) -> str:
    return max(cluster.jobs(), key=lambda job: job["start_time"])["submission_id"]


def log_of(cluster: Cluster, job: str) -> str:
    return cluster.request(f"/api/jobs/{job}/logs")[1]["logs"]


def wait_for_job(cluster: Cluster, job: str, status: str) -> None:
    def ended() -> bool:
        return cluster.job(job)["status"] in ("SUCCEEDED", "FAILED", "STOPPED")

    wait_until(ended, f"{job} ends", lambda: log_of(cluster, job), patience=240)
    assert cluster.job(job)["status"] == status, log_of(cluster, job)


def wait_for_step(cluster: Cluster, job: str, run: Path, step: int) -> None:
    """Until rank 0 of a submitted job has done so many steps."""

    def there() -> bool:
        assert cluster.job(job)["status"] in ("PENDING", "RUNNING"), log_of(cluster, job)
        beat = read_beat(rank_path(run, 0))
        return beat is not None and beat.get("step", 0) >= step

    wait_until(there, f"{job} does step {step}", lambda: log_of(cluster, job))


def assert_same_run(job: Job, other: Job) -> None:
    for ours, theirs, what in zip(final_state(job), final_state(other), ("model", "optimiser"), strict=True):
        assert_same_bits(dict(ours), dict(theirs), what)


# The cluster itself


def test_it_is_a_cluster_and_shut_to_strangers(cluster):
    assert len(cluster.alive()) == 5
    ended = ray(cluster, "job", "submit", "--", "pwd")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert str(cluster.home) in ended.stdout.splitlines()  # from where the head was started
    for token, status in ((None, 401), ("wrong", 403)):
        assert cluster.request("/api/jobs/", token)[0] == status
    without = {name: value for name, value in cluster.env.items() if not name.startswith("RAY_AUTH")}
    stranger = run(submit(cluster), cluster.home, without | {"RAY_AUTH_MODE": "disabled"})
    assert stranger.returncode == 2
    assert "asks for a token, and none is set here" in stranger.stderr
    assert len(cluster.jobs()) == 1

    processes = [process for node in cluster.nodes for process in node.processes()]
    sockets = [c for process in processes for c in process.net_connections() if c.status == psutil.CONN_LISTEN]
    assert len(sockets) > 5 * len(cluster.nodes)
    assert {c.laddr.ip for c in sockets} <= {"127.0.0.1", "::ffff:127.0.0.1"}


def test_local_edits_travel_as_a_working_directory(cluster):
    """From this project's own root, whatever else lies there; the job's home is still the cluster's."""
    words = ["--working-dir", ".", "--", "jobs/train_scene_cpu.yaml", "--set", "scene.path=no scene"]
    ended = run([str(BIN / "ray"), "job", "submit", *words], ROOT, cluster.env)
    assert ended.returncode == 1, ended.stdout + ended.stderr
    assert "scene.path: no scene is not a folder, and there are no shards in shards/no scene-R8" in ended.stdout
    assert cluster.job(newest_id(cluster))["driver_exit_code"] == 2


# What happens to a connection


@contextmanager
def gate(port: int) -> Iterator[tuple[str, list[socket.socket]]]:
    """A way to a port of this machine that can be cut: its address, and the connections that go through it."""
    open_now: list[socket.socket] = []

    def pump(source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while piece := source.recv(65536):
                target.sendall(piece)
        for end in (source, target):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def serve() -> None:
        with suppress(OSError):
            while True:
                near, _ = listener.accept()
                far = socket.create_connection(("127.0.0.1", port))
                open_now.extend((near, far))
                for pair in ((near, far), (far, near)):
                    threading.Thread(target=pump, args=pair, daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=serve, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}", open_now
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            cut(open_now)


def cut(connections: list[socket.socket]) -> None:
    for end in connections:
        with suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


def test_a_lost_connection_loses_nothing_of_the_log(cluster, project, straight):
    words = submit(cluster, "--set", "name=connection", "--set", "ranks=1", "--set", "launcher=local")
    output = project / "connection.txt"
    port = int(cluster.url.rpartition(":")[2])
    with gate(port) as (address, connections), output.open("wb") as file:
        process = subprocess.Popen([*words, "--address", address], cwd=project, env=cluster.env, stdout=file)
        try:
            wait_until(lambda: b"Running entrypoint" in output.read_bytes(), "the log is followed")
            for _ in range(3):  # whenever it has come back
                before = len(connections)
                cut(connections)
                wait_until(lambda before=before: len(connections) > before, "it is connected again")
            assert process.wait(120) == 0
        finally:
            process.kill()
            process.wait()
    job = newest_id(cluster)
    first, *log, last = output.read_text().splitlines(keepends=True)
    assert first.startswith(f"{job}: submitted")
    assert "".join(log) == log_of(cluster, job)
    assert last == f"{job}: succeeded\n"


# Jobs


def test_a_job_that_does_not_fit_fails_at_once_and_says_what_fits(cluster, project):
    began = time.monotonic()
    ended = run(submit(cluster, "--set", "name=large", "--set", "ranks=64"), project, cluster.env)
    assert time.monotonic() - began < 60
    assert ended.returncode == 1
    assert "the job wants 64 ranks" in ended.stdout
    assert "--set ranks=5" in ended.stdout
    assert "failed (exit status 2)" in ended.stdout
    assert cluster.job(newest_id(cluster))["status"] == "FAILED"


def test_a_stopped_job_saves_where_it_is_and_goes_on_to_the_same_bits(cluster, project, straight):
    folder = project / "runs" / "stopped"
    words = submit(cluster, "--set", "name=stopped")
    following = subprocess.Popen(words, cwd=project, env=cluster.env, stdout=subprocess.PIPE, text=True)
    try:
        wait_until(lambda: any("stopped" in job["submission_id"] for job in cluster.jobs()), "it is submitted")
        job = newest_id(cluster)
        wait_for_step(cluster, job, folder, 5)
        following.send_signal(signal.SIGINT)  # Ctrl-C: the following ends, the job does not
        said, _ = following.communicate(timeout=60)
    finally:
        following.kill()
        following.wait()
    assert following.returncode == 130
    assert f"{job}: goes on" in said
    assert cluster.job(job)["status"] == "RUNNING"

    asked = time.monotonic()
    assert ray(cluster, "job", "stop", job).returncode == 0
    wait_for_job(cluster, job, "STOPPED")
    assert time.monotonic() - asked < GRACE
    state = job_of(project, "stopped")
    (stopped,) = committed(checkpoints(state))  # the job asks for no other before its end
    at = read_checkpoint(stopped)
    assert 5 <= at.step < STEPS
    assert (at.meta["finished"], at.meta["world_size"]) == (False, RANKS)
    assert not (folder / "eval").exists()

    ended = run(words, project, cluster.env)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    again = newest_id(cluster)
    assert again != job
    assert ended.stdout.count("Running entrypoint") == 1
    assert ended.stdout.endswith(f"{again}: succeeded\n")
    assert cluster.job(again)["metadata"]["method"] == "crossray"
    assert_same_run(state, straight)


def node_of_a_rank(cluster: Cluster, run: Path) -> tuple[Node, list[int]]:
    """A node that holds a rank, and is not the head; and the processes of all ranks."""
    pids = [read_beat(rank_path(run, rank))["pid"] for rank in range(RANKS)]
    nodes = [cluster.node_of(pid) for pid in pids]
    assert None not in nodes
    assert len(set(nodes)) == RANKS  # a CPU each
    return next(node for node in reversed(nodes) if node is not cluster.head), pids


def test_a_job_outlives_a_node(cluster, project, straight):
    """The whole of a job, as the README says it: shards, four ranks, a node that is lost, evaluation."""
    name, folder = "literal", project / "runs" / "literal"
    text = (project / JOB).read_text().replace("name: tiny", f"name: {name}").replace("shards/tiny", "shards/by-tasks")
    program = project / JOB.with_name("literal.yaml")
    program.write_text(text.replace("checkpoint_every: 1000", "checkpoint_every: 10"))
    program.chmod(0o755)

    assert ray(cluster, "job", "submit", "--no-wait", "jobs/literal.yaml").returncode == 0
    job = newest_id(cluster)
    wait_for_step(cluster, job, folder, 30)
    lost, pids = node_of_a_rank(cluster, folder)
    there = len(cluster.alive())
    lost.kill()
    assert any(not psutil.pid_exists(pid) for pid in pids)
    cluster.wait_for_nodes(there - 1)
    wait_for_job(cluster, job, "SUCCEEDED")

    log = log_of(cluster, job)
    assert "1 of 3" in log, log  # attempts; the sentence around it may be broken into lines
    assert "resuming literal from step" in log, log
    assert_same_run(job_of(project, name), straight)

    began = cluster.job(job)["start_time"]
    wait_until(lambda: len(finished_tasks(cluster, "score_views", began)) == VIEWS, "each view is scored, and once")
    for stage in ("write_shard", "score_views"):
        assert len({task["node_id"] for task in finished_tasks(cluster, stage, began)}) > 1, f"{stage}: one node alone"
    for ours, theirs in zip(tars(project, "by-tasks"), tars(project, "tiny"), strict=True):
        assert ours.read_bytes() == theirs.read_bytes()
    for protocol in ("crnerf-full@R2", "nerfw-half@R2"):
        metrics = [
            project / "runs" / run / "eval" / protocol / f"step-{STEPS:08d}" / "metrics.json"
            for run in (name, "straight")
        ]
        ours, theirs = (json.loads(path.read_text()) for path in metrics)
        assert len(ours["images"]) == VIEWS
        assert (ours["images"], ours["mean"]) == (theirs["images"], theirs["mean"])


def metrics(run: Path, protocol: str) -> dict[str, Any]:
    return json.loads((run / "eval" / protocol / f"step-{STEPS:08d}" / "metrics.json").read_text())


def finished_tasks(cluster: Cluster, function: str, since: float) -> list[dict[str, Any]]:
    """What the cluster remembers of the tasks of a function, milliseconds `since` on."""
    tasks = cluster.request("/api/v0/tasks?limit=10000&detail=1")[1]["data"]["result"]["result"]
    return [
        task
        for task in tasks
        if task["name"] == function and task["state"] == "FINISHED" and (task["creation_time_ms"] or 0) >= since
    ]


def tars(project: Path, shards: str) -> list[Path]:
    found = sorted((project / "shards" / shards).glob("*.tar"))
    assert found
    return found
