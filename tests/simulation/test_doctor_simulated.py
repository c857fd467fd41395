"""The doctor in broken set-ups that really happened: each is a swarm on virtual time with one thing wrong."""

import json
from pathlib import Path
from typing import Any

import pytest

from flocc_agent.core.pose_graph import map_frame
from flocc_agent.runtime.evidence import evidence_of, solver_of
from flocc_launch.dashboard.status_table import RobotStatus, status_from
from flocc_launch.doctor import Finding, Severity, diagnose
from flocc_launch.doctor.live import diagnose_live
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.simulate import playbacks_of, simulate, swarm_of, write
from flocc_launch.simulation.swarm import Swarm

LOOP = [[0, 0], [9, 0], [9, 6], [0, 6], [0, 0]]
FAR_AWAY = [[60, 0], [69, 0], [69, 6], [60, 6], [60, 0]]


def broken(**changes: Any) -> Scenario:
    """Two robots on one loop that merge, but for what is changed; dots in a name are written as two underscores."""
    fields: dict[str, Any] = {
        "name": "broken",
        "rate": 4.0,
        "settle_s": 3.0,
        "tracks": {"robots": 2, "routes_m": {"r1": LOOP, "r2": LOOP}},
        "keyframes": {"distance_m": 0.75},
        "perception": {"method": "synthetic"},
        "simulation": {"optimiser": "quick"},
    }
    for name, value in changes.items():
        table, *keys = name.split("__")
        if not keys:
            fields[table] = value
            continue
        inner = fields.setdefault(table, {})
        for key in keys[:-1]:
            inner = inner.setdefault(key, {})
        inner[keys[-1]] = value
    return Scenario.model_validate(fields)


def fault(at_s: float, kind: str, **fields: Any) -> dict[str, Any]:
    return {"at_s": at_s, "kind": kind, **fields}


def diagnosed(scenario: Scenario, folder: Path) -> list[Finding]:
    simulate(scenario, folder)
    return diagnose(RunFolder.open(folder))


def blocking(findings: list[Finding]) -> list[Finding]:
    return [finding for finding in findings if finding.severity is Severity.BLOCKS]


BROKEN: dict[str, tuple[str, dict[str, Any]]] = {
    "too far apart for their radios": (
        "no-peer",
        {"tracks__routes_m": {"r1": LOOP, "r2": FAR_AWAY}, "radio__range_m": 20.0},
    ),
    "kept apart by a partition": ("no-peer", {"faults": [fault(0.0, "partition", groups=[["r1"], ["r2"]])]}),
    "a radio that only sends": (
        "one-way-link",
        {"radio__overrides": [{"sender": "r1", "receiver": "r2", "loss_ratio": 1.0}]},
    ),
    "records get lost, all of them": (
        "no-descriptors",
        {"faults": [fault(0.0, "mute", message="records", value=1.0)], "duration_s": 15.0},
    ),
    "a similarity threshold that nothing reaches": (
        "low-similarity",
        {"core__place_recognition__similarity_threshold": 0.9999},
    ),
    "routes that share no place": (
        "low-similarity",
        {
            "tracks__routes_m": {"r1": LOOP, "r2": FAR_AWAY},
            "core__place_recognition__similarity_threshold": 0.6,
            "perception__synthetic": {"alias_probability": 0.0},
        },
    ),
    "latents that are larger than the link carries": (
        "latents",
        {
            "radio__bandwidth_bytes_s": 20_000.0,
            "perception__synthetic": {"latent_bytes": 8_000_000},
            "duration_s": 40.0,
        },
    ),
    "a run that ends before the first registration": (
        "not-registered",
        {"simulation": {"optimiser": "quick", "register_s": 60.0}, "duration_s": 15.0},
    ),
    "a match-ratio threshold that nothing reaches": (
        "registrations-rejected",
        {"core__loop_closing__match_ratio_threshold": 50.0},
    ),
    "elections that nobody wins": (
        "no-leader",
        {"core__election__startup_s": 1000.0, "duration_s": 20.0},
    ),
    "a leader that dies before it has optimised": (
        "leader-silent",
        {
            "robots": {"server": {"compute_class": 9}},
            "simulation": {"optimiser": "quick", "optimise_s": 60.0},
            "faults": [fault(9.0, "kill", robots=["server"])],
            "duration_s": 10.0,
        },
    ),
    "maps that take more agreeing closures than there are": (
        "closures-not-connecting",
        {"simulation": {"optimiser": "backend"}, "backend__closures_to_join_min": 5000, "keyframes__distance_m": 1.5},
    ),
    "corrections that get lost, all of them": (
        "corrections-lost",
        {"faults": [fault(0.0, "mute", message="correction", value=1.0)], "duration_s": 15.0},
    ),
    "a robot that is never switched on": ("no-keyframes", {"robots": {"r2": {"start_s": 100.0}}, "duration_s": 15.0}),
}


