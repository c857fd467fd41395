"""Maps: saved whole or not at all, never changed by reading, opened by teams, merged, pruned, exported."""

import hashlib
import io
import json
import os
import shutil
import signal
import sqlite3
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.launch.map_missions import AGAIN, BLOCK, FAR, mission, scenario

from flocc_agent.config import TlsConfig
from flocc_agent.core.pose_graph import ClosureResult, ClosureState
from flocc_agent.core.reports import FoundInMap, MapOpened
from flocc_agent.geometry import symmetric
from flocc_agent.runtime.map_folder import BadMap, LensModel, MapFolder, read_manifest
from flocc_agent.runtime.persistence import joined_logs
from flocc_agent.runtime.record_tables import PUT_RECORD, row
from flocc_agent.runtime.security import RecordSealer
from flocc_agent.runtime.trajectory_text import read_tum
from flocc_launch.commands.main import main
from flocc_launch.graph_files.g2o import read_g2o
from flocc_launch.maps.gathering import gathered
from flocc_launch.maps.map_export import export_map
from flocc_launch.maps.map_info import map_lines
from flocc_launch.maps.map_merging import MERGER, like_pairs, merge_maps
from flocc_launch.maps.map_pruning import prune_map
from flocc_launch.maps.map_saving import save_map
from flocc_launch.maps.opening import MapUse
from flocc_launch.maps.solving import NotSolved, SolvedMap, contradicted, laid_onto, solved_map
from flocc_launch.maps.writing import MapContent, write_map
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.setup.credentials import make_keys
from flocc_launch.simulation.sessions import map_of_sessions
from flocc_launch.simulation.simulate import simulate
from flocc_launch.swarm.launching import launch
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.records import ClosureRecord, RejectionRecord, WithdrawalRecord, decode_record, encode_record


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two robots around a block."""
    run = tmp_path_factory.mktemp("first") / "run"
    mission(run, BLOCK)
    return run


@pytest.fixture(scope="module")
def block(first: Path) -> Path:
    """Its map."""
    save_map(first, first.parent / "block")
    return first.parent / "block"


@pytest.fixture(scope="module")
def second(block: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one robot that begins elsewhere in that map."""
    run = tmp_path_factory.mktemp("second") / "run"
    mission(run, AGAIN, MapUse(block))
    return run


def content_of(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in folder.rglob("*")}


def facts(run: Path, kind: type) -> list[object]:
    return [told.fact for told in RunFolder.open(run).events() if isinstance(told.fact, kind)]


def said(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["flocc", *words])
    try:
        main()
    except SystemExit as left:
        code = left.code
    else:
        code = 0
    out, err = capsys.readouterr()
    assert isinstance(code, int)
    return code, " ".join((out + err).split())


# Save


def test_a_map_holds_logs_latents_and_solution_of_the_run(first: Path, block: Path) -> None:
    opened, found = MapFolder.open(block), gathered(first)
    assert opened.records == dict(found.logs)
    assert opened.manifest.frame == "map/r1"
    assert opened.manifest.edition == 1
    assert opened.manifest.front_end.model == "synthetic/1"
    latents = {keyframe: data for keyframe, _, data in found.latents()}
    assert {k: opened.latent(k) for k in opened.latent_keyframes()} == latents
    assert {log: len(T) for log, T in opened.poses().items()} == {
        log: sum(k.log == log for k in latents) for log in (LogId("r1"), LogId("r2"))
    }
    covariances = opened.covariances()[LogId("r2")]
    assert np.isfinite(covariances).all()
    assert (block / "index.html").read_text().count("<svg") == 1


def test_poses_of_a_map_are_near_the_truth(first: Path, block: Path) -> None:
    truth = read_tum(first / "groundtruth" / "r2.tum")
    poses = MapFolder.open(block).poses()[LogId("r2")]
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.sum() == pytest.approx(truth.length_m(), rel=0.1)


def test_a_map_is_solved_as_its_robots_solved(block: Path, tmp_path: Path) -> None:
    simulate(scenario(BLOCK, backend={"odometry_translation_sigma_m": 0.5}), tmp_path / "run")
    save_map(tmp_path / "run", tmp_path / "map")
    assert read_manifest(tmp_path / "map").back_end["odometry_translation_sigma_m"] == 0.5
    folders = (block, tmp_path / "map")
    usual, loose = (symmetric(MapFolder.open(folder).covariances()[LogId("r1")][1])[3, 3] for folder in folders)
    assert loose > 10 * usual


def test_saving_reads_stores_that_are_in_use_and_changes_nothing(first: Path, tmp_path: Path) -> None:
    before = content_of(first / "robots" / "r1" / "store")
    held = sqlite3.connect(first / "robots" / "r1" / "store" / "robot.sqlite")
    try:
        held.execute("BEGIN")
        held.execute("SELECT * FROM records").fetchone()
        save_map(first, tmp_path / "map")
    finally:
        held.close()
    after = content_of(first / "robots" / "r1" / "store")
    assert {name: after[name] for name in before if "-" not in name} == {
        n: s for n, s in before.items() if "-" not in n
    }


