"""The account of a run: both ends of a link count the same bytes, on virtual time exactly."""

from pathlib import Path
from typing import Any

import pytest
from tests.launch import synthetic_run

from flocc_agent.runtime.event_lines import line_of
from flocc_agent.stages import BOUNDS_S, Histogram
from flocc_launch.report import RunReport, finish
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.scenario import Scenario
from flocc_launch.simulation.simulate import playbacks_of, simulate, swarm_of

PERFECT: dict[str, Any] = {}
BAD: dict[str, Any] = {"loss_ratio": 0.2, "duplicate_ratio": 0.1, "latency_s": 0.05, "range_m": 25.0}


def scenario(radio: dict[str, Any], **more: Any) -> Scenario:
    return Scenario.model_validate(
        {
            "name": "accounts",
            "tracks": {"robots": 3, "seed": 3, "area_m": 20.0, "length_m": 25.0},
            "keyframes": {"distance_m": 1.0, "rotation_rad": 0.7},
            "perception": {"method": "synthetic", "synthetic": {"latent_bytes": 400_000, "outlier_probability": 0.0}},
            "simulation": {"optimiser": "quick"},
            "radio": radio,
            **more,
        }
    )


def simulated(path: Path, radio: dict[str, Any], **more: Any) -> RunReport:
    return simulate(scenario(radio, **more), path / "run")


def test_on_a_lossless_link_the_receiver_counts_exactly_what_the_sender_does(tmp_path: Path) -> None:
    report = simulated(tmp_path, PERFECT)
    assert {(link.sender, link.receiver) for link in report.links} == {
        (a, b) for a in report.robots for b in report.robots if a != b
    }
    for link in report.links:
        assert (link.received, link.lost, link.repeated, link.unaccounted) == (link.sent, 0, 0, 0)
        assert all(kind.sent == kind.received for kind in link.by_kind.values())
    assert {"heartbeat", "records", "latent"} <= set(report.links[0].by_kind) | set(report.links[1].by_kind)


def test_latents_count_their_own_bytes_once_each_in_pieces_or_not(tmp_path: Path) -> None:
    report = simulated(tmp_path, PERFECT)
    latents = sum(link.by_kind["latent"].received or 0 for link in report.links if "latent" in link.by_kind)
    fetches = report.stages["fetch"].count
    assert fetches > 0
    assert latents / fetches == pytest.approx(400_000, rel=0.01)
    assert latents == report.bytes["latent"]


def test_a_broadcast_counts_once_by_kind_and_once_per_link(tmp_path: Path) -> None:
    report = simulated(tmp_path, PERFECT)
    on_links = sum(link.by_kind["heartbeat"].sent or 0 for link in report.links)
    assert on_links == 2 * report.bytes["heartbeat"]


def test_under_loss_repetition_and_deaths_every_byte_is_received_lost_or_under_way() -> None:
    faults = [{"at_s": 10, "kind": "kill", "robots": ["r2"]}, {"at_s": 20, "kind": "restart", "robots": ["r2"]}]
    bad = scenario(BAD, faults=faults)
    swarm = swarm_of(bad, playbacks_of(bad, {}), 5)
    links = swarm.network.links
    for end_s in (9.0, 15.0, 40.0):
        swarm.run_until(end_s)
        for each in links.counts.values():
            assert each.sent + each.repeated == each.received + each.lost + each.under_way
    assert sum(each.lost for each in links.counts.values()) > 0
    assert sum(each.repeated for each in links.counts.values()) > 0


def test_lost_and_repeated_bytes_stand_apart(tmp_path: Path) -> None:
    report = simulated(tmp_path, BAD)
    for link in report.links:
        counts = (link.sent, link.repeated, link.received, link.lost, link.unaccounted)
        sent, repeated, received, lost, unaccounted = (count or 0 for count in counts)
        assert sent + repeated == received + lost + unaccounted
        assert 0 <= unaccounted <= 0.02 * sent  # on its way when the run ended
    assert sum(link.lost or 0 for link in report.links) > 0


def test_stages_tell_how_often_and_how_long(tmp_path: Path) -> None:
    report = simulated(tmp_path, PERFECT)
    keyframes = sum(robot.keyframes for robot in report.robot_details)
    encode = report.stages["encode"]
    assert encode.count == report.stages["encode_wait"].count == keyframes
    assert 0.05 <= encode.median_s <= 0.15
    assert sum(encode.counts) == encode.count
    assert len(encode.counts) == len(report.stage_bounds_s) + 1
    assert sum(times["encode"].count for times in report.stages_by_robot.values()) == encode.count


def account(robot: str, since_s: float, t: float, sent: int, stage_s: float) -> dict[str, Any]:
    times = Histogram()
    times.observe(stage_s)
    peer = "r2" if robot == "r1" else "r1"
    return {
        "t": t,
        "robot": robot,
        "event": "account",
        "since_s": since_s,
        "sent_to": {peer: {"records": sent}},
        "received_from": {peer: {"records": sent}},
        "lost_from": {},
        "repeated_from": {},
        "stages": {"match": {"counts": times.counts, "total_s": times.total_s, "max_s": times.max_s}},
    }


def report_of(path: Path, lines: list[dict[str, Any]]) -> tuple[RunReport, RunFolder]:
    folder = synthetic_run.write(path / "run")
    made = synthetic_run.Synthetic()
    events = [*(line_of(event) for event in folder.events()), *lines]
    folder.write_events(events)
    assert made is not None
    return finish(folder), folder


def test_a_robot_that_was_started_again_counts_with_all_its_starts(tmp_path: Path) -> None:
    lines = [
        account("r1", 0.0, 10.0, 100, 0.01),
        account("r1", 0.0, 20.0, 250, 0.01),
        account("r1", 30.0, 40.0, 400, 0.02),
        account("r2", 0.0, 40.0, 650, 0.01),
    ]
    report, _ = report_of(tmp_path, lines)
    there, back = report.links
    assert (there.sender, there.receiver, there.sent, there.received, there.unaccounted) == ("r1", "r2", 650, 650, 0)
    assert (back.sent, back.received) == (650, 650)
    assert report.stages["match"].count == 3


def test_what_an_end_counted_that_left_no_account_is_not_known(tmp_path: Path) -> None:
    report, folder = report_of(tmp_path, [account("r1", 0.0, 10.0, 100, 0.01)])
    there, back = report.links
    assert (there.sent, there.received, there.lost, there.unaccounted) == (100, None, None, None)
    assert (back.sent, back.received) == (None, 100)
    page = (folder.path / "report.html").read_text()
    assert "From whom to whom" in page
    assert "Where time went" in page


def test_a_run_of_an_earlier_version_has_no_account_and_a_report(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    report = finish(folder)
    assert (report.links, report.stages) == ([], {})
    assert report.stage_bounds_s == list(BOUNDS_S)
    assert "From whom to whom" not in (folder.path / "report.html").read_text()
