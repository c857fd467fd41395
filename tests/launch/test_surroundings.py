"""What the world does to a command is one sentence with exit code 2: homes, disks, locales, networks."""

import contextlib
import errno
import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from flocc_agent.config import TransportConfig
from flocc_agent.core.interfaces import Camera
from flocc_agent.core.reports import Fact
from flocc_agent.perception.learned.weight_sources import weights_folder
from flocc_agent.runtime import network_faults as network
from flocc_agent.runtime import zenoh_admin
from flocc_agent.runtime.event_lines import Reported
from flocc_agent.runtime.facts import AgentStopped
from flocc_agent.runtime.recording import write_camera
from flocc_agent.runtime.trajectory import Trajectory, write_tum
from flocc_launch.commands import main as command_line
from flocc_launch.commands.common import EXIT_TRY_AGAIN
from flocc_launch.datasets import writer
from flocc_launch.doctor.installation import surroundings
from flocc_launch.setup import cache
from flocc_launch.setup.cache import CacheError, cache_folder
from flocc_launch.setup.world_faults import sentence_of, speak_utf8
from flocc_launch.swarm import agent_process
from flocc_launch.swarm.agent_process import LOOK_PERIOD_S, RETRY_S, Lines
from flocc_protocol.errors import FloccError


def write_plain(path: Path, count: int = 4) -> Path:
    (path / "images").mkdir(parents=True)
    for k in range(count):
        cv2.imwrite(str(path / "images" / f"{100 + k}.000.png"), np.full((24, 32, 3), 9 * k, np.uint8))
    write_tum(
        path / "odometry.tum",
        Trajectory(np.linspace(100.0, 99.0 + count, count), np.repeat(np.eye(4)[None], count, axis=0)),
    )
    write_camera(path / "camera.toml", Camera(32, 24, 30.0, 30.0, 16.0, 12.0), np.eye(4))
    return path


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> int:
    """Exit code of the entry point."""
    monkeypatch.setattr(sys, "argv", ["flocc", *words])
    with pytest.raises(SystemExit) as left:
        command_line.main()
    assert isinstance(left.value.code, int)
    return left.value.code


def homeless(monkeypatch: pytest.MonkeyPatch, temporary: Path) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("FLOCC_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))


def test_a_user_without_a_home_has_a_cache_in_the_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    homeless(monkeypatch, tmp_path)
    assert cache_folder() == tmp_path / f"flocc-{os.getuid()}"


def test_a_home_that_cannot_be_written_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    homeless(monkeypatch, tmp_path)
    (tmp_path / "home").write_text("a file, where nobody can make a folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / f"flocc-{os.getuid()}"


def test_no_place_at_all_names_the_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    homeless(monkeypatch, tmp_path)
    monkeypatch.setattr(cache, "can_be_written", lambda _: False)
    with pytest.raises(CacheError, match="name a folder with FLOCC_CACHE"):
        cache_folder()
    monkeypatch.setenv("FLOCC_CACHE", "/somewhere")
    with pytest.raises(CacheError, match="/somewhere: cannot be written; FLOCC_CACHE names"):
        cache_folder()


def test_doctor_finds_a_folder_and_a_cache_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "cache"))
    assert [finding.cause for finding in surroundings(tmp_path)] == ["cache"]
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("FLOCC_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert [(finding.cause, finding.advice != "") for finding in surroundings(tmp_path)] == [
        ("folder", True),
        ("cache", True),
    ]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "runs/a"), "runs/a: the disk is full; what was written"),
        (PermissionError(errno.EACCES, "Permission denied", "/root/x"), "/root/x: permission denied: choose a folder"),
        (OSError(errno.EROFS, "Read-only file system", "/mnt/x"), "/mnt/x: the disk is read-only"),
        (IsADirectoryError(errno.EISDIR, "Is a directory", "/tmp"), "/tmp: Is a directory"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), "a text cannot be read or written: 'utf-8'"),
        (sqlite3.OperationalError("database or disk is full"), "a store cannot be used: database or disk is full"),
        (ExceptionGroup("tasks", [FloccError("camera.yaml: is empty")]), "camera.yaml: is empty"),
    ],
)
def test_what_the_world_does_is_a_sentence(error: Exception, said: str) -> None:
    sentence = sentence_of(error)
    assert sentence is not None
    assert sentence.startswith(said)


