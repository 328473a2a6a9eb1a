"""One job on a cluster of one node, submitted as the README says; what takes several nodes is in test_cluster.py."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from ray_cluster import Cluster, wait_until
from tiny_run import tiny_mapping
from tiny_scene import write_tiny_scene

pytestmark = pytest.mark.slow

BIN = Path(sys.executable).parent
SHEBANG = "#!/usr/bin/env -S python -m pipeline run\n"


def test_a_literal_job_submit_trains_and_evaluates_and_a_schedule_finds_it_done_and_is_stopped(tmp_path):
    write_tiny_scene(tmp_path / "scene")
    over = {
        "scene": {"path": "scene", "shards": "shards/tiny"},
        "runs": "runs",
        "launcher": "local",
        "evaluate": {"protocols": ["crnerf-full@R2"]},
    }
    reeval = {"kind": "reeval", "runs": "runs/*", "launcher": "local"}
    (tmp_path / "jobs").mkdir()
    for name, mapping in (("train", tiny_mapping(tmp_path, over=over)), ("reeval", reeval)):
        file = tmp_path / "jobs" / f"{name}.yaml"
        file.write_text(SHEBANG + yaml.safe_dump(mapping))
        file.chmod(0o755)
    with Cluster(tmp_path, nodes=0, head_cpus=2, env={"CROSSRAY_CACHE": str(tmp_path / "cache")}) as cluster:

        def run(*words: str) -> str:
            ended = subprocess.run(
                [str(BIN / words[0]), *words[1:]],
                cwd=tmp_path,
                env=cluster.env,
                capture_output=True,
                text=True,
                timeout=200,
                check=False,
            )
            assert ended.returncode == 0, ended.stdout + ended.stderr
            return ended.stdout + ended.stderr

        assert "succeeded" in run("ray", "job", "submit", "jobs/train.yaml")
        assert json.loads((tmp_path / "runs" / "tiny" / "training.json").read_text())["finished"]
        assert "0 evaluated, 1 there already" in run("crossray", "submit", "jobs/reeval.yaml")
        assert {job["metadata"].get("kind", "literal") for job in cluster.jobs()} == {"literal", "reeval"}

        run("crossray", "submit", "jobs/reeval.yaml", "--set", "every=1s", "--no-wait")
        schedule = max(cluster.jobs(), key=lambda job: job["start_time"])["submission_id"]

        def log() -> str:
            return cluster.request(f"/api/jobs/{schedule}/logs")[1]["logs"]

        wait_until(lambda: "the next pass comes 1s after" in log(), "a pass", log)
        run("ray", "job", "stop", schedule)
        wait_until(lambda: cluster.job(schedule)["status"] == "STOPPED", "the schedule is stopped", log)
        assert "stopped; nothing is half-written" in log()
        assert "Traceback" not in log()
