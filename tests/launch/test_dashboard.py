"""The live page: what it reads from a growing run folder, and what a browser shows of it."""

import json
import re
import shutil
import socket
import subprocess
import threading
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from tests.agent.runtime.test_metrics import most_threads
from tests.launch import synthetic_run
from tests.launch.synthetic_run import Synthetic

from flocc_agent.core.reports import CorrectionApplied
from flocc_agent.runtime import few_connections
from flocc_agent.runtime.event_lines import Reported
from flocc_launch.dashboard import Dashboard, DashboardError, live_dashboard, server
from flocc_launch.dashboard.page_source import RunSource
from flocc_launch.dashboard.snapshot import LinkView, MapGroup, RobotView, Said, Snapshot
from flocc_launch.dashboard.state import SwarmState
from flocc_launch.dashboard.tail import LineTail
from flocc_launch.runs.run_folder import RunFolder, event_from_line
from flocc_launch.runs.run_records import Run

START_S = 1_700_000_000.0
IDENTITY = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]


def growing(path: Path, start_s: float | None = START_S) -> RunFolder:
    folder = RunFolder.create(path)
    folder.write_run(Run(scenario="growing", robots=["r1", "r2", "r3"], start=start_s))
    return folder


def add(folder: RunFolder, t: float, robot: str, event: str, **fields: Any) -> None:
    path = folder.path / "robots" / robot / "events.jsonl"
    path.parent.mkdir(exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps({"t": t, "robot": robot, "event": event, **fields}) + "\n")


def start_swarm(folder: RunFolder) -> None:
    for robot in ("r1", "r2", "r3"):
        add(folder, 1.0, robot, "keyframe", keyframe=f"{robot}/0", stamp_s=0.0, T_odom_body=IDENTITY)
        for peer in {"r1", "r2", "r3"} - {robot}:
            add(folder, 1.5, robot, "neighbour_up", peer=peer)
        add(folder, 2.0, robot, "leader", term=1, leader="r1")
        add(folder, 3.0, robot, "correction", term=1, round=1, map_frame="map/r1", T_map_odom=IDENTITY)


def kill_the_leader(folder: RunFolder) -> None:
    for robot in ("r2", "r3"):
        add(folder, 30.0, robot, "neighbour_down", peer="r1")
        add(folder, 31.0, robot, "leader_lost", term="1:r1", reason="silent")
        add(folder, 32.0, robot, "leader", term=2, leader="r2")


def robot_of(snapshot: Snapshot, robot: str) -> RobotView:
    return next(r for r in snapshot.robots if r.robot == robot)


def test_a_growing_folder_is_read_as_it_grows(tmp_path: Path) -> None:
    folder = growing(tmp_path / "run")
    now_s = START_S + 4.0
    source = RunSource(folder, clock_s=lambda: now_s)
    assert source.snapshot().leaders == []
    start_swarm(folder)
    before = source.snapshot()
    assert (before.leaders, before.ranges) == (["r1"], [["r1", "r2", "r3"]])
    assert before.maps == [MapGroup("map/r1", ["r1", "r2", "r3"])]
    kill_the_leader(folder)
    now_s = START_S + 33.0
    after = source.snapshot()
    assert [robot_of(after, r).leader for r in ("r2", "r3")] == ["r2", "r2"]
    assert robot_of(after, "r1").state == "silent"
    assert (after.leaders, after.ranges) == (["r2"], [["r2", "r3"]])
    assert (after.t, after.running) == (33.0, True)


def test_the_merged_file_replaces_what_was_read_before(tmp_path: Path) -> None:
    folder = growing(tmp_path / "run")
    source = RunSource(folder, clock_s=lambda: START_S + 5.0)
    start_swarm(folder)
    source.snapshot()
    lines = [json.loads(line) for p in folder.path.glob("robots/*/events.jsonl") for line in p.read_text().splitlines()]
    folder.write_events([*lines, {"t": 4.0, "robot": "r1", "event": "agent_died", "signal": 9}])
    snapshot = source.snapshot()
    assert not snapshot.running
    assert robot_of(snapshot, "r1").state == "died"
    assert robot_of(snapshot, "r2").keyframes == 1


