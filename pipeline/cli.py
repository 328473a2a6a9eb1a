"""The command line. Stages are imported when their command runs, so that `--help` is quick and a machine without Ray
or pycolmap can train from shards."""

from __future__ import annotations

import errno
import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipeline.errors import CrossrayError
from pipeline.launch.stop import interrupted_by_signals
from pipeline.log import plain, set_up_logging

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Photos that strangers took of one place -> one radiance field without the tourists, in any appearance.",
)

Settings = Annotated[list[str], typer.Option("--set", metavar="KEY=VALUE", help="Set a key of the job file.")]

DropBadPhotos = Annotated[
    bool, typer.Option("--drop-bad-photos", help="Leave out photos that are missing, damaged or of a wrong size.")
]


def main() -> None:
    """Run a command; what the user has to put right is one message and exit status 2. Stopped: 130."""
    set_up_logging()
    try:
        with interrupted_by_signals():
            app()
    except KeyboardInterrupt:
        sys.exit(130)
    except (CrossrayError, OSError) as error:
        text = str(error) if isinstance(error, CrossrayError) else told(error)
        Console(stderr=True).print(
            f"[bold red]crossray:[/] {escape(plain(text))}", highlight=False, soft_wrap=True, markup=True
        )
        sys.exit(2)


ADVICE = {
    errno.ENOSPC: "make room, and run the same command again",
    errno.EDQUOT: "make room, and run the same command again",
    errno.EROFS: "name a folder that can be written",
    errno.EACCES: "name one that may be read and written",
    errno.ENOTDIR: "a file stands where a folder is needed; name another one",
    errno.EISDIR: "a folder stands where a file is needed; name another one",
    errno.EEXIST: "a file stands where a folder is needed; name another one",
    errno.ENOENT: "is the name right?",
    errno.ENAMETOOLONG: "name a shorter one",
}


def told(error: OSError) -> str:
    """What the system refused, where, and what to do."""
    where = f"{error.filename}: " if error.filename else ""
    advice = ADVICE.get(error.errno or 0)
    return f"{where}{error.strerror or error}{f'; {advice}' if advice else ''}"


@app.command()
def quickstart(
    out: Annotated[Path, typer.Option(help="Folder for everything that is made.")] = Path("quickstart"),
) -> None:
    """The whole pipeline on the built-in landmark: photos, shards, training, evaluation, report."""
    from pipeline.launch.local import run_local
    from pipeline.launch.tasks import ray_tasks
    from pipeline.quickstart import run_quickstart

    run_quickstart(out, train=run_local, tasks=ray_tasks)


@app.command()
def landmark(
    out: Annotated[Path, typer.Argument(help="Folder for the scene.")],
    train: Annotated[int, typer.Option(help="Training photos.")] = 48,
    val: Annotated[int, typer.Option(help="Validation photos.")] = 8,
    test: Annotated[int, typer.Option(help="Test photos.")] = 8,
    size: Annotated[int, typer.Option(help="Long side of a photo, pixels.")] = 128,
    seed: Annotated[int, typer.Option(help="Of everything that is drawn.")] = 0,
    sun_jitter: Annotated[float, typer.Option(help="Degrees by which the sun moves between photos.")] = 0.0,
) -> None:
    """Make the built-in scene: photos "in the wild" of a rendered landmark, with the truth beside them."""
    from pipeline.landmark import write_landmark
    from pipeline.launch.tasks import ray_tasks
    from pipeline.progress import shown

    with ray_tasks() as mapper:
        write_landmark(
            out,
            train=train,
            val=val,
            test=test,
            size=size,
            seed=seed,
            sun_jitter=sun_jitter,
            mapper=shown(mapper, "taking photos"),
        )
    print_line(f"{out}: {train + val + test} photos. Its pictures are small, so train on them as they are:")
    print_line(
        f"crossray run jobs/train_scene_cpu.yaml --set scene.path={out} --set name=landmark --set scene.downscale=1 "
        "--set scene.reference_downscale=1 --set 'evaluate.protocols=[crnerf-full@R1]'"
    )


