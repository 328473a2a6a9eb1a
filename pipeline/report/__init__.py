"""Reports: one self-contained HTML page of a run, of a study, or of the quick start.

run.py, study.py and quickstart.py say what stands on a page, in the terms of blocks.py; page.html, style.css and
page.js are how it looks. recorded.py reads a run's folder, gallery.py renders, plots.py and dots.py are the charts.
"""

from pipeline.report.overview import write_overview
from pipeline.report.quickstart import Row, write_report

__all__ = ["Row", "write_overview", "write_report"]
