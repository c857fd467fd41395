"""Experiments: what is finished is kept, resumed, never mixed, and marked partial until all is there."""

import ast
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from tests.lab.experiments.toy_experiment import TOY, ToySettings

from flocc_lab.experiments import outputs
from flocc_lab.experiments.experiment import ExperimentError
from flocc_lab.experiments.outputs import markdown_table
from flocc_lab.experiments.runner import Interrupted, Result, processes_of, run_experiment

pytestmark = pytest.mark.usefixtures("without_figures")
ROOT = Path(__file__).resolve().parents[3]
START_S = 60.0


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures take a second each; `test_experiment_cli` draws those of every experiment."""
    monkeypatch.setattr(outputs, "write_figures", lambda *_: None)


def run(out: Path, processes: int = 1, seed: int = 5, **settings: Any) -> Result:
    return run_experiment(TOY, ToySettings(**settings), seed, out, processes)


def rows(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "rows.jsonl").read_text(encoding="utf-8").splitlines()]


def config(out: Path) -> dict[str, Any]:
    read: dict[str, Any] = json.loads((out / "config.json").read_text(encoding="utf-8"))
    return read


def test_an_experiment_leaves_rows_tables_findings_and_its_configuration(tmp_path: Path) -> None:
    run(tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"config.json", "rows.jsonl", "findings.json", "toy.csv", "toy.md"}
    assert [(row["cell"], row["height"], row["missing"]) for row in rows(tmp_path / "out")] == [
        ("level=1 run=0", 15.0, None),
        ("level=2 run=0", 25.0, None),
        ("level=3 run=0", 35.0, None),
    ]
    assert (tmp_path / "out" / "toy.csv").read_text(encoding="utf-8").splitlines() == [
        "level,height", "1,15.0", "2,25.0", "3,35.0",
    ]  # fmt: skip
    page = (tmp_path / "out" / "toy.md").read_text(encoding="utf-8")
    assert "**confirmed**: it rises (Sec. 0). 3 rows." in page
    assert "artial" not in page
    written = config(tmp_path / "out")
    assert (written["experiment"], written["seed"], written["state"]) == ("toy", 5, "finished")
    assert written["settings"] == ToySettings().model_dump(mode="json")


def test_several_processes_give_the_same_table_as_one(tmp_path: Path) -> None:
    run(tmp_path / "one")
    run(tmp_path / "two", processes=2)
    tables = [(tmp_path / name / "toy.csv").read_text(encoding="utf-8") for name in ("one", "two")]
    assert tables[0] == tables[1]


def test_an_interrupted_experiment_keeps_its_rows_marked_partial_and_goes_on(tmp_path: Path) -> None:
    with pytest.raises(Interrupted, match="interrupted, 2 of 3 cells are kept; the same command goes on"):
        run(tmp_path, interrupted_at=3)
    assert config(tmp_path)["state"] == "partial"
    assert "**Partial: 2 of 3 cells.**" in (tmp_path / "toy.md").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "findings.json").read_text(encoding="utf-8"))["partial"] == "partial: 2 of 3 cells"
    before = rows(tmp_path)
    with pytest.raises(Interrupted):
        run(tmp_path, interrupted_at=3)
    assert rows(tmp_path) == before


def test_the_folder_says_after_every_cell_how_far_it_is(tmp_path: Path) -> None:
    said = []
    run_experiment(TOY, ToySettings(), 5, tmp_path, on_row=lambda *_: said.append(config(tmp_path)))
    assert [(state["state"], state["done"], state["cells"]) for state in said] == [
        ("partial", 1, 3),
        ("partial", 2, 3),
        ("finished", 3, 3),
    ]


def test_a_finished_cell_is_not_measured_again(tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        run(tmp_path, interrupted_at=2)
    told = config(tmp_path)
    told["settings"]["interrupted_at"] = None
    (tmp_path / "config.json").write_text(json.dumps(told), encoding="utf-8")
    first = rows(tmp_path)
    assert len(run(tmp_path).rows) == 3
    assert rows(tmp_path)[:1] == first
    assert len(rows(tmp_path)) == 3
    assert config(tmp_path)["state"] == "finished"


def none_is_left() -> bool:
    """Whether all children end; of two threads that reap one, the later sees it alive for a moment."""
    deadline_s = time.monotonic() + START_S
    while (children := multiprocessing.active_children()) and time.monotonic() < deadline_s:
        children[0].join(0.1)
    return not multiprocessing.active_children()


def test_ctrl_c_while_a_row_is_told_ends_the_cells_that_run_in_other_processes(tmp_path: Path) -> None:
    def interrupt(_row: object, _done: int, _all: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(Interrupted) as interrupted:
        run_experiment(TOY, ToySettings(waits_at=2), 5, tmp_path / "out", 2, interrupt)
    assert none_is_left()
    assert "1 of 3 cells are kept" in str(interrupted.value)  # whose traceback still holds all that was under way


def test_ctrl_c_ends_the_cells_that_run_in_other_processes(tmp_path: Path) -> None:
    out = tmp_path / "out"
    code = (
        "from pathlib import Path; from tests.lab.experiments.toy_experiment import *;"
        "from flocc_lab.experiments.runner import run_experiment\n"
        "import signal\n"
        "if __name__ == '__main__':\n"
        "    signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # whatever started the tests may ignore it
        "    try: run_experiment(TOY, ToySettings(waits_at=2), 5, Path(__import__('sys').argv[1]), 2)\n"
        "    except Exception as error: print(error)\n"
    )
    script = tmp_path / "script.py"
    script.write_text(code, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(script), str(out)]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, start_new_session=True) as child:
        deadline_s = time.monotonic() + START_S
        while not (out / "rows.jsonl").exists() or len(rows(out)) < 2:
            assert child.poll() is None
            assert time.monotonic() < deadline_s, "no row in time"
            time.sleep(0.05)
        os.killpg(child.pid, signal.SIGINT)
        said, _ = child.communicate(timeout=START_S)
    assert "2 of 3 cells are kept" in said
    assert {row["cell"] for row in rows(out)} == {"level=1 run=0", "level=3 run=0"}


@pytest.mark.parametrize(
    ("seed", "settings", "said"),
    [
        (6, {}, "seed is 5 there and 6 now"),
        (5, {"levels": (1, 2)}, r"settings.levels is \[1, 2, 3\] there and \[1, 2\] now"),
    ],
)
def test_rows_of_another_configuration_are_never_mixed_in(
    seed: int, settings: dict[str, Any], said: str, tmp_path: Path
) -> None:
    run(tmp_path)
    with pytest.raises(ExperimentError, match=said):
        run(tmp_path, seed=seed, **settings)


def test_a_folder_that_is_no_experiment_is_left_alone(tmp_path: Path) -> None:
    precious = tmp_path / "toy.md"
    precious.write_text("three years of work", encoding="utf-8")
    with pytest.raises(ExperimentError, match="holds something that is no experiment"):
        run(tmp_path)
    assert precious.read_text(encoding="utf-8") == "three years of work"


def test_an_error_in_one_cell_stands_in_its_row_and_the_others_go_on(tmp_path: Path) -> None:
    result = run(tmp_path, fails_at=2)
    assert result.errors == ["level=2 run=0: ZeroDivisionError: the cell has a bug"]
    assert [row["level"] for row in result.summary.table] == [1, 3]
    page = (tmp_path / "toy.md").read_text(encoding="utf-8")
    assert "**Partial: 2 of 3 cells.**" in page
    assert "the cell has a bug" in page
    assert config(tmp_path)["failed"] == 1


def test_a_cell_that_failed_is_tried_again(tmp_path: Path) -> None:
    run(tmp_path, fails_at=2)
    run(tmp_path, fails_at=2)
    assert [row["level"] for row in rows(tmp_path)] == [1, 2, 3, 2]


def test_an_experiment_of_which_every_cell_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match="every cell failed; level=1 run=0: ZeroDivisionError"):
        run(tmp_path, levels=(1,), fails_at=1)


def test_a_row_that_was_cut_off_by_a_crash_is_measured_again(tmp_path: Path) -> None:
    run(tmp_path)
    path = tmp_path / "rows.jsonl"
    path.write_bytes(path.read_bytes()[:-20])
    run(tmp_path)
    assert [row["level"] for row in rows(tmp_path)] == [1, 2, 3]


def test_times_are_measured_one_after_the_other_and_processes_are_bounded_by_cores() -> None:
    cores = os.cpu_count() or 1
    assert processes_of(TOY, None) == cores
    assert processes_of(TOY, 10_000) == cores


def test_a_table_for_people_rounds_and_says_what_is_not_known() -> None:
    table = [{"a": 0.123456, "b": None, "c": True, "d": 123456.7}]
    assert markdown_table(table).splitlines()[-1] == "| 0.1235 | n/a | yes | 123457 |"


def test_without_matplotlib_all_but_the_figure_is_written_and_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr(outputs, "write_figures", lambda *_: pytest.fail("drawn without matplotlib"))
    run(tmp_path / "toy")
    assert {"toy.csv", "toy.md", "findings.json"} <= {path.name for path in (tmp_path / "toy").iterdir()}
    assert "pip install '.[figures]'" in caplog.text


def test_findings_cite_the_paper_or_a_page_that_exists() -> None:
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "lab/flocc_lab/experiments").glob("*.py")]
    calls = [node for text in sources for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    made = [call for call in calls if getattr(call.func, "id", "") in ("judged", "ExperimentFinding")]
    given = [call.args[1] for call in made if len(call.args) > 1]
    cited = {str(source.value) for source in given if isinstance(source, ast.Constant)}
    assert len(cited) > 3
    pages = {source.split(",")[0]: source for source in cited if not source.startswith(("Sec. ", "Fig. ", "Eq. "))}
    for page, source in pages.items():
        assert f"## {source.split(', ')[1]}" in (ROOT / page).read_text(encoding="utf-8"), source
