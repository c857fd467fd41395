"""The table of docs/doctor.md has every sentence of the doctor, and every row of it can be brought about."""

import ast
import importlib.util
import json
import locale
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from tests.launch import synthetic_run
from tests.launch.synthetic_run import Synthetic
from tests.launch.test_doctor import PAIR, SETUPS, Story, closures_not_connecting, corrections_lost
from tests.launch.test_ground_truth import lifted, truth_of
from tests.launch.test_status import apart, pair, row

from flocc_agent.config import PerceptionConfig, TlsConfig, TransportConfig
from flocc_agent.core.reports import CAME_APART
from flocc_agent.core.tentative_joins import SECOND_PLACE
from flocc_agent.geometry import pose_from_tq, so3_exp, tq_from_pose
from flocc_agent.runtime.robot_result import ClosureKnown
from flocc_agent.runtime.trajectory import write_tum
from flocc_launch import doctor
from flocc_launch.dashboard.status_table import NO_ANSWER
from flocc_launch.doctor import Finding, Severity, cameras, diagnose, installation, network_check
from flocc_launch.doctor.live import diagnose_live
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.setup import cache
from flocc_launch.setup.credentials import make_keys

PAGE = Path(__file__).parents[2] / "docs/doctor.md"
HELD_CLOSURE = f"closure r1/3 - r2/5: {SECOND_PLACE}of 5 places where r1 and r2 would be side by side 3 do not match"
KINDS = {"well": Severity.GOOD, "blocks": Severity.BLOCKS, "hinders": Severity.HINDERS, "note": Severity.NOTE}
OF = {
    "run": ("diagnose", "steps", "held_joins", "general", "cameras", "odometry_up"),
    "swarm": ("live", "live_steps", "held_joins", "cameras"),
    "machine": ("installation", "network_check"),
}


@dataclass(frozen=True, slots=True)
class Row:
    of: str
    cause: str
    kind: Severity
    says: str

    def fits(self, finding: Finding) -> bool:
        """Whether a finding is the one of this row; `…` stands for anything, and for nothing at its end."""
        pattern = "".join(".*" if part == "…" else re.escape(part) for part in re.split("(…)", self.says))
        same = (finding.cause, finding.severity) == (self.cause, self.kind)
        return same and re.fullmatch(pattern, finding.sentence) is not None


def table() -> list[Row]:
    rows = re.findall(
        r"^\| (run|swarm|machine) \| `([\w-]+)` \| (\w+) \| [^|]+ \| ([^|]+) \|", PAGE.read_text(encoding="utf-8"), re.M
    )
    return [Row(of, cause, KINDS[kind], says) for of, cause, kind, says in rows]


ROWS = table()