def test_the_same_robots_merge_when_nothing_is_wrong(tmp_path: Path) -> None:
    assert [finding.cause for finding in diagnosed(broken(), tmp_path / "run")] == ["merged"]


@pytest.mark.parametrize("setup", BROKEN)
def test_the_doctor_names_the_cause_of_a_simulated_failure(tmp_path: Path, setup: str) -> None:
    cause, changes = BROKEN[setup]
    found = blocking(diagnosed(broken(**changes), tmp_path / "run"))
    assert [finding.cause for finding in found] == [cause], [finding.sentence for finding in found]


def test_two_robots_with_one_name_are_named(tmp_path: Path) -> None:
    scenario = broken(duration_s=15.0)
    swarm = swarm_of(scenario, playbacks_of(scenario, {}), scenario.seed)
    swarm.add_twin("r2")
    swarm.run_until(15.0)
    del swarm.stations["r2-twin"]  # it belongs to somebody else, and so do its files
    swarm.told = [told for told in swarm.told if told.robot != "r2-twin"]
    folder = RunFolder.create(tmp_path / "run")
    write(folder, swarm, scenario.seed, 15.0)
    assert [(finding.cause, finding.robots) for finding in diagnose(folder)] == [
        ("merged", ("r1", "r2")),
        ("duplicate-name", ("r2",)),
    ]


def test_the_best_similarity_and_the_threshold_stand_in_the_sentence(tmp_path: Path) -> None:
    _, changes = BROKEN["routes that share no place"]
    (finding,) = blocking(diagnosed(broken(**changes), tmp_path / "run"))
    results = RunFolder.open(tmp_path / "run").results()
    best = max(results["r1"].best_similarities["r2"], results["r2"].best_similarities["r1"])
    assert best < 0.6
    assert f"below the threshold of 0.6, the best was {best:.2f}" in finding.sentence


def answers(swarm: Swarm) -> list[RobotStatus]:
    """What the robots of a simulated swarm would answer an operator."""
    rows = []
    for name, station in swarm.stations.items():
        core = station.core
        assert core is not None
        term, applied = core.election.term, core.corrections.applied
        solved = solver_of(station.solution) if station.solution else None
        fields = {
            "robot": name,
            "leader": None if term is None else term.leader.robot,
            "neighbours": core.neighbours.names(),
            "map_frame": None if applied is None else map_frame(applied.anchor),
            "keyframes": core.gossip.logs[core.log].keyframes,
            "closures": core.assembly.closures,
            "logs": {str(digest.log): [digest.count, digest.checksum] for digest in core.gossip.digests()},
            "compute_class": swarm.scenario.robot(name).compute_class,
            **evidence_of(core, swarm.scenario.core, solved).model_dump(),
        }
        rows.append(status_from(name, json.dumps(fields).encode()))
    return rows


ASKED = {
    "a radio that only sends": "one-way-link",
    "kept apart by a partition": "no-peer",
    "records get lost, all of them": "no-descriptors",
    "a similarity threshold that nothing reaches": "low-similarity",
    "a match-ratio threshold that nothing reaches": "registrations-rejected",
    "maps that take more agreeing closures than there are": "closures-not-connecting",
    "elections that nobody wins": "no-leader",
    "a robot that is never switched on": None,
}


@pytest.mark.parametrize("setup", ASKED)
def test_the_doctor_names_it_while_the_swarm_runs(setup: str) -> None:
    scenario = broken(**BROKEN[setup][1])
    swarm = swarm_of(scenario, playbacks_of(scenario, {}), scenario.seed)
    swarm.run_until(14.0)
    if ASKED[setup] is None:
        del swarm.stations["r2"]  # who is off does not answer
    found = [finding.cause for finding in diagnose_live(answers(swarm)) if finding.severity is Severity.BLOCKS]
    assert found == [cause for cause in [ASKED[setup]] if cause is not None]


def test_what_a_robot_answers_counts_every_pair_once() -> None:
    scenario = broken(robots={"server": {"compute_class": 9}})
    swarm = swarm_of(scenario, playbacks_of(scenario, {}), scenario.seed)
    swarm.run_until(20.0)
    rows = answers(swarm)
    assert [finding.cause for finding in diagnose_live(rows)] == ["merged"]
    for row in rows:
        (pair,) = row.pairs
        assert (pair.robots, pair.accepted) == (("r1", "r2"), row.closures)
        assert pair.best_ratio is None or pair.rejected > 0
