"""A run as MCAP: opened by `mcap` with the file's own schemas, drawn from its messages, opened by rerun; live."""

import base64
import json
import math
import os
import re
import shutil
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.agent.runtime.loopback import free_ports
from tests.launch import synthetic_run

from flocc_agent.geometry import Float, pose_from_tq
from flocc_launch.commands.main import _record
from flocc_launch.runs.loaded_run import LoadedRun, load
from flocc_launch.runs.run_folder import RunFolder
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.shipped import read_shipped
from flocc_launch.simulation.simulate import simulate
from flocc_launch.view import scene_drawing
from flocc_launch.view.mcap_file import McapError, foxglove_server, write_mcap
from flocc_launch.view.scene_drawing import FoxgloveMissing, layout

pytest.importorskip("foxglove")
pytest.importorskip("mcap_protobuf")

SCHEMAS = {
    "/tf": "foxglove.FrameTransforms",
    "/graph": "foxglove.SceneUpdate",
    "/events": "foxglove.Log",
    "before": "foxglove.PosesInFrame",
    "after": "foxglove.PosesInFrame",
    "keyframes": "foxglove.CompressedImage",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A simulated run with images."""
    out = tmp_path_factory.mktemp("run") / "run"
    scenario = read_shipped("corridor")
    simulate(scenario, out, recordings=recordings(scenario))
    return RunFolder.open(out)


@pytest.fixture(scope="module")
def loaded(run: RunFolder) -> LoadedRun:
    """The same run, read."""
    return load(run)


@pytest.fixture(scope="module")
def mcap(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run as MCAP."""
    return write_mcap(run, tmp_path_factory.mktemp("mcap") / "run.mcap")


def messages(path: Path) -> Iterator[tuple[str, str, int, Any]]:
    """Topic, schema, time (ns) and message as the file's own schema decodes it."""
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.message_encoding == "json":
                yield channel.topic, schema.name, message.log_time, json.loads(message.data)
                continue
            decoder = DecoderFactory().decoder_for(channel.message_encoding, schema)
            assert decoder is not None
            yield channel.topic, schema.name, message.log_time, decoder(message.data)


def last(path: Path) -> dict[str, Any]:
    """The last message of each topic."""
    return {topic: message for topic, _, _, message in messages(path)}


def pose_of(told: Any) -> Float:
    """A Pose or FrameTransform as a matrix."""
    t = told.position if hasattr(told, "position") else told.translation
    q = told.orientation if hasattr(told, "orientation") else told.rotation
    return pose_from_tq(np.array([t.x, t.y, t.z, q.w, q.x, q.y, q.z]))


def test_every_topic_has_foxgloves_schema_and_times_within_the_run(mcap: Path, loaded: LoadedRun) -> None:
    schemas, times_ns = dict[str, str](), list[int]()
    for topic, schema, at_ns, _ in messages(mcap):
        schemas[topic] = schema
        times_ns.append(at_ns)
    expected = {topic: name for topic, name in SCHEMAS.items() if topic.startswith("/")}
    for robot in loaded.robots:
        expected |= {f"/{robot}/{name}": SCHEMAS[name] for name in ("before", "after", "keyframes")}
    assert {topic: schema for topic, schema in schemas.items() if topic != "/status"} == expected
    assert times_ns == sorted(times_ns)
    assert max(times_ns) - min(times_ns) <= loaded.end_s * 1e9 + 1


def test_corrected_keyframes_are_those_of_the_results(mcap: Path, loaded: LoadedRun) -> None:
    ended = last(mcap)
    for robot, track in loaded.tracks.items():
        after = ended[f"/{robot}/after"]
        assert after.frame_id == track.map_frame
        told = np.array([pose_of(each) for each in after.poses])
        np.testing.assert_allclose(told, track.T_map_body[track.corrected], atol=1e-6)
        assert len(ended[f"/{robot}/before"].poses) == len(track)


def test_frames_form_one_tree_of_which_the_robots_are_leaves(mcap: Path, loaded: LoadedRun) -> None:
    parents = dict[str, str]()
    for topic, _, _, message in messages(mcap):
        if topic == "/tf":
            for each in message.transforms:
                assert math.isclose(sum(getattr(each.rotation, axis) ** 2 for axis in "xyzw"), 1.0, abs_tol=1e-6)
                parents[each.child_frame_id] = each.parent_frame_id
    for robot in loaded.robots:
        chain = [robot]
        while chain[-1] in parents and len(chain) < 9:
            chain.append(parents[chain[-1]])
        assert chain == [robot, f"{robot}/odom", loaded.tracks[robot].map_frame, "world"]


def test_events_and_images_are_those_of_the_run(mcap: Path, loaded: LoadedRun) -> None:
    cv2 = pytest.importorskip("cv2")
    told = Counter(topic for topic, *_ in messages(mcap))
    for robot, track in loaded.tracks.items():
        assert told[f"/{robot}/keyframes"] == len(track)
    said = [message.message for topic, _, _, message in messages(mcap) if topic == "/events"]
    assert any("leads, term" in sentence for sentence in said)
    image = last(mcap)["/r1/keyframes"]
    pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    assert pixels.shape[1] <= scene_drawing.IMAGE_WIDTH_MAX


def test_the_last_scene_draws_the_map_of_the_results(mcap: Path, loaded: LoadedRun, tmp_path: Path) -> None:
    """Drawn from the messages' own fields only; each end of a closure is at a corrected keyframe."""
    ended = last(mcap)
    entities = {entity.id: entity for entity in ended["/graph"].entities}
    assert {f"robot/{robot}" for robot in loaded.robots} | {"closures", "links"} == set(entities)
    (lines,) = entities["closures"].lines
    ends = np.array([[point.x, point.y, point.z] for point in lines.points])
    assert len(ends) == 2 * sum(pair.accepted for pair in loaded.pairs)
    assert len(lines.colors) == len(ends)
    keyframes = np.concatenate([track.T_map_body[:, :3, 3] for track in loaded.tracks.values()])
    off_m = np.linalg.norm(ends[:, None] - keyframes[None], axis=2).min(axis=1)
    assert off_m.max() < 2e-3
    draw(ended, tmp_path / "scene.png")
    assert (tmp_path / "scene.png").stat().st_size > 10_000


def draw(ended: dict[str, Any], path: Path) -> None:
    """The last scene as a picture."""
    pyplot = pytest.importorskip("matplotlib.pyplot")
    figure, axes = pyplot.subplots(figsize=(8, 6))
    for topic, message in sorted(ended.items()):
        if topic.endswith("/after"):
            points = np.array([[each.position.x, each.position.y] for each in message.poses])
            axes.plot(points[:, 0], points[:, 1], label=topic)
    for entity in ended["/graph"].entities:
        for lines in entity.lines:
            for k in range(0, len(lines.points), 2):
                a, b = lines.points[k : k + 2]
                colour = lines.colors[k]
                axes.plot([a.x, b.x], [a.y, b.y], color=(colour.r, colour.g, colour.b), linewidth=lines.thickness / 3)
    axes.set_aspect("equal")
    axes.legend()
    figure.savefig(path, dpi=80)
    pyplot.close(figure)


def test_the_layout_names_topics_that_are_there(mcap: Path, loaded: LoadedRun) -> None:
    fields = json.loads(mcap.with_suffix(".layout.json").read_text())
    panels = fields["configById"]
    topics = {*panels["3D!map"]["topics"], panels["RosOut!events"]["topicToRender"]}
    topics |= {panel["imageMode"]["imageTopic"] for name, panel in panels.items() if name.startswith("Image!")}
    topics.add(panels["RawMessages!status"]["topicPath"])
    assert topics <= set(last(mcap))
    placed, waiting = list[str](), [fields["layout"]]
    while waiting:
        each = waiting.pop()
        if isinstance(each, str):
            placed.append(each)
        else:
            waiting += [each["first"], each["second"]]
    assert sorted(placed) == sorted(panels)
    assert json.loads(layout([]))["layout"]


def test_rerun_opens_the_file(mcap: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    out = tmp_path / "run.rrd"
    program = "import sys; from rerun_cli.__main__ import main; sys.argv[0] = 'rerun'; main()"
    command = [sys.executable, "-c", program, "mcap", "convert", str(mcap), "-o", str(out)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stderr
    content = out.read_bytes()
    for entity in (b"/r1/after", b"/graph", b"/r2/keyframes"):
        assert entity in content


def test_a_run_without_images_is_written_and_images_are_bounded(
    tmp_path: Path, run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    topics = set(last(write_mcap(folder, tmp_path / "a.mcap")))
    assert not any(topic.endswith("/keyframes") for topic in topics)
    monkeypatch.setattr(scene_drawing, "IMAGES_BYTES_MAX", 1)
    told = Counter(topic for topic, *_ in messages(write_mcap(run, tmp_path / "b.mcap")))
    assert sum(count for topic, count in told.items() if topic.endswith("/keyframes")) == 1


def test_nothing_but_an_earlier_mcap_file_is_replaced(run: RunFolder, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    for _ in range(2):
        write_mcap(run, path)
    path.write_bytes(b"")
    write_mcap(run, path)
    notes = tmp_path / "notes.txt"
    notes.write_text("mine")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for taken in (notes, pipe, tmp_path, run.path / "run.json", Path("/dev/null")):
        with pytest.raises(McapError, match=r"cannot be written \(it is "):
            write_mcap(run, taken)
    assert notes.read_text() == "mine"
    assert pipe.is_fifo()
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize("at_s", ["-5.0", "1e30"])
def test_a_time_that_is_none_is_one_sentence(run: RunFolder, tmp_path: Path, at_s: str) -> None:
    other = Path(shutil.copytree(run.path, tmp_path / "run"))
    lines = (other / "events.jsonl").read_text()
    (other / "events.jsonl").write_text(re.sub(r'"t": ?[0-9.e-]+', f'"t": {at_s}', lines))
    with pytest.raises(McapError, match="holds a time that MCAP cannot"):
        write_mcap(RunFolder.open(other), tmp_path / "run.mcap")
    fields = json.loads((other / "run.json").read_text())
    (other / "run.json").write_text(json.dumps(fields | {"start": "yesterday"}))
    with pytest.raises(McapError, match="start: 'yesterday' is no date"):
        write_mcap(RunFolder.open(other), tmp_path / "run.mcap")
    assert not list(tmp_path.glob("run.mcap*"))


def test_what_cannot_be_written_is_one_sentence_and_leaves_nothing(tmp_path: Path, run: RunFolder) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(McapError, match=r"run.mcap: cannot be written \("):
        write_mcap(run, tmp_path / "file" / "run.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_file_that_cannot_be_written_does_not_hide_what_came_of_the_run(
    run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`launch` goes on to its report; stdout stays free for JSON."""
    (tmp_path / "file").write_text("")
    assert _record(run.path, tmp_path / "file" / "run.mcap")
    out, err = capsys.readouterr()
    assert (out, err.count("error: "), "cannot be written" in err) == ("", 1, True)
    assert not _record(run.path, tmp_path / "run.mcap")


def test_without_the_package_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, run: RunFolder) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(FoxgloveMissing, match=r"pip install '\.\[mcap\]'"):
        write_mcap(run, run.path / "run.mcap")


def test_a_run_that_grows_is_served_to_foxglove(run: RunFolder) -> None:
    """A client by Foxglove's protocol hears of every topic of the run."""
    (port,) = free_ports(1)
    with foxglove_server(run, "127.0.0.1", port) as url:
        assert url == f"ws://127.0.0.1:{port}"
        channels = advertised(port, {"/graph", "/status", "/events", "/r1/after"})
    assert channels["/graph"]["schemaName"] == "foxglove.SceneUpdate"
    assert channels["/status"]["encoding"] == "json"


def test_a_port_that_is_taken_is_said(run: RunFolder) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with (
            pytest.raises(McapError, match=r"127\.0\.0\.1:\d+: cannot be served"),
            foxglove_server(run, "127.0.0.1", taken.getsockname()[1]),
        ):
            pass


def advertised(port: int, wanted: set[str]) -> dict[str, Any]:
    """Channels that a Foxglove server tells of, by topic, as soon as those wanted are among them."""
    channels: dict[str, Any] = {}
    with socket.create_connection(("127.0.0.1", port), timeout=10.0) as connection:
        key = base64.b64encode(bytes(16)).decode()
        connection.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        stream = connection.makefile("rb")
        assert b"101" in stream.readline()
        while stream.readline() != b"\r\n":
            pass
        while not wanted <= channels.keys():
            head = stream.read(2)
            length = head[1] & 127
            if length >= 126:
                length = int.from_bytes(stream.read(2 if length == 126 else 8), "big")
            payload = stream.read(length)
            if head[0] & 15 == 1 and (told := json.loads(payload))["op"] == "advertise":
                channels |= {each["topic"]: each for each in told["channels"]}
    return channels


def test_the_command_writes_into_the_run_folder_or_where_it_is_told(tmp_path: Path) -> None:
    folder = synthetic_run.write(tmp_path / "run")
    program = "from flocc_launch.commands.main import main; main()"
    for options in ([], ["--mcap", str(tmp_path / "elsewhere" / "a.mcap")]):
        command = [sys.executable, "-c", program, "export", str(folder.path), *options]
        ran = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert ran.returncode == 0, ran.stderr
    for path in (folder.path / "run.mcap", tmp_path / "elsewhere" / "a.mcap"):
        assert "/tf" in last(path)
        assert path.with_suffix(".layout.json").exists()
