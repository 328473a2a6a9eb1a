"""Containers, as far as they can be shown without an engine: files that agree with each other, with the project and
with Ray; and the commands of the compose file, run as processes in their order."""

from __future__ import annotations

import json
import os
import re
import secrets
import shlex
import subprocess
import sys
import time
import tomllib
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version
from tiny_run import tiny_mapping
from tiny_scene import write_tiny_scene

from pipeline.checkpoint import latest_checkpoint
from pipeline.config import load_job
from pipeline.launch.submit import STOP_GRACE
from pipeline.reeval import load_reeval
from pipeline.study import read_kind

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"
FILES = sorted(path for path in DOCKER.rglob("*") if path.is_file())
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
VERSION = PROJECT["project"]["version"]
PINNED = [Requirement(line) for line in (ROOT / "constraints.txt").read_text().splitlines()]
PINS = {r.name.lower(): next(iter(r.specifier)).version for r in PINNED}
LOOPBACK = "127.0.0.1"


def load(name: str) -> dict[str, Any]:
    return yaml.safe_load((DOCKER / name).read_text())


COMPOSE = load("compose.yaml")
CLUSTER, TRAIN, REEVAL = (load(f"k8s/{name}.yaml") for name in ("raycluster", "rayjob-train", "cronjob-reeval"))
CLAIMS = list(yaml.safe_load_all((DOCKER / "k8s" / "pvc.yaml").read_text()))
NODES = ("head", "worker", "worker-cpu")  # services that run Ray


class Instruction(NamedTuple):
    """One of a Dockerfile."""

    name: str
    words: str


def dockerfile() -> list[Instruction]:
    text = re.sub(r"^#.*\n", "", (DOCKER / "Dockerfile").read_text(), flags=re.MULTILINE)
    lines = re.sub(r"\\\n\s*", "", text).splitlines()
    return [Instruction(*line.split(maxsplit=1)) for line in lines if line.strip()]


def of(name: str) -> list[str]:
    return [words for instruction, words in dockerfile() if instruction == name]


def environment() -> dict[str, str]:
    return dict(word.split("=", 1) for line in of("ENV") for word in shlex.split(line))


def arguments() -> dict[str, str]:
    return dict(line.split("=", 1) for line in of("ARG"))


def pods() -> dict[str, dict[str, Any]]:
    """The pods' specs, by what they are."""
    return {
        "head": CLUSTER["spec"]["headGroupSpec"]["template"]["spec"],
        "worker": CLUSTER["spec"]["workerGroupSpecs"][0]["template"]["spec"],
        "submitter": TRAIN["spec"]["submitterPodTemplate"]["spec"],
        "reeval": REEVAL["spec"]["jobTemplate"]["spec"]["template"]["spec"],
    }


def containers() -> list[dict[str, Any]]:
    return [container for pod in pods().values() for container in pod["containers"]]


# The image


def test_what_is_copied_is_there_and_is_sent():
    sent = (ROOT / ".dockerignore").read_text().splitlines()
    copied = [source for line in of("COPY") for source in line.split()[:-1]]
    assert {"model", "pipeline", "jobs", "pyproject.toml", "constraints.txt"} <= set(copied)
    for source in copied:
        assert (ROOT / source).exists()
        assert f"!{source}" in sent
    needed = {package.split(".")[0] for package in PROJECT["tool"]["setuptools"]["packages"]}
    assert needed | {PROJECT["project"]["readme"], *PROJECT["project"]["license-files"]} <= set(copied)


def test_nothing_else_is_sent_to_the_builder():
    lines = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line and not line.startswith("#")]
    assert lines[0] == "*"
    allowed = {line[1:] for line in lines if line.startswith("!")}
    assert not allowed & {"data", "runs", "shards", "quickstart", ".git", ".venv", "docker", "tests"}
    assert all("*" not in name and "/" not in name for name in allowed)


def test_python_is_the_one_that_is_tested():
    python = re.fullmatch(r"python:(3\.\d+)-slim-\w+", arguments()["BASE"])
    assert python is not None
    assert python[1] == PROJECT["tool"]["mypy"]["python_version"]
    assert Version(python[1]) in SpecifierSet(PROJECT["project"]["requires-python"])


