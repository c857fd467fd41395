"""`flocc experiment`: settings as options, and one clear sentence with exit code 2 for what cannot be run."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.lab.experiments.toy_experiment import TOY

from flocc_agent.config import ConfigError
from flocc_lab.commands.experiments import settings_of
from flocc_lab.experiments.experiment import ExperimentError
from flocc_lab.experiments.overlap import require_overlap
from flocc_lab.experiments.registry import ALL, find
from flocc_lab.experiments.runner import run_experiment
from flocc_launch.commands.main import main
from flocc_launch.graph_files.graph_file import INDEX_BITS
from flocc_launch.graph_files.jrl import BETWEEN
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Scenario, TracksScenario
from flocc_launch.simulation.simulate import playbacks_of


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["flocc", "experiment", *arguments])
    with pytest.raises(SystemExit) as left:
        main()
    return left.value.code if isinstance(left.value.code, int) else 0


def sentence(capsys: pytest.CaptureFixture[str]) -> str:
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1, said
    return said[0]


@pytest.fixture
def two_walks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Recordings of two robots with ground truth, seen by synthetic perception."""
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    scenario = Scenario(tracks=TracksScenario(robots=2, seed=3, area_m=8.0, length_m=6.0))
    return list(recordings(scenario).values())


def test_the_list_names_every_experiment(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "list") == 0
    said = capsys.readouterr().out
    assert all(experiment.name in said for experiment in ALL)


def test_an_unknown_experiment_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, "nonsense") == 2
    assert "there is no experiment 'nonsense'; there are full-system" in sentence(capsys)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--robots", "many"], "experiment faults: robots: Input should be a valid integer"),
        (["--losses", "0,1.5,x"], "experiment faults: losses.2: Input should be a valid number"),
        (["--from", "nowhere.json"], "nowhere.json: cannot be read"),
    ],
)
def test_a_bad_setting_is_named(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "faults", "--out", str(tmp_path / "out"), *arguments) == 2
    assert said in sentence(capsys)


def test_options_come_before_the_quick_version_and_that_before_an_earlier_configuration(tmp_path: Path) -> None:
    earlier = {"experiment": "toy", "settings": {"levels": [7, 8], "waits_at": 9}}
    (tmp_path / "config.json").write_text(json.dumps(earlier), encoding="utf-8")
    settings = settings_of(TOY, {"fails_at": "4"}, quick=True, config=tmp_path / "config.json")
    assert (settings.levels, settings.waits_at, settings.fails_at) == ((1,), 9, 4)
    assert settings_of(TOY, {"levels": "4,5"}, quick=True, config=None).levels == (4, 5)


def test_the_configuration_of_another_experiment_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"experiment": "faults", "settings": {}}', encoding="utf-8")
    with pytest.raises(ConfigError, match="is no configuration of the experiment toy"):
        settings_of(TOY, {}, quick=False, config=tmp_path / "config.json")