def causes_in(module: str) -> set[str]:
    """Causes that the code of a module names."""
    source = Path(doctor.__path__[0]) / f"{module}.py"
    calls = [node for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    makers = ("Finding", "blocked", "good", "discovered")
    first = [call.args[0] for call in calls if isinstance(call.func, ast.Name) and call.func.id in makers and call.args]
    named = {str(cause.value) for cause in first if isinstance(cause, ast.Constant)}
    return named | ({*cameras.CAUSES.values(), cameras.OTHER_CAUSE} if module == "cameras" else set())


@pytest.mark.parametrize("of", OF)
def test_the_table_has_every_cause_of_the_code_and_no_other(of: str) -> None:
    assert set().union(*(causes_in(module) for module in OF[of])) == {each.cause for each in ROWS if each.of == of}


def test_no_module_of_the_doctor_is_forgotten() -> None:
    modules = {path.stem for path in Path(doctor.__path__[0]).glob("*.py")}
    looked_at = {module for group in OF.values() for module in group}
    assert {module for module in modules if causes_in(module)} == looked_at


def merged() -> Story:
    story = corrections_lost()
    story.frames["r2"] = "map/r1"
    return story


def unsteady() -> Story:
    story = merged()
    for k in range(8):
        story.say(16.0 + k, "r2", "leader", term=2 + k, leader=f"r{1 + k % 2}")
    return story


def hanging() -> Story:
    story = merged()
    story.closures = [ClosureKnown(**PAIR, scale=1.3)]
    return story


def held_join() -> Story:
    story = closures_not_connecting()
    return story.say(14.5, "r1", "optimised", term=1, round=4, components=[["r1"], ["r2"]], warnings=[HELD_CLOSURE])


def looking_alike(elsewhere: str = "r2/25", apart: str = "r2/8", step_m: float = -1.0) -> Story:
    """Two robots that are joined at one place and walk apart; a closure puts the first one's keyframe elsewhere."""
    story = merged()
    story.steps_m, story.keyframes = {"r1": step_m, "r2": 1.0}, {"r1": 30, "r2": 30}
    near = {"T_query_match_unscaled": [0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], "scale_initial": 1.0}
    story.closures = [
        *(ClosureKnown(query=f"r1/{k}", match=f"r2/{k + 2}", scale=1.0, **near) for k in (3, 4, 5)),
        ClosureKnown(query="r1/6", match=apart, scale=1.0, **near),
        ClosureKnown(query="r1/3", match=elsewhere, **near),
    ]
    return story


def refusing(refused: int = 7, used: int = 5) -> Story:
    counts = {"closures_used": used, "closures_rejected": refused}
    return merged().say(14.0, "r1", "optimised", term=1, round=3, components=[["r1", "r2"]], **counts)


def upright(*up: float) -> Story:
    """Two robots whose odometry frames differ by a quarter turn about z, and a direction that is called up."""
    story = merged()
    story.perception = {"odometry_up": list(up)}
    turned = {"T_query_match_unscaled": [1.0, 0.0, 0.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], "scale_initial": 1.0}
    story.closures = [ClosureKnown(query=f"r1/{k}", match=f"r2/{k}", scale=1.0, **turned) for k in range(2, 8)]
    return story


def warning(*texts: str) -> Story:
    parts = {"components": [["r1", "r2"]], "warnings": list(texts)}
    return merged().say(14.0, "r1", "optimised", term=1, round=3, **parts)


def doubting(doubt: str, amount: float, where: str = "", withheld: bool = False) -> Callable[[], Story]:
    fields = {"doubt": doubt, "amount": amount, "where": where, "pairs": 12, "withheld": withheld}
    return lambda: merged().say(14.0, "r2", "camera_doubted", **fields)


STORIES: dict[str, Callable[[], Story]] = {
    **SETUPS,
    "front-ends-differ": lambda: merged().say(14.0, "r2", "front_ends_differ", peer="r1"),
    "focal-length": doubting("focal length", 1.25),
    "camera-turned": doubting("mounting", 5.0, "5 degrees about x (right)"),
    "mirrored": doubting("mirrored", 1.0),
    "inverted-poses": doubting("inverted poses", 1.0),
    "mixed-frames": doubting("mixed frames", 1.0),
    "overlay": doubting("overlay", 0.3, "bottom"),
    "frozen-pictures": doubting("frozen", 10),
    "stands-still": doubting("standing", 10),
    "odometry-up": lambda: upright(0.0, -1.0, 0.0),
    "camera": doubting("of a later version", 2.0),
    "merged": merged,
    "places-alike": looking_alike,
    "join-held": held_join,
    "merged-doubtfully": doubting("mounting", 179.9, "180 degrees about z (forward)", withheld=True),
    "unknown": lambda: corrections_lost().say(
        13.1, "r2", "correction", term=1, round=2, map_frame="map/r2", T_map_odom=[0.0] * 3 + [0.0, 0.0, 0.0, 1.0]
    ),
    "agent-died": lambda: merged().say(13.0, "r2", "agent_died", signal=9),
    "agent-killed": lambda: merged().say(13.0, "r2", "agent_died", signal=9, scripted=True),
    "weak-link": hanging,
    "solver-warning": lambda: warning("a scale collapsed"),
    "solver-refuses": refusing,
    "came-apart": lambda: merged().say(15.0, "r2", "peer_refused", peer="r1", reason=f"shared poses: {CAME_APART}"),
    "encoding-failed": lambda: merged().say(15.0, "r2", "encoding_failed", keyframe="r2/3", reason="image is black"),
    "unsteady-leader": unsteady,
}


def of_truth(path: Path, move: bool) -> list[Finding]:
    made = Synthetic()
    folder = synthetic_run.write(path, made)
    truth = truth_of(made, "r2")
    changed = type(truth)(truth.stamps_s, lifted(truth.T_fixed_body)) if move else truth.later(-3600.0)
    write_tum(folder.path / "recordings" / "r2" / "groundtruth.tum", changed)
    return diagnose(folder)


def of_a_run(cause: str, path: Path) -> list[Finding]:
    if cause.startswith("truth"):
        return of_truth(path, move=cause == "truth-frames")
    return diagnose(STORIES[cause]().write(path))


def doubt(what: str, amount: float, withheld: bool = False) -> dict[str, object]:
    return {"doubt": what, "amount": amount, "where": "bottom", "pairs": 5, "withheld": withheld}


SWARMS = {
    "merged": [row("r1", "r2"), row("r2", "r1")],
    "no-answer": [row("r1", "r2"), row("r2", state=NO_ANSWER)],
    "duplicate-name": [row("r1", "r2"), row("r2", "r1", doubles=("r1",), map_frame="map/r2")],
    "no-peer": [row("r1"), row("r2", map_frame="map/r2")],
    "one-way-link": [row("r1", "r2 r3"), row("r2", "r3"), row("r3", "r1 r2", map_frame="map/r2")],
    "no-keyframes": [row("r1", "r2"), row("r2", "r1", keyframes=0, map_frame=None)],
    "no-leader": [row("r1", "r2", leader=None), row("r2", "r1", map_frame="map/r2")],
    "two-leaders": [row("r1", "r2"), row("r2", "r1", leader="r2", map_frame="map/r2")],
    "refused": [row("r1", "r2"), row("r2", "r1", refused={"refused unknown version": 3})],
    "came-apart": [row("r1", "r2"), row("r2", "r1", refused={f"refused shared poses: {CAME_APART}": 1})],
    "no-descriptors": apart(logs={"r1": [9, 1]}, peer_logs={"r2": [9, 1]}),
    "low-similarity": apart(best_similarities={"r2": 0.41}),
    "registrations-rejected": apart(pairs=[pair(rejected=3, best_ratio=0.21)]),
    "join-held": apart(pairs=[pair(accepted=3)], solver={"components": [["r1"], ["r2"]], "warnings": [HELD_CLOSURE]}),
    "closures-not-connecting": apart(pairs=[pair(accepted=3)], solver={"components": [["r1"], ["r2"]]}),
    "merged-doubtfully": [row("r1", "r2"), row("r2", "r1", camera=[doubt("mounting", 179.9, True)])],
    "focal-length": [row("r1", "r2", camera=[doubt("focal length", 0.8)]), row("r2", "r1")],
    "camera-turned": [row("r1", "r2", camera=[doubt("mounting", 5.0)]), row("r2", "r1")],
    "mirrored": [row("r1", "r2", camera=[doubt("mirrored", 1.0)]), row("r2", "r1")],
    "inverted-poses": [row("r1", "r2", camera=[doubt("inverted poses", 1.0)]), row("r2", "r1")],
    "mixed-frames": [row("r1", "r2", camera=[doubt("mixed frames", 1.0)]), row("r2", "r1")],
    "overlay": [row("r1", "r2", camera=[doubt("overlay", 0.3)]), row("r2", "r1")],
    "frozen-pictures": [row("r1", "r2", camera=[doubt("frozen", 10)]), row("r2", "r1")],
    "stands-still": [row("r1", "r2", camera=[doubt("standing", 10)]), row("r2", "r1")],
    "camera": [row("r1", "r2", camera=[doubt("out of focus", 1.0)]), row("r2", "r1")],
    "not-merged-yet": apart(pairs=[pair(accepted=3)]),
}


def of_a_machine(each: Row, path: Path, patch: pytest.MonkeyPatch) -> list[Finding]:
    """What the part of the doctor that is concerned says of a machine that is well, or is not."""
    well = each.kind is Severity.GOOD
    no_config = TransportConfig(interface="flocc-none", roster={})
    match each.cause:
        case "python":
            return installation.python_found()
        case "package":
            patch.setattr(installation, "import_problem", lambda module: None if well else "torn")
            return installation.packages()
        case "extra":
            patch.setattr(importlib.util, "find_spec", lambda name: None)
            return installation.packages()
        case "perception":
            patch.setattr(installation, "check_perception", lambda config: None) if well else None
            patch.setattr(installation, "methods", lambda: {"grey": "greyeyes 1.0"})
            return installation.networks(PerceptionConfig(method="grey"))
        case "torch" if not well:
            patch.setattr(installation, "import_problem", lambda module: "No module named 'torch'")
            return installation.networks(PerceptionConfig(method="mast3r"))
        case "torch":
            pytest.importorskip("torch")
            return installation.networks(PerceptionConfig(method="mast3r"))
        case "checkpoint" if not well:
            return installation.checkpoints(PerceptionConfig().mast3r)
        case "checkpoint":
            return installation.networks(PerceptionConfig())
        case "disk":
            usage = shutil.disk_usage(path)
            patch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10**10 if well else 10**8))
            return installation.disk(path)
        case "folder":
            patch.setattr(os, "access", lambda *_: False)
            return installation.surroundings(path)
        case "cache":
            patch.setenv("FLOCC_CACHE", str(path / "cache"))
            patch.setattr(cache, "can_be_written", lambda _: well)
            return installation.surroundings(path)
        case "locale":
            patch.setattr(locale, "getpreferredencoding", lambda _: "ANSI_X3.4-1968")
            return installation.surroundings(path)
        case "clock":
            return installation.clock(1.8e9 if well else 86_400.0)
        case "port":
            patch.setattr(network_check, "port_problem", lambda host, port: None if well else "Address in use")
            return network_check.ports(TransportConfig(control_listen=("tcp/127.0.0.1:7447",)))
        case "certificate":
            made = datetime(2020, 1, 1, tzinfo=UTC)
            tls = TlsConfig(folder=make_keys(path, "yard", ["r1"], now=made)["r1"])
            return network_check.configured_network(TransportConfig(tls=tls))
        case "network":
            return network_check.configured_network(no_config)
        case _:
            patch.setattr(network_check, "two_peers", lambda config, by_multicast: well)
            patch.setattr(network_check, "by_gossip", lambda config: well)
            return network_check.discovery(TransportConfig())