def test_ray_and_torch_are_the_pinned_ones_everywhere():
    assert CLUSTER["spec"]["rayVersion"] == PINS["ray"]
    assert TRAIN["spec"]["rayClusterSpec"]["rayVersion"] == PINS["ray"]
    for build in ("", "+cpu", "+cu126"):  # what TORCH_INDEX may give
        assert Version(PINS["torch"] + build) in SpecifierSet(f"=={PINS['torch']}")
    for requirement in map(Requirement, PROJECT["project"]["dependencies"]):
        assert PINS[requirement.name] in requirement.specifier
    installs = [line for line in of("RUN")[0].split("&&") if "pip install" in line]
    assert len(installs) == 2
    assert all("--constraint constraints.txt" in line for line in installs)
    torch_first = "--no-deps" in installs[0] and '--index-url "${TORCH_INDEX}"' in installs[0]
    assert torch_first  # of that index, torch alone
    assert "index" not in installs[1]


def test_the_layer_of_dependencies_needs_no_sources_and_has_them_all(tmp_path):
    before = [copied for name, copied in dockerfile()[: dockerfile().index(("RUN", of("RUN")[0]))] if name == "COPY"]
    assert before == ["pyproject.toml constraints.txt ./"]
    (tmp_path / "pyproject.toml").write_bytes((ROOT / "pyproject.toml").read_bytes())
    command = next(step for step in of("RUN")[0].split("&&") if "tomllib" in step)
    subprocess.run(
        ["sh", "-c", command.replace("python", sys.executable, 1).replace("/tmp/needs.txt", "needs.txt")],
        cwd=tmp_path,
        check=True,
    )
    assert (tmp_path / "needs.txt").read_text().splitlines() == PROJECT["project"]["dependencies"]


def test_the_shell_understands_every_step():
    for step in of("RUN"):
        subprocess.run(["sh", "-n", "-c", step], check=True)
        subprocess.run(["bash", "-n", "-c", step], check=True)


def test_the_image_runs_as_nobody_special():
    names = [name for name, _ in dockerfile()]
    assert of("USER") == ["${UID}"]
    assert names.index("USER") > max(i for i, name in enumerate(names) if name == "RUN")
    assert int(arguments()["UID"]) >= 1000


def test_jobs_find_their_files_and_their_home():
    assert of("WORKDIR") == ["/app"]
    assert environment()["CROSSRAY_HOME"] == "/app"
    assert "jobs jobs" in of("COPY")
    assert "chmod 755 jobs/*.yaml" in of("RUN")[1]
    writable = of("RUN")[2]
    for folder in ("data", "runs", "shards", environment()["CROSSRAY_CACHE"]):
        assert f" {folder}" in writable


def test_every_variable_is_one_that_somebody_reads():
    code = "".join(path.read_text() for path in (ROOT / "pipeline").rglob("*.py"))
    text = "".join(path.read_text() for path in FILES)
    ours = set(re.findall(r"CROSSRAY_[A-Z_]+", text))
    assert ours == {"CROSSRAY_HOME", "CROSSRAY_CACHE"}
    assert all(f'"{name}"' in code for name in ours)
    import ray

    sources = Path(ray.__file__).parent
    folders = ("_private", "_common", "dashboard/modules/job")
    ray_code = "".join(path.read_text() for folder in folders for path in (sources / folder).rglob("*.py"))
    for name in set(re.findall(r"\bRAY_[A-Z_]+", text)):
        assert name in ray_code, name


def test_a_stopped_job_has_as_long_as_crossray_submit_gives_it():
    grace = int(environment()["RAY_JOB_STOP_WAIT_TIME_S"])
    assert grace == STOP_GRACE
    for service in NODES:
        assert int(COMPOSE["services"][service]["stop_grace_period"].removesuffix("s")) > grace
    for pod in (pods()["head"], pods()["worker"]):
        wait = int(pod["containers"][0]["lifecycle"]["preStop"]["exec"]["command"][1])
        assert pod["terminationGracePeriodSeconds"] > wait >= 60