@app.command()
def ingest(
    photos: Annotated[Path, typer.Argument(help="Folder of photos, or a nerfstudio transforms.json.")],
    out: Annotated[Path, typer.Option(help="Folder for the scene.")],
    matching: Annotated[
        str, typer.Option(help="Pairs to compare: auto, exhaustive, sequential (a film's frames) or nearest.")
    ] = "auto",
    test_every: Annotated[int, typer.Option(min=0, help="Every so many photos one is for testing; 0: none.")] = 8,
) -> None:
    """Make a posed scene of a folder of photos. Again: goes on from where it was."""
    from pipeline.ingest import ingest as make_scene
    from pipeline.launch.tasks import ray_tasks

    with ray_tasks() as mapper:
        summary = make_scene(photos, out, mapper=mapper, matching=matching, test_every=test_every)
    Console(width=None if sys.stdout.isatty() else 160).print(summary.table())
    print_line(f"{out}: a scene of {len(summary.registered)} photos; {out / 'ingest' / 'cameras.png'} shows it")
    print_line(f"crossray run jobs/train_scene_cpu.yaml --set scene.path={out} --set name={out.resolve().name}")


@app.command()
def run(
    job: Annotated[Path, typer.Argument(help="A job file, for example jobs/train_scene.yaml.")],
    settings: Settings = [],  # noqa: B006 (typer reads it once)
    launcher: Annotated[str | None, typer.Option(help="local, torchrun or ray; over the job's own.")] = None,
) -> None:
    """Run a job file: shards if they are absent, training, evaluation. Again: goes on from where it was."""
    from pipeline.study import read_kind

    if read_kind(job) == "timing":
        if launcher:
            raise CrossrayError(f"--launcher: {job} is a timing, which starts its ranks itself; leave it out")
        from pipeline.timing_job import load_timing

        print_timing(load_timing(job, settings))
        return
    from pipeline.config import load_job
    from pipeline.launch.home import go_home
    from pipeline.launch.run import run_job

    if read_kind(job) == "study":
        if launcher:
            raise CrossrayError(f"--launcher: {job} is a study, which starts its runs itself; leave it out")
        run_study_file(job, settings)
        return
    extra = [f"launcher={launcher}"] if launcher else []
    if read_kind(job) == "reeval":
        run_reeval_file(job, [*settings, *extra])
        return
    resolved = load_job(job, [*settings, *extra])
    go_home({"runs": resolved.runs, "scene.path": resolved.scene.path})
    trained, evaluated = run_job(resolved)
    if os.environ.get("RANK", "0") != "0":
        return
    state = "trained" if trained["finished"] else "stopped; run the same command again to go on"
    print_line(f"{resolved.run}: {state}, {trained['steps']} steps in {trained['train_seconds']:.0f} s")
    for result in evaluated:
        print_scores(result)
    print_line(f"TensorBoard: tensorboard --logdir {resolved.runs}")


@app.command()
def submit(
    job: Annotated[Path, typer.Argument(help="A job file, for example jobs/train_scene.yaml.")],
    settings: Settings = [],  # noqa: B006
    address: Annotated[
        str | None,
        typer.Option(metavar="URL", help="The cluster; by default RAY_API_SERVER_ADDRESS, else this machine's."),
    ] = None,
    home: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder on the cluster that relative paths are meant from; by default this one for a cluster on this "
            "machine, and else what CROSSRAY_HOME is there.",
        ),
    ] = None,
    no_wait: Annotated[bool, typer.Option("--no-wait", help="Do not follow the log.")] = False,
) -> None:
    """Run a job file on a Ray cluster and follow its log; Ctrl-C ends the following, not the job."""
    from pipeline.launch.submit import follow, how_it_ended, submit_job

    submitted = submit_job(job, settings, address, home)
    print_line(f"{submitted.id}: submitted. `{submitted.command('stop')}` stops it")
    if no_wait:
        return

    def write(text: str) -> None:
        sys.stdout.write(text)
        sys.stdout.flush()

    try:
        details = follow(submitted, write)
    except KeyboardInterrupt:
        print_line(f"\n{submitted.id}: goes on. `{submitted.command('logs --follow')}` follows it again")
        print_line(f"`{submitted.command('stop')}` stops it, with a checkpoint")
        raise
    print_line(f"{submitted.id}: {how_it_ended(details)}")
    if details.status.value != "SUCCEEDED":
        raise typer.Exit(1)


