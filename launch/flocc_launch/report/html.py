"""report.html: one file that explains a run to a person; no script, nothing fetched from elsewhere."""

from importlib.resources import files
from pathlib import Path

from flocc_launch.report import section_accounts, section_pictures, sections
from flocc_launch.report.album import EMPTY, Album
from flocc_launch.report.model import RunReport
from flocc_launch.report.svg import element, text_of
from flocc_launch.report.verdict import verdict
from flocc_launch.runs.loaded_run import LoadedRun
from flocc_launch.runs.plain_numbers import unbroken


def write_html(path: Path, report: RunReport, loaded: LoadedRun, album: Album = EMPTY) -> None:
    """Write report.html."""
    path.write_text(page(report, loaded, album), encoding="utf-8")


def page(report: RunReport, loaded: LoadedRun, album: Album = EMPTY) -> str:
    """The whole page: the verdict first, then what it rests on."""
    body = element(
        "main",
        sections.kicker(report),
        element("h1", text_of(unbroken(verdict(report)))),
        sections.tiles(report),
        sections.findings(loaded),
        sections.expectations(report),
        sections.warnings(report),
        sections.trajectories(report, loaded, album),
        section_pictures.way_strips(report, album),
        sections.over_time(report, loaded),
        sections.closures(report, loaded),
        section_pictures.gallery(album),
        sections.network(report),
        section_accounts.links(report),
        section_accounts.stages(report),
        sections.robots(report),
        sections.settings(report, loaded),
        sections.footer(report),
    )
    head = element("meta", charset="utf-8").removesuffix("</meta>")
    head += '<meta name="viewport" content="width=device-width, initial-scale=1">'
    head += element("title", text_of(f"flocc: {report.scenario}"))
    head += element("style", files("flocc_launch.report").joinpath("page.css").read_text(encoding="utf-8"))
    return "<!doctype html>\n" + element("html", element("head", head), element("body", body), lang="en") + "\n"