def test_one_agents_folder_gives_a_map_as_well(first: Path, tmp_path: Path) -> None:
    manifest = save_map(first / "robots" / "r1", tmp_path / "map")
    assert [entry.log for entry in manifest.logs] == ["r1"]


def test_a_damaged_record_ends_its_log_there(first: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(first, tmp_path / "run"))
    with sqlite3.connect(run / "robots" / "r2" / "store" / "robot.sqlite") as store:
        store.execute("UPDATE records SET data = x'00' WHERE log = 'r2' AND number = 5")
    store.close()
    assert len(gathered(run).logs[LogId("r2")]) == 5


def test_a_map_is_replaced_by_a_later_state_of_itself_only(first: Path, tmp_path: Path) -> None:
    found = gathered(first)
    solved = solved_map("run", found.logs)
    content = MapContent("one", found.logs, solved, found.front_end, {}, (), swarm="crew")
    write_map(tmp_path / "map", content)
    write_map(tmp_path / "map", replace(content, name="later"))
    fewer = {log: records[:-1] for log, records in found.logs.items()}
    with pytest.raises(BadMap, match=r"holds the map 'later' of swarm crew, whose log r1 this one does not have"):
        write_map(tmp_path / "map", replace(content, logs=fewer))
    assert MapFolder.open(tmp_path / "map").records == dict(found.logs)


