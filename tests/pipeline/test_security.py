"""Attacks on everything that reads what somebody else made. Each is refused with a message for people, or does nothing.

What must never happen: a command is run, a file outside the folder in question is read or written, a class or a
function that a file names is called, or memory is taken for what a file merely claims.
"""

from __future__ import annotations

import ast
import io
import json
import os
import pickle
import resource
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from contextlib import nullcontext
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from forgery import edit_manifest, read_all, repack
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from rich.console import Console
from tiny_run import cut_tiny, tiny_job, tiny_mapping
from tiny_scene import write_tiny_scene

from pipeline import cli
from pipeline.checkpoint import CheckpointError, digest, latest_checkpoint, read_checkpoint, save_checkpoint
from pipeline.config import JobError, load_job, make_job, save_job
from pipeline.cutting import cut_shards
from pipeline.errors import CrossrayError
from pipeline.files import sha256_of
from pipeline.importing import import_checkpoint
from pipeline.launch.process import Spec, run_one
from pipeline.launch.submit import new_id, stage
from pipeline.launch.tasks import in_process
from pipeline.manifest import ShardError, read_manifest
from pipeline.masks import MaskError, make_masks, read_record
from pipeline.patches import PatchPlan
from pipeline.photos import open_photos
from pipeline.protocol import parse_protocol
from pipeline.reeval import ReevalJob, find_runs, load_reeval, one_pass
from pipeline.report import Row, write_report
from pipeline.runs import load_run
from pipeline.scene import SceneError, read_scene
from pipeline.segmentation import find_segmenter
from pipeline.status import Status, as_table
from pipeline.study import load_study, make_study

ROOT = Path(__file__).resolve().parents[2]
PWNED = "pwned"  # what an attack that works leaves in the working directory
COMMANDS = ("pipe:touch pwned", "; touch pwned", "$(touch pwned)", "`touch pwned`", "| touch pwned", "\ntouch pwned")
ELSEWHERE = ("../pwned", "/tmp/../pwned", "a/../../pwned", "..", ".", "", "pwned\0", "a\nb", "~/pwned")
METADATA = "http://169.254.169.254/latest/meta-data"


@pytest.fixture(autouse=True)
def working_directory(tmp_path_factory, monkeypatch) -> Iterator[Path]:
    """A folder of its own for each test, in which nothing may appear."""
    folder = tmp_path_factory.mktemp("cwd")
    monkeypatch.chdir(folder)
    yield folder
    assert list(folder.iterdir()) == []


class Attack:
    """An object that runs a command when it is unpickled."""

    def __reduce__(self) -> tuple:
        return os.system, (f"touch {PWNED}",)


@cache
def bomb() -> bytes:
    """A PNG of 14,000 x 14,000 zeros: a few kilobytes that would become half a gigabyte."""
    buffer = io.BytesIO()
    Image.new("1", (14_000, 14_000)).save(buffer, "PNG")
    return buffer.getvalue()


def nested(depth: int) -> str:
    """JSON that a recursive parser falls over."""
    return "[" * depth + "]" * depth


# Shards: manifest, tars, members


@pytest.fixture(scope="module")
def cut(tmp_path_factory) -> Path:
    return cut_tiny(tmp_path_factory.mktemp("security"))


@pytest.fixture
def shards(tmp_path) -> Path:
    root, out = write_tiny_scene(tmp_path / "scene", photos=4, size=(16, 12)), tmp_path / "shards"
    cut_shards(root, out, downscale=1, reference_downscale=1, plan=PatchPlan(size=4), mapper=in_process)
    return out


@pytest.mark.parametrize(
    "name", [*COMMANDS, *ELSEWHERE, METADATA, "file:///etc/passwd", "shard-000000.tar\0", "shard-000000.tar\n"]
)
def test_a_manifest_names_no_other_files(shards, name):
    edit_manifest(shards, lambda m: m["shards"][0].update(file=name))
    with pytest.raises(ShardError, match="damaged"):
        read_all(shards)


@pytest.mark.parametrize("key", [*COMMANDS, *ELSEWHERE, "000000-photo_000\n", "a.rgb", "<script>"])
def test_a_manifest_has_no_other_keys(shards, key):
    edit_manifest(shards, lambda m: m["shards"][0].update(keys=[key]))
    with pytest.raises(ShardError, match="damaged"):
        read_all(shards)


