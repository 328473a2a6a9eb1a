"""A real Ray cluster of several nodes on one machine: each has a raylet, processes, ports and a folder of its own.

All of it is on loopback and behind a token. Losing a node is what it is in life: all of its processes end at once.
"""

from __future__ import annotations

import json
import os
import random
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

PATIENCE = 120.0  # seconds until a test gives up
STORE_BYTES = 80 * 2**20  # of a node's object store: about the least that Ray allows
MARK = "CROSSRAY_TEST_CLUSTER"  # in the environment of every process of a cluster

# `ray start`. The setting that keeps Ray on loopback also forbids a second node, and without it 127.0.0.1 would be
# replaced by the machine's address: here the first half of that setting holds and the second does not.
START = """
from ray._private import ray_constants, services
from ray.scripts.scripts import main
ray_constants.ENABLE_RAY_CLUSTER = True
services.get_node_ip_address = lambda address=None: "127.0.0.1"
main()
"""

SETTINGS = {
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_AUTH_MODE": "token",
    "RAY_JOB_STOP_WAIT_TIME_S": "120",  # as in the containers: a stopped job may write its checkpoint
    "RAY_TRAIN_HEALTH_CHECK_INTERVAL_S": "0.5",
    "RAY_health_check_period_ms": "1000",  # a lost node is known to be lost after five of these
    "RAY_health_check_failure_threshold": "5",
    "GLOO_SOCKET_IFNAME": "lo",
    "OMP_NUM_THREADS": "1",
}


class Node:
    """One node of a cluster: `ray start` in the foreground, and all that comes of it."""

    def __init__(self, folder: Path, words: Sequence[str], cwd: Path, env: dict[str, str], cpus: int) -> None:
        self.folder, self.lost = folder, False
        folder.mkdir()
        http, grpc, runtime_env = free_ports(3)
        command = [
            *(sys.executable, "-c", START, "start", "--block", "--disable-usage-stats", *words),
            *("--node-ip-address", "127.0.0.1", "--temp-dir", str(folder)),
            *("--num-cpus", str(cpus), "--num-gpus", "0", "--object-store-memory", str(STORE_BYTES)),
            *("--dashboard-agent-listen-port", str(http), "--dashboard-agent-grpc-port", str(grpc)),
            *("--runtime-env-agent-port", str(runtime_env)),
        ]
        with (folder / "output").open("wb") as output:
            self.process = subprocess.Popen(
                command,
                cwd=cwd,
                env=env,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )

    def processes(self) -> list[psutil.Process]:
        """Raylet, agents, workers, drivers of jobs: everything that `ray start` and its children have started."""
        try:
            root = psutil.Process(self.process.pid)
            return [root, *root.children(recursive=True)]
        except psutil.NoSuchProcess:
            return []

    def kill(self) -> None:
        """Lose the node."""
        self.lost = True
        kill(self.processes)