def test_recordings_without_ground_truth_are_refused(
    two_walks: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (two_walks[1] / "groundtruth.tum").unlink()
    given = ",".join(map(str, two_walks))
    assert run(monkeypatch, "registration", "--worlds", "", "--recordings", given, "--out", str(tmp_path / "out")) == 2
    assert sentence(capsys).endswith("r2: has no ground truth, so no registration in it can be judged")


def test_robots_that_never_come_near_each_other_are_refused(
    two_walks: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = two_walks[1] / "groundtruth.tum"
    rows = np.loadtxt(path)
    rows[:, 1] += 1000.0
    np.savetxt(path, rows)
    given = ",".join(map(str, two_walks))
    assert run(monkeypatch, "registration", "--worlds", "", "--recordings", given, "--out", str(tmp_path / "out")) == 2
    assert "no two views of different robots are within 10 m of each other" in sentence(capsys)


def test_a_robot_without_truth_or_whose_way_stays_apart_is_named_before_anything_is_simulated() -> None:
    routes = {"r1": [[0, 0], [10, 0]], "r2": [[10, 0], [20, 0]], "r3": [[500, 0], [510, 0]]}
    tracks = TracksScenario.model_validate({"robots": 3, "routes_m": routes})
    playbacks = playbacks_of(Scenario(tracks=tracks), {})
    require_overlap({name: playbacks[name] for name in ("r1", "r2")}, 5.0, "scenario s")
    with pytest.raises(ExperimentError, match=r"scenario s: the way of robot r3 stays more than 5 m from the others'"):
        require_overlap(playbacks, 5.0, "scenario s")
    blind = {**playbacks, "r2": replace(playbacks["r2"], truth=None)}
    with pytest.raises(ExperimentError, match="scenario s: robot r2 has no ground truth"):
        require_overlap(blind, 5.0, "scenario s")


def two_robots() -> dict[str, Any]:
    """A JRL file of two robots that meet at their first keyframes, three keyframes each."""
    still = {"rotation": [1.0, 0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]}
    step = {**still, "translation": [1.0, 0.0, 0.0]}
    keys = {robot: [(ord(robot) << INDEX_BITS) + k for k in range(3)] for robot in "ab"}

    def between(stamp: int, first: int, second: int, value: dict[str, Any]) -> dict[str, Any]:
        factor = {"type": BETWEEN, "key1": first, "key2": second, "measurement": value}
        return {"stamp": stamp, "measurements": [{**factor, "covariance": np.eye(6).ravel().tolist()}]}

    odometry = {robot: [between(k + 1, own[k], own[k + 1], step) for k in range(2)] for robot, own in keys.items()}
    truth = {robot: [{"key": key, **still} for key in own] for robot, own in keys.items()}
    odometry["a"].append(between(0, keys["a"][0], keys["b"][0], still))
    return {"measurements": odometry, "groundtruth": truth}


@pytest.mark.parametrize(
    ("experiment", "left_out", "said"),
    [
        ("scale", "truth", "has no ground truth of robot b"),
        ("scale", "closures", "no closures join robot b to the others"),
        ("full-system", "truth", "has no ground truth of robot b"),
        ("full-system", "times", "the times of robot a do not increase"),
    ],
)
def test_a_benchmark_without_truth_or_overlap_is_refused_before_any_cell(
    experiment: str,
    left_out: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    graph = two_robots()
    if left_out == "truth":
        del graph["groundtruth"]["b"]
    elif left_out == "closures":
        del graph["measurements"]["a"][-1]
    else:
        graph["measurements"]["a"][0]["stamp"] = 5
    (tmp_path / "cosmo_bench" / "wifi").mkdir(parents=True)
    (tmp_path / "cosmo_bench" / "wifi" / "small.jrl").write_text(json.dumps(graph), encoding="utf-8")
    out = tmp_path / "out"
    given = ["--data", str(tmp_path), "--sources", "cosmo-wifi", "--out", str(out)]
    assert run(monkeypatch, experiment, *given) == 2
    assert said in sentence(capsys)
    assert not (out / "rows.jsonl").exists()


def test_pictures_that_are_missing_are_told_before_any_cell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--data", str(tmp_path), "--sources", "sevenscenes", "--out", str(tmp_path / "out")]
    assert run(monkeypatch, "full-system", *given) == 2
    assert sentence(capsys).endswith("sevenscenes: does not exist")


def test_a_checkpoint_of_another_model_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    torch = pytest.importorskip("torch", reason="torch, an optional extra, is not installed")
    from flocc_launch.setup.weight_files import synthesize

    paths = synthesize(tmp_path / "weights")
    torch.save({"model": {"some.layer": torch.zeros(3)}, "args": None}, paths["mast3r"])
    config = tmp_path / "agent.toml"
    config.write_text(
        'name = "r1"\n[perception]\nmethod = "mast3r"\n[perception.mast3r]\nnetwork = "tiny"\n'
        f'weights = "{paths["mast3r"]}"\nplace_weights = "{paths["cosplace"]}"\n',
        encoding="utf-8",
    )
    out = tmp_path / "out"
    assert run(monkeypatch, "registration", "--quick", "--perception", str(config), "--out", str(out)) == 2
    assert str(paths["mast3r"]) in sentence(capsys)
    assert not (out / "rows.jsonl").exists()


@pytest.mark.parametrize(
    "name", ["full-system", "registration", "scale", "split-compute", "sparse-keyframes", "faults", "bandwidth"]
)
def test_the_smallest_version_of_each_experiment_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    if name in ("split-compute", "bandwidth"):
        pytest.importorskip("torch", reason="torch, an optional extra, is not installed")
    experiment = find(name)
    settings = experiment.settings.model_validate(experiment.quick)
    result = run_experiment(experiment, settings, 1, tmp_path / "out")
    assert result.errors == []
    assert len(result.rows) == result.cells > 0
    assert result.summary.table
    assert {f"{name}.{kind}" for kind in ("csv", "md", "png", "svg")} <= {
        path.name for path in (tmp_path / "out").iterdir()
    }