def test_health_is_asked_of_ray_where_no_token_is_wanted():
    from ray.dashboard.http_server_agent import PUBLIC_EXACT_PATHS
    from ray.scripts.scripts import start

    port = next(option.default for option in start.params if option.name == "dashboard_agent_listen_port")
    (check,) = of("HEALTHCHECK")
    command = json.loads(check.partition("CMD ")[2])
    asked = re.search(r"http://127\.0\.0\.1:(\d+)(/[a-z/]+)", command[-1])
    assert asked is not None
    assert int(asked[1]) == port
    assert asked[2] in PUBLIC_EXACT_PATHS
    for pod in ("head", "worker"):
        for probe in ("readinessProbe", "livenessProbe"):
            assert pods()[pod]["containers"][0][probe]["httpGet"] == {"path": asked[2], "port": port}
    assert of("CMD")[0].startswith('["ray", "start", "--head", "--block"')


# What all of them must hold to


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_names_of_the_image_and_of_jobs_are_right(path):
    text = path.read_text()
    assert set(re.findall(r"crossray:(\d+\.\d+\.\d+)", text)) <= {VERSION}
    for job in re.findall(r"\bjobs/\w+\.yaml", text):
        assert os.access(ROOT / job, os.X_OK), job


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_no_file_holds_a_secret(path):
    text = path.read_text()
    assert not re.search(r"\b[0-9a-fA-F]{32,}\b|[A-Za-z0-9+/]{40,}=", text)
    assert not re.search(r"RAY_AUTH_TOKEN[\"']?\s*[:=]\s*[\"']?[A-Za-z0-9]", text)


def test_everything_runs_the_same_image():
    images = {service["image"] for service in COMPOSE["services"].values()} | {c["image"] for c in containers()}
    assert images == {f"crossray:{VERSION}"}


# Compose


def test_only_the_dashboard_and_tensorboard_are_published_and_on_loopback():
    published = [port for service in COMPOSE["services"].values() for port in service.get("ports", [])]
    assert sorted(published) == ["127.0.0.1:6006:6006", "127.0.0.1:8265:8265"]
    assert all(
        "network_mode" not in service and "privileged" not in service for service in COMPOSE["services"].values()
    )


def test_the_token_comes_from_a_file():
    assert set(COMPOSE["secrets"]) == {"ray_token"}
    assert COMPOSE["secrets"]["ray_token"]["file"] == "${RAY_AUTH_TOKEN_PATH:-${HOME}/.ray/auth_token}"
    for name in NODES:
        service = COMPOSE["services"][name]
        assert service["secrets"] == ["ray_token"]
        assert service["environment"] == {"RAY_AUTH_TOKEN_PATH": "/run/secrets/ray_token"}
    assert environment()["RAY_AUTH_MODE"] == "token"
    assert "secrets" not in COMPOSE["services"]["tensorboard"]


def test_services_run_commands_that_exist():
    from ray.scripts.scripts import start

    options = {name for option in start.params for name in option.opts}
    for name in NODES:
        words = COMPOSE["services"][name]["command"]
        assert words[:2] == ["ray", "start"]
        assert {word.partition("=")[0] for word in words[2:]} <= options
    given = json.loads(of("CMD")[0])
    assert {word.partition("=")[0] for word in given[2:]} <= options
    params = [CLUSTER["spec"]["headGroupSpec"], *CLUSTER["spec"]["workerGroupSpecs"]]
    assert {f"--{name}" for group in params for name in group["rayStartParams"]} <= options
    for service in COMPOSE["services"].values():
        assert (Path(sys.executable).parent / service["command"][0]).is_file()


def test_workers_wait_for_a_healthy_head_and_see_what_it_sees():
    services = COMPOSE["services"]
    for name in ("worker", "worker-cpu"):
        assert services[name]["depends_on"] == {"head": {"condition": "service_healthy"}}
        assert services[name]["command"][2] == "--address=head:6379"
        assert services[name]["volumes"] == services["head"]["volumes"]
    assert "--port=6379" in services["head"]["command"]
    mounted = {volume["target"] for volume in services["head"]["volumes"]}
    assert mounted == {"/app/data", "/app/runs", "/app/shards", environment()["CROSSRAY_CACHE"]}
    assert services["worker"]["profiles"] == ["gpu"]
    assert services["worker-cpu"]["profiles"] == ["cpu"]
    (device,) = services["worker"]["deploy"]["resources"]["reservations"]["devices"]
    assert device["capabilities"] == ["gpu"]
    assert set(COMPOSE["volumes"]) == {
        v["source"] for s in services.values() for v in s["volumes"] if v["type"] == "volume"
    }


