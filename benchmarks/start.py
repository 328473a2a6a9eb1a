"""Start of training for 74, 500 and 5,000 photos, and the memory of a rank.

    python benchmarks/start.py [--out benchmarks/results/start.json]

Seconds from the command, `crossray run` of the fast method on the CPU with the shards there, to the end of the first
step, and what they went into: once with no cache of photos, which this process then verifies the shards for and makes,
and once with the cache there. The files are in the system's own cache either way. "Bare" is what verify and cache
cannot do without: SHA-256 of every shard, decoding its PNGs, writing their pixels into one file.

Memory is a rank's proportional share (PSS, /proc/PID/smaps) some seconds into the training: of one rank, whose process
has read the scene's model before, and of each of two, which are processes of their own. It is told in three parts:
memory of no file, the mapped file of photos, and all other files, whose share depends on what else runs. Bar: the first
grows by at most 10 % from 74 to 5,000 photos. Exit status 1 if it is missed.

Scenes are of noise, with 100 points a photo, as Phototourism's models have (benchmarks/shards.py). 5,000 photos of real
size would take 6 GB: they are of 64 x 48 pixels, so that what a photo costs beside its pixels shows.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tarfile
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

from rich.console import Console
from rich.table import Table
from shards import Parts, Stopwatch, seconds_of, write_scene

from pipeline.cutting import cut_shards
from pipeline.files import atomic_write
from pipeline.heartbeat import rank_path, read_beat
from pipeline.launch.tasks import in_process
from pipeline.manifest import read_manifest
from pipeline.patches import PatchPlan
from pipeline.pictures import decode_png
from pipeline.provenance import provenance
from pipeline.timing_measure import summarised

ROUNDS = 2
SETTLED = 4.0  # seconds of training after which memory is looked at
GROWTH = 0.1  # the bar
ENDLESS = 10**6  # steps


class Kind(NamedTuple):
    """Photos of one size: (width, height), and what they are reduced by."""

    size: tuple[int, int]
    downscale: int
    reference_downscale: int

    @property
    def pixels(self) -> str:
        """Width and height that are trained on."""
        return " x ".join(str(side // self.downscale) for side in self.size)


SMALL, REAL = Kind((64, 48), 1, 1), Kind((1024, 768), 2, 8)
SCENES = ((SMALL, 74), (SMALL, 500), (SMALL, 5000), (REAL, 74), (REAL, 500))


# ---------------------------------------------------------------------------------------- in a process of its own


def parts() -> Parts:
    """What a start goes into."""
    from pipeline import photos, train
    from pipeline.launch import run

    return {
        "scene": [(run, "known"), (run, "read_scene"), (run, "check_scene")],
        "verify": [(photos, "check_sizes"), (photos, "check_sha256")],
        "cache": [(photos, "build_cache")],
        "index": [(train, "open_photos"), (run, "read_manifest"), (train, "run_identity")],
        "model": [(train, "build_model")],
        "optimiser": [(train, "build_optimiser")],  # torch imports its compiler for it
        "first step": [(train, "training_step")],
    }


def watched(began: float, result: Path, words: list[str]) -> None:
    """The command line `words`, which began at `began` (time.monotonic); `result` gets the seconds of its parts once
    the first step is done."""
    sys.argv = ["crossray", *words]
    from pipeline import train
    from pipeline.cli import main as crossray

    watch = Stopwatch()
    watched_parts = parts()
    imported = time.monotonic() - began

    with watch.running(watched_parts):
        step = train.training_step

        def first(*args: Any) -> Any:
            done = step(*args)
            train.training_step = step
            whole = time.monotonic() - began
            found = {"imports": imported, **{name: watch.seconds[name] for name in watched_parts}}
            atomic_write(result, json.dumps({"whole": whole, **found, "rest": whole - sum(found.values())}))
            return done

        with patch.object(train, "training_step", first):
            crossray()


# ------------------------------------------------------------------------------------------------------ measuring


class Memory(NamedTuple):
    """A rank's proportional share, bytes."""

    anonymous: float  # of no file
    photos: float  # of the mapped file of photos
    others: float  # of all other files