def run_study_file(file: Path, settings: list[str]) -> None:
    """Run a study and print its tables; exit status 1 if some of its runs are not done."""
    from pipeline.launch.home import go_home
    from pipeline.launch.study import run_study
    from pipeline.study import expand, load_study
    from pipeline.study_tables import as_rich, captions

    study = load_study(file, settings)
    scenes = {f"scenes.{run.scene}.scene.path": run.job.scene.path for run in expand(study)}
    go_home({"runs": study.runs, **scenes})
    tables, failures = run_study(study)
    console = Console() if sys.stdout.isatty() else Console(width=1000)  # nothing is wrapped in a file
    for table in tables:
        console.print(as_rich(table))
    for text in captions(study):
        print_line(text)
    print_line(f"{study.folder / 'table.md'}, {study.folder / 'study.json'}")
    for name, reason in failures.items():
        print_line(f"not done: {name}: {reason}")
    if failures:
        raise typer.Exit(1)


def run_reeval_file(file: Path, settings: list[str]) -> None:
    """Run a re-evaluation; exit status 1 if a single pass could not evaluate something."""
    from pipeline.launch.home import go_home
    from pipeline.launch.reeval import run_reeval
    from pipeline.reeval import load_reeval

    reeval = load_reeval(file, settings)
    for pattern in reeval.runs:
        go_home({"runs": Path(pattern)})
    summary = run_reeval(reeval)
    if summary is None:
        return
    for state, lines in (("skipped", summary.skipped), ("failed", summary.failed)):
        for line in lines:
            print_line(f"{state}: {line}")
    print_line(str(summary))
    if summary.failed:
        raise typer.Exit(1)


@app.command()
def shard(
    scene: Annotated[Path, typer.Argument(help="Folder of a posed scene.")],
    out: Annotated[Path, typer.Option(help="Folder for the shards.")],
    downscale: Annotated[int, typer.Option(min=1, help="Photos are reduced by this factor.")] = 2,
    reference_downscale: Annotated[int, typer.Option(min=1, help="The encoder's references, by this factor.")] = 8,
    drop_bad_photos: DropBadPhotos = False,
    list_patches: Annotated[
        int | None, typer.Option(metavar="EPOCH", min=0, help="Print an epoch's patch plan.")
    ] = None,
    ranks: Annotated[int, typer.Option(min=1, help="Ranks of the printed plan.")] = 1,
    settings: Settings = [],  # noqa: B006
) -> None:
    """Cut a scene into webdataset tars, as Ray tasks. Keys to set: size, photos, min_scale, max_scale, seed."""
    from pydantic import ValidationError

    from pipeline.config import explain, merge, parse_setting
    from pipeline.cutting import cut_shards
    from pipeline.launch.tasks import ray_tasks
    from pipeline.patches import PatchPlan
    from pipeline.progress import shown

    chosen: dict = {}
    for setting in settings:
        chosen = merge(chosen, parse_setting(setting))
    try:
        plan = PatchPlan(**chosen)
    except ValidationError as error:
        raise CrossrayError("\n".join(f"--set {explain(e, PatchPlan)}" for e in error.errors())) from None
    with ray_tasks() as mapper:
        manifest = cut_shards(
            scene,
            out,
            downscale=downscale,
            reference_downscale=reference_downscale,
            plan=plan,
            mapper=shown(mapper, "cutting shards"),
            on_bad_photo="drop" if drop_bad_photos else "refuse",
        )
    if list_patches is None:
        size = sum(s.bytes for s in manifest.shards) / 1e6
        print_line(f"{out}: {len(manifest.keys)} photos in {len(manifest.shards)} shards, {size:.1f} MB")
        return
    print_patches(out, plan, list_patches, ranks)