def test_containers_have_no_rights_that_they_do_not_need():
    for service in COMPOSE["services"].values():
        assert service["cap_drop"] == ["ALL"]
        assert "no-new-privileges:true" in service["security_opt"]
        assert "user" not in service  # the image's
    (runs,) = COMPOSE["services"]["tensorboard"]["volumes"]
    assert runs["read_only"] is True


def test_tensorboard_has_a_health_check_of_its_own():
    assert "6006" in COMPOSE["services"]["tensorboard"]["healthcheck"]["test"][-1]
    assert all("healthcheck" not in COMPOSE["services"][name] for name in NODES)  # the image's


# Kubernetes


def test_kinds_and_versions_of_the_api():
    assert (CLUSTER["apiVersion"], CLUSTER["kind"]) == ("ray.io/v1", "RayCluster")
    assert (TRAIN["apiVersion"], TRAIN["kind"]) == ("ray.io/v1", "RayJob")
    assert (REEVAL["apiVersion"], REEVAL["kind"]) == ("batch/v1", "CronJob")
    assert {(claim["apiVersion"], claim["kind"]) for claim in CLAIMS} == {("v1", "PersistentVolumeClaim")}
    assert all("namespace" not in manifest["metadata"] for manifest in (CLUSTER, TRAIN, REEVAL, *CLAIMS))


def test_the_training_has_the_cluster_that_the_other_file_explains():
    assert TRAIN["spec"]["rayClusterSpec"] == CLUSTER["spec"]
    assert CLUSTER["spec"]["authOptions"] == {"mode": "token"}


def test_the_workers_hold_the_job():
    job = load_job(ROOT / TRAIN["spec"]["entrypoint"])
    (group,) = CLUSTER["spec"]["workerGroupSpecs"]
    limits = group["template"]["spec"]["containers"][0]["resources"]["limits"]
    assert group["replicas"] * int(limits["nvidia.com/gpu"]) == job.ranks
    assert int(limits["cpu"]) >= job.ranks * (job.ray.cpus_per_rank or job.threads)
    assert CLUSTER["spec"]["headGroupSpec"]["rayStartParams"]["num-cpus"] == "0"


def test_a_training_is_tried_again_and_gives_its_cluster_back():
    spec = TRAIN["spec"]
    assert spec["shutdownAfterJobFinishes"] is True
    assert spec["backoffLimit"] >= 1
    assert spec["ttlSecondsAfterFinished"] >= 0
    assert {"jobId", "clusterSelector"}.isdisjoint(spec)  # a fixed id could not be tried again


def test_reevaluation_is_one_pass_and_never_two_at_once():
    assert REEVAL["spec"]["concurrencyPolicy"] == "Forbid"
    (container,) = pods()["reeval"]["containers"]
    (file,) = container["command"]
    assert read_kind(ROOT / file) == "reeval"
    assert load_reeval(ROOT / file).every is None
    assert pods()["reeval"]["restartPolicy"] == "Never"
    minute, *others = REEVAL["spec"]["schedule"].split()
    assert re.fullmatch(r"\*/\d+", minute)
    assert others == ["*"] * 4


