"""The doctor names the right cause in each of its broken set-ups, and sends nobody after a wrong one."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel
from tests.launch import synthetic_run
from tests.launch.synthetic_run import Synthetic

from flocc_agent.core.reports import WITHHELD
from flocc_agent.runtime.robot_result import ClosureKnown, KeyframeResult, RobotResult
from flocc_launch.doctor import Finding, Severity, diagnose, finding_lines
from flocc_launch.report.build import build
from flocc_launch.report.verdict import verdict
from flocc_launch.runs.loaded_run import load
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.runs.run_records import Run
from flocc_launch.scenarios.scenario import Scenario

IDENTITY = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
PAIR = {"query": "r1/3", "match": "r2/5"}
SETTINGS = {
    "core": {
        "place_recognition": {"similarity_threshold": 0.1},
        "loop_closing": {"match_ratio_threshold": 0.3},
    }
}


@dataclass
class Story:
    """Two robots that merge, if nothing is changed; each set-up breaks one thing."""

    events: list[dict[str, Any]] = field(default_factory=list)
    keyframes: dict[str, int] = field(default_factory=lambda: {"r1": 10, "r2": 10})
    frames: dict[str, str | None] = field(default_factory=lambda: {"r1": "map/r1", "r2": "map/r2"})
    logs: dict[str, dict[str, int]] = field(default_factory=lambda: {r: {"r1": 11, "r2": 10} for r in ("r1", "r2")})
    closures: list[ClosureKnown] = field(default_factory=list)
    best_similarities: dict[str, float] = field(default_factory=dict)
    left_no_result: set[str] = field(default_factory=set)
    radio: dict[str, Any] = field(default_factory=dict)
    steps_m: dict[str, float] = field(default_factory=lambda: {"r1": 0.0, "r2": 0.0})
    perception: dict[str, Any] = field(default_factory=dict)

    def say(self, t: float, robot: str, event: str, **fields: Any) -> "Story":
        self.events.append({"t": t, "robot": robot, "event": event, **fields})
        return self

    def without(self, *kinds: str) -> "Story":
        self.events = [event for event in self.events if event["event"] not in kinds]
        return self

    def write(self, path: Path) -> RunFolder:
        folder = RunFolder.create(path)
        about = {"settings": SETTINGS, "radio": self.radio, "perception": self.perception}
        folder.write_run(Run(scenario="broken", robots=["r1", "r2"], **about))
        folder.write_events(self.events)
        for robot in {"r1", "r2"} - self.left_no_result:
            folder.write_result(self.result(robot))
        return folder

    def result(self, robot: str) -> RobotResult:
        keyframes = [
            KeyframeResult(index=i, stamp_s=float(i), T_odom_body=[self.steps_m[robot] * i, *IDENTITY[1:]])
            for i in range(self.keyframes[robot])
        ]
        return RobotResult(
            robot=robot,
            map_frame=self.frames[robot],
            T_map_odom=IDENTITY,
            keyframes=keyframes,
            closures=self.closures,
            logs=self.logs[robot],
            best_similarities=self.best_similarities if robot == "r1" else {},
        )


def healthy() -> Story:
    """Everything that happens until two robots are joined, but for the last correction."""
    story = Story()
    for robot, peer in (("r1", "r2"), ("r2", "r1")):
        story.say(1.0, robot, "neighbour_up", peer=peer)
        story.say(2.0, robot, "leader", term=1, leader="r1")
        story.say(6.0, robot, "correction", term=1, round=1, map_frame=f"map/{robot}", T_map_odom=IDENTITY)
    story.say(5.0, "r1", "optimised", term=1, round=1, components=[["r1"], ["r2"]], closures_used=0)
    story.say(9.0, "r1", "candidate", **PAIR, similarity=0.8)
    story.say(10.0, "r1", "closure_accepted", **PAIR, **accepted())
    story.say(12.0, "r1", "optimised", term=1, round=2, components=[["r1", "r2"]], closures_used=1)
    return story.say(30.0, "r1", "bytes", sent={}, received={})


def accepted() -> dict[str, Any]:
    return {"ratio": 0.9, "probability": 0.4, "correspondences": 90, "odometry_correspondences": 100, "by": "r1"}


def no_keyframes() -> Story:
    story = healthy().without("candidate", "closure_accepted")
    story.keyframes["r2"] = 0
    return story


def no_peer() -> Story:
    story = healthy().without("neighbour_up", "candidate", "closure_accepted")
    story.logs = {"r1": {"r1": 10}, "r2": {"r2": 10}}
    return story


def refused() -> Story:
    return no_peer().say(1.0, "r1", "peer_refused", peer="r2", reason="speaks protocol version 9")


def duplicate_name() -> Story:
    return no_peer().say(1.0, "r1", "duplicate_name", peer="r2", reason="two robots run with this name")


def one_way_link() -> Story:
    return no_peer().say(1.0, "r1", "neighbour_up", peer="r2")


def no_descriptors() -> Story:
    story = no_peer()
    for robot, peer in (("r1", "r2"), ("r2", "r1")):
        story.say(1.0, robot, "neighbour_up", peer=peer).say(3.5, robot, "neighbour_down", peer=peer)
    return story


def low_similarity() -> Story:
    story = healthy().without("candidate", "closure_accepted")
    story.best_similarities = {"r2": 0.07}
    return story


def latents() -> Story:
    failure = {"keyframe": "r2/5", "holder": "r2", "reason": "no answer in 10 s"}
    return healthy().without("closure_accepted").say(20.0, "r1", "latent_failed", **failure)


def not_registered() -> Story:
    return healthy().without("closure_accepted")


def registrations_rejected() -> Story:
    story = healthy().without("closure_accepted")
    story.say(11.0, "r1", "closure_rejected", **PAIR, ratio=0.21, reason="match ratio too low")
    return story.say(
        12.0, "r1", "closure_rejected", query="r1/4", match="r2/7", ratio=0.05, reason="few correspondences"
    )


def no_leader() -> Story:
    return healthy().without("leader", "optimised", "correction")


def leader_silent() -> Story:
    story = healthy()
    story.events = [e for e in story.events if not (e["event"] == "optimised" and e["round"] == 2)]
    for event in story.events:
        event.update({"leader": "server"} if event["event"] == "leader" else {})
    return story.say(10.5, "server", "agent_died", signal=9)


def solver_failed() -> Story:
    story = healthy()
    story.events = [e for e in story.events if not (e["event"] == "optimised" and e["round"] == 2)]
    return story.say(12.0, "r1", "optimisation_failed", term="1:r1", round=2, reason="the system is singular")


def closures_not_connecting() -> Story:
    parts = {"components": [["r1"], ["r2"]], "closures_used": 0, "closures_rejected": 1}
    return healthy().say(14.0, "r1", "optimised", term=1, round=3, **parts)


def corrections_lost() -> Story:
    return healthy().say(13.0, "r1", "correction", term=1, round=2, map_frame="map/r1", T_map_odom=IDENTITY)


SETUPS: dict[str, Callable[[], Story]] = {
    "no-keyframes": no_keyframes,
    "no-peer": no_peer,
    "refused": refused,
    "duplicate-name": duplicate_name,
    "one-way-link": one_way_link,
    "no-descriptors": no_descriptors,
    "low-similarity": low_similarity,
    "latents": latents,
    "not-registered": not_registered,
    "registrations-rejected": registrations_rejected,
    "no-leader": no_leader,
    "leader-silent": leader_silent,
    "solver-failed": solver_failed,
    "closures-not-connecting": closures_not_connecting,
    "corrections-lost": corrections_lost,
}


def blocking(folder: RunFolder) -> list[Finding]:
    return [finding for finding in diagnose(folder) if finding.severity is Severity.BLOCKS]


@pytest.mark.parametrize("cause", SETUPS)
def test_the_doctor_names_the_cause_and_only_it(tmp_path: Path, cause: str) -> None:
    assert [finding.cause for finding in blocking(SETUPS[cause]().write(tmp_path / "run"))] == [cause]


@pytest.mark.parametrize("cause", SETUPS)
def test_every_finding_says_what_to_change(tmp_path: Path, cause: str) -> None:
    (finding,) = blocking(SETUPS[cause]().write(tmp_path / "run"))
    assert finding.sentence.endswith(".")
    assert finding.advice.endswith(".")
    assert {"r1", "r2"} >= set(finding.robots) != set()


@pytest.mark.parametrize("cause", SETUPS)
def test_every_setting_that_the_doctor_names_exists(tmp_path: Path, cause: str) -> None:
    (finding,) = blocking(SETUPS[cause]().write(tmp_path / "run"))
    for name in re.findall(r"\b(?:core|keyframes|backend|perception)(?:\.\w+)+", finding.advice):
        assert name in set(settings_of(Scenario, "")), name


def settings_of(section: Any, above: str) -> Iterator[str]:
    fields = section.model_fields if issubclass(section, BaseModel) else section.__dataclass_fields__
    for name, described in fields.items():
        yield f"{above}{name}"
        kind = described.annotation if issubclass(section, BaseModel) else described.type
        if isinstance(kind, type) and (issubclass(kind, BaseModel) or hasattr(kind, "__dataclass_fields__")):
            yield from settings_of(kind, f"{above}{name}.")


@pytest.mark.parametrize("cause", ["no-peer", "one-way-link"])
def test_robots_that_an_emulated_radio_keeps_apart_are_not_sent_to_the_network(tmp_path: Path, cause: str) -> None:
    """`run.json` has null where a partition never ends."""
    story = SETUPS[cause]()
    story.radio = {"range_m": 12.0, "partitions": [{"groups": [["r1"], ["r2"]], "from_s": 3.0, "to_s": None}]}
    (finding,) = blocking(story.write(tmp_path / "emulated"))
    assert finding.cause == cause
    assert "The emulated radio may be why (a range of 12 m, partitions)" in finding.advice
    story.radio = {"of a later version": 1}
    (finding,) = blocking(story.write(tmp_path / "later"))
    assert "emulated" not in finding.advice


def test_the_figures_that_show_it_stand_in_the_sentence(tmp_path: Path) -> None:
    (rejected,) = blocking(registrations_rejected().write(tmp_path / "rejected"))
    assert "r1/3 – r2/5: 0.210, r1/4 – r2/7: 0.0500" in rejected.sentence
    assert "below R_thr 0.3" in rejected.sentence
    (similar,) = blocking(low_similarity().write(tmp_path / "similar"))
    assert "below the threshold of 0.1, the best was 0.07" in similar.sentence
    (silent,) = blocking(leader_silent().write(tmp_path / "silent"))
    assert silent.sentence.startswith("The leader server died: nothing was optimised after the first closure")
    cut = leader_silent()
    cut.events = [e for e in cut.events if e["event"] != "agent_died"]
    (ended,) = blocking(cut.say(12.0, "server", "agent_stopped").write(tmp_path / "cut"))
    assert ended.sentence.startswith("The leader server was stopped at 12.0 s: nothing was optimised")
    assert ended.advice == "Let the run go on: it ended before a round."
    (latent,) = blocking(latents().write(tmp_path / "latent"))
    assert "no answer in 10 s" in latent.sentence


def test_a_merged_run_is_said_to_be_well(tmp_path: Path) -> None:
    story = corrections_lost()
    story.frames["r2"] = "map/r1"
    assert [(f.cause, f.sentence) for f in diagnose(story.write(tmp_path / "run"))] == [
        ("merged", "All 2 robots are in map/r1.")
    ]


def test_a_dead_robot_is_named_and_the_others_are_well(tmp_path: Path) -> None:
    findings = diagnose(synthetic_run.write(tmp_path / "run", Synthetic(died=("r1", 50.0))))
    assert [finding.cause for finding in findings][:2] == ["merged", "agent-died"]
    assert findings[1].robots == ("r1",)


def test_robots_that_do_not_merge_though_all_is_there_are_not_explained_away(tmp_path: Path) -> None:
    story = corrections_lost().say(13.1, "r2", "correction", term=1, round=2, map_frame="map/r2", T_map_odom=IDENTITY)
    assert [finding.cause for finding in blocking(story.write(tmp_path / "run"))] == ["unknown"]


def test_warnings_failures_and_restless_leaders_are_told(tmp_path: Path) -> None:
    story = corrections_lost()
    story.frames["r2"] = "map/r1"
    story.say(14.0, "r1", "optimised", term=1, round=3, components=[["r1", "r2"]], warnings=["a scale collapsed"])
    story.say(15.0, "r2", "encoding_failed", keyframe="r2/3", reason="image is black")
    for k in range(8):
        story.say(16.0 + k, "r2", "leader", term=2 + k, leader=f"r{1 + k % 2}")
    findings = diagnose(story.write(tmp_path / "run"))
    assert [finding.cause for finding in findings] == ["merged", "solver-warning", "encoding-failed", "unsteady-leader"]
    assert "a scale collapsed" in findings[1].sentence


def test_a_camera_that_does_not_fit_is_named_with_its_latest_figure(tmp_path: Path) -> None:
    story = corrections_lost()
    story.frames["r2"] = "map/r1"
    for t, amount in ((14.0, 1.4), (15.0, 1.5)):
        story.say(t, "r2", "camera_doubted", doubt="focal length", amount=amount, where="", pairs=10)
    story.say(16.0, "r1", "camera_doubted", doubt="mounting", amount=90.0, where="90 degrees about x", pairs=12)
    story.say(17.0, "r1", "camera_doubted", doubt="overlay", amount=0.3, where="bottom", pairs=5)
    story.say(18.0, "r1", "camera_doubted", doubt="of a later version", amount=2.0, where="", pairs=5)
    folder = story.write(tmp_path / "run")
    findings = {finding.cause: finding for finding in diagnose(folder)}
    assert set(findings) == {"merged", "focal-length", "camera-turned", "overlay", "camera"}
    assert "r2's focal length is 1.50 times (+50 %)" in findings["focal-length"].sentence
    assert "another convention" in findings["camera-turned"].advice
    assert findings["overlay"].severity is Severity.NOTE
    assert "30 % of r1's pictures (bottom)" in findings["overlay"].sentence
    report = build(load(folder))
    assert report.doubted_cameras == ["r1", "r2"]
    assert verdict(report).endswith("Look at r1's and r2's cameras: their pictures and odometry do not fit.")
    assert any("1.50 times" in warning for warning in report.warnings)


def upside_down(*frames: str) -> Story:
    """A run whose second robot told that its camera hangs upside down, after some closures."""
    story = corrections_lost()
    story.frames.update(zip(("r1", "r2"), frames, strict=True))
    story.say(15.0, "r2", "encoding_failed", keyframe="r2/9", reason=WITHHELD)
    fields = {"doubt": "mounting", "amount": 179.9, "where": "180 degrees about z (forward)", "pairs": 5}
    return story.say(4.0, "r2", "camera_doubted", **fields, withheld=True)


def test_no_map_is_ok_that_a_robot_with_its_camera_upside_down_is_part_of(tmp_path: Path) -> None:
    folder = upside_down("map/r1", "map/r1").write(tmp_path / "run")
    findings = diagnose(folder)
    assert [finding.cause for finding in findings] == ["merged-doubtfully", "camera-turned"]
    begins = "r2's camera is turned by 179.9 degrees against its odometry. Do not believe where r2 is"
    assert findings[0].sentence == f"{begins}. All 2 robots are in map/r1."
    assert "T_body_camera" in findings[0].advice
    assert not [line for line in finding_lines(findings) if line.startswith("ok")]
    said = verdict(build(load(folder)))
    assert said.startswith(f"{begins}. All two robots found one common map")
    assert "Look at" not in said


def test_a_camera_that_was_kept_out_is_why_maps_did_not_merge(tmp_path: Path) -> None:
    folder = upside_down("map/r1", "map/r2").write(tmp_path / "run")
    findings = diagnose(folder)
    assert [(finding.cause, finding.severity) for finding in findings] == [("camera-turned", Severity.BLOCKS)]
    assert findings[0].sentence.endswith("kept out of closures.")
    begins = "r2's camera is turned by 179.9 degrees against its odometry."
    assert verdict(build(load(folder))).startswith(f"{begins} The robots did not merge")


def test_a_robot_that_left_no_result_is_judged_by_the_events(tmp_path: Path) -> None:
    story = latents()
    story.left_no_result = {"r1", "r2"}
    for robot in ("r1", "r2"):
        story.say(0.5, robot, "keyframe", keyframe=f"{robot}/0", stamp_s=0.0, T_odom_body=IDENTITY)
    assert [finding.cause for finding in blocking(story.write(tmp_path / "run"))] == ["latents"]


def test_a_robot_that_hangs_on_one_closure_is_told(tmp_path: Path) -> None:
    story = corrections_lost()
    story.frames["r2"] = "map/r1"
    story.closures = [ClosureKnown(**PAIR, scale=1.3), ClosureKnown(query="r1/4", match="r2/6")]
    findings = diagnose(story.write(tmp_path / "run"))
    assert [finding.cause for finding in findings] == ["merged", "weak-link", "weak-link"]
    assert findings[1].sentence.startswith("r1 hangs on map/r1 by 1 of 2 accepted closures")


def test_a_dead_robot_whose_store_was_read_blocks_nothing(tmp_path: Path) -> None:
    story = healthy().say(13.0, "r2", "agent_died", signal=9)
    assert blocking(story.write(tmp_path / "run")) == []


def test_one_robot_alone_has_nothing_to_merge(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run")
    folder.write_run(Run(scenario="alone", robots=["r1"]))
    folder.write_events([])
    assert diagnose(folder) == []
