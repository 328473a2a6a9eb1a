"""Submitting: what is sent, what it is called, where it goes; and a log that is followed through lost connections.

What needs a cluster is in tests/faults/test_cluster.py.
"""

from __future__ import annotations

import importlib.metadata
import os
import re
import shlex
import subprocess
import sys
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from tiny_run import tiny_mapping

from pipeline.config import JobError
from pipeline.launch import submit
from pipeline.launch.submit import Log, SubmitError, Submitted

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch):
    for name in ("RAY_API_SERVER_ADDRESS", "RAY_ADDRESS"):
        monkeypatch.setenv(name, "")  # restored afterwards, whatever the code sets


@pytest.fixture
def job_file(tmp_path):
    path = tmp_path / "my job.yaml"
    path.write_text("#!/usr/bin/env -S python -m pipeline run\n" + yaml.safe_dump(tiny_mapping(tmp_path)))
    return path


# What is sent


def code_of(folder: Path) -> dict[str, bytes]:
    """Everything in the packages under `folder`, but what Python has compiled."""
    paths = (path for package in ("model", "pipeline") for path in (folder / package).rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): p.read_bytes() for p in paths if "__pycache__" not in p.parts}


class TestStage:
    def test_all_of_the_code_and_the_job_and_nothing_else(self, job_file, tmp_path):
        folder = tmp_path / "stage"
        submit.stage(job_file, [], folder)
        code = code_of(folder)
        assert code == code_of(ROOT)
        assert {"pipeline/published.yaml", "pipeline/launch/submit.py", "model/methods.py"} <= code.keys()
        others = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()} - code.keys()
        assert others == {"jobs/my job.yaml"}
        assert (folder / "jobs" / "my job.yaml").read_bytes() == job_file.read_bytes()
        assert sum(map(len, code.values())) < submit.UPLOAD_LIMIT / 20

    def test_the_command_keeps_every_setting_as_it_was_typed(self, job_file, tmp_path):
        settings = ["evaluate.protocols=[a@R1, b@R2]", "name=$(touch hacked); 'x'", "scene.path=a b"]
        command = submit.stage(job_file, settings, tmp_path / "stage")
        words = shlex.split(command)
        assert words[:5] == ["python", "-m", "pipeline", "run", "jobs/my job.yaml"]
        assert words[5:] == [word for setting in settings for word in ("--set", setting)]
        echoed = subprocess.run(["sh", "-c", f"printf '%s\\n' {command}"], capture_output=True, text=True, check=True)
        assert echoed.stdout.splitlines() == words  # a shell runs it on the cluster

    @pytest.mark.slow
    def test_the_copy_runs(self, job_file, tmp_path):
        folder = tmp_path / "stage"
        command = submit.stage(job_file, ["scene.path=nowhere"], folder)
        words = [sys.executable, *shlex.split(command)[1:]]
        ended = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
        assert ended.returncode == 2, ended.stderr
        assert "nowhere is not a folder" in ended.stderr

    def test_too_much_is_refused_before_anything_is_sent(self, job_file, tmp_path, monkeypatch):
        monkeypatch.setattr(submit, "UPLOAD_LIMIT", 2**20)
        package = tmp_path / "pipeline"
        package.mkdir()
        (package / "__init__.py").touch()
        (package / "left_here.ckpt").write_bytes(bytes(2 * 2**20))
        monkeypatch.setitem(sys.modules, "pipeline", SimpleNamespace(__file__=str(package / "__init__.py")))
        with pytest.raises(SubmitError, match=r"the code is \d+ MiB.* first of all pipeline/left_here.ckpt"):
            submit.stage(job_file, [], tmp_path / "stage")


# What it is called