@pytest.mark.parametrize("each", ROWS, ids=lambda each: f"{each.of}-{each.cause}-{each.kind.name.lower()}")
def test_every_row_can_be_brought_about(each: Row, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if each.of == "run":
        found = of_a_run(each.cause, tmp_path / "run")
    elif each.of == "swarm":
        found = diagnose_live(SWARMS[each.cause])
    else:
        found = of_a_machine(each, tmp_path, monkeypatch)
    fitting = [finding for finding in found if each.fits(finding)]
    assert fitting, [finding for finding in found if finding.cause == each.cause]
    for finding in fitting:
        assert finding.sentence.endswith(".")
        assert bool(finding.advice) == (each.kind is not Severity.GOOD and each.cause != "agent-killed")


def test_every_page_that_advice_names_holds_what_it_is_named_for() -> None:
    sources = "".join(path.read_text(encoding="utf-8") for path in Path(doctor.__path__[0]).glob("*.py"))
    pages = set(re.findall(r"docs/[\w-]+\.md", sources))
    promised = {
        "docs/back-end.md": ("warnings", "scale"),
        "docs/measurements.md": ("## the kinds", "quaternion w x y z"),
    }
    assert pages == set(promised)
    for page, words in promised.items():
        text = (PAGE.parents[1] / page).read_text(encoding="utf-8").lower()
        assert [word for word in words if word not in text] == []


@pytest.mark.parametrize(("refused", "used", "told"), [(7, 5, True), (6, 6, False), (3, 0, False), (4, 3, True)])
def test_a_solver_that_refuses_most_closures_is_a_finding_of_its_own(
    refused: int, used: int, told: bool, tmp_path: Path
) -> None:
    found = [f for f in diagnose(refusing(refused, used).write(tmp_path / "run")) if f.cause == "solver-refuses"]
    assert [f.sentence for f in found] == [
        f"The solver left out {refused} of {used + refused} accepted closures."
    ] * told


def judged_run(path: Path, wrong: bool) -> RunFolder:
    """Three robots whose solver left out five closures: by ground truth these are right, or wrong."""
    made = Synthetic()
    folder = synthetic_run.write(path, made)
    closures = [closure.model_copy(update={"scale": None if k < 5 else 2.0}) for k, closure in enumerate(made.closures)]
    for k in range(5 if wrong else 0):
        T = pose_from_tq(np.array(closures[k].T_query_match_unscaled))
        T[:3, :3] = T[:3, :3] @ so3_exp(np.array([0.0, 0.0, 0.5]))
        closures[k] = closures[k].model_copy(update={"T_query_match_unscaled": [float(v) for v in tq_from_pose(T)]})
    for robot, result in folder.results().items():
        folder.write_result(result.model_copy(update={"closures": closures, "robot": robot}))
    solved = {
        "t": 500.0,
        "robot": "r1",
        "event": "optimised",
        "term": 2,
        "round": 99,
        "components": [["r1", "r2", "r3"]],
    }
    with (folder.path / "events.jsonl").open("a") as file:
        file.write(json.dumps(solved | {"closures_used": 4, "closures_rejected": 5}) + "\n")
    return folder


@pytest.mark.parametrize("wrong", [False, True])
def test_the_likely_reasons_follow_ground_truth(wrong: bool, tmp_path: Path) -> None:
    (found,) = [f for f in diagnose(judged_run(tmp_path / "run", wrong)) if f.cause == "solver-refuses"]
    right = 0 if wrong else 5
    assert (
        found.sentence
        == f"The solver left out 5 of 9 accepted closures. By ground truth {right} of 5 of these are right."
    )
    first = "places that look alike" if wrong else "the camera's intrinsics"
    assert found.advice.startswith(f"Likely reasons, in this order: {first}")


def test_warnings_that_differ_in_names_and_numbers_only_are_one(tmp_path: Path) -> None:
    alike = [f"the scale of closure r1/{k} – r2/{k} is unobservable" for k in range(6)]
    found = diagnose(warning(*alike, "a scale collapsed").write(tmp_path / "run"))
    assert [f.sentence for f in found if f.cause == "solver-warning"] == [
        "The solver warns: the scale of closure r1/0 – r2/0 is unobservable (the first of 6 such warnings).",
        "The solver warns: a scale collapsed.",
    ]


def test_a_robot_that_hangs_by_all_of_its_closures_is_not_said_to_have_more(tmp_path: Path) -> None:
    found = [f for f in diagnose(hanging().write(tmp_path / "run")) if f.cause == "weak-link"]
    assert [f.sentence for f in found] == [
        f"{robot} hangs on map/r1 by 1 closure, all that were accepted. One false closure misplaces it."
        for robot in ("r1", "r2")
    ]


def test_a_place_that_looks_like_another_is_named_with_what_shows_it(tmp_path: Path) -> None:
    first = diagnose(looking_alike().write(tmp_path / "run"))[0]
    assert first.sentence.startswith(
        "r2 hangs on map/r1 by one place only (r2/5 to r2/8), and places may look alike here: r1/3 was registered "
        "with r2/5 and with r2/25, which odometry puts 20 m apart. Do not believe where r2 is."
    )
    assert first.robots == ("r2",)


def test_a_map_that_puts_robots_side_by_side_whose_pictures_never_match_is_doubted(tmp_path: Path) -> None:
    first = diagnose(looking_alike(elsewhere="r2/6", step_m=1.0).write(tmp_path / "run"))[0]
    assert first.cause == "places-alike"
    # r2/3 to r2/9 are within two keyframes of a closure at both ends
    assert "of 30 of its keyframes that the map puts beside others', 23 match none of them." in first.sentence


@pytest.mark.parametrize(
    "story",
    [
        looking_alike(elsewhere="r2/6"),  # within reach of both closures
        looking_alike(apart="r2/29"),  # the robots met at two places
    ],
)
def test_robots_that_met_elsewhere_or_agree_are_believed(story: Story, tmp_path: Path) -> None:
    assert diagnose(story.write(tmp_path / "run"))[0].cause == "merged"


def test_a_direction_that_is_not_up_is_named_with_the_one_that_closures_leave_where_it_is(tmp_path: Path) -> None:
    (found,) = [f for f in diagnose(upright(0.0, -1.0, 0.0).write(tmp_path / "y")) if f.cause == "odometry-up"]
    assert "agreed with 0 of 6 used closures" in found.sentence
    assert "With [0, 0, 1], or its opposite, 6 agree" in found.advice
    assert not [f for f in diagnose(upright(0.0, 0.0, 2.0).write(tmp_path / "z")) if f.cause == "odometry-up"]


def test_robots_that_died_are_not_counted_among_all(tmp_path: Path) -> None:
    found = diagnose(synthetic_run.write(tmp_path / "run", Synthetic(died=("r1", 50.0))))
    assert found[0].sentence == "All 2 robots that lived to the end (without r1) are in map/r1."


def test_a_simulated_robot_has_no_log_to_read(tmp_path: Path) -> None:
    folder = STORIES["agent-died"]().write(tmp_path / "run")
    advice = [f.advice for f in diagnose(folder) if f.cause == "agent-died"]
    folder.write_run(folder.run().model_copy(update={"driver": "simulate"}))
    simulated = [f.advice for f in diagnose(folder) if f.cause == "agent-died"]
    assert ("agent.log" in advice[0], "agent.log" in simulated[0]) == (True, False)
