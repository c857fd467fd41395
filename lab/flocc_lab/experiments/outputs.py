"""Tables, figures and findings of an experiment, for people and for other programs.

    NAME.csv, NAME.md     the table; the Markdown also says how it came about, and holds notes and findings
    NAME.png, NAME.svg    the figure
    findings.json         the paper's claims, each with a verdict and the numbers

All of them say where they are partial.
"""

import csv
import json
import logging
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from flocc_agent.extras import to_install
from flocc_lab.experiments.experiment import Experiment, Row, S, Settings, Summary
from flocc_lab.experiments.folder import ExperimentFolder
from flocc_launch.runs.run_folder import write_json

FIGURE_INCHES = (8.0, 4.5)
DOTS_PER_INCH = 150
logger = logging.getLogger(__name__)

HOW = to_install("figures")
STYLE: Any = {
    "font.size": 10,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.hashsalt": "flocc",
    "figure.constrained_layout.use": True,
}


def can_draw() -> bool:
    """Whether figures can be drawn; tables and findings need no matplotlib. Where not, that is said."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        logger.warning("without figures, which need matplotlib: %s, and the same command again draws them", HOW)
        return False
    return True


def write_outputs(
    experiment: Experiment[S],
    settings: S,
    folder: ExperimentFolder,
    summary: Summary,
    rows: Sequence[Row],
    cells: int,
) -> None:
    """Write everything that is made of the rows."""
    path, name = folder.path, experiment.name
    good = [row for row in rows if row["error"] is None]
    partial = None if len(good) == cells else f"partial: {len(good)} of {cells} cells"
    write_csv(path / f"{name}.csv", summary.table)
    text = markdown(experiment.title, folder.configuration, settings, summary, rows, partial)
    (path / f"{name}.md").write_text(text, encoding="utf-8")
    findings = [{**asdict(finding), "verdict": finding.verdict.value} for finding in summary.findings]
    write_json(path / "findings.json", {"partial": partial, "findings": findings})
    if good and can_draw():
        write_figures(path / name, experiment, settings, good, partial)


def write_csv(path: Path, table: Sequence[Row]) -> None:
    """Write a table with full precision; what is not known is empty."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]) if table else [])
        writer.writeheader()
        writer.writerows(table)


def write_figures(stem: Path, experiment: Experiment[S], settings: S, rows: Sequence[Row], partial: str | None) -> None:
    """Draw the rows into STEM.png and STEM.svg."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=FIGURE_INCHES)
        FigureCanvasAgg(figure)
        experiment.draw(figure, settings, rows)
        if partial:
            figure.suptitle(partial, color="#b00020")
        figure.savefig(stem.with_suffix(".png"), dpi=DOTS_PER_INCH, metadata={"Software": None})
        figure.savefig(stem.with_suffix(".svg"), metadata={"Date": None})


def markdown(
    title: str,
    configuration: dict[str, Any],
    settings: Settings,
    summary: Summary,
    rows: Sequence[Row],
    partial: str | None,
) -> str:
    """The whole result as one page."""
    name, seed = configuration["experiment"], configuration["seed"]
    changed = settings.model_dump(mode="json", exclude_defaults=True)
    errors = [f"- `{row['cell']}`: {row['error']}" for row in rows if row["error"] is not None]
    parts = [
        f"# {name}: {title}",
        f"**{partial[0].upper()}{partial[1:]}.**" if partial else "",
        f"flocc {configuration['flocc_version']}, seed {seed}, {configuration['machine']['cpu']}; "
        f"settings that differ from the defaults: `{json.dumps(changed)}`.",
        markdown_table(summary.table),
        f"![{title}]({name}.png)",
        "\n".join(f"- {note}" for note in summary.notes),
        "## Findings" if summary.findings else "",
        *(
            f"- **{finding.verdict.value}**: {finding.claim} ({finding.source}). {finding.numbers}"
            for finding in summary.findings
        ),
        "## Cells that failed\n\n" + "\n".join(errors) if errors else "",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def markdown_table(table: Sequence[Row]) -> str:
    """Rows as a Markdown table, numbers rounded for reading."""
    if not table:
        return ""
    lines = [list(table[0]), ["---"] * len(table[0]), *([shown(value) for value in row.values()] for row in table)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def shown(value: Any) -> str:
    """A value for people: four significant digits, n/a for what is not known."""
    if value is None:
        return "n/a"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 10_000 else f"{value:.4g}"
    return str(value).replace("|", "\\|")