class TestDescribe:
    def test_a_training_job(self, job_file):
        assert submit.describe(job_file, ["name=Trevi.R2", "method=nerf", "model.channels=64"]) == {
            "kind": "train",
            "name": "Trevi.R2",
            "scene": "scene",
            "method": "nerf",
            "version": importlib.metadata.version("crossray"),
        }

    def test_a_study(self):
        about = submit.describe(ROOT / "jobs" / "num_rays.yaml", ["name=few"])
        assert (about["kind"], about["name"], about["scene"]) == ("study", "few", "landmark")
        assert about["method"].split()[0] == "rays400"

    def test_a_reevaluation(self, tmp_path):
        path = tmp_path / "reeval.yaml"
        path.write_text("kind: reeval\nruns: runs/*\n")
        about = submit.describe(path, ["runs=[runs/a, runs/b]"])
        assert (about["kind"], about["name"]) == ("reeval", "runs/a runs/b")
        assert submit.new_id(about).startswith("reeval-runs-a-runs-b-")

    def test_every_job_of_the_repository(self):
        for path in sorted((ROOT / "jobs").glob("*.yaml")):
            about = submit.describe(path, [])
            assert all(isinstance(value, str) and value for value in about.values())  # Ray takes nothing else

    def test_a_typo_is_refused(self, job_file):
        with pytest.raises(JobError, match="eposchs: there is no such key; did you mean 'epochs'"):
            submit.describe(job_file, ["train.eposchs=3"])

    @given(st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", fullmatch=True) | st.text(max_size=99))
    @example("a" * 43 + "." + "b" * 9)
    @example("*")
    def test_an_id_is_plain_and_new(self, name):
        about = {"kind": "train", "name": name}
        first, second = submit.new_id(about), submit.new_id(about)
        assert first != second
        assert re.fullmatch(r"train-([a-z0-9]+-)*[0-9a-f]{8}", first)
        assert len(first) < 60

    def test_an_id_tells_what_it_is(self):
        assert re.fullmatch(
            r"study-my-num-rays-r2-[0-9a-f]{8}", submit.new_id({"kind": "study", "name": "My_num_rays.R2"})
        )


# Where it goes


class TestAddress:
    def test_what_wins(self, monkeypatch):
        assert submit.find_address(None) == "http://127.0.0.1:8265"
        monkeypatch.setenv("RAY_ADDRESS", "10.0.0.1:6379")
        assert submit.find_address(None) == "10.0.0.1:6379"
        monkeypatch.setenv("RAY_API_SERVER_ADDRESS", "http://10.0.0.2:8265")
        assert submit.find_address(None) == "http://10.0.0.2:8265"
        assert submit.find_address("https://cluster") == "https://cluster"
        assert submit.find_address("10.0.0.3:8265") == "http://10.0.0.3:8265"

    def test_home_is_this_folder_on_this_machine_alone(self, monkeypatch, tmp_path):
        monkeypatch.chdir(tmp_path)
        for here in ("http://127.0.0.1:8265", "http://localhost:1", "127.0.0.1:6379", "auto"):
            assert submit.find_home(None, here) == str(tmp_path)
            assert submit.find_home("sub", here) == str(tmp_path / "sub")
        assert submit.find_home(None, "http://192.0.2.77:8265") is None
        assert submit.find_home("/app", "http://192.0.2.77:8265") == "/app"
        with pytest.raises(SubmitError, match="must be an absolute path"):
            submit.find_home("sub", "http://192.0.2.77:8265")


@contextmanager
def server(status: int, body: str = ""):
    """A web server that always answers the same; gives its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            self.end_headers()
            self.wfile.write(body.encode())

        def log_message(self, *words: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as http:
        thread = threading.Thread(target=http.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{http.server_port}"
        finally:
            http.shutdown()
            thread.join()


def test_a_head_that_has_lost_its_port_is_told_from_other_refusals(tmp_path, monkeypatch):
    """As Ray's Jobs API puts it where another Ray was started on that machine before."""
    (tmp_path / "job.yaml").write_text("kind: reeval\nruns: [runs/x]\n")

    class Client:
        def submit_job(self, **keys):
            raise RuntimeError(f"Request failed with status code 500: {reason}.")

    monkeypatch.setattr(submit, "connect", lambda url: Client())
    reason = "No available agent to submit job, please try again later."
    with pytest.raises(SubmitError, match=r"no agent for jobs.*52365.*start the head again"):
        submit.submit_job(tmp_path / "job.yaml", address="http://127.0.0.1:1")
    reason = "something else"
    with pytest.raises(SubmitError, match=r"did not take the job: .*something else"):
        submit.submit_job(tmp_path / "job.yaml", address="http://127.0.0.1:1")


class TestConnect:
    def test_a_token_that_is_missing(self):
        with (
            server(401, "Unauthorized: Missing authentication token") as url,
            pytest.raises(SubmitError, match=r"none is set here\. Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN_PATH "),
        ):
            submit.connect(url)

    def test_a_token_that_is_wrong(self):
        with (
            server(403, "Forbidden: Invalid authentication token") as url,
            pytest.raises(SubmitError, match="does not take the one that is set here"),
        ):
            submit.connect(url)

    def test_something_else_answers(self):
        with server(404, "") as url, pytest.raises(SubmitError, match=f"no Ray cluster answers at {url}"):
            submit.connect(url)

    def test_the_address_that_was_given_wins_over_the_environment(self, monkeypatch):
        monkeypatch.setenv("RAY_API_SERVER_ADDRESS", "http://127.0.0.1:1")
        with server(200, '{"version": "4", "ray_version": "2.60.0", "ray_commit": "", "session_name": ""}') as url:
            assert submit.connect(url).get_address() == url

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["--address", "http://127.0.0.1:1"], "no Ray cluster answers at http://127.0.0.1:1"),
            (["--set", "train.eposchs=3"], "train.eposchs: there is no such key"),
        ],
    )
    def test_on_the_command_line(self, job_file, words, message):
        command = [sys.executable, "-m", "pipeline", "submit", str(job_file), *words]
        env = os.environ | {"RAY_API_SERVER_ADDRESS": "http://127.0.0.1:2"}
        ended = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
        assert (ended.returncode, ended.stdout) == (2, "")
        assert message in ended.stderr
        assert "Traceback" not in ended.stderr