def print_patches(folder: Path, plan: object, epoch: int, ranks: int) -> None:
    """One line a patch: step, rank, photo, scale, offsets."""
    from pipeline.patches import PatchPlan
    from pipeline.patches import list_patches as rows_of
    from pipeline.photos import open_photos

    assert isinstance(plan, PatchPlan)
    photos = open_photos(folder)
    keys = [photos.records[i].key for i in photos.indices("train")]
    sys.stdout.write("step\trank\tphoto\tscale\toffset_h\toffset_w\tother\n")
    for row in rows_of(plan, keys, photos.sizes("train"), epoch, ranks):
        sys.stdout.write("\t".join(f"{v:.6f}" if isinstance(v, float) else str(v) for v in row) + "\n")


@app.command()
def mask(
    scene: Annotated[Path, typer.Argument(help="Folder of a posed scene.")],
    segmenter: Annotated[
        str, typer.Option("--with", help="deeplabv3, maskrcnn, tflite:FILE, or folder:DIR with masks made elsewhere.")
    ],
    replace: Annotated[bool, typer.Option("--replace", help="Masks that are there may be overwritten.")] = False,
    drop_bad_photos: DropBadPhotos = False,
) -> None:
    """Mask what is transient in a scene's photos with a network made elsewhere. Again: goes on from where it was."""
    from pipeline.launch.tasks import ray_tasks
    from pipeline.masks import make_masks
    from pipeline.progress import shown
    from pipeline.segmentation import find_segmenter

    found = find_segmenter(segmenter)
    with ray_tasks() as mapper:
        masked = make_masks(
            scene,
            found,
            replace=replace,
            on_bad_photo="drop" if drop_bad_photos else "refuse",
            mapper=shown(mapper, "masking photos"),
        )
    print_line(
        f"{masked.folder}: {masked.photos} photos, {100 * masked.share:.2f} % masked on average; {masked.made} made now"
    )
    print_line(
        f"crossray run jobs/train_scene_cpu.yaml --set scene.path={scene} --set name=fixed-masks "
        "--set model.transient=fixed"
    )


@app.command()
def verify(folder: Annotated[Path, typer.Argument(help="Folder of shards.")]) -> None:
    """Check every hash and every sample of a folder of shards."""
    from pipeline.shards import verify_shards

    manifest = verify_shards(folder)
    print_line(f"{folder}: {len(manifest.shards)} shards, {len(manifest.keys)} photos, all as the manifest says")


@app.command()
def evaluate(
    run: Annotated[Path, typer.Argument(help="Folder of a trained run.")],
    protocol: Annotated[
        list[str], typer.Option(help="For example crnerf-full@R4 or nerfw-half@R1+fit; may be given several times.")
    ],
    step: Annotated[int | None, typer.Option(help="Checkpoint to evaluate; the newest by default.")] = None,
) -> None:
    """Score a run on its test photos under a protocol; metrics.json and pictures go to RUN/eval."""
    from pipeline.evaluate import evaluate_protocols

    for result in evaluate_protocols(run, protocol, step):
        print_scores(result)


@app.command()
def timing(
    what: Annotated[str, typer.Argument(help="inference (seconds an image) or training (minutes of the schedule).")],
    settings: Settings = [],  # noqa: B006
) -> None:
    """Time methods on this machine, without a scene: the paper's timing tables. Keys to set: as in jobs/timing.yaml."""
    from pipeline.config import nearest
    from pipeline.timing_job import make_timing

    known = ["inference", "training"]
    if what not in known:
        raise CrossrayError(f"timing {what}: there is nothing of this name to time{nearest(what, known)}")
    print_timing(make_timing({"name": f"timing-{what}", "what": [what]}, settings, source="timing"))


