"""report.html."""

from pathlib import Path

from flocc_launch.report.load import LoadedRun
from flocc_launch.report.model import Report


def write_html(path: Path, report: Report, loaded: LoadedRun) -> None:
    """Write report.html."""
    path.write_text(f"<!doctype html><title>{report.scenario}</title>{loaded.end_s}", encoding="utf-8")