# Following the log

TEXT = "".join(f"line {i}\n" for i in range(30))


class Ends(SimpleNamespace):
    """Ray's JobDetails."""

    def __init__(self, status: str, **more: object) -> None:
        terminal = status in ("SUCCEEDED", "FAILED", "STOPPED")
        super().__init__(status=SimpleNamespace(value=status, is_terminal=lambda: terminal), **more)


class FakeCluster:
    """A Jobs API whose connections are lost: each of `tails` is one reading of the log from its beginning, in pieces,
    with an exception at its end or not; each of `answers` is what it says of the job after that."""

    def __init__(self, tails: list[list], answers: list, whole: str = TEXT) -> None:
        self.tails, self.answers, self.whole = iter(tails), iter(answers), whole

    async def tail_job_logs(self, job: str):
        for piece in next(self.tails):
            if isinstance(piece, BaseException):
                raise piece
            yield piece

    def get_job_info(self, job: str):
        answer = next(self.answers)
        if isinstance(answer, BaseException):
            raise answer
        return answer

    def get_job_logs(self, job: str) -> str:
        return self.whole


@pytest.fixture
def follow(monkeypatch):
    """follow(cluster): what was written, in pieces; the pauses are in follow.pauses and take no time."""
    now = [0.0]

    def sleep(seconds: float) -> None:
        run.pauses.append(seconds)
        now[0] += seconds

    def run(cluster: FakeCluster) -> tuple[str, object]:
        written: list[str] = []
        try:
            details = submit.follow(Submitted(cluster, "http://127.0.0.1:8265", "train-x"), written.append)
        finally:
            run.text = "".join(written)
        return run.text, details

    run.pauses = []
    monkeypatch.setattr(submit, "time", SimpleNamespace(sleep=sleep, monotonic=lambda: now[0]))
    return run


LOST = RuntimeError("WebSocket connection closed unexpectedly with close code 1006")
RUNNING, DONE = Ends("RUNNING"), Ends("SUCCEEDED")