@app.command()
def bake(
    run: Annotated[Path, typer.Argument(help="Folder of a trained run.")],
    appearance: Annotated[str, typer.Option(metavar="PHOTO", help="A photo of the scene, by name, or an image file.")],
    towards: Annotated[str | None, typer.Option(metavar="PHOTO", help="A second one, to go towards.")] = None,
    share: Annotated[float | None, typer.Option(help="How far, from 0 to 1; 0.5 by default.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for it; by default RUN/baked/<photo>.")] = None,
    step: Annotated[int | None, typer.Option(help="Checkpoint to bake; the newest by default.")] = None,
) -> None:
    """Fold an appearance into a trained field: the same pictures without the appearance networks."""
    from pipeline.bake import bake_run

    folder = bake_run(run, appearance, towards, share, out, step)
    print_line(f"{folder}: baked; {folder / 'preview.png'} shows it")


@app.command()
def render(
    run: Annotated[Path, typer.Argument(help="Folder of a trained run.")],
    out: Annotated[Path, typer.Option(help="Folder for PNGs, film.mp4, or path.json for the camera path alone.")],
    view: Annotated[
        str,
        typer.Option(metavar="VIEW", help="train, val, test, a photo's name, orbit, interpolate:A..B, or path.json."),
    ] = "orbit",
    appearance: Annotated[
        str | None,
        typer.Option(
            metavar="PHOTO",
            help="A photo of the scene or any image file, A..B from one to another; stills have their own by default.",
        ),
    ] = None,
    what: Annotated[str, typer.Option(help="Of rgb, depth, mask, accumulation; separated by commas.")] = "rgb",
    size: Annotated[str | None, typer.Option(help="Pixels: 640 for the longer side, or 640x480.")] = None,
    frames: Annotated[int, typer.Option(help="Of orbit and interpolate.")] = 240,
    fps: Annotated[float | None, typer.Option(help="Frames per second; 30, or what the path's file says.")] = None,
    path_format: Annotated[str, typer.Option(help="Of --out path.json: nerfstudio or nerfbaselines.")] = "nerfstudio",
    step: Annotated[int | None, typer.Option(help="Checkpoint to render; the newest by default.")] = None,
    use_ray: Annotated[bool, typer.Option("--ray", help="Spread the pictures over Ray tasks.")] = False,
) -> None:
    """Render views or a film, in an appearance of your choice. Again: goes on where it was."""
    from contextlib import nullcontext

    from pipeline.film import Order, render_film
    from pipeline.launch.tasks import in_process, one_gpu_if_any, ray_tasks
    from pipeline.progress import shown

    order = Order(view, appearance, tuple(word.strip() for word in what.split(",")), size, frames, fps, path_format)
    with ray_tasks(needs=one_gpu_if_any) if use_ray else nullcontext(in_process) as mapper:
        for path in render_film(run, out, order, shown(mapper, "rendering"), step):
            print_line(str(path))


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="Folder of a trained run.")],
    out: Annotated[Path, typer.Option(help="Folder for the files.")],
    what: Annotated[str, typer.Option(help="Of points, depth, cameras and views, with commas.")] = (
        "points,depth,cameras,views"
    ),
    appearance: Annotated[
        str | None,
        typer.Option(
            metavar="PHOTO", help="A photo of the scene, by name, or an image file; else the first training photo."
        ),
    ] = None,
    view: Annotated[
        str, typer.Option(help="Views, depth maps and cameras of: train, val, test, all, or a photo, by name.")
    ] = "test",
    points: Annotated[
        int, typer.Option(help="Rays for the point cloud at most; those that meet one sure surface give a point.")
    ] = 1_000_000,
    step: Annotated[int | None, typer.Option(help="Checkpoint to export; the newest by default.")] = None,
) -> None:
    """A point cloud, depth maps, cameras and views in one appearance, for other programs. Again: goes on."""
    from pipeline.exporting.export import export_run

    words = [word.strip() for word in what.split(",") if word.strip()]
    record = export_run(run, out, words, appearance, view, points, step)
    counts = ", ".join(f"{count} {name}" for name, count in record["counts"].items())
    print_line(f"{out}: {counts}; {out / 'README.txt'} says what is what")