class Cluster:
    """A head and some nodes, as a context manager; `env` is what a client on this machine needs.

    Args:
        home: the head's working directory, so that of every job, and CROSSRAY_HOME of all nodes.
        nodes: beside the head.
        cpus: of each node.
        head_cpus: of the head.
        env: more variables for all processes of the cluster.
    """

    def __init__(
        self, home: Path, nodes: int = 4, cpus: int = 1, head_cpus: int = 1, env: dict[str, str] | None = None
    ) -> None:
        # Short, for the paths of Ray's sockets must stay under 108 characters.
        self.folder = Path(tempfile.mkdtemp(prefix="crx-", dir="/tmp"))
        self.home, self.cpus, self.head_cpus, self.wanted = home, cpus, head_cpus, nodes
        self.token = secrets.token_hex(32)
        self.port, dashboard = free_ports(2)
        self.url = f"http://127.0.0.1:{dashboard}"
        clean = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "CROSSRAY_HOME"))}
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        self.cluster_env = clean | SETTINGS | {"PATH": path, "RAY_AUTH_TOKEN": self.token, MARK: str(self.folder)}
        self.cluster_env |= {"CROSSRAY_HOME": str(home)} | (env or {})
        self.env = {k: v for k, v in self.cluster_env.items() if k not in (MARK, "CROSSRAY_HOME")}
        self.env["RAY_API_SERVER_ADDRESS"] = self.url
        self.nodes: list[Node] = []

    def __enter__(self) -> Cluster:
        try:
            self.start_head()
            for _ in range(self.wanted):
                self.add_node()
            self.wait_for_nodes(1 + self.wanted)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def start_head(self) -> None:
        (client,) = free_ports(1)
        dashboard = self.url.rpartition(":")[2]
        words = ["--head", "--port", str(self.port), "--ray-client-server-port", str(client)]
        words += ["--dashboard-host", "127.0.0.1", "--dashboard-port", dashboard]
        self.head = self.start_node(words, self.home, self.head_cpus)
        self.wait_for_nodes(1)

    def add_node(self) -> Node:
        """Start one more node; `wait_for_nodes` says when it is there."""
        return self.start_node(["--address", f"127.0.0.1:{self.port}"], self.folder, self.cpus)

    def start_node(self, words: Sequence[str], cwd: Path, cpus: int) -> Node:
        node = Node(self.folder / f"n{len(self.nodes)}", words, cwd, self.cluster_env, cpus)
        self.nodes.append(node)
        return node

    def wait_for_nodes(self, count: int) -> None:
        """Wait until the cluster says that exactly `count` nodes are alive."""

        def there() -> bool:
            for node in self.nodes:
                ended = not node.lost and node.process.poll() is not None
                assert not ended, f"a node ended by itself:\n{(node.folder / 'output').read_text()}"
            return len(self.alive()) == count

        wait_until(there, f"{count} nodes are alive")

    def alive(self) -> list[dict[str, Any]]:
        """What the cluster says of its living nodes; none while it does not answer."""
        try:
            status, answer = self.request("/api/v0/nodes")
        except OSError:
            return []
        if status != 200 or not answer.get("result"):
            return []
        return [node for node in answer["data"]["result"]["result"] if node["state"] == "ALIVE"]

    def node_of(self, pid: int) -> Node | None:
        """The node that a process belongs to."""
        above = {process.pid for process in psutil.Process(pid).parents()}
        return next((node for node in self.nodes if node.process.pid in above), None)

    def request(self, path: str, token: str | None = "") -> tuple[int, Any]:
        """GET from the Jobs API: status and answer. With the cluster's token unless another one, or None, is given."""
        request = urllib.request.Request(self.url + path)
        if token is not None:
            request.add_header("Authorization", f"Bearer {token or self.token}")
        try:
            with urllib.request.urlopen(request, timeout=30) as response:
                return response.status, json.loads(response.read())
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()

    def jobs(self) -> list[dict[str, Any]]:
        """What the Jobs API says of all submitted jobs."""
        return [job for job in self.request("/api/jobs/")[1] if job["submission_id"]]

    def job(self, submission_id: str) -> dict[str, Any]:
        """What the Jobs API says of one job."""
        return self.request(f"/api/jobs/{submission_id}")[1]

    def close(self) -> None:
        """End every process of the cluster, by its pid, and remove its folder; nothing may be left."""
        for node in self.nodes:
            node.lost = True
        kill(lambda: [process for node in self.nodes for process in node.processes()])
        wait_until(lambda: not self.left_behind(), "nothing of the cluster is left", self.left_behind)
        shutil.rmtree(self.folder, ignore_errors=True)

    def left_behind(self) -> list[psutil.Process]:
        """Living processes that belong to this cluster, by their command line, environment or session."""
        sessions = {node.process.pid for node in self.nodes}
        return [process for process in psutil.process_iter() if self.owns(process, sessions)]

    def owns(self, process: psutil.Process, sessions: set[int]) -> bool:
        try:
            if process.status() == psutil.STATUS_ZOMBIE:
                return False
            mine = os.getsid(process.pid) in sessions or process.environ().get(MARK) == str(self.folder)
            return mine or any(str(self.folder) in word for word in process.cmdline())
        except (psutil.Error, ProcessLookupError):
            return False


def kill(find: Callable[[], list[psutil.Process]]) -> None:
    """SIGKILL for all processes that `find` finds, parents first, until it finds none."""
    deadline = time.monotonic() + PATIENCE
    remaining = find()
    while remaining:
        assert time.monotonic() < deadline, f"{remaining} cannot be killed"
        for process in remaining:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        _, alive = psutil.wait_procs(remaining, timeout=1)
        remaining = [*alive, *find()]


def free_ports(count: int) -> list[int]:
    """Ports that nobody listens on, below those that the system gives out by itself."""
    found: list[int] = []
    while len(found) < count:
        port = random.SystemRandom().randrange(20000, 32000)
        with socket.socket() as listener:
            try:
                listener.bind(("127.0.0.1", port))
            except OSError:
                continue
        if port not in found:
            found.append(port)
    return found


def wait_until(
    condition: Callable[[], object], what: str, show: Callable[[], object] = lambda: "", patience: float = PATIENCE
) -> None:
    """Poll until `condition()` holds.

    Raises:
        AssertionError: it does not within `patience` seconds; shows `show()`.
    """
    deadline = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < deadline, f"not within {patience:.0f} s: {what}; {show()}"
        time.sleep(0.1)