class TestFollow:
    def test_an_undisturbed_job(self, follow):
        assert follow(FakeCluster([[TEXT[:50], TEXT[50:]]], [DONE])) == (TEXT, DONE)
        assert follow.pauses == []

    def test_nothing_twice_and_nothing_lost(self, follow):
        tails = [[TEXT[:40], LOST], [TEXT[:10], LOST], [TEXT[:25], TEXT[25:90], LOST], [TEXT[:7], TEXT[7:]]]
        assert follow(FakeCluster(tails, [RUNNING, RUNNING, RUNNING, DONE]))[0] == TEXT

    @given(st.lists(st.lists(st.integers(0, len(TEXT)), max_size=4), max_size=6))
    def test_whatever_the_pieces(self, cuts):
        tails = []
        for points in cuts:
            points = sorted(points)
            pieces = [TEXT[a:b] for a, b in zip([0, *points], points, strict=False)]
            tails.append([*pieces, LOST])
        log, written = None, []
        log = Log(written.append)
        for tail in [*tails, [TEXT]]:
            log.begin()
            for piece in tail:
                if piece is not LOST:
                    log.add(piece)
        assert "".join(written) == TEXT

    def test_the_rest_after_a_connection_that_was_lost_at_the_end(self, follow):
        assert follow(FakeCluster([[TEXT[:60], LOST]], [Ends("FAILED")]))[0] == TEXT
        assert follow(FakeCluster([[TEXT[:60]]], [Ends("FAILED")]))[0] == TEXT  # closed as if that were all

    def test_pauses_grow_while_the_cluster_is_silent(self, follow):
        silent = [ConnectionError("refused")] * 8
        tails = [[TEXT[:60], LOST], *([[LOST]] * 7), [TEXT[:80], LOST], [LOST], [TEXT]]
        text, _ = follow(FakeCluster(tails, [*silent, RUNNING, ConnectionError("refused"), DONE]))
        assert text == TEXT
        assert follow.pauses == [2, 4, 8, 16, 30, 30, 30, 30, 1, 2]

    def test_a_connection_that_died_unnoticed(self, follow, monkeypatch):
        monkeypatch.setattr(submit, "QUIET", 0.01)

        async def silent(job: str):
            yield TEXT[:60]
            await submit.asyncio.Event().wait()

        cluster = FakeCluster([[TEXT]], [RUNNING, DONE])
        again = cluster.tail_job_logs
        first = iter([silent])
        cluster.tail_job_logs = lambda job: next(first, again)(job)  # type: ignore[method-assign]
        assert follow(cluster)[0] == TEXT

    def test_a_cluster_that_was_started_anew(self, follow):
        unknown = RuntimeError("Request failed with status code 404: Job train-x does not exist.")
        with pytest.raises(SubmitError, match="does not know this job any more"):
            follow(FakeCluster([[TEXT[:60], LOST]], [unknown]))

    def test_a_cluster_that_never_comes_back(self, follow):
        count = 100
        with pytest.raises(SubmitError, match="has not answered for 10 minutes") as caught:
            follow(FakeCluster([[LOST]] * count, [ConnectionError("refused")] * count))
        assert "ray job logs --follow --address http://127.0.0.1:8265 train-x" in str(caught.value)
        assert submit.GIVE_UP <= sum(follow.pauses) <= submit.GIVE_UP + submit.LONGEST_PAUSE

    def test_a_reader_that_has_gone(self, monkeypatch):
        def write(text: str) -> None:
            raise BrokenPipeError("Broken pipe")

        with pytest.raises(SubmitError, match="the job goes on without a reader"):
            submit.follow(Submitted(FakeCluster([[TEXT]], [RUNNING]), "", "x"), write)


class TestTheEnd:
    @pytest.mark.parametrize(
        ("details", "words"),
        [
            (Ends("SUCCEEDED"), "succeeded"),
            (Ends("STOPPED"), "was stopped; submit it again to go on"),
            (Ends("FAILED", driver_exit_code=2), "failed (exit status 2); its log above says why"),
            (Ends("FAILED", driver_exit_code=None, message="no memory"), "failed: no memory"),
        ],
    )
    def test_in_words(self, details, words):
        assert submit.how_it_ended(details) == words