@pytest.mark.parametrize("change", [{"bytes": -1}, {"sha256": "../" * 22}, {"keys": []}, {"bytes": 1e400}])
def test_a_manifest_of_absurd_numbers_is_refused(shards, change):
    edit_manifest(shards, lambda m: m["shards"][0].update(change))
    with pytest.raises(ShardError):
        read_all(shards)


def test_a_manifest_nested_beyond_all_bounds_is_refused(shards):
    (shards / "manifest.json").write_text(nested(200_000))
    with pytest.raises(ShardError, match="damaged"):
        read_manifest(shards)


@pytest.mark.parametrize("name", [f"{place}.rgb.png" for place in (*COMMANDS, *ELSEWHERE) if "\0" not in place])
def test_a_member_of_a_tar_has_no_other_name(shards, name):
    def change(member: tarfile.TarInfo, data: bytes) -> tuple[tarfile.TarInfo, bytes]:
        if member.name.endswith("rgb.png"):
            member.name = name
        return member, data

    repack(shards, change)
    with pytest.raises(ShardError, match=r"shard-000000\.tar"):
        read_all(shards)
    assert sorted(p.name for p in shards.parent.iterdir()) == ["scene", "shards"]


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE, tarfile.DIRTYPE])
def test_a_member_of_a_tar_is_a_file_and_nothing_else(shards, kind):
    def change(member: tarfile.TarInfo, data: bytes) -> tuple[tarfile.TarInfo, bytes]:
        if member.name.endswith("rgb.png"):
            member.type, member.linkname = kind, "/etc/passwd"
        return member, data

    repack(shards, change)
    with pytest.raises(ShardError, match=r"shard-000000\.tar"):
        read_all(shards)


@pytest.mark.parametrize("suffix", ["rgb.pyd", "rgb.pkl", "pt", "rgb.png.pickle", "pipe:touch pwned"])
def test_what_webdataset_would_decode_by_running_it_is_refused(shards, suffix):
    def change(member: tarfile.TarInfo, data: bytes) -> tuple[tarfile.TarInfo, bytes]:
        if not member.name.endswith("rgb.png"):
            return member, data
        member.name = member.name.replace("rgb.png", suffix)
        return member, pickle.dumps(Attack())

    repack(shards, change)
    with pytest.raises(ShardError, match="has members"):
        read_all(shards)


@pytest.mark.parametrize("member", ["rgb.png", "ref.png", "mask.png"])
def test_a_picture_that_would_fill_the_memory_is_refused(shards, member):
    def change(info: tarfile.TarInfo, data: bytes) -> tuple[tarfile.TarInfo, bytes]:
        return info, bomb() if info.name.endswith(member) else data

    if member == "mask.png":
        masks = shards.parent / "scene" / "masks"
        masks.mkdir()
        for photo in (shards.parent / "scene" / "dense" / "images").iterdir():
            Image.new("L", (16, 12)).save(masks / f"{photo.stem}.png")
        cut_shards(masks.parent, shards, downscale=1, reference_downscale=1, plan=PatchPlan(size=4), mapper=in_process)
    repack(shards, change)
    with pytest.raises(ShardError, match=r"sample 000000-photo_000 is damaged"):
        read_all(shards)


@pytest.mark.parametrize(
    "change",
    [
        {"width": 10**12},
        {"height": 10**30},
        {"width": -1},
        {"fx": 1e999},
        {"near": float("nan")},
        {"c2w": []},
        {"c2w": [[0] * 4] * 4},
        {"split": "../train"},
        {"key": "../pwned"},
        {"source_sha256": "x"},
        {"surprise": 1},
    ],
)
def test_an_absurd_camera_is_refused(shards, change):
    def edit(member: tarfile.TarInfo, data: bytes) -> tuple[tarfile.TarInfo, bytes]:
        return member, json.dumps(json.loads(data) | change).encode() if member.name.endswith("json") else data

    repack(shards, edit)
    with pytest.raises(ShardError, match="sample 000000-photo_000 is damaged"):
        read_all(shards)