def test_a_kill_during_save_leaves_the_old_map_or_the_new_one(first: Path, block: Path, tmp_path: Path) -> None:
    """A child writes two maps over each other until it is killed, at another moment each time."""
    out = tmp_path / "map"
    found = gathered(first)
    solved = solved_map("run", found.logs)
    latents = list(found.latents())
    some = [MapContent("one", found.logs, solved, found.front_end, {}, latents)]
    some.append(replace(some[0], name="two", latents=latents[: len(latents) // 2], edition=2))
    counts = {1: len(latents), 2: len(latents) // 2}
    began_s = time.monotonic()
    write_map(out, some[0])
    lasts_s = time.monotonic() - began_s
    rng = np.random.default_rng(7)
    seen: set[int] = set()
    for kills in range(60):
        if kills >= 12 and seen == {1, 2}:
            break
        child = os.fork()
        if child == 0:
            while True:
                write_map(out, some[1])
                write_map(out, some[0])
        time.sleep(float(rng.uniform(0.0, 4 * lasts_s)))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        opened = MapFolder.open(out)
        assert opened.records == dict(found.logs)
        assert opened.saved().logs == solved.saved.logs
        assert len(opened.latent_keyframes()) == counts[opened.manifest.edition]
        assert all(opened.latent(k) is not None for k in opened.latent_keyframes())
        seen.add(opened.manifest.edition)
        opened.close()
    assert seen == {1, 2}
    write_map(out, some[0])
    assert len(list(out.glob("latents-*"))) == 1
    assert list(out.glob("*.partial")) == []


def test_a_first_save_that_was_cut_off_is_no_map_and_may_be_done_again(first: Path, tmp_path: Path) -> None:
    save_map(first, tmp_path / "map")
    (tmp_path / "map" / "map.json").unlink()
    (tmp_path / "map" / "index.html").unlink()
    with pytest.raises(BadMap, match="it is no map, or saving it did not end"):
        MapFolder.open(tmp_path / "map")
    assert save_map(first, tmp_path / "map").edition == 1


# Open


def test_a_robot_finds_itself_in_the_maps_frame(block: Path, second: Path) -> None:
    (opened,) = facts(second, MapOpened)
    (found,) = facts(second, FoundInMap)
    assert isinstance(opened, MapOpened)
    assert isinstance(found, FoundInMap)
    assert (opened.map_frame, found.map_frame) == ("map/r1", "map/r1")
    assert found.keyframes <= 10
    result = RunFolder.open(second).results()["r1"]
    assert (result.incarnation, result.map_frame) == (1, "map/r1")
    T_map_camera = MapFolder.open(block).poses()[LogId("r1")]
    start = np.array(result.keyframes[0].T_map_body)[:3]
    assert np.linalg.norm(start - T_map_camera[8, :3, 3]) < 0.6, "it began where r1 was at its ninth keyframe, 6 m on"


def test_nothing_that_reads_a_map_changes_it(block: Path, tmp_path: Path) -> None:
    before = content_of(block)
    mission(tmp_path / "run", AGAIN, MapUse(block, fixed=True))
    save_map(tmp_path / "run", tmp_path / "next")
    export_map(MapFolder.open(block), tmp_path / "files")
    prune_map(block, tmp_path / "pruned", 2.0, 30.0)
    assert content_of(block) == before


def test_what_a_robot_adds_is_the_next_edition_and_the_frame_stays(block: Path, second: Path, tmp_path: Path) -> None:
    manifest = save_map(second, tmp_path / "next")
    old, new = MapFolder.open(block), MapFolder.open(tmp_path / "next")
    assert (manifest.edition, manifest.frame, manifest.name) == (2, "map/r1", "block")
    assert [entry.log for entry in manifest.logs] == ["r1", "r2", "r1~1"]
    assert set(old.latent_keyframes()) < set(new.latent_keyframes())
    assert {log: new.records[log] for log in old.records} == old.records
    third = mission(tmp_path / "third", AGAIN, MapUse(tmp_path / "next"))
    assert (third.map_frames, third.maps_used) == (["map/r1"], [str(tmp_path / "next")])


def test_the_next_edition_is_what_all_its_logs_give_together_where_the_map_lay(tmp_path: Path) -> None:
    mission(tmp_path / "first", {"r1": BLOCK["r1"]})
    save_map(tmp_path / "first", tmp_path / "map")
    mission(tmp_path / "run", {"r1": BLOCK["r2"]}, MapUse(tmp_path / "map"))
    assert save_map(tmp_path / "run", tmp_path / "next").edition == 2
    before, after = MapFolder.open(tmp_path / "map"), MapFolder.open(tmp_path / "next")
    together = solved_map("both", after.records).saved.T_map_camera
    assert set(together) == set(after.poses()) == {LogId("r1"), LogId("r1", 1)}
    T = laid_onto(together, after.poses())
    for log, poses in after.poses().items():
        np.testing.assert_allclose(T @ together[log], poses, atol=1e-3)
    np.testing.assert_allclose(laid_onto(after.poses(), before.poses()), np.eye(4), atol=1e-6)


def test_keyframes_that_several_logs_contradict_are_named() -> None:
    r1, r2, r3, r4 = map(LogId, ("r1", "r2", "r3", "r4"))

    def closure(log: LogId, match: KeyframeId, state: ClosureState) -> ClosureResult:
        return ClosureResult(KeyframeId(log, 0), match, state, 1.0, 1.0, 0.0)

    used, rejected = ClosureState.USED, ClosureState.REJECTED
    changed, lone, disputed, mixed = (KeyframeId(r1, k) for k in range(4))
    closures = [
        *(closure(log, changed, rejected) for log in (r2, r3)),
        closure(r2, changed._replace(index=9), ClosureState.EXCLUDED),
        closure(r2, lone, rejected),
        *(
            closure(log, disputed, state)
            for log, state in ((r2, rejected), (r3, rejected), (r4, used), (LogId("z"), used))
        ),
        *(closure(r2, mixed, state) for state in (used, rejected)),
        closure(r3, mixed, rejected),
    ]
    found = contradicted(closures, {r1, r2, r3, r4})
    assert found == {"r1/0": ("r2", "r3"), "r1/2": ("r2", "r3")}
    assert contradicted(closures, {r1, r2}) == {}


def test_map_info_names_contradicted_keyframes_those_of_most_logs_first(block: Path, tmp_path: Path) -> None:
    opened = MapFolder.open(block)
    named = {f"r1/{k}": ("r2", "r3") for k in range(11)} | {"r2/5": ("r1", "r3", "r4")}
    solved = SolvedMap(opened.saved(), opened.covariances(), {}, contradicted=named)
    write_map(tmp_path / "map", MapContent("m", opened.records, solved, opened.manifest.front_end, {}, ()))
    prune_map(tmp_path / "map", tmp_path / "pruned", 2.0, 30.0)
    for folder in (tmp_path / "map", tmp_path / "pruned"):
        lines = [line for line in map_lines(MapFolder.open(folder)) if line[0].startswith("contradicted")]
        assert lines[:2] == [("contradicted r2/5", "by r1, r3, r4"), ("contradicted r1/0", "by r2, r3")]
        assert lines[-1] == ("contradicted", "2 keyframes more, in map.json")
        assert len(lines) == 11
        weights = MapFolder.open(folder).saved().weights
        assert len(weights) == 12
        assert (weights[KeyframeId.parse("r2/5")], weights[KeyframeId.parse("r1/0")]) == (1 / 4, 1 / 3)


def test_a_fixed_map_does_not_move(block: Path, tmp_path: Path) -> None:
    mission(tmp_path / "run", AGAIN, MapUse(block, fixed=True))
    save_map(tmp_path / "run", tmp_path / "next")
    old, new = MapFolder.open(block).poses(), MapFolder.open(tmp_path / "next").poses()
    for log, poses in old.items():
        np.testing.assert_allclose(new[log], poses, atol=1e-12)
    assert len(new) == len(old) + 1


def test_a_map_is_not_written_over_the_one_that_the_team_worked_in(block: Path, second: Path) -> None:
    with pytest.raises(BadMap, match="the new one needs another folder"):
        save_map(second, block)


def test_a_team_that_never_found_itself_adds_nothing(block: Path, tmp_path: Path) -> None:
    mission(tmp_path / "run", FAR, MapUse(block))
    with pytest.raises(NotSolved, match=r"none of its robots found itself in .*block \(map/r1\)"):
        save_map(tmp_path / "run", tmp_path / "next")
    assert facts(tmp_path / "run", FoundInMap) == []


# Merge, prune, export


def test_maps_of_teams_that_never_met_become_one(block: Path, tmp_path: Path) -> None:
    mission(tmp_path / "run", AGAIN, lives={"r1": 7})
    other = LogId("r1", 7)
    taken_back = WithdrawalRecord(other, 0, 3, is_final=True)
    with closing(sqlite3.connect(tmp_path / "run/robots/r1/store/robot.sqlite")) as store, store:
        (count,) = store.execute("SELECT COUNT(*) FROM records WHERE log = ?", (str(other),)).fetchone()
        store.execute(PUT_RECORD, row("records", str(other), count, encode_record(taken_back)))
    save_map(tmp_path / "run", tmp_path / "other")
    merged = merge_maps(block, tmp_path / "other", tmp_path / "both", clock_ms=lambda: 5)
    opened = MapFolder.open(tmp_path / "both")
    first_said, *later = (decode_record(data) for data in opened.records[LogId(MERGER, 5)])
    assert first_said == taken_back
    judged = [record for record in later if isinstance(record, ClosureRecord | RejectionRecord)]
    assert len(judged) == len(later)
    ends = {end for record in judged for end in (record.query, record.match) if end.log == other}
    assert min(end.index for end in ends) >= 3, "what was taken back for good is not looked at"
    assert opened.manifest.frame == "map/r1"
    assert [entry.log for entry in opened.manifest.logs] == ["r1", "r2", "r1~7", f"{MERGER}~5"]
    assert merged.closures >= 10
    start = opened.poses()[LogId("r1", 7)][0, :3, 3]
    assert np.linalg.norm(start - opened.poses()[LogId("r1")][8, :3, 3]) < 0.6
    assert mission(tmp_path / "third", AGAIN, MapUse(tmp_path / "both")).map_frames == ["map/r1"]


def test_maps_with_nothing_in_common_are_refused_with_the_best_similarities(block: Path, tmp_path: Path) -> None:
    mission(tmp_path / "run", FAR, lives={"r1": 7, "r2": 7})
    save_map(tmp_path / "run", tmp_path / "far")
    with pytest.raises(BadMap, match=r"too little in common .* closures; most similar: r\d/\d+ and r\d~7/\d+ 0\.\d+"):
        merge_maps(block, tmp_path / "far", tmp_path / "both")
    assert not (tmp_path / "both").exists()


def test_maps_that_hold_one_log_are_told_apart(block: Path, second: Path, tmp_path: Path) -> None:
    save_map(second, tmp_path / "next")
    with pytest.raises(BadMap, match="both hold the log r1: they are editions of one map"):
        merge_maps(block, tmp_path / "next", tmp_path / "both")
    mission(tmp_path / "run", FAR)
    save_map(tmp_path / "run", tmp_path / "far")
    with pytest.raises(BadMap, match=r"both are of map/r1, and each has another log r1"):
        merge_maps(block, tmp_path / "far", tmp_path / "both")


def test_a_pruned_map_is_smaller_and_still_found(block: Path, tmp_path: Path) -> None:
    manifest = prune_map(block, tmp_path / "pruned", 1.6, 30.0)
    assert manifest.latents < 0.6 * read_manifest(block).latents
    mission(tmp_path / "run", AGAIN, MapUse(tmp_path / "pruned"))
    (found,) = facts(tmp_path / "run", FoundInMap)
    assert isinstance(found, FoundInMap)
    assert found.keyframes <= 10
    kept = set(MapFolder.open(tmp_path / "pruned").latent_keyframes())
    closures = RunFolder.open(tmp_path / "run").results()["r1"].closures
    ends = {end for c in closures for end in (c.query, c.match) if not end.startswith("r1~1/")}
    new = {end for end in ends if f"{end}" in {str(k) for k in kept}}
    old = {str(e) for q, m in MapFolder.open(block).used_closures() for e in (q, m)}
    assert ends - new <= old, "a keyframe without a latent is no candidate"


def test_an_exported_map_opens_in_what_it_is_made_for(block: Path, tmp_path: Path) -> None:
    opened = MapFolder.open(block)
    export_map(opened, tmp_path)
    poses = opened.poses()
    assert len(read_tum(tmp_path / "r1.tum")) == len(poses[LogId("r1")])
    graph = read_g2o(tmp_path / "map.g2o")
    assert len(graph.graph.closures) == opened.manifest.closures
    header, _, points = (tmp_path / "cameras.ply").read_bytes().partition(b"end_header\n")
    count = sum(map(len, poses.values()))
    assert f"element vertex {count}".encode() in header
    assert len(points) == 27 * count
    np.testing.assert_allclose(np.frombuffer(points[:12], "<f4"), poses[LogId("r1")][0, :3, 3], atol=1e-6)


# Bad input: one sentence each


def spoilt(block: Path, tmp_path: Path, **changes: object) -> Path:
    """A copy of a map whose manifest says something else."""
    folder = Path(shutil.copytree(block, tmp_path / "spoilt"))
    manifest = json.loads((folder / "map.json").read_text())
    (folder / "map.json").write_text(json.dumps(manifest | changes))
    return folder


def test_a_folder_that_is_no_map_is_named(tmp_path: Path, block: Path) -> None:
    with pytest.raises(BadMap, match="is not a folder"):
        MapFolder.open(tmp_path / "nowhere")
    (tmp_path / "map.json").write_text('{"a": 1}')
    with pytest.raises(BadMap, match="is not of a flocc map"):
        MapFolder.open(tmp_path)
    (tmp_path / "map.json").write_text((block / "map.json").read_text()[:200])
    with pytest.raises(BadMap, match="is cut off or not JSON"):
        MapFolder.open(tmp_path)


def test_a_map_of_another_version_is_named(block: Path, tmp_path: Path) -> None:
    with pytest.raises(BadMap, match="is of format 2, and this flocc reads 1"):
        MapFolder.open(spoilt(block, tmp_path, format=2))


@pytest.mark.parametrize("pattern", ["records-*", "solution-*", "latents-*"])
def test_a_map_that_was_cut_off_is_named(block: Path, tmp_path: Path, pattern: str) -> None:
    folder = Path(shutil.copytree(block, tmp_path / "spoilt"))
    (file,) = folder.glob(pattern)
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(BadMap, match="it is cut off or altered"):
        MapFolder.open(folder)
    file.unlink()
    with pytest.raises(BadMap, match="is missing; the map is not whole"):
        MapFolder.open(folder)


def test_an_altered_byte_is_found(block: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(block, tmp_path / "spoilt"))
    for pattern in ("records-*", "solution-*", "latents-*"):
        (file,) = folder.glob(pattern)
        data = bytearray(file.read_bytes())
        data[len(data) // 2] ^= 1
        file.write_bytes(data)
    opened = MapFolder.open(folder)
    with pytest.raises(BadMap, match="its checksum is another one"):
        _ = opened.records
    with pytest.raises(BadMap, match="its checksum is another one"):
        opened.saved()


def altered(block: Path, tmp_path: Path, pattern: str) -> Path:
    """A copy of a map in which one byte of a file is another one."""
    folder = Path(shutil.copytree(block, tmp_path / f"altered-{pattern[:3]}"))
    (file,) = folder.glob(pattern)
    data = bytearray(file.read_bytes())
    data[-20] ^= 1
    file.write_bytes(data)
    return folder


@pytest.mark.parametrize("pattern", ["records-*", "solution-*", "latents-*"])
def test_every_command_of_maps_refuses_an_altered_byte(
    block: Path,
    tmp_path: Path,
    pattern: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder, out = str(altered(block, tmp_path, pattern)), str(tmp_path / "out")
    for words in (
        ("map", "info", folder),
        ("map", "info", folder, "--json"),
        ("map", "prune", folder, "--out", out),
        ("map", "merge", folder, str(block), "--out", out),
        ("simulate", "meeting", "--map", folder, "--out", out),
    ):
        code, text = said(capsys, monkeypatch, *words)
        assert (code, "its checksum is another one" in text) == (2, True), words
        assert text.startswith("error: ")
    assert not Path(out).exists()


def rewritten(block: Path, tmp_path: Path, what: str, data: bytes, suffix: str) -> Path:
    """A copy of a map with another file, whose checksum fits."""
    name = f"{what}-other.{suffix}"
    key = {"latents": "latent_file"}.get(what, what)
    folder = spoilt(
        block,
        tmp_path,
        **{key: {"name": name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}},
    )
    (folder / name).write_bytes(data)
    return folder


@pytest.mark.parametrize("what", ["records", "solution", "latents"])
@pytest.mark.parametrize("data", [b"", b"hello", bytes(5000)])
def test_files_of_something_else_are_named_even_where_checksums_fit(
    block: Path, tmp_path: Path, what: str, data: bytes
) -> None:
    folder = rewritten(block, tmp_path, what, data, "bin")
    with pytest.raises(BadMap, match=f"{what}-other.bin: "):
        MapFolder.open(folder).check_whole()


def turned(name: str, change: Any) -> Any:
    """A change of one array of a solution; None takes it away."""

    def of(arrays: dict[str, Any]) -> None:
        array = arrays.pop(name)
        if change is not None:
            arrays[name] = change(array)

    return of


@pytest.mark.parametrize(
    ("name", "change"),
    [
        (name, change)
        for name, changes in {
            "poses0": (lambda x: x[:0], lambda x: x * np.nan, lambda x: x * 0, lambda x: x[0], lambda x: x.astype(str)),
            "covariances0": (lambda x: x[:, :5], lambda x: x[:-1], lambda x: x.astype(int)),
            "closures": (lambda x: x + 1000, lambda x: -1 - x, lambda x: x[:-1], lambda x: x + 0.5, lambda x: x[0]),
            "closure_values": (lambda x: x * np.nan, lambda x: x[:, :1]),
        }.items()
        for change in (None, *changes)
    ],
)
def test_a_solution_that_does_not_fit_is_named(block: Path, tmp_path: Path, name: str, change: Any) -> None:
    arrays = dict(MapFolder.open(block).solution)
    turned(name, change)(arrays)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    folder = rewritten(block, tmp_path, "solution", buffer.getvalue(), "npz")
    for reading in (MapFolder.poses, MapFolder.saved, MapFolder.used_closures, MapFolder.check_whole):
        with pytest.raises(BadMap, match=r"solution-other\.npz: does not fit the map"):
            reading(MapFolder.open(folder))


@pytest.mark.parametrize(
    "change",
    [{"fx": 0.0}, {"width": -1}, {"T_body_camera": [0.0] * 7}, {"records": -3}, {"records": 3}, {"records": 9999}],
)
def test_a_log_that_cannot_be_is_named(block: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    logs = json.loads((block / "map.json").read_text())["logs"]
    lens = {"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
    logs[0] |= {"camera": lens | change} if set(change) <= set(lens) else change
    with pytest.raises(BadMap, match=r"map\.json"):
        MapFolder.open(spoilt(block, tmp_path, logs=logs)).check_whole()


@pytest.mark.parametrize(
    "change", [{"frame": "map/zz"}, {"edition": 0}, {"name": "\ud800"}, {"latents": 1}, {"poses": 1}]
)
def test_a_manifest_that_contradicts_its_files_is_refused(block: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    with pytest.raises(BadMap):
        MapFolder.open(spoilt(block, tmp_path, **change)).check_whole()


def test_a_manifest_of_brackets_is_refused(block: Path, tmp_path: Path) -> None:
    (Path(shutil.copytree(block, tmp_path / "deep")) / "map.json").write_text("[" * 100_000)
    with pytest.raises(BadMap, match="is cut off or not JSON"):
        MapFolder.open(tmp_path / "deep")


def test_a_map_without_latents_is_pruned_and_merged_in_a_sentence(first: Path, block: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(first, tmp_path / "run"))
    for file in run.glob("robots/*/store/latents.sqlite"):
        file.unlink()
    save_map(run, tmp_path / "blind")
    assert prune_map(tmp_path / "blind", tmp_path / "small", 2.0, 30.0).latents == 0
    assert like_pairs(MapFolder.open(tmp_path / "blind"), MapFolder.open(block), 3) == []


def test_a_map_whose_name_is_no_text_is_saved(first: Path, tmp_path: Path) -> None:
    out = tmp_path / os.fsdecode(b"t\xf6wn")
    try:
        out.mkdir()
    except OSError:
        pytest.skip("this file system takes UTF-8 only")
    assert save_map(first, out).name == MapFolder.open(out).manifest.name == "t\ufffdwn"
    assert save_map(first, out, name="one\x1b[31m\ntwo").name == "one\ufffd[31m\ufffdtwo"


def test_a_run_in_a_map_whose_folder_is_no_text_ends_in_a_sentence(
    block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / os.fsdecode(b"t\xf6wn")
    try:
        shutil.copytree(block, folder)
    except OSError:
        pytest.skip("this file system takes UTF-8 only")
    out = str(tmp_path / "run")
    words = ("simulate", "meeting", "--set", "duration_s=1", "--map", str(folder), "--out", out)
    code, text = said(capsys, monkeypatch, *words)
    assert (code, "is not UTF-8" in text) == (2, True), text


def test_what_is_missing_from_a_run_is_said_when_it_is_saved(
    first: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Path(shutil.copytree(first, tmp_path / "run"))
    shutil.rmtree(run / "robots" / "r2" / "store")
    (run / "robots" / "r1" / "store" / "latents.sqlite").unlink()
    code, text = said(capsys, monkeypatch, "map", "save", str(run), "--out", str(tmp_path / "map"))
    assert code == 0
    assert "left out: r2 left no log in any store" in text
    keyframes = MapFolder.open(tmp_path / "map").manifest.logs[0].keyframes
    assert f"without latents: {keyframes} keyframes" in text
    _, whole = said(capsys, monkeypatch, "map", "save", str(first), "--out", str(tmp_path / "whole"))
    assert "left out" not in whole
    assert "without latents" not in whole


def test_a_run_is_not_replaced_for_a_map_that_cannot_be_used(
    first: Path, block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Path(shutil.copytree(first, tmp_path / "run"))
    inside = Path(shutil.copytree(block, run / "map"))
    before = content_of_files(run)
    for command in ("simulate", "launch"):
        for folder, sentence in (
            (tmp_path / "nowhere", "is not a folder"),
            (altered(block, tmp_path / command, "latents-*"), "its checksum is another one"),
            (inside, "holds the map"),
        ):
            code, text = said(capsys, monkeypatch, command, "meeting", "--map", str(folder), "--out", str(run))
            assert (code, sentence in text) == (2, True), text
    assert content_of_files(run) == before


def content_of_files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_map_is_not_exported_into_itself(block: Path) -> None:
    before = content_of_files(block)
    with pytest.raises(BadMap, match="is the map itself"):
        export_map(MapFolder.open(block), block / ".." / block.name)
    assert content_of_files(block) == before


def test_a_manifest_that_names_a_file_elsewhere_is_refused(block: Path, tmp_path: Path) -> None:
    wrong = {"name": "../records.bin", "bytes": 1, "sha256": ""}
    with pytest.raises(BadMap, match="names a file elsewhere"):
        MapFolder.open(spoilt(block, tmp_path, records=wrong))


def test_a_map_of_another_front_end_is_named(block: Path, tmp_path: Path) -> None:
    with pytest.raises(BadMap, match=r"was made with perception\.method 'synthetic', and block has 'classical'"):
        simulate(scenario(AGAIN, perception={"method": "classical"}), tmp_path / "run", use=MapUse(block))
    front_end = json.loads((block / "map.json").read_text())["front_end"] | {"model": "synthetic/0"}
    other = spoilt(block, tmp_path, front_end=front_end)
    with pytest.raises(BadMap, match="its latents are of 'synthetic/0', and this front end makes 'synthetic/1'"):
        simulate(scenario(AGAIN), tmp_path / "run2", use=MapUse(other))
    (tmp_path / "earlier").mkdir()
    (tmp_path / "earlier/run.json").write_text("{}")
    with pytest.raises(BadMap, match="its latents are of 'synthetic/0'"):
        launch(scenario(AGAIN), tmp_path / "earlier", use=MapUse(other))
    assert (tmp_path / "earlier/run.json").exists(), "the earlier run stays"


def test_a_much_wider_lens_is_said_and_allowed(block: Path) -> None:
    lens = LensModel(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
    opened = MapFolder.open(block)
    entries = tuple(entry.model_copy(update={"camera": lens}) for entry in opened.manifest.logs)
    opened.manifest = opened.manifest.model_copy(update={"logs": entries})
    assert opened.other_lens(lens.model_copy(update={"fx": 600.0})) is None
    warning = opened.other_lens(lens.model_copy(update={"fx": 200.0}))
    assert warning is not None
    assert "lenses of 65 degrees and this one has 116" in warning


def test_distributed_mode_and_the_quick_optimiser_know_no_maps(block: Path, tmp_path: Path) -> None:
    wrong: list[dict[str, Any]] = [
        {"backend": {"mode": "distributed", "formulation": "base"}},
        {"simulation": {"optimiser": "quick"}},
    ]
    for changes in wrong:
        with pytest.raises(FloccError, match="knows no maps"):
            simulate(scenario(AGAIN, **changes), tmp_path / "run", use=MapUse(block))


def test_runs_that_hold_no_store_or_no_keyframe_give_no_map(tmp_path: Path, first: Path) -> None:
    with pytest.raises(BadMap, match="holds no robot's store"):
        save_map(tmp_path, tmp_path / "map")
    with pytest.raises(BadMap, match="nowhere: there is no such folder"):
        save_map(tmp_path / "nowhere", tmp_path / "map")
    with pytest.raises(NotSolved, match=r"has no map map/r9; there are map/r1"):
        save_map(first, tmp_path / "map", frame="map/r9")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(BadMap, match="holds something else than a map; choose another --out"):
        save_map(first, tmp_path / "mine")
    assert (tmp_path / "mine" / "letter.txt").read_text() == "dear"


def test_a_run_and_a_map_that_are_mistaken_for_each_other_are_told(first: Path, block: Path, tmp_path: Path) -> None:
    for part in (first, first / "robots" / "r1", first / "robots" / "r1" / "store"):
        with pytest.raises(BadMap, match=f"no map yet: flocc map save {part} --out FOLDER makes one of it"):
            MapFolder.open(part)
    with pytest.raises(BadMap, match="is a map already"):
        save_map(block, tmp_path / "map")


def test_two_missions_in_one_folder_are_told_apart(first: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(first, tmp_path / "run"))
    mission(tmp_path / "far", FAR)
    shutil.copytree(tmp_path / "far" / "robots" / "r1", run / "robots" / "r1b")
    with pytest.raises(BadMap, match="two robots hold different logs r1"):
        save_map(run, tmp_path / "map")


def test_a_robot_does_not_go_on_with_a_log_of_the_map(block: Path) -> None:
    opened = MapFolder.open(block)
    with pytest.raises(BadMap, match=r"holds the log r1, which robot r1 goes on writing: begin a new journey"):
        joined_logs(opened, {}, LogId("r1"), None)
    other = {LogId("r2"): (b"another",)}
    with pytest.raises(BadMap, match=r"holds another log r2 than the robot's own folder"):
        joined_logs(opened, other, LogId("z"), None)
    longer = {LogId("r2"): (*opened.records[LogId("r2")], b"more")}
    assert joined_logs(opened, longer, LogId("z"), None)[LogId("r2")][-1] == b"more"


@pytest.fixture
def signed(first: Path, tmp_path: Path) -> tuple[Path, dict[str, RecordSealer]]:
    """The same run in a swarm with keys: every record with its writer's signature, and who can check them."""
    pytest.importorskip("cryptography")
    run = Path(shutil.copytree(first, tmp_path / "signed"))
    folders = make_keys(tmp_path / "keys", "block", ["r1", "r2", "z"])
    sealers = {name: RecordSealer.of(TlsConfig(folder=folder)) for name, folder in folders.items()}
    for name in ("r1", "r2"):
        log = LogId(name)
        with closing(sqlite3.connect(run / "robots" / name / "store" / "robot.sqlite")) as store, store:
            plain = store.execute("SELECT number, data FROM records WHERE log = ?", (name,)).fetchall()
            store.execute("DELETE FROM records")
            rows = [row("records", name, n, sealers[name].seal(log, n, data)) for n, data in plain]
            store.executemany(PUT_RECORD, rows)
    return run, sealers


def test_a_map_keeps_signatures_and_is_believed_by_its_own_swarm_only(
    signed: tuple[Path, dict[str, RecordSealer]], tmp_path: Path
) -> None:
    run, sealers = signed
    manifest = save_map(run, tmp_path / "map")
    assert manifest.signed
    opened = MapFolder.open(tmp_path / "map")
    opened.check_keys(sealers["z"])
    records = opened.records[LogId("r2")]
    assert all(sealers["z"].opened(LogId("r2"), n, data) for n, data in enumerate(records))
    with pytest.raises(BadMap, match="its logs are signed, and this swarm has no keys"):
        opened.check_keys(None)
    others = make_keys(tmp_path / "others", "block", ["r1", "r2", "z"])
    with pytest.raises(BadMap, match="is of a swarm with other keys: log r1"):
        opened.check_keys(RecordSealer.of(TlsConfig(folder=others["z"])))
    save_map(run, tmp_path / "again")
    with pytest.raises(BadMap, match="their logs are signed"):
        merge_maps(tmp_path / "map", _renamed(tmp_path / "again"), tmp_path / "both")


def _renamed(folder: Path) -> Path:
    """Make a map's logs look like those of other robots."""
    path = folder / "map.json"
    manifest = json.loads(path.read_text())
    for entry in manifest["logs"]:
        entry["log"] = entry["log"].replace("r", "s")
    manifest["frame"] = "map/" + manifest["logs"][0]["log"]
    path.write_text(json.dumps(manifest))
    return folder


# The command line


def test_commands_say_what_they_did(
    first: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = str(tmp_path / "map")
    code, text = said(capsys, monkeypatch, "map", "save", str(first), "--out", out)
    assert (code, text.split(": ")[0]) == (0, "map/r1")
    code, text = said(capsys, monkeypatch, "map", "info", out)
    assert code == 0
    assert "frame map/r1 logs 2 keyframes" in text
    known = json.loads(said(capsys, monkeypatch, "map", "info", out, "--json")[1])
    assert [entry["log"] for entry in known["logs"]] == ["r1", "r2"]
    assert 0.0 < known["positions_sigma_m"][0] <= known["positions_sigma_m"][1] < 1.0
    assert said(capsys, monkeypatch, "map", "export", out, "--out", str(tmp_path / "files"))[0] == 0
    code, text = said(capsys, monkeypatch, "map", "prune", out, "--out", str(tmp_path / "small"))
    assert code == 0
    assert " latents, " in text
    code, text = said(capsys, monkeypatch, "map", "merge", out, str(tmp_path / "small"), "--out", str(tmp_path / "b"))
    assert (code, "editions of one map" in text) == (2, True)
    code, text = said(capsys, monkeypatch, "simulate", "meeting", "--map-fixed")
    assert (code, text) == (2, "error: --map-fixed says of --map that it does not move; give --map FOLDER")


# Sessions


def test_sessions_one_after_the_other_make_one_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    given = scenario({**BLOCK, "r3": FAR["r1"]})
    paths = recordings(given)
    told: list[tuple[str, bool]] = []
    manifest = map_of_sessions(
        given, paths, tmp_path / "map", tmp_path / "runs", tell=lambda s: told.append((s.name, s.left_out is None))
    )
    assert told == [("r1", True), ("r2", True), ("r3", False)], "the third was never near"
    assert (manifest.frame, manifest.edition, manifest.name) == ("map/r1", 2, "map")
    assert [entry.log for entry in manifest.logs] == ["r1", "r2"]
    assert MapFolder.open(tmp_path / "map").records == MapFolder.open(tmp_path / "runs" / "02-r2" / "map").records
    with pytest.raises(BadMap, match="is not empty; choose another --runs"):
        map_of_sessions(given, paths, tmp_path / "map", tmp_path / "runs")
    later = map_of_sessions(given, {"r1": paths["r1"]}, tmp_path / "next", tmp_path / "more", begin=tmp_path / "map")
    assert [entry.log for entry in later.logs] == ["r1", "r2", "r1~1"]