@app.command()
def view(
    run: Annotated[Path, typer.Argument(help="Folder of a trained run.")],
    host: Annotated[str, typer.Option(help="Address to listen at; by default this machine's own browsers alone.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen at; 0: any free one.")] = 8080,
    size: Annotated[int, typer.Option(min=64, max=4096, help="Long side of a sharp picture, pixels.")] = 640,
    step: Annotated[int | None, typer.Option(help="Checkpoint to look at; the newest by default.")] = None,
) -> None:
    """Fly through a trained scene in a browser, in the light of any photo; record a camera path for `render`."""
    from pipeline.viewer.server import view_run

    view_run(run, host, port, size, step, say=print_line)


@app.command()
def figure(
    kind: Annotated[str, typer.Argument(help="transfer, unseen, interpolation, masks, depth or rays.")],
    run: Annotated[Path, typer.Argument(help="Folder of a trained run; for rays also of a study.")],
    out: Annotated[Path, typer.Option(help="Folder for the figure, or the name of its PNG or PDF.")],
    photos: Annotated[
        str, typer.Option(metavar="A,B,...", help="Photos of the scene, by name, or image files; chosen by default.")
    ] = "",
    views: Annotated[str, typer.Option(metavar="A,B,...", help="Views, by their photos; test views by default.")] = "",
    appearance: Annotated[
        list[str], typer.Option(metavar="FILE", help="transfer: a photo of another place, beside these; several.")
    ] = [],  # noqa: B006
    columns: Annotated[int | None, typer.Option(help="Pictures side by side, of those that are chosen.")] = None,
    step: Annotated[int | None, typer.Option(help="Checkpoint to show; the newest by default.")] = None,
) -> None:
    """A figure of the paper for a trained run, for print: PNG (300 dpi), PDF, and a record of what it shows."""
    from pipeline.figures import Order, make_figure

    def names(text: str) -> tuple[str, ...]:
        return tuple(name.strip() for name in text.split(",") if name.strip())

    files = make_figure(kind, run, out, Order(names(photos), names(views), tuple(appearance), columns, step))
    print_line(f"{files[0]}, {files[1].name}, {files[2].name}")


@app.command()
def status(
    runs: Annotated[list[Path], typer.Argument(help="Runs, or folders of runs.")] = [Path("runs")],  # noqa: B006
) -> None:
    """How runs are doing: stage, step, time left, last checkpoint and evaluation, ranks alive."""
    from pipeline.status import as_table, find_runs, status_of

    console = Console() if sys.stdout.isatty() else Console(width=1000)
    console.print(as_table([status_of(run) for run in find_runs(runs)]))


@app.command()
def tables(
    runs: Annotated[
        list[Path] | None, typer.Option(help="Folder of runs, at any depth; `runs` by default, where it exists.")
    ] = None,
    results: Annotated[
        list[Path] | None, typer.Option(help="Folder of results; `benchmarks/results` by default, where it exists.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for results.md or results.html; printed by default.")] = None,
    form: Annotated[str, typer.Option("--format", help="md or html.")] = "md",
) -> None:
    """Every table of the paper from recorded results, the published numbers beside ours; nothing is measured."""
    from pipeline.beyond_tables import all_tables
    from pipeline.config import nearest
    from pipeline.files import atomic_write
    from pipeline.page import FORMATS
    from pipeline.provenance import command
    from pipeline.results import read_results

    if form not in FORMATS:
        raise CrossrayError(f"--format {form}: there is no such format{nearest(form, list(FORMATS))}")
    usual = [[path] if path.is_dir() else [] for path in (Path("runs"), Path("benchmarks/results"))]
    found = read_results(runs or usual[0], results or usual[1])
    text = FORMATS[form](all_tables(found), command())
    if out is None:
        sys.stdout.write(text)
        return
    atomic_write(out / f"results.{form}", text)
    print_line(f"{out / f'results.{form}'}: {len(found.scores)} scores, {len(found.times)} times")