def test_a_camera_nested_beyond_all_bounds_is_refused(shards):
    repack(shards, lambda m, d: (m, nested(200_000).encode() if m.name.endswith("json") else d))
    with pytest.raises(ShardError, match="is damaged"):
        read_all(shards)


# Scenes: names of photos, of masks, in tables


def rename_photo(root: Path, name: str) -> Path:
    """The tiny scene with another name for its first photo in the model; no split table."""
    path = root / "dense" / "sparse" / "images.txt"
    path.write_text(path.read_text().replace("photo_000.jpg", name))
    return root


@pytest.fixture
def scene(tmp_path) -> Path:
    root = write_tiny_scene(tmp_path / "scene", photos=4, size=(16, 12), tsv=False)
    (tmp_path / "outside.jpg").write_bytes((root / "dense" / "images" / "photo_000.jpg").read_bytes())
    return root


@pytest.mark.parametrize("name", ["../../../outside.jpg", "{}/outside.jpg", "a/../../../../outside.jpg", "x\0.jpg"])
def test_a_photo_outside_the_scene_is_not_read(scene, tmp_path, name):
    with pytest.raises(SceneError, match="is not in"):
        read_scene(rename_photo(scene, name.format(tmp_path)))


def test_a_photo_that_is_a_link_out_of_the_scene_is_not_read(scene, tmp_path):
    photo = scene / "dense" / "images" / "photo_000.jpg"
    photo.unlink()
    photo.symlink_to(tmp_path / "outside.jpg")
    with pytest.raises(SceneError, match="is not in"):
        read_scene(scene)


@pytest.mark.parametrize(
    "name", [";touch${IFS}pwned.jpg", "$(touch${IFS}pwned).jpg", "<script>alert(1)<&script>.jpg", "-rf.jpg"]
)
def test_an_odd_name_of_a_photo_is_a_name(scene, tmp_path, name):
    (scene / "dense" / "images" / "photo_000.jpg").rename(scene / "dense" / "images" / name)
    rename_photo(scene, name)
    out = tmp_path / "out"
    manifest = cut_shards(scene, out, downscale=1, reference_downscale=1, plan=PatchPlan(size=4), mapper=in_process)
    assert all(set(key) <= set("abcdefghijklmnopqrstuvwxyz0123456789_-") for key in manifest.keys)
    assert name in [record.name for record in open_photos(out).records]
    read_all(out)


def test_a_mask_is_not_written_outside_the_scene(scene, tmp_path):
    images, given = scene / "dense" / "images", tmp_path / "given"
    (images / "sub").mkdir()
    (images / "photo_000.jpg").rename(images / "x.jpg")
    rename_photo(scene, "sub/../x.jpg")  # inside the photos; from the masks it could be anywhere
    given.mkdir()
    for stem in ("x", "photo_001", "photo_002", "photo_003"):
        Image.new("L", (16, 12)).save(given / f"{stem}.png")
    (given / "sub").mkdir()
    with pytest.raises(MaskError, match="would lie outside"):
        make_masks(scene, find_segmenter(f"folder:{given}"), mapper=in_process)
    assert not (scene / "masks").exists()


def test_a_folder_of_masks_that_is_a_link_is_not_followed(scene, tmp_path):
    images, given, elsewhere = scene / "dense" / "images", tmp_path / "given", tmp_path / "elsewhere"
    (images / "sub").mkdir()
    (images / "photo_000.jpg").rename(images / "sub" / "x.jpg")
    rename_photo(scene, "sub/x.jpg")
    for folder in (given / "sub", elsewhere, scene / "masks"):
        folder.mkdir(parents=True)
    for stem in ("sub/x", "photo_001", "photo_002", "photo_003"):
        Image.new("L", (16, 12)).save(given / f"{stem}.png")
    (scene / "masks" / "sub").symlink_to(elsewhere)
    with pytest.raises(MaskError, match="would lie outside"):
        make_masks(scene, find_segmenter(f"folder:{given}"), mapper=in_process)
    assert list(elsewhere.iterdir()) == []