@pytest.mark.parametrize("name", ["head", "worker", "submitter", "reeval"])
def test_pods_are_locked(name):
    pod = pods()[name]
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["runAsUser"] == int(arguments()["UID"])
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert pod["automountServiceAccountToken"] is False
    assert {"hostNetwork", "hostPID", "hostIPC"}.isdisjoint(pod)
    assert all("hostPath" not in volume for volume in pod.get("volumes", []))
    for container in pod["containers"]:
        assert container["securityContext"] == {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
        assert container["resources"]["limits"]["memory"] == container["resources"]["requests"]["memory"]


def test_nothing_is_published_by_kubernetes():
    text = "".join(path.read_text() for path in (DOCKER / "k8s").iterdir())
    assert not re.search(r"NodePort|LoadBalancer|Ingress|hostPort", text)


def test_pods_mount_what_is_claimed_where_jobs_look_for_it():
    claimed = {claim["metadata"]["name"]: claim["spec"] for claim in CLAIMS}
    assert all(claim["accessModes"] == ["ReadWriteMany"] for claim in claimed.values())
    for name in ("head", "worker", "reeval"):
        volumes = {volume["name"]: volume for volume in pods()[name]["volumes"]}
        for container in pods()[name]["containers"]:
            mounts = {mount["mountPath"]: volumes[mount["name"]] for mount in container["volumeMounts"]}
            for folder in ("data", "runs", "shards"):
                assert mounts[f"/app/{folder}"]["persistentVolumeClaim"] == {"claimName": f"crossray-{folder}"}
                assert f"crossray-{folder}" in claimed
            assert "emptyDir" in mounts[environment()["CROSSRAY_CACHE"]]
            assert mounts["/dev/shm"]["emptyDir"]["medium"] == "Memory"


# The compose file's commands, as processes


class Local:
    """The services of the compose file as processes of this machine: what a network of containers would keep apart,
    their names and ports, is replaced; everything else is as it stands there."""

    def __init__(self, folder: Path, home: Path, tools: Any) -> None:
        self.folder, self.home, self.tools = folder, home, tools
        self.processes: dict[str, subprocess.Popen] = {}
        gcs, dashboard, board = tools.free_ports(3)
        self.dashboard, self.board = f"http://{LOOPBACK}:{dashboard}", f"http://{LOOPBACK}:{board}"
        self.agents: dict[str, int] = {}
        self.replaced = {
            "--address=head:6379": f"--address={LOOPBACK}:{gcs}",
            "--port=6379": f"--port={gcs}",
            "--dashboard-host=0.0.0.0": f"--dashboard-host={LOOPBACK}",
            "--dashboard-port=8265": f"--dashboard-port={dashboard}",
            "--host=0.0.0.0": f"--host={LOOPBACK}",
            "--port=6006": f"--port={board}",
            "--logdir=/app/runs": f"--logdir={home / 'runs'}",
            "--object-store-memory=1000000000": f"--object-store-memory={tools.STORE_BYTES}",
        }
        token = folder / "token"
        token.touch(0o600)
        token.write_text(secrets.token_hex(32))
        clean = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
        self.env = clean | environment() | {"CROSSRAY_HOME": str(home), "CROSSRAY_CACHE": str(folder / "cache")}
        self.env |= {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "HOME": str(folder)}
        self.env |= {name: tools.SETTINGS[name] for name in ("GLOO_SOCKET_IFNAME", "OMP_NUM_THREADS")}
        self.env |= {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_TRAIN_HEALTH_CHECK_INTERVAL_S": "0.5"}
        self.token = {"RAY_AUTH_TOKEN_PATH": str(token)}

    def up(self, name: str) -> None:
        """Start one service."""
        service = COMPOSE["services"][name]
        command = [self.replaced.get(word, word) for word in service["command"]]
        if command[0] == "ray":
            self.agents[name], grpc, runtime_env = self.tools.free_ports(3)
            command = [sys.executable, "-c", self.tools.START, *command[1:], "--node-ip-address", LOOPBACK]
            command += ["--temp-dir", str(self.folder / name), "--dashboard-agent-listen-port", str(self.agents[name])]
            command += ["--dashboard-agent-grpc-port", str(grpc), "--runtime-env-agent-port", str(runtime_env)]
        with (self.folder / f"{name}.log").open("wb") as log:
            self.processes[name] = subprocess.Popen(
                command,
                cwd=ROOT,  # /app of the image: where jobs/ is
                env=self.env | (self.token if "secrets" in service else {}),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def is_healthy(self, name: str) -> bool:
        """What the engine would find with the image's health check, or the service's own."""
        own = COMPOSE["services"][name].get("healthcheck")
        command = own["test"][1:] if own else json.loads(of("HEALTHCHECK")[0].partition("CMD ")[2])
        code = command[-1].replace(":52365", f":{self.agents.get(name)}").replace("http://127.0.0.1:6006", self.board)
        ended = self.processes[name].poll()
        assert ended is None, f"{name} ended:\n{(self.folder / f'{name}.log').read_text()}"
        return subprocess.run([sys.executable, *command[1:-1], code], capture_output=True, check=False).returncode == 0

    def wait_for(self, name: str) -> None:
        self.tools.wait_until(lambda: self.is_healthy(name), f"{name} is healthy")

    def alive(self) -> list[psutil.Process]:
        """All processes of all services."""
        roots = [psutil.Process(p.pid) for p in self.processes.values() if psutil.pid_exists(p.pid)]
        ours = {p.pid for p in self.processes.values()}
        others = [p for p in psutil.process_iter() if session_of(p) in ours]
        found = {p for root in roots for p in (root, *children(root))} | set(others)
        return [p for p in found if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]

    def down(self) -> None:
        self.tools.kill(self.alive)
        for process in self.processes.values():
            process.wait()


def listens_on(process: psutil.Process) -> set[str]:
    try:
        return {c.laddr.ip for c in process.net_connections("inet") if c.status == psutil.CONN_LISTEN}
    except psutil.NoSuchProcess:
        return set()


def session_of(process: psutil.Process) -> int | None:
    try:
        return os.getsid(process.pid)
    except ProcessLookupError:
        return None


def children(process: psutil.Process) -> list[psutil.Process]:
    try:
        return process.children(recursive=True)
    except psutil.NoSuchProcess:
        return []


@pytest.fixture
def local(tmp_path_factory, monkeypatch) -> Iterator[Local]:
    import shutil
    import tempfile

    monkeypatch.syspath_prepend(str(ROOT / "tests" / "faults"))
    import ray_cluster

    home = tmp_path_factory.mktemp("app")
    folder = Path(tempfile.mkdtemp(prefix="crc-", dir="/tmp"))  # short, for the paths of Ray's sockets
    services = Local(folder, home, ray_cluster)
    try:
        yield services
    finally:
        services.down()
        shutil.rmtree(folder, ignore_errors=True)


def settings_of(mapping: dict[str, Any], prefix: str = "") -> list[str]:
    """A job's mapping as words of a command line."""
    words: list[str] = []
    for key, value in mapping.items():
        if isinstance(value, dict):
            words += settings_of(value, f"{prefix}{key}.")
        else:
            words += ["--set", f"{prefix}{key}={json.dumps(value)}"]
    return words


@pytest.mark.cluster
def test_the_commands_of_the_compose_file_make_a_cluster_that_trains(local):
    """In the order in which compose would start them; then the header's own `ray job submit`, and a look at all."""
    write_tiny_scene(local.home / "data" / "tiny")
    (local.home / "runs").mkdir()
    local.up("head")
    local.wait_for("head")
    local.up("worker-cpu")
    local.up("tensorboard")
    local.wait_for("worker-cpu")
    local.wait_for("tensorboard")

    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(f"{local.dashboard}/api/jobs/", timeout=30)
    assert refused.value.code == 401

    tiny = tiny_mapping(Path(), over={"ranks": 2, "evaluate": {"protocols": []}})
    tiny["scene"] = {"path": "data/tiny", "downscale": 2, "reference_downscale": 1}
    del tiny["runs"]
    command = ["ray", "job", "submit", "--address", local.dashboard, "--", "jobs/train_scene_cpu.yaml"]
    command += settings_of(tiny | {"train": tiny["train"] | {"seconds": None}})
    ran = subprocess.run(
        command, cwd="/", env=local.env | local.token, capture_output=True, text=True, timeout=300, check=False
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "trained, 12 steps" in ran.stdout
    checkpoint = latest_checkpoint(local.home / "runs" / "tiny" / "checkpoints")  # under CROSSRAY_HOME
    assert checkpoint is not None
    assert (checkpoint.step, checkpoint.meta["world_size"]) == (12, 2)
    assert (local.home / "shards" / "tiny-R2" / "manifest.json").is_file()

    deadline = time.monotonic() + 60
    while "tiny/tensorboard" not in json.load(urllib.request.urlopen(f"{local.board}/data/runs", timeout=30)):
        assert time.monotonic() < deadline, "TensorBoard does not show the run"
        time.sleep(0.5)
    assert local.is_healthy("head")
    local.tools.kill(
        lambda: children(psutil.Process(local.processes["worker-cpu"].pid))
    )  # the check must find that out
    local.tools.wait_until(lambda: not asks(local, "worker-cpu"), "the worker is not healthy any more")


def asks(local: Local, name: str) -> bool:
    """Whether the node's agent answers."""
    try:
        urllib.request.urlopen(f"http://{LOOPBACK}:{local.agents[name]}/api/healthz", timeout=5)
    except OSError:
        return False
    return True