@app.command()
def compare(
    a: Annotated[Path, typer.Argument(help="Folder of a run.")],
    b: Annotated[Path, typer.Argument(help="Folder of another one.")],
) -> None:
    """Compare two runs to the bit: every step's losses, and checkpoints. Exit status 1 if anything differs."""
    from pipeline.compare import compare_runs

    found = compare_runs(a, b)
    for finding in found.findings:
        print_line(f"{'same' if finding.same else 'DIFFERS':8}{finding.text}")
    for key in found.differing_keys:
        print_line(f"        job: {key}")
    raise typer.Exit(0 if found.same else 1)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Folder of a run, of a study, or of the quick start.")],
    out: Annotated[Path | None, typer.Option(help="The page; by default report.html in the folder.")] = None,
) -> None:
    """Write one self-contained HTML page: scores, curves, pictures, appearances, masks, time, provenance."""
    from pipeline.report.make import make_report

    page = make_report(folder, out)
    print_line(f"{page}: {page.stat().st_size / 1e6:.1f} MB")


@app.command("import-checkpoint")
def import_released(
    file: Annotated[Path, typer.Argument(help="A released CR-NeRF checkpoint (.ckpt).")],
    job: Annotated[Path, typer.Argument(help="The job whose run it becomes; method: crnerf.")],
    settings: Settings = [],  # noqa: B006
) -> None:
    """Turn a released CR-NeRF checkpoint into a run, executing nothing of the file."""
    from pipeline.config import load_job
    from pipeline.importing import import_checkpoint

    resolved = load_job(job, settings)
    folder = import_checkpoint(file, resolved)
    print_line(f"{folder}: imported. crossray evaluate {folder} --protocol crnerf-full@R{resolved.scene.downscale}")


@app.command()
def methods() -> None:
    """The methods: each is a point in one design space."""
    from model.losses import loss_terms
    from model.methods import AXES, METHODS
    from pipeline.config import make_job

    table = Table("method", *AXES, title="A method is five choices", pad_edge=False)
    notes = Table(
        "method", "reproduces", "losses", "unpublished, so our choice", title="\nWhat each is", pad_edge=False
    )
    for name, method in METHODS.items():
        job = make_job({"name": name, "method": name, "scene": {"path": "."}})
        table.add_row(name, *method.axes().values())
        notes.add_row(name, method.reproduces, " ".join(loss_terms(job.model, job.losses)), method.our_choice or "-")
    Console().print(table, notes)
    print_line("Any choice can be set by itself: --set model.transient=uncertainty, --set model.field=hash, ...")


@app.command()
def schema() -> None:
    """JSON Schema of a job file, for editors."""
    from pipeline.config import Job

    sys.stdout.write(json.dumps(Job.model_json_schema(), indent=2) + "\n")


def print_scores(result: dict) -> None:
    """A protocol's means as one line, with their 95 % intervals where there are any."""
    intervals = result.get("interval", {})

    def shown(metric: str, mean: float) -> str:
        found = intervals.get(metric)
        return f"{metric.upper()} {mean:.4g}" + (f" [{found[0]:.4g}, {found[1]:.4g}]" if found else "")

    scores = "  ".join(shown(metric, mean) for metric, mean in result["mean"].items())
    print_line(f"{result['protocol']} (step {result['step']}, {len(result['images'])} photos): {scores}")


def print_timing(job: object) -> None:
    """Run a timing and print its tables."""
    from pipeline.launch.home import go_home
    from pipeline.launch.timing import run_timing
    from pipeline.timing import TIMING
    from pipeline.timing_job import TimingJob
    from pipeline.timing_table import LEGEND, tables

    assert isinstance(job, TimingJob)
    go_home({"runs": job.runs})
    rows = run_timing(job)
    if not rows:
        return
    console = Console() if sys.stdout.isatty() else Console(width=1000)  # nothing is wrapped in a file
    for table in tables(rows):
        console.print(table)
    print_line(LEGEND)
    print_line(str(job.folder / TIMING))


def print_line(text: str) -> None:
    """A line of output."""
    Console(highlight=False).print(text, soft_wrap=True, markup=False)