def memory_of(pid: int, cache: Path) -> Memory:
    """Of one process now; `cache` is the file of photos."""
    process = Path("/proc", str(pid))
    whole = dict(re.findall(r"^(Pss\w*): +(\d+) kB", (process / "smaps_rollup").read_text(), re.MULTILINE))
    mappings = re.split(r"^(?=[0-9a-f]+-)", (process / "smaps").read_text(), flags=re.MULTILINE)
    photos = sum(int(n) for m in mappings if str(cache) in m for n in re.findall(r"^Pss: +(\d+) kB", m, re.MULTILINE))
    anonymous, total = int(whole["Pss_Anon"]), int(whole["Pss"])
    return Memory(*(1024.0 * kilobytes for kilobytes in (anonymous, photos, total - anonymous - photos)))


class Scene:
    """A scene and its shards in a folder, and the starts of its training."""

    def __init__(self, folder: Path, kind: Kind, photos: int) -> None:
        self.folder, self.kind, self.photos, self.started = folder, kind, photos, 0
        folder.mkdir()
        write_scene(folder / "scene", photos, kind.size)
        self.shards, self.cache = folder / "shards", folder / "cache"
        manifest = cut_shards(
            folder / "scene",
            self.shards,
            downscale=kind.downscale,
            reference_downscale=kind.reference_downscale,
            plan=PatchPlan(),
            mapper=in_process,
        )
        self.pixels = self.cache / f"{manifest.content_hash}.pixels"

    def job(self, ranks: int) -> Path:
        """A job file for a run that has not been."""
        self.started += 1
        job = {
            "name": f"start-{self.started}",
            "method": "crossray",
            "scene": {
                "path": str(self.folder / "scene"),
                "shards": str(self.shards),
                "downscale": self.kind.downscale,
                "reference_downscale": self.kind.reference_downscale,
            },
            "runs": str(self.folder / "runs"),
            "ranks": ranks,
            "device": "cpu",
            "launcher": "local",
            "train": dict.fromkeys(("steps_per_epoch", "checkpoint_every", "log_every", "picture_every"), ENDLESS),
        }
        path = self.folder / f"{job['name']}.yaml"
        path.write_text(json.dumps(job))  # JSON is YAML
        return path

    def start(self, ranks: int, program: list[str]) -> list[Memory]:
        """Start the training with `program`, stop it some seconds after its first step; the memory of its ranks."""
        path = self.job(ranks)
        run = self.folder / "runs" / path.stem
        environment = os.environ | {
            "OMP_NUM_THREADS": "1",
            "GLOO_SOCKET_IFNAME": "lo",
            "CROSSRAY_CACHE": str(self.cache),
        }
        with (self.folder / "log.txt").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, *program, "run", str(path)],
                env=environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
            try:
                pids = [self.settled(process, run, rank) for rank in range(ranks)]
                return [memory_of(pid, self.pixels) for pid in pids]
            finally:
                process.send_signal(signal.SIGTERM)
                process.wait()
                shutil.rmtree(run, ignore_errors=True)

    def settled(self, process: subprocess.Popen, run: Path, rank: int) -> int:
        """Wait until a rank has trained for some seconds; its process id."""
        while (beat := read_beat(rank_path(run, rank))) is None or beat["seconds"] < SETTLED:
            if process.poll() is not None:
                sys.exit(f"a run ended early: {(self.folder / 'log.txt').read_text()}")
            time.sleep(0.05)
        return beat["pid"]

    def timed_start(self) -> tuple[dict[str, float], list[Memory]]:
        """Seconds of a start of one rank, in all and by part; and its memory."""
        result = self.folder / "seconds.json"
        result.unlink(missing_ok=True)
        memory = self.start(1, [__file__, "--watched", str(time.monotonic()), str(result)])
        return json.loads(result.read_text()), memory

    def bare(self) -> None:
        """The least that verify and cache take."""
        with (self.folder / "bare.pixels").open("wb") as out:
            for shard in read_manifest(self.shards).shards:
                data = (self.shards / shard.file).read_bytes()
                assert hashlib.sha256(data).hexdigest() == shard.sha256
                with tarfile.open(fileobj=io.BytesIO(data)) as tar:
                    for member in tar:
                        if member.name.endswith(".png"):
                            out.write(decode_png(tar.extractfile(member).read()).tobytes())  # type: ignore[union-attr]


