"""`crossray report`: finds out what a folder is, and writes its page."""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import CrossrayError
from pipeline.quickstart import report_again
from pipeline.report.run import write_run_report
from pipeline.report.study import REPORT, write_study_report


def make_report(folder: Path, out: Path | None = None) -> Path:
    """The report of a run's, a study's or the quick start's folder, as `out` or as report.html in the folder; returns
    its path.

    Raises:
        CrossrayError: the folder is none of these, or its files are damaged; or `out` is a folder.
    """
    kinds = {"job.yaml": write_run_report, "study.json": write_study_report, "summary.json": report_again}
    if out is not None and out.is_dir():
        raise CrossrayError(f"--out: {out} is a folder; name a file, for example {out / REPORT}")
    for name, write in kinds.items():
        if (folder / name).is_file():
            return write(folder, out or folder / REPORT)
    what = "has no job.yaml (a run), study.json (a study) or summary.json (the quick start)"
    raise CrossrayError(f"{folder}: {what if folder.is_dir() else 'is not there'}; `crossray status` lists runs")
