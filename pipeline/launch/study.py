"""Runs a study: shards first, then every run that is not done as a process of its own, as many at once as fit.

A run that crashes, or is killed, ends no other one. SIGTERM and Ctrl-C reach the processes through a file that their
tasks watch: Ray's own ways of ending a task leave a run no time to save.
"""

from __future__ import annotations

import json
import logging
import os
import uuid
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

from pipeline.checkpoint import committed
from pipeline.config import Job, save_job
from pipeline.errors import CrossrayError
from pipeline.files import atomic_write
from pipeline.launch.process import Outcome, Spec, run_one
from pipeline.launch.room import alive_nodes, check_room, wanted
from pipeline.launch.run import claim_run, ensure_shards
from pipeline.launch.stop import stopped_by_signals
from pipeline.launch.tasks import Mapper, ray_session, ray_tasks
from pipeline.launch.torchrun import pick_device
from pipeline.protocol import check_protocols
from pipeline.provenance import provenance
from pipeline.resume import checkpoints
from pipeline.study import Run, StudyJob, expand, result_of
from pipeline.study_tables import Table, make_tables, write_results

log = logging.getLogger("crossray")


def run_study(
    study: StudyJob, tasks: Callable[..., AbstractContextManager[Mapper]] = ray_tasks
) -> tuple[list[Table], dict[str, str]]:
    """Run what of a study is not done yet, and write its results.

    Returns:
        The tables, and why runs are not done: run -> how it ended, the last line of its log, and the log.

    Raises:
        CrossrayError: anything that the user has to put right; no run has been started then.
        KeyboardInterrupt: the study was asked to stop; its runs have saved where they were.
    """
    if "RANK" in os.environ:
        raise CrossrayError("a study starts its runs itself; start it without torchrun")
    with ray_session() if on_cluster() else nullcontext():
        return run_what_is_left(study, tasks)


def run_what_is_left(
    study: StudyJob, tasks: Callable[..., AbstractContextManager[Mapper]]
) -> tuple[list[Table], dict[str, str]]:
    """Like run_study; where there is a cluster, connected to it."""
    runs = expand(study)
    for run in {(r.job.shards, r.job.scene, r.job.model.transient): r for r in reversed(runs)}.values():
        with named(run):
            check_protocols(run.job)
            ensure_shards(run.job)
    for run in runs:
        if committed(checkpoints(run.job)):  # a run that never came so far may have been of a job put right since
            with named(run):
                claim_run(run.job)
    todo = [run for run in runs if result_of(run) is None]
    log.info("study %s: %d runs, %d of them done", study.name, len(runs), len(runs) - len(todo))
    for run in todo:
        with named(run):
            check_protocols(run.job)
            takes_gpus(run.job)
    failures: dict[str, str] = {}
    try:
        failures = run_all(study, todo, tasks) if todo else {}
    finally:  # also when it was stopped: what is done counts
        results = [result for run in runs if (result := result_of(run)) is not None]
        tables = make_tables(study, runs, results)
        write_results(study, results, tables, failures)
    return tables, failures


@contextmanager
def named(run: Run) -> Iterator[None]:
    """An error of the block tells of which run it is."""
    try:
        yield
    except CrossrayError as error:
        raise CrossrayError(f"variant {run.variant}, scene {run.scene}: {error}") from None


def run_all(study: StudyJob, todo: list[Run], tasks: Callable[..., AbstractContextManager[Mapper]]) -> dict[str, str]:
    """Run them; returns why runs are not done."""
    by_name = {run.job.name: run for run in todo}
    source = json.dumps(provenance(), indent=2)
    for run in todo:
        save_job(run.job, run.job.run / "job.yaml")
        if not committed(checkpoints(run.job)):  # a run that goes on was started by what it says already
            atomic_write(run.job.run / "source.json", source)
    log.info("%d to go; each writes to %s/<run>/log.txt", len(todo), study.folder)
    failures: dict[str, str] = {}
    stopped = False
    stop = (study.folder / f".stop-{uuid.uuid4().hex}").absolute()
    with (
        stopped_by_signals(stop),
        tasks(needs=needs_of, died=lambda spec, error: Outcome(spec.name, str(error))) as mapper,
    ):
        for done, outcome in enumerate(mapper(run_one, [spec_of(run, stop) for run in todo]), start=1):
            state = "done"
            if outcome.how is None:
                stopped, state = True, "stopped"
            elif result_of(by_name[outcome.name]) is None:
                log_file = by_name[outcome.name].job.run / "log.txt"
                failures[outcome.name], state = f"{outcome.how} ({log_file})", "crashed"
            log.info("%s: %s (%d of %d)", outcome.name, state, done, len(todo))
    if stopped:
        log.info("study %s: stopped; run the same command again to go on", study.name)
        raise KeyboardInterrupt
    return failures


def spec_of(run: Run, stop: Path) -> Spec:
    """The task of a run."""
    job, folder = run.job, Path.cwd()
    on_gpus = takes_gpus(job)
    return Spec(
        name=job.name,
        run=folder / job.run,
        shards=folder / job.shards,
        folder=folder,
        stop=stop,
        threads=job.threads,
        cpus=0 if on_gpus else job.ranks * job.threads,
        gpus=job.ranks if on_gpus else 0,
    )


def on_cluster() -> bool:
    """Whether the runs go to a cluster, and not to this machine."""
    return bool(os.environ.get("RAY_ADDRESS"))


def takes_gpus(job: Job) -> bool:
    """Whether a run takes a GPU a rank.

    Raises:
        CrossrayError: no node of the cluster, or not this machine, has room for all of its ranks.
    """
    if not on_cluster():
        return pick_device(job, job.ranks - 1).type == "cuda"
    nodes = alive_nodes()
    need = replace(wanted(job, nodes), placement="STRICT_PACK")  # a run of a study is one process and its children
    if need.gpus:
        check_room(need, nodes)
    return need.gpus > 0


def needs_of(spec: Spec) -> dict[str, int]:
    """What Ray is asked for."""
    return {"num_cpus": spec.cpus, "num_gpus": spec.gpus}