def measure(scene: Scene) -> dict[str, Any]:
    """A row of results/start.json. Seconds are of one rank's first start and of its second, in turns with the bare."""
    seconds: dict[str, list[dict[str, float]]] = {"first": [], "second": []}
    memory: dict[str, list[Memory]] = {"first": [], "second": [], "two ranks": []}
    bare = []
    for _ in range(ROUNDS):
        bare.append(seconds_of(scene.bare))
        shutil.rmtree(scene.cache, ignore_errors=True)
        for start in seconds:
            found, ranks = scene.timed_start()
            seconds[start].append(found)
            memory[start] += ranks
        memory["two ranks"] += scene.start(2, ["-m", "pipeline"])
    return {
        "photos": scene.photos,
        "pixels": scene.kind.pixels,
        "shards_bytes": sum(path.stat().st_size for path in scene.shards.glob("*.tar")),
        "mapped_bytes": scene.pixels.stat().st_size,
        "bare_seconds": summarised(bare, None)._asdict() | {"rounds": bare},
        "seconds": {
            start: {
                part: summarised([r[part] for r in rounds], None)._asdict() | {"rounds": [r[part] for r in rounds]}
                for part in rounds[0]
            }
            for start, rounds in seconds.items()
        },
        "memory": {
            start: {
                kind: {"median": statistics.median(values), "all": list(values)}
                for kind, values in zip(Memory._fields, zip(*ranks, strict=True), strict=True)
            }
            for start, ranks in memory.items()
        },
    }


# ------------------------------------------------------------------------------------------------------ the table


def bars(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Growth from the fewest to the most photos of one size."""
    small = [row for row in rows if row["pixels"] == SMALL.pixels]
    few, many = small[0], small[-1]
    found = []
    for start in few["memory"]:
        before, after = (row["memory"][start]["anonymous"]["median"] for row in (few, many))
        found.append(
            {
                "bar": f"memory of no file, {few['photos']:,} to {many['photos']:,} photos, {start}",
                "measured": after / before - 1,
                "wanted": GROWTH,
                "bytes_a_photo": (after - before) / (many["photos"] - few["photos"]),
                "met": after / before - 1 <= GROWTH,
            }
        )
    return found


def table_of(rows: list[dict[str, Any]]) -> Table:
    """What a person reads."""
    names = list(rows[0]["seconds"]["first"])
    table = Table("photos", "pixels", "start", *names, "bare", "no file", "other files", "photos", "of")
    for row in rows:
        for start, memory in row["memory"].items():
            times = row["seconds"].get(start)
            seconds = [f"{times[name]['median']:.2f}" for name in names] if times else [""] * len(names)
            table.add_row(
                f"{row['photos']:,}",
                row["pixels"],
                start,
                *seconds,
                f"{row['bare_seconds']['median']:.2f}" if start == "first" else "",
                *(f"{memory[kind]['median'] / 1e6:.0f}" for kind in ("anonymous", "others", "photos")),
                f"{row['mapped_bytes'] / 1e6:.0f}",
            )
    return table


def main() -> None:
    """Measure, print, record."""
    if sys.argv[1:2] == ["--watched"]:
        watched(float(sys.argv[2]), Path(sys.argv[3]), sys.argv[4:])
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    where = provenance()
    rows = []
    for kind, photos in SCENES:
        with tempfile.TemporaryDirectory(prefix="start-") as name:
            rows.append(measure(Scene(Path(name) / "start", kind, photos)))
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(table_of(rows))
    console.print(
        f"Seconds to the end of the first step, medians of {ROUNDS} rounds; a rank's PSS in MB, and the size of the "
        "mapped file."
    )
    table = bars(rows)
    for row in table:
        console.print(
            f"{row['bar']}: {100 * row['measured']:+.1f} %, {row['bytes_a_photo']:,.0f} bytes a photo; wanted at most "
            f"{100 * row['wanted']:+.0f} %: {'met' if row['met'] else 'MISSED'}"
        )
    if options.out:
        atomic_write(options.out, json.dumps({"bars": table, "scenes": rows, "provenance": where}, indent=1) + "\n")
    sys.exit(0 if all(row["met"] for row in table) else 1)


if __name__ == "__main__":
    main()