@pytest.mark.parametrize("record", ["{}", nested(200_000), "!!python/object/apply:os.system", '{"segmenter": "../x"}'])
@pytest.mark.parametrize("compressed", [False, True])
def test_a_record_of_a_mask_is_data(tmp_path, record, compressed):
    text = PngInfo()
    text.add_text("crossray", record, zip=compressed)
    Image.new("L", (4, 4)).save(tmp_path / "mask.png", pnginfo=text)
    assert read_record(tmp_path / "mask.png") is None


def test_a_record_of_a_mask_that_would_fill_the_memory_is_none(tmp_path):
    text = PngInfo()
    text.add_text("crossray", "0" * 2**23, zip=True)
    Image.new("L", (4, 4)).save(tmp_path / "mask.png", pnginfo=text)
    assert (tmp_path / "mask.png").stat().st_size < 2**20
    assert read_record(tmp_path / "mask.png") is None


# Job files


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.system ['touch pwned']",
        "name: !!python/object/apply:os.system ['touch pwned']",
        "name: !!python/object/new:subprocess.Popen [['touch', 'pwned']]",
        "!!python/module:pwned {}",
        "name: !!python/name:os.system ''",
    ],
)
def test_a_tag_of_yaml_makes_nothing(tmp_path, text):
    path = tmp_path / "job.yaml"
    path.write_text(text)
    with pytest.raises(JobError, match="not a YAML file"):
        load_job(path)
    with pytest.raises((yaml.YAMLError, JobError)):
        load_study(path)
    with pytest.raises(JobError, match="is not YAML"):
        make_job({"name": "x", "scene": {"path": "."}}, [f"name={text.removeprefix('name: ')}"])


@pytest.mark.parametrize("name", [*COMMANDS, *ELSEWHERE, "-x", ".hidden", "a/b", "x\n", "x" * 200])
def test_names_of_jobs_stay_in_their_folder(name):
    with pytest.raises(JobError, match="name"):
        make_job({"name": name, "scene": {"path": "."}})
    variants, scenes = {"nerf": {"method": "nerf"}}, {"here": {"scene": {"path": "."}}}
    for study in (
        {"name": name, "variants": variants, "scenes": scenes},
        {"name": "x", "variants": {name: variants["nerf"]}, "scenes": scenes},
        {"name": "x", "variants": variants, "scenes": {name: scenes["here"]}},
    ):
        with pytest.raises(JobError):
            make_study({"kind": "study", **study})


LAUGHS = "\n".join(["x0: &x0 [x, x]", *(f"x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 10)}]" for i in range(1, 9))])


@pytest.mark.slow
@pytest.mark.parametrize("text", [f"{LAUGHS}\nname: *x8", f"{LAUGHS}\nmodel: {{field: *x8}}", "name: &a [*a]"])
def test_a_job_file_that_would_fill_the_memory_is_refused(tmp_path, text):
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (15, 15))
        resource.setrlimit(resource.RLIMIT_DATA, (2**30, 2**30))

    (tmp_path / "job.yaml").write_text(f"{text}\nscene: {{path: x}}")
    code = "import sys; from pathlib import Path; from pipeline.config import load_job; load_job(Path(sys.argv[1]))"
    command = [sys.executable, "-c", code, str(tmp_path / "job.yaml")]
    found = subprocess.run(command, cwd=ROOT, preexec_fn=limit, capture_output=True, text=True, check=False)
    assert found.returncode == 1, found.stderr[-500:]
    assert "JobError" in found.stderr
    assert len(found.stderr) < 10_000


@pytest.mark.parametrize("name", ["../../x@R1", "/etc/x@R1", "crnerf-full@R1/../..", "crnerf-full@R1\n", *COMMANDS])
def test_names_of_protocols_stay_in_their_folder(name):
    with pytest.raises(CrossrayError, match="protocol"):
        parse_protocol(name)


@pytest.mark.parametrize("pattern", [*COMMANDS, "/etc/*", "~/*", "../**/passwd", "runs\0"])
def test_patterns_of_runs_are_patterns(pattern):
    with pytest.raises(CrossrayError, match="runs: "):
        find_runs(ReevalJob(runs=(pattern,)))


@pytest.mark.parametrize("key", ["protocols=['../../x@R1']", "every=1s; touch pwned", "every=$(touch pwned)"])
def test_a_reevaluation_takes_no_other_names(tmp_path, key):
    (tmp_path / "reeval.yaml").write_text("kind: reeval\nruns: [x]")
    with pytest.raises(CrossrayError, match=r"protocol|every"):
        load_reeval(tmp_path / "reeval.yaml", [key])