def test_a_bug_stays_a_traceback() -> None:
    assert sentence_of(ValueError("negative")) is None
    assert sentence_of(ExceptionGroup("tasks", [OSError("a"), KeyError("b")])) is None


def test_a_full_disk_ends_a_conversion_with_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(path: str, _: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", path)

    monkeypatch.setattr(writer, "_write", full)
    source = write_plain(tmp_path / "data")
    assert run(monkeypatch, "dataset", "convert", str(source), "--out", str(tmp_path / "out")) == 2
    assert "error: " in (told := capsys.readouterr().err)
    assert "000000.png: the disk is full; what was written before is kept" in told


def test_a_full_disk_costs_events_and_not_the_robot(caplog: pytest.LogCaptureFixture) -> None:
    lines = Lines(Path("/dev/full"))
    event: Reported[Fact] = Reported(1.0, "r1", AgentStopped())
    lines.write(event)
    lines.write(event)
    lines.close()
    assert caplog.text.count("/dev/full: No space left on device; events are not written meanwhile") == 1


def test_events_are_written_again_once_there_is_room(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    now_s = [0.0]
    path = tmp_path / "r1" / "events.jsonl"
    path.parent.write_text("in the way")
    lines = Lines(path, lambda: now_s[0])
    for t in (0.0, 1.0, RETRY_S + 1.0):
        now_s[0] = t
        lines.write(Reported(t, "r1", AgentStopped()))
    assert caplog.text.count("events are not written meanwhile") == 1
    path.parent.unlink()
    for t in (RETRY_S + 2.0, 3 * RETRY_S, 3 * RETRY_S + 1.0):
        now_s[0] = t
        lines.write(Reported(t, "r1", AgentStopped()))
    lines.close()
    assert [json.loads(line)["t"] for line in path.read_text().splitlines()] == [3 * RETRY_S, 3 * RETRY_S + 1.0]
    assert "events are written again; 4 were lost" in caplog.text


def test_events_go_to_a_new_file_when_the_old_one_was_rotated_away(tmp_path: Path) -> None:
    now_s, path = [0.0], tmp_path / "events.jsonl"
    lines = Lines(path, lambda: now_s[0])
    for t, rotates in ((0.0, True), (LOOK_PERIOD_S / 2, False), (LOOK_PERIOD_S, False), (LOOK_PERIOD_S + 1.0, False)):
        now_s[0] = t
        lines.write(Reported(t, "r1", AgentStopped()))
        if rotates:
            path.rename(tmp_path / "events.jsonl.1")
    lines.close()
    assert [json.loads(line)["t"] for line in path.read_text().splitlines()] == [LOOK_PERIOD_S, LOOK_PERIOD_S + 1.0]
    assert len((tmp_path / "events.jsonl.1").read_text().splitlines()) == 2


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of one mebibyte."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def until(true: Callable[[], bool], timeout_s: float = 60.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.05)


@pytest.mark.swarm
@pytest.mark.beside
@pytest.mark.slow
def test_an_agent_lives_through_a_full_disk_and_records_again(tmp_path: Path, small_disk: Path) -> None:
    config, log = tmp_path / "agent.toml", tmp_path / "log"
    config.write_text(f'name = "r1"\nfolder = "{small_disk}"\n[transport]\nmulticast = false\n')
    command = [sys.executable, "-m", "flocc_launch.commands.main", "agent", "--config", str(config)]
    with log.open("wb") as output, subprocess.Popen(command, stderr=output, stdout=output) as agent:
        until((small_disk / "events.jsonl").exists)
        with (small_disk / "filler").open("wb", buffering=0) as filler, contextlib.suppress(OSError):
            while filler.write(bytes(4096)):
                pass
        until(lambda: "events are not written meanwhile" in log.read_text())
        (small_disk / "filler").unlink()
        until(lambda: "events are written again" in log.read_text())
        agent.send_signal(signal.SIGTERM)
        assert agent.wait(20.0) == 0
    assert log.read_text().count("events are not written meanwhile") == 1
    assert all(json.loads(line) for line in (small_disk / "events.jsonl").read_text().splitlines())
    assert json.loads((small_disk / "events.jsonl").read_text().splitlines()[-1])["event"] == "agent_stopped"


def test_an_agent_whose_disk_fails_it_ends_with_a_code_that_systemd_restarts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async def fails(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "full", "/var/lib/flocc/x")

    monkeypatch.setattr(agent_process, "run_agent", fails)
    config = tmp_path / "agent.toml"
    config.write_text('name = "r1"\n')
    assert run(monkeypatch, "agent", "--config", str(config)) == EXIT_TRY_AGAIN
    assert "error: /var/lib/flocc/x: the disk is full" in capsys.readouterr().err
    assert run(monkeypatch, "agent", "--config", str(tmp_path / "none.toml")) == 2


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_names_with_umlauts_are_read_in_a_c_locale(tmp_path: Path, encoding: str) -> None:
    source = write_plain(tmp_path / "Prüfung")
    odd = {"LC_ALL": "C", "LANG": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": encoding}
    command = [sys.executable, "-m", "flocc_launch.commands.main", "dataset", "convert", str(source), "--out"]
    done = subprocess.run(
        [*command, str(tmp_path / "Ausgänge")], capture_output=True, env={**os.environ, **odd}, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    assert "Prüfung" in (tmp_path / "Ausgänge" / "source.txt").read_text(encoding="utf-8")


def config(**fields: object) -> TransportConfig:
    return TransportConfig.model_validate(fields)


def test_an_interface_that_does_not_exist_is_named() -> None:
    (fault,) = network.network_faults(config(interface="wlan7"), "a")
    assert fault.startswith("transport.interface: the interface 'wlan7' does not exist; there is lo")
    (fault,) = network.network_faults(config(multicast=False, control_listen=("tcp/[::]:0#iface=wlan7",)), "a")
    assert "tcp/[::]:0#iface=wlan7: the interface 'wlan7' does not exist" in fault
    (fault,) = network.network_faults(config(interface="192.0.2.7"), "a")
    assert fault == "transport.interface: no interface of this machine has the address 192.0.2.7"


@pytest.mark.parametrize("words", [("status", "--timeout", "0.2"), ("chaos", "heal")])
def test_operators_on_an_interface_that_does_not_exist_hear_of_it(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    agent = tmp_path / "agent.toml"
    agent.write_text('name = "r1"\nswarm = "alone"\n[transport]\ninterface = "wlan7"\n')
    monkeypatch.setattr(zenoh_admin, "SCOUT_S", 0.1)
    monkeypatch.setattr(zenoh_admin, "FIND_TIMEOUTS", 0.1)
    assert run(monkeypatch, *words, "--config", str(agent)) == 2
    assert "the interface 'wlan7' does not exist; there is lo" in capsys.readouterr().err


def test_a_host_to_which_no_way_leads_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_route(_family: int, _address: object) -> str:
        return "Network is unreachable"

    roster = {"b": {"control": ("tcp/192.0.2.7:7450",), "bulk": ()}}
    monkeypatch.setattr(network, "_no_way", no_route)
    (fault,) = network.network_faults(config(multicast=False, roster=roster), "a")
    assert fault.startswith("transport.roster.b: the host '192.0.2.7' cannot be reached (Network is unreachable)")


def test_a_launch_without_a_loopback_interface_says_so_before_anything_is_prepared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def down(*_: object) -> None:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    monkeypatch.setattr(socket, "create_connection", down)
    assert run(monkeypatch, "launch", "corridor", "--out", str(tmp_path / "run")) == 2
    assert "127.0.0.1, which cannot be reached (Network is unreachable)" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_device_without_an_end_is_no_configuration(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(monkeypatch, "agent", "--config", "/dev/zero") == 2
    assert "/dev/zero: has more than" in capsys.readouterr().err


def test_a_link_that_leads_to_itself_is_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    assert run(monkeypatch, "map", "merge", str(loop), str(loop), "--out", str(tmp_path / "out")) == 2
    assert f"error: {loop}" in capsys.readouterr().err


def test_a_host_that_does_not_resolve_is_named_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(host: str, *_: object, **__: object) -> list[object]:
        if host != "127.0.0.1":
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return []

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    roster = {
        "a": {"control": ("tcp/robot-a.invalid:7450",), "bulk": ("tcp/robot-a.invalid:7451",)},
        "b": {"control": ("tcp/127.0.0.1:7450",), "bulk": ()},
    }
    (fault,) = network.network_faults(config(multicast=False, roster=roster), "c")
    assert fault.startswith("transport.roster.a: the host 'robot-a.invalid' is not known (Name or service not known)")


def test_no_network_but_the_machines_own_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "if_nameindex", lambda: [(1, "lo")])
    (fault,) = network.network_faults(config(), "a")
    assert fault == "no interface for multicast is up (there is lo); nobody is found until one is"
    assert network.network_faults(config(interface="lo"), "a") == []
    assert network.network_faults(config(multicast=False), "a") == []


@pytest.mark.parametrize(
    ("addresses", "is_fault"), [((), True), (("fd00::7",), True), (("169.254.7.1", "fd00::7"), False)]
)
def test_a_machine_with_addresses_of_ipv6_alone_finds_nobody_and_says_so(
    addresses: tuple[str, ...], is_fault: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket, "if_nameindex", lambda: [(1, "lo"), (2, "eth0")])
    monkeypatch.setattr(network, "_flags", lambda name: 0x1043 if name == "eth0" else 0x49)
    monkeypatch.setattr(network, "machine_addresses", lambda: frozenset(("eth0", each) for each in addresses))
    faults = network.network_faults(config(), "a")
    assert [fault.startswith("no interface has an IPv4 address (up: eth0)") for fault in faults] == [True] * is_fault


def test_weights_of_a_user_without_a_home_are_in_the_temporary_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    homeless(monkeypatch, tmp_path)
    assert weights_folder() == tmp_path / f"flocc-{os.getuid()}" / "weights"


def test_an_agent_in_somebody_elses_folder_ends_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "agent.toml").write_text(f'name = "r1"\nfolder = "{tmp_path / "a" / "b"}"\n')
    monkeypatch.setattr(os, "access", lambda _place, mode, **_: mode != os.W_OK)
    assert run(monkeypatch, "agent", "--config", str(tmp_path / "agent.toml")) == 2
    assert f"{tmp_path} cannot be written by this user" in capsys.readouterr().err


@pytest.mark.parametrize("words", [("launch", "corridor"), ("demo", "--small")])
def test_a_run_folder_that_cannot_be_made_is_said_before_anything_is_prepared(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    out = tmp_path / "runs" / "a"
    assert run(monkeypatch, *words, "--out", str(out)) == 2
    assert f"error: {out}: cannot be made: {tmp_path} cannot be written" in capsys.readouterr().err
    assert not out.exists()


def test_weights_that_do_not_fit_on_the_disk_end_with_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    torch = pytest.importorskip("torch")

    def full(*_: object) -> None:
        raise RuntimeError("[enforce fail at inline_container.cc:672] . unexpected pos 64 vs 0")

    monkeypatch.setattr(torch, "save", full)
    assert run(monkeypatch, "weights", "synthesize", str(tmp_path), "--network", "tiny") == 2
    assert "cannot be written; is the disk full?" in capsys.readouterr().err


def test_a_text_is_no_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    (tmp_path / "agent.toml").write_text('robot = "r1"\n')
    assert run(monkeypatch, "weights", "check", str(tmp_path / "agent.toml")) == 2
    assert "is truncated, damaged or no torch checkpoint" in capsys.readouterr().err


def test_a_python_that_cannot_be_started_anew_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(sys, "getfilesystemencoding", lambda: "ascii")
    monkeypatch.setattr(os, "execv", denied)
    monkeypatch.setenv("PYTHONUTF8", "0")
    if not sys.flags.utf8_mode:
        speak_utf8()