def test_a_torn_line_waits_for_its_end_and_a_broken_one_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    tail = LineTail(path)
    assert tail.events() == []
    path.write_text('{"t": 1, "robot": "r1", "event": "agent_stopped"}\nnonsense\n{"t": 2, "robot": "r1", "ev')
    assert [event.t for event in tail.events()] == [1]
    with path.open("a") as file:
        file.write('ent": "agent_stopped"}\n')
    assert [event.t for event in tail.events()] == [2]
    assert tail.events() == []


def test_a_partition_shows_as_two_ranges() -> None:
    state = SwarmState(["r1", "r2", "r3", "r4"])
    for robot, peer in (("r1", "r2"), ("r4", "r3")):
        state.apply(event_from_line(f'{{"t": 1, "robot": "{robot}", "event": "neighbour_up", "peer": "{peer}"}}', ""))
    assert state.snapshot(None, "test").ranges == [["r1", "r2"], ["r3", "r4"]]


def test_an_event_of_a_later_version_is_shown_as_it_stands() -> None:
    state = SwarmState(["r1"])
    state.apply(event_from_line('{"t": 1, "robot": "r1", "event": "teleported", "where": "mars"}', ""))
    assert state.snapshot(2.0, "test").recent == [Said(1.0, "r1", "teleported where=mars")]