def test_a_run_that_somebody_sent_is_evaluated_in_its_own_folder(tmp_path, cut):
    run = tmp_path / "runs" / "sent"
    job = tiny_job(cut, over={"name": "other", "evaluate": {"protocols": ["../../../pwned@R2"]}})
    save_job(job, run / "job.yaml")
    model, optimiser = {"w": torch.zeros(3)}, {"state": {}, "param_groups": []}
    meta = {"seconds": 0.0, "finished": False, "world_size": 1, "photos": 1, "shards": "0" * 64, "job": "0" * 64}
    save_checkpoint(run / "checkpoints", 10, model, optimiser, meta | {"skipped": []})
    before = sorted(tmp_path.rglob("*"))
    summary = one_pass(ReevalJob(runs=(str(tmp_path / "runs" / "*"),)), in_process)
    assert len(summary.skipped) == 1
    assert "protocol '../../../pwned@R2'" in summary.skipped[0]
    assert sorted(tmp_path.rglob("*")) == before
    assert not job.run.exists()


# Commands that are made of names


@pytest.mark.slow
def test_the_process_of_a_study_takes_odd_folders_as_they_are(tmp_path):
    run = tmp_path / "runs; touch pwned" / "$(touch pwned)"
    run.mkdir(parents=True)
    (tmp_path / "shards").mkdir()
    (tmp_path / "shards" / "manifest.json").touch()
    spec = Spec(
        name="$(touch pwned)",
        run=run,
        shards=tmp_path / "shards",
        folder=tmp_path,
        stop=tmp_path / "stop",
        threads=1,
        cpus=1,
        gpus=0,
    )
    outcome = run_one(spec)  # which finds no job.yaml there
    assert outcome.how is not None
    assert "job.yaml" in outcome.how
    assert "exit status 2" in outcome.how
    assert not list(tmp_path.rglob(PWNED))


@pytest.mark.parametrize("file", ["job; touch pwned;.yaml", "$(touch pwned).yaml", "`touch pwned`.yaml", "-c.yaml"])
def test_a_submitted_command_has_the_words_that_were_given(tmp_path, file):
    (tmp_path / file).write_text("kind: train")
    settings = [
        "name=x; touch pwned",
        "scene.path=$(touch pwned)",
        "runs='`touch pwned`'",
        "threads=\n1 && touch pwned",
    ]
    folder = tmp_path / "staged"
    folder.mkdir()
    entrypoint = stage(tmp_path / file, settings, folder)
    shown = tmp_path / "bin" / "python"  # shows what it was called with
    shown.parent.mkdir()
    shown.write_text(f"#!{sys.executable}\nimport json, sys\nprint(json.dumps(sys.argv[1:]))\n")
    shown.chmod(0o755)
    ran = subprocess.run(  # as Ray's job supervisor does
        ["/bin/sh", "-c", entrypoint],
        cwd=tmp_path,
        env={"PATH": f"{shown.parent}:/bin"},
        capture_output=True,
        check=True,
    )
    words = [word for setting in settings for word in ("--set", setting)]
    assert json.loads(ran.stdout) == ["-m", "pipeline", "run", f"jobs/{file}", *words]
    assert not list(tmp_path.rglob(PWNED))
    assert list((folder / "jobs").iterdir()) == [folder / "jobs" / file]


def test_a_submission_id_is_plain():
    made = new_id({"kind": "train", "name": "../$(touch pwned)\n;"})
    assert set(made) <= set("abcdefghijklmnopqrstuvwxyz0123456789-")


# Checkpoints


@pytest.fixture
def checkpoint(tmp_path) -> Path:
    model = {"w": torch.zeros(3)}
    meta = {"seconds": 0.0, "finished": False, "world_size": 1, "photos": 1, "shards": "0" * 64, "job": "0" * 64}
    return save_checkpoint(tmp_path / "checkpoints", 10, model, {"state": {}, "param_groups": []}, meta)