def test_the_snapshot_of_a_finished_run_agrees_with_its_report(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    snapshot = RunSource(folder).snapshot()
    assert [r.keyframes for r in snapshot.robots] == [63, 60, 66]
    assert sum(r.accepted for r in snapshot.robots) == len(snapshot.closures) == 63
    assert {r.map_frame for r in snapshot.robots} == {"map/r1"}
    json.dumps(snapshot.as_json(), allow_nan=False)


def test_links_have_loss_and_bytes_and_robots_have_queues(tmp_path: Path) -> None:
    folder = growing(tmp_path / "run")
    start_swarm(folder)
    add(folder, 4.0, "r1", "bytes", sent={}, received={}, loss={"r2": 0.25}, queues={"inbox": 3})
    links = {"sent_to": {"r2": {"records": 100, "heartbeat": 20}}, "received_from": {"r2": {"latent": 7}}}
    add(folder, 4.0, "r1", "account", since_s=0.0, lost_from={}, repeated_from={}, stages={}, **links)
    r1 = robot_of(RunSource(folder, clock_s=lambda: START_S + 5.0).snapshot(), "r1")
    assert r1.queues == {"inbox": 3}
    assert r1.links == {
        "r2": LinkView(hears=True, loss_ratio=0.25, sent_bytes=120, received_bytes=7),
        "r3": LinkView(hears=True, loss_ratio=None, sent_bytes=None, received_bytes=None),
    }
    add(folder, 5.0, "r1", "neighbour_down", peer="r2")
    later = robot_of(RunSource(folder, clock_s=lambda: START_S + 6.0).snapshot(), "r1")
    assert later.links["r2"] == LinkView(hears=False, loss_ratio=None, sent_bytes=120, received_bytes=7)


def test_a_server_is_in_no_map_and_nobody_waits_for_it(tmp_path: Path) -> None:
    folder = growing(tmp_path / "run")
    folder.write_run(Run(scenario="growing", robots=["r1", "r2", "r3"], servers=["r3"], start=START_S))
    start_swarm(folder)
    snapshot = RunSource(folder, clock_s=lambda: START_S + 5.0).snapshot()
    assert snapshot.maps == [MapGroup("map/r1", ["r1", "r2"])]
    assert [robot.server for robot in snapshot.robots] == [False, False, True]


def test_a_run_that_is_over_is_drawn_as_it_was_corrected(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    corrected = [keyframe.T_map_body for keyframe in folder.results()["r2"].keyframes]
    drawn = robot_of(RunSource(folder).snapshot(), "r2").path_m
    known = [[round(v, 3) for v in pose[:3]] for pose in corrected if pose is not None]
    assert drawn[: len(known)] == known
    assert len(drawn) == len(corrected), "a keyframe after the last correction moves with the odom frame"


def test_the_server_answers_two_paths_and_nothing_else(tmp_path: Path) -> None:
    with Dashboard(synthetic_run.write(tmp_path / "run"), port=0) as dashboard:
        with urllib.request.urlopen(dashboard.url + "state.json") as answer:
            assert json.load(answer)["scenario"] == "synthetic-hall"
        with urllib.request.urlopen(dashboard.url) as answer:
            assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
            assert not re.search(rb"(src|href)=.?https?:", answer.read())
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(dashboard.url + "../run.json")


def test_the_page_works_below_a_path_of_a_reverse_proxy(tmp_path: Path) -> None:
    """Also where the proxy leaves its own path in front; the page asks relative to itself."""
    with Dashboard(synthetic_run.write(tmp_path / "run"), port=0) as dashboard:
        below = dashboard.url + "robots/swarm/"
        with urllib.request.urlopen(below) as answer:
            assert re.findall(rb"fetch\((.*?),", answer.read()) == [b'"state.json"']
        with urllib.request.urlopen(below + "state.json?t=1") as answer:
            assert json.load(answer)["scenario"] == "synthetic-hall"


def test_a_correction_is_no_sign_of_life_of_a_robot_that_is_gone() -> None:
    """A leader corrects the logs of dead robots too; what the robot says itself is what counts."""
    swarm = SwarmState(["r1"])
    corrected = CorrectionApplied(term=1, leader="r2", round=3, map_frame="map/r1", T_map_odom=(0, 0, 0, 1, 0, 0, 0))
    swarm.heard("r1", 5.0)
    swarm.apply(Reported(80.0, "r1", corrected), by_itself=False)
    (view,) = swarm.snapshot(81.0, "gone").robots
    assert (view.last_s, view.state, view.map_frame) == (5.0, "silent", "map/r1")
    swarm.apply(Reported(90.0, "r1", corrected))
    assert swarm.snapshot(91.0, "gone").robots[0].last_s == 90.0


def test_idle_connections_are_few_and_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = 3
    monkeypatch.setattr(few_connections, "CONNECTIONS_MAX", few)
    monkeypatch.setattr(server, "IDLE_S", 2.0)
    threads = threading.active_count()
    with Dashboard(synthetic_run.write(tmp_path / "run", Synthetic()), port=0) as dashboard:
        host, port = dashboard.url.removeprefix("http://").strip("/").split(":")
        idle = [socket.create_connection((host, int(port)), timeout=10.0) for _ in range(3 * few)]
        assert most_threads() <= threads + 1 + few
        assert [connection.recv(1) for connection in idle] == [b""] * len(idle)
        assert urllib.request.urlopen(dashboard.url, timeout=10.0).status == 200
    for connection in idle:
        connection.close()


def test_a_port_in_use_is_one_sentence(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    with Dashboard(folder, port=0) as dashboard:
        port = int(dashboard.url.rsplit(":", 1)[1].strip("/"))
        with pytest.raises(DashboardError, match=rf"port {port} on 127\.0\.0\.1: Address already in use"):
            Dashboard(folder, port=port)


def test_a_launch_is_shown_from_its_first_state_and_the_port_is_given_back(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    seen: list[str] = []
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with live_dashboard(folder, port, seen.append) as show:
        start_swarm(growing(folder.path))
        show("first state")
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/state.json") as answer:
            assert len(json.load(answer)["robots"]) == 3
    assert seen == ["first state"]
    Dashboard(folder, port).close()


def browse(url: str, profile: Path, *more: str) -> str:
    """The page's elements after its scripts ran, in headless Chromium."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("chromium is not installed")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"]
    flags += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    flags += [f"--user-data-dir={profile}", "--virtual-time-budget=3000", "--dump-dom", *more]
    return subprocess.run([chromium, *flags, url], capture_output=True, text=True, check=True, timeout=120).stdout


def rows(html: str) -> dict[str, dict[str, str]]:
    found = re.findall(r"<tr ([^>]*data-robot=[^>]*)>", html)
    attributes = [dict(re.findall(r'data-(\w+)="([^"]*)"', text)) for text in found]
    return {row["robot"]: row for row in attributes}


@pytest.mark.slow
def test_a_browser_shows_the_new_leader_and_the_map_after_a_kill(tmp_path: Path) -> None:
    folder = growing(tmp_path / "run", start_s=None)
    start_swarm(folder)
    with Dashboard(folder, port=0) as dashboard:
        before = rows(browse(dashboard.url, tmp_path / "profile"))
        assert {row["leader"] for row in before.values()} == {"r1"}
        kill_the_leader(folder)
        html = browse(dashboard.url, tmp_path / "profile")
    after = rows(html)
    assert (after["r2"]["leader"], after["r3"]["leader"]) == ("r2", "r2")
    assert after["r2"]["frame"] == "map/r1"
    assert "lost its leader" in html
    assert "one map: map/r1" in html


@pytest.mark.slow
def test_a_browser_shows_maps_that_are_apart(tmp_path: Path) -> None:
    with Dashboard(synthetic_run.write(tmp_path / "run", Synthetic(merged_s=None)), port=0) as dashboard:
        html = browse(dashboard.url, tmp_path / "profile")
    assert ">3 maps<" in html
    assert html.count("<svg") == 3


@pytest.mark.slow
def test_robots_without_a_map_are_drawn_apart_and_stale_leaders_have_no_star(tmp_path: Path) -> None:
    folder = growing(tmp_path / "run", start_s=None)
    for robot in ("r1", "r2", "r3"):
        add(folder, 1.0, robot, "keyframe", keyframe=f"{robot}/0", stamp_s=0.0, T_odom_body=IDENTITY)
        add(folder, 1.0, robot, "leader", term=1, leader=robot)
        for peer in {"r1", "r2", "r3"} - {robot}:
            add(folder, 1.5, robot, "neighbour_up", peer=peer)
    for robot in ("r1", "r3"):
        add(folder, 2.0, robot, "leader", term=2, leader="r1")
    with Dashboard(folder, port=0) as dashboard:
        html = browse(dashboard.url, tmp_path / "profile")
    assert ">0 maps, 3 robots without<" in html
    assert len(re.findall(r"<b>odometry alone</b>: r\d<", html)) == html.count("<svg") == 3
    assert re.findall(r">(r\d ★)<", html) == ["r1 ★"], "r2 leads itself, and hears a newer leader"
    assert ">leader r1 (term 2)<" in html


def test_rejected_candidates_are_counted_and_not_listed(tmp_path: Path) -> None:
    folder = growing(tmp_path / "run")
    for k in range(100):
        add(folder, 5.0 + k, "r1", "closure_rejected", query="r1/0", match=f"r2/{k}", ratio=0.1, reason="few")
    add(folder, 200.0, "r1", "closure_accepted", query="r1/0", match="r2/0", ratio=1.0, probability=0.9,
        correspondences=99, odometry_correspondences=99, scale_initial=None, by="r1")  # fmt: skip
    snapshot = RunSource(folder).snapshot()
    assert robot_of(snapshot, "r1").rejected == 100
    assert [said.text for said in snapshot.recent] == ["closure r1/0 – r2/0, match ratio 1.00"]