def forge(checkpoint: Path, **change: object) -> None:
    """A meta.json that vouches for what is there: the attacker wrote all of it."""
    meta = json.loads((checkpoint / "meta.json").read_text()) | change
    meta["sha256"] = {name: sha256_of(checkpoint / name) for name in ("model.safetensors", "training.pt")}
    meta["digest"] = digest(meta)
    (checkpoint / "meta.json").write_text(json.dumps(meta))


@pytest.mark.parametrize("as_zip", [True, False])
def test_an_optimiser_state_that_runs_code_is_refused(checkpoint, as_zip):
    buffer = io.BytesIO()
    torch.save({"state": Attack(), "param_groups": []}, buffer, _use_new_zipfile_serialization=as_zip)
    (checkpoint / "training.pt").write_bytes(buffer.getvalue())
    forge(checkpoint)
    with pytest.raises(CheckpointError, match=r"training\.pt"):
        read_checkpoint(checkpoint).optimiser()


@pytest.mark.parametrize(
    "content",
    [
        (2**60).to_bytes(8, "little") + b"{}",
        (2**31).to_bytes(8, "little") + b"{}",
        b"",
        pickle.dumps(Attack()),
        *(
            len(header).to_bytes(8, "little") + header + bytes(8)
            for header in (
                b'{"w": {"dtype": "F32", "shape": [1000000000000], "data_offsets": [0, 4000000000000]}}',
                b'{"w": {"dtype": "F32", "shape": [2], "data_offsets": [-8, 0]}}',
                b'{"w": {"dtype": "F32", "shape": [4], "data_offsets": [0, 8]}}',
                nested(50_000).encode(),
            )
        ),
    ],
)
def test_absurd_weights_are_refused(checkpoint, content):
    (checkpoint / "model.safetensors").write_bytes(content)
    forge(checkpoint)
    with pytest.raises(CheckpointError, match="cannot be read"):
        read_checkpoint(checkpoint)


@pytest.mark.parametrize("step", ["../../pwned", "00000010", 10.5, -1, None, [10], 2**70, True])
def test_a_checkpoint_is_of_the_step_that_its_folder_says(checkpoint, step):
    forge(checkpoint, step=step)
    with pytest.raises(CheckpointError):
        read_checkpoint(checkpoint)


def test_a_meta_nested_beyond_all_bounds_is_a_damaged_checkpoint(checkpoint):
    (checkpoint / "meta.json").write_text(nested(200_000))
    with pytest.raises(CheckpointError, match="all 1 checkpoints are damaged"):
        latest_checkpoint(checkpoint.parent)


def test_files_of_a_checkpoint_are_those_of_its_folder(checkpoint, tmp_path):
    (tmp_path / "elsewhere").write_bytes((checkpoint / "model.safetensors").read_bytes())
    meta = json.loads((checkpoint / "meta.json").read_text())
    meta["sha256"] = {"../../elsewhere": sha256_of(tmp_path / "elsewhere")}
    meta["digest"] = digest(meta)
    (checkpoint / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(CheckpointError, match="cannot be read"):
        read_checkpoint(checkpoint)


def test_the_job_of_a_run_that_somebody_sent_is_data(tmp_path, cut):
    job = tiny_job(cut, over={"name": "sent"})
    save_job(job, tmp_path / "job.yaml")
    (tmp_path / "job.yaml").write_text(
        (tmp_path / "job.yaml").read_text() + "\nextra: !!python/object/apply:os.system ['touch pwned']\n"
    )
    with pytest.raises(JobError, match="not a YAML file"):
        load_run(tmp_path)


def test_a_released_checkpoint_that_runs_code_runs_none(tmp_path, cut):
    mlp = {"width": 256, "xyz_frequencies": 15, "dir_frequencies": 4}
    job = make_job(
        tiny_mapping(cut, "crnerf", {"name": "imported", "model": {"mlp": mlp}, "runs": str(tmp_path / "r")})
    )
    for value in (Attack(), {"state_dict": Attack()}, {"state_dict": {"w": Attack()}}):
        torch.save(value, tmp_path / "released.ckpt")
        with pytest.raises(CheckpointError, match="state_dict"):
            import_checkpoint(tmp_path / "released.ckpt", job)
    assert not job.run.exists()


# What people see


def test_the_report_shows_names_as_text(tmp_path):
    evil = "</h1><script>alert('1')</script><img src=x onerror=\"alert(1)\">'&"
    picture = np.zeros((2, 2, 3), np.uint8)
    path = write_report(tmp_path / "report.html", evil, [(evil, evil, evil)], [Row(evil, {evil: picture})])
    page = path.read_text()
    assert "alert('1')" not in page
    assert "<script" not in page
    assert "<img src=x" not in page
    assert 'onerror="' not in page
    assert "&lt;script&gt;" in page


def test_a_message_shows_names_without_what_a_terminal_acts_upon(scene, monkeypatch, capsys):
    rename_photo(scene, "\x1b]0;pwned\x07[red]x[/].jpg")
    monkeypatch.setattr(sys, "argv", ["crossray", "shard", str(scene), "--out", str(scene.parent / "out")])
    monkeypatch.setattr("pipeline.launch.tasks.ray_tasks", lambda: nullcontext(in_process))
    with pytest.raises(SystemExit) as ended:
        cli.main()
    shown = capsys.readouterr().err
    assert ended.value.code == 2
    assert "is not in" in shown
    assert "[red]x[/].jpg" in shown
    assert "\x1b]0" not in shown
    assert "\x07" not in shown


def test_a_table_shows_names_as_text():
    name = "[/x][link=http://x]x"
    row = Status(name, "trained", 1, 1, 1.0, None, None, None, name, 0, 0)
    console = Console(file=io.StringIO(), width=200)
    console.print(as_table([row]))
    assert console.file.getvalue().count(name) == 2  # type: ignore[attr-defined]


# The sources


def sources() -> list[Path]:
    return [path for folder in ("model", "pipeline", "benchmarks") for path in sorted((ROOT / folder).rglob("*.py"))]


FORBIDDEN_CALLS = {
    *("eval", "exec", "compile", "__import__", "os.system", "os.popen", "os.execvp", "pty.spawn"),
    *("yaml.load", "yaml.unsafe_load", "yaml.full_load", "yaml.load_all", "tempfile.mktemp", "torch.hub.load"),
    *("subprocess.getoutput", "subprocess.getstatusoutput"),
}
FORBIDDEN_IMPORTS = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "telnetlib", "xml"}
FORBIDDEN_METHODS = {"extractall", "extract", "to_pickle", "read_pickle"}


def dotted(node: ast.expr) -> str:
    """`a.b.c` of an expression, as far as it is one."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def faults(tree: ast.Module) -> Iterator[str]:
    """What no source of ours may hold."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            allowed = isinstance(node, ast.ImportFrom) and [a.name for a in node.names] == ["UnpicklingError"]
            yield from (f"imports {n}" for n in names if n.split(".")[0] in FORBIDDEN_IMPORTS and not allowed)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and "0.0.0.0" in node.value:
            yield "binds to all interfaces"
        if not isinstance(node, ast.Call):
            continue
        name, given = dotted(node.func), {k.arg: k.value for k in node.keywords}
        if name in FORBIDDEN_CALLS:
            yield f"calls {name}"
        if isinstance(node.func, ast.Attribute) and node.func.attr in FORBIDDEN_METHODS:
            yield f"calls {node.func.attr}"
        if "shell" in given:
            yield "runs a shell"
        if name == "torch.load" and not is_constant(given.get("weights_only"), True):
            yield "torch.load without weights_only=True"
        if name in ("np.load", "numpy.load") and not is_constant(given.get("allow_pickle"), False):
            yield "np.load without allow_pickle=False"


def is_constant(node: ast.expr | None, value: object) -> bool:
    return isinstance(node, ast.Constant) and node.value is value


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_no_source_runs_what_it_reads(path):
    assert list(faults(ast.parse(path.read_text()))) == []


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from pickle import loads",
        "import os\nos.system('x')",
        "subprocess.run('x', shell=True)",
        "yaml.load(text)",
        "yaml.load(text, Loader=yaml.Loader)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "np.load(path, allow_pickle=True)",
        "eval('1')",
        "tar.extractall(folder)",
        "serve(host='0.0.0.0')",
    ],
)
def test_the_search_of_the_sources_finds(code):
    assert list(faults(ast.parse(code)))
