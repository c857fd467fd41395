"""Claims on keys, signatures and mutual TLS, the last over real zenoh on loopback."""

import asyncio
import json
import shutil
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from tests.agent.runtime.loopback import loopback_configs, until
from typer.testing import CliRunner

from flocc_agent import Agent, AgentConfig
from flocc_agent.config import TlsConfig, TransportConfig
from flocc_agent.runtime.certificate_faults import certificate_faults
from flocc_agent.runtime.network_faults import network_faults
from flocc_agent.runtime.security import RecordSealer, read_members
from flocc_agent.runtime.transport import FetchFailed, FetchProblem, TransportError
from flocc_agent.runtime.zenoh_admin import ask
from flocc_agent.runtime.zenoh_session import Plane, open_session, session_settings
from flocc_agent.runtime.zenoh_transport import ZenohTransport
from flocc_launch.commands.main import app
from flocc_launch.setup.credentials import KeysError, make_keys
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import LogId
from flocc_protocol.keys import Admin

SWARM = "field"
ROBOTS = ("r1", "r2")


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return make_keys(tmp_path_factory.mktemp("keys"), SWARM, [*ROBOTS, "r3"])


def sealer(folders: dict[str, Path], robot: str) -> RecordSealer:
    return RecordSealer.of(TlsConfig(folder=folders[robot]))


# --- keys


def test_private_keys_are_readable_by_their_owner_only(folders: dict[str, Path]) -> None:
    private = [folders["r1"] / "robot.key", folders["r1"] / "signing.key", folders["r1"].parent / "authority/ca.key"]
    assert [stat.S_IMODE(path.stat().st_mode) for path in private] == [0o600] * 3
    assert not (folders["r1"] / "ca.key").exists()


def test_admits_more_robots_without_touching_those_that_are_there(tmp_path: Path) -> None:
    first = make_keys(tmp_path, SWARM, ["r1"])
    before = {path.name: path.read_bytes() for path in first["r1"].iterdir() if path.name != "members.json"}
    both = make_keys(tmp_path, SWARM, ["r2"])
    after = {path.name: path.read_bytes() for path in both["r1"].iterdir() if path.name != "members.json"}
    assert before == after
    assert list(both) == ["operator", "r1", "r2"]
    lists = [json.loads((folder / "members.json").read_bytes()) for folder in both.values()]
    assert [sorted(content["robots"]) for content in lists] == [["r1", "r2"]] * 3


def test_a_robot_has_a_name_of_its_own_and_a_class_of_one_digit(tmp_path: Path) -> None:
    make_keys(tmp_path, SWARM, ["r1"])
    for robots, operators in ((["authority"], ()), (["operator"], ()), (["r2"], ["r1"])):
        with pytest.raises(KeysError, match=r"no robot can be named '(authority|operator|r1)' here"):
            make_keys(tmp_path, SWARM, robots, operators)
    told = CliRunner().invoke(app, ["keys", str(tmp_path), "r1=12"])
    assert told.exit_code == 2
    assert "a compute class is a number from 0 to 9" in told.output


async def test_keys_of_another_robot_are_refused_by_name(folders: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(TransportError, match=r"signing.key: is the key of no member of the swarm, and"):
        RecordSealer.of(TlsConfig(folder=make_keys(tmp_path, SWARM, [])["operator"]), "r1")
    config = loopback_configs(("r1",), tls=TlsConfig(folder=folders["r2"]))["r1"]
    with pytest.raises(TransportError, match=r"signing.key: is the key of robot r2, and this robot is named r1"):
        async with Agent(AgentConfig(name="r1", swarm=SWARM, transport=config)):
            pass


def test_the_list_of_members_says_compute_classes_once_one_is_given(tmp_path: Path) -> None:
    make_keys(tmp_path, SWARM, ["r1"])
    assert read_members(tmp_path / "r1/members.json").compute_classes is None
    make_keys(tmp_path, SWARM, ["server"], compute_classes={"server": 9})
    make_keys(tmp_path, SWARM, ["r2"])
    assert read_members(tmp_path / "r1/members.json").compute_classes == {"server": 9}
    assert RecordSealer.of(TlsConfig(folder=tmp_path / "r1")).compute_classes == {"server": 9}


def test_a_certificate_that_expired_or_is_not_valid_yet_is_said(tmp_path: Path) -> None:
    made = datetime(2020, 1, 1, tzinfo=UTC)
    tls = TlsConfig(folder=make_keys(tmp_path, SWARM, ["r1"], now=made)["r1"])
    path = tmp_path / "r1/robot.crt"
    sentences = [*certificate_faults(tls, made + timedelta(days=1826))]
    assert sentences == [
        f"{path}: expired on 2024-12-30: nobody accepts it; remove it and its key, and run 'flocc keys' again"
    ]
    assert [*certificate_faults(tls, made + timedelta(days=400))] == []
    assert [*certificate_faults(tls, made + timedelta(days=1810))] == [
        f"{path}: expires on 2024-12-30; remove it and its key, and run 'flocc keys' again"
    ]
    early = [*certificate_faults(tls, made - timedelta(days=400))]
    assert early[0] == f"{path}: is valid from 2019-12-31 on, and the clock says 2018-11-27; nobody is heard"
    assert network_faults(TransportConfig(tls=tls), "r1")[0].startswith(f"{path}: expired on")


@pytest.mark.parametrize(
    ("file", "of", "sentence"),
    [
        ("ca.crt", "other/r1", "robot.crt: was not made by the authority of .*ca.crt, so that nobody accepts it"),
        ("robot.crt", "keys/r2", "robot.crt: is of r2, and this robot is named r1; its keys are in another folder"),
        ("robot.key", "keys/r2", "robot.key: is not the key of .*robot.crt"),
        ("robot.crt", "keys/r1/robot.key", "robot.crt: is no certificate"),
        ("signing.key", "keys/r2", "signing.key: is the key of robot r2, and this robot is named r1"),
        ("members.json", "farm/r1", "signing.key: is the key of no member of the swarm|is of swarm farm, not of field"),
    ],
)
async def test_keys_that_do_not_belong_together_are_refused_before_anything_is_written(
    tmp_path: Path, file: str, of: str, sentence: str
) -> None:
    """With such a certificate zenoh opens, nobody hears the robot, and it would lead itself for ever."""
    for name, swarm in (("keys", SWARM), ("other", SWARM), ("farm", "farm")):
        make_keys(tmp_path / name, swarm, ["r1", "r2"])
    tls = TlsConfig(folder=tmp_path / "keys/r1")
    source = tmp_path / of
    (tls.folder / file).write_bytes((source if source.is_file() else source / file).read_bytes())
    config = AgentConfig(name="r1", swarm=SWARM, folder=tmp_path / "r1", transport=TransportConfig(tls=tls))
    with pytest.raises(TransportError, match=sentence):
        await Agent(config).__aenter__()
    assert not (tmp_path / "r1").exists()
    if file == "ca.crt":
        assert next(certificate_faults(tls)).startswith(f"{tls.folder / 'robot.crt'}: was not made by")


@pytest.mark.parametrize("lost", ["authority/ca.key", "authority/ca.crt", "authority"])
def test_a_lost_authority_is_said_and_no_other_one_put_in_its_place(tmp_path: Path, lost: str) -> None:
    make_keys(tmp_path, SWARM, ["r1"])
    shutil.rmtree(tmp_path / lost) if lost == "authority" else (tmp_path / lost).unlink()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(KeysError, match=r"ca\.(key|crt): is gone, and the certificates beside it rest on it"):
        make_keys(tmp_path, SWARM, ["r2"])
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    "written", ["{", "[]", '{"swarm": "field"}', '{"swarm": "field", "robots": 3, "operators": []}']
)
def test_a_list_of_members_that_a_hand_broke_is_said(tmp_path: Path, written: str) -> None:
    make_keys(tmp_path, SWARM, ["r1"])
    (tmp_path / "authority/members.json").write_text(written)
    told = CliRunner().invoke(app, ["keys", str(tmp_path), "r2", "--swarm", SWARM])
    assert isinstance(told.exception, KeysError), told.output
    assert "members.json: is not a list of members: " in str(told.exception)


def test_a_member_whose_folder_went_to_its_robot_keeps_the_key_by_which_others_know_it(tmp_path: Path) -> None:
    make_keys(tmp_path, SWARM, ["r1"])
    shutil.rmtree(tmp_path / "r1")
    with pytest.raises(KeysError, match=r"signing.key: is not the key by which .*members.json knows r1"):
        make_keys(tmp_path, SWARM, ["r1", "r2"])
    assert not (tmp_path / "r2").exists()
    assert list(make_keys(tmp_path, SWARM, ["r2"])) == ["operator", "r1", "r2"]


def test_one_folder_is_of_one_swarm(tmp_path: Path) -> None:
    make_keys(tmp_path, SWARM, ["r1"])
    with pytest.raises(KeysError, match="is of swarm field, not of farm"):
        make_keys(tmp_path, "farm", ["r2"])


# --- signatures


def test_a_relay_can_pass_a_record_on_and_not_change_it(folders: dict[str, Path]) -> None:
    log, record = LogId("r1", 3), b"a keyframe"
    sealed = sealer(folders, "r1").seal(log, 7, record)
    judge = sealer(folders, "r2")
    assert judge.opened(log, 7, sealed) == record
    altered = [
        (log, 7, b"A" + sealed[1:]),
        (log, 7, sealed[:-1] + bytes([sealed[-1] ^ 1])),
        (log, 8, sealed),
        (LogId("r1", 4), 7, sealed),
        (LogId("r2", 3), 7, sealed),
        (LogId("r9", 3), 7, sealed),
        (log, 7, b""),
        (log, 7, sealed[:20]),
    ]
    for claim in altered:
        with pytest.raises(DecodeError):
            judge.opened(*claim)


def test_a_relay_cannot_sign_for_another(folders: dict[str, Path]) -> None:
    forged = sealer(folders, "r2").seal(LogId("r1"), 0, b"forged")
    with pytest.raises(DecodeError, match="carries no signature of r1"):
        sealer(folders, "r3").opened(LogId("r1"), 0, forged)


def test_a_signature_is_of_one_swarm(tmp_path: Path, folders: dict[str, Path]) -> None:
    elsewhere = RecordSealer("farm", sealer(folders, "r1")._signing_key, {})
    sealed = elsewhere.seal(LogId("r1"), 0, b"record")
    with pytest.raises(DecodeError):
        sealer(folders, "r2").opened(LogId("r1"), 0, sealed)


def test_a_correction_is_signed_by_its_leader_and_by_nobody_else(folders: dict[str, Path]) -> None:
    leader, judge, correction = LogId("r1", 3), sealer(folders, "r2"), b"a correction"
    signature = sealer(folders, "r1").sign_correction(correction)
    judge.check_correction(leader, correction, signature)
    forged = [
        (leader, b"another", signature),
        (leader, correction, b""),
        (leader, correction, sealer(folders, "r3").sign_correction(correction)),
        (LogId("r2"), correction, signature),
        (LogId("r9"), correction, signature),
        (leader, correction, RecordSealer("farm", sealer(folders, "r1")._signing_key, {}).sign_correction(correction)),
    ]
    for claim in forged:
        with pytest.raises(DecodeError):
            judge.check_correction(*claim)


def test_a_signed_record_is_no_signed_correction(folders: dict[str, Path]) -> None:
    sealed = sealer(folders, "r1").seal(LogId("r1"), 0, b"record")
    with pytest.raises(DecodeError):
        sealer(folders, "r2").check_correction(LogId("r1"), b"record", sealed[len(b"record") :])


# --- files


@pytest.mark.parametrize("name", ["ca.crt", "robot.crt", "robot.key", "members.json"])
def test_a_missing_file_is_named(tmp_path: Path, name: str) -> None:
    folder = make_keys(tmp_path, SWARM, ["r1"])["r1"]
    (folder / name).unlink()
    config = TransportConfig(tls=TlsConfig(folder=folder), control_listen=("tls/[::]:0",), bulk_listen=("tls/[::]:0",))
    with pytest.raises(TransportError, match=f"{name}: cannot be read: No such file"):
        session_settings(config, SWARM, "r1", Plane.CONTROL)


def test_a_robot_that_is_no_member_is_named(folders: dict[str, Path]) -> None:
    config = TransportConfig(
        tls=TlsConfig(folder=folders["r1"]), control_listen=("tls/[::]:0",), bulk_listen=("tls/[::]:0",)
    )
    with pytest.raises(TransportError, match="does not name r8"):
        session_settings(config, SWARM, "r8", Plane.CONTROL)


# --- mutual TLS over real zenoh


class Listener:
    """A transport that remembers what it received."""

    def __init__(self, robot: str, config: TransportConfig) -> None:
        self.received: list[tuple[str, str, bytes]] = []
        self.transport = ZenohTransport(SWARM, robot, config)
        self.transport.set_receiver(lambda *message: self.received.append(message))
        self.transport.serve_latents(lambda key, encode_bytes: b"secret latent")


def secure_configs(folders: dict[str, Path]) -> dict[str, TransportConfig]:
    configs = loopback_configs(["r1", "r2", "r3"], tls=TlsConfig(folder=folders["r1"]))
    return {
        name: config.model_copy(update={"tls": TlsConfig(folder=folders[name])}) for name, config in configs.items()
    }


@pytest.mark.swarm
@pytest.mark.beside
async def test_members_talk_and_fetch(folders: dict[str, Path]) -> None:
    configs = secure_configs(folders)
    one, two = Listener("r1", configs["r1"]), Listener("r2", configs["r2"])
    async with one.transport, two.transport:
        await until(lambda: bool(two.received), act=lambda: one.transport.broadcast("log", b"to all"))
        await until(lambda: bool(one.received), act=lambda: two.transport.unicast("r1", "pull", b"to one"))
        assert two.received[0] == ("r1", "log", b"to all")
        assert one.received[0] == ("r2", "pull", b"to one")
        fetched = await one.transport.fetch_latent("r2", "r2/0", 10.0)
        assert not isinstance(fetched, FetchFailed)


def stranger_configs(folders: dict[str, Path], elsewhere: Path) -> dict[str, dict[str, object]]:
    """Settings of processes that must get nothing, made from those of r3."""
    member = session_settings(secure_configs(folders)["r3"], SWARM, "r3", Plane.CONTROL)
    member.pop("access_control")
    other = make_keys(elsewhere, SWARM, ["r3"])["r3"]
    path = "transport/link/tls"
    without = {key: value for key, value in member.items() if not key.startswith(f"{path}/connect_")}
    foreign = {
        f"{path}/{role}_{what}": str(other / name)
        for role in ("listen", "connect")
        for what, name in (("certificate", "robot.crt"), ("private_key", "robot.key"))
    }
    return {
        "no certificate": without | {f"{path}/enable_mtls": False},
        "another authority's certificate": member | foreign,
        "plain TCP": {key: value for key, value in member.items() if "tls" not in key and "protocols" not in key},
    }


@pytest.mark.swarm
@pytest.mark.beside
@pytest.mark.parametrize("who", ["no certificate", "another authority's certificate", "plain TCP"])
async def test_a_stranger_reads_nothing_and_writes_nothing(folders: dict[str, Path], tmp_path: Path, who: str) -> None:
    configs = secure_configs(folders)
    one, two = Listener("r1", configs["r1"]), Listener("r2", configs["r2"])
    settings = dict(stranger_configs(folders, tmp_path)[who])
    dialled = [*configs["r1"].control_listen, *configs["r2"].control_listen]
    if who == "plain TCP":
        dialled = [endpoint.replace("tls/", "tcp/") for endpoint in dialled]
        settings["listen/endpoints"] = ["tcp/127.0.0.1:0"]
    settings["connect/endpoints"] = dialled
    heard: list[str] = []
    async with one.transport, two.transport:
        stranger = open_session(settings, "stranger")
        try:
            stranger.declare_subscriber("**", lambda sample: heard.append(str(sample.key_expr)))
            await until(
                lambda: len(two.received) > 100,
                act=lambda: (one.transport.broadcast("log", b"x"), stranger.put("flocc/v2/field/r3/log", b"forged")),  # type: ignore[func-returns-value,arg-type]
            )
            replies = list(stranger.get("flocc/v2/field/*/latent/r1/0", timeout=1.0))
            assert stranger.info.peers_zid() == []
        finally:
            stranger.close()
    assert [key for key in heard if not key.startswith("flocc/v2/field/r3")] == []
    assert [reply for reply in replies if reply.ok is not None] == []
    assert {sender for sender, *_ in (*one.received, *two.received)} <= {"r1", "r2"}


@pytest.mark.swarm
@pytest.mark.beside
async def test_a_member_writes_under_its_own_name_only(folders: dict[str, Path]) -> None:
    """r3, rightly certified, turns rogue: it leaves its own rules away and writes as r2."""
    configs = secure_configs(folders)
    one = Listener("r1", configs["r1"])
    settings = session_settings(configs["r3"], SWARM, "r3", Plane.CONTROL)
    settings.pop("access_control")
    async with one.transport:
        rogue = open_session(settings, "rogue")
        try:

            def write() -> None:
                rogue.put("flocc/v2/field/r2/log", b"forged")
                rogue.put("flocc/v2/field/r2/to/r1/pull", b"forged")
                rogue.put("flocc/v2/field/r3/log", b"own")

            await until(lambda: len(one.received) > 20, act=write)
        finally:
            rogue.close()
    assert {(sender, payload) for sender, _, payload in one.received} == {("r3", b"own")}


@pytest.mark.swarm
@pytest.mark.beside
async def test_a_fetch_from_a_robot_without_a_link_says_no_answer(folders: dict[str, Path]) -> None:
    async with Listener("r1", secure_configs(folders)["r1"]).transport as transport:
        assert await transport.fetch_latent("r2", "r2/0", 10.0) == FetchFailed(FetchProblem.NO_ANSWER)


@pytest.mark.swarm
@pytest.mark.beside
async def test_only_operators_are_answered(folders: dict[str, Path]) -> None:
    configs = secure_configs(folders)
    one = Listener("r1", configs["r1"])
    one.transport.serve_admin(Admin.STATUS, lambda _: b"well")
    as_operator = configs["r1"].model_copy(
        update={"tls": TlsConfig(folder=folders["operator"]), "roster": {"r1": configs["r1"].roster["r1"]}}
    )
    settings = session_settings(configs["r3"], SWARM, "r3", Plane.CONTROL)
    async with one.transport:
        assert await ask(as_operator, SWARM, Admin.STATUS, timeout_s=3.0) == {"r1": b"well"}
        member = open_session(settings, "r3")
        try:
            await until(lambda: len(member.info.peers_zid()) == 1)
            replies = await asyncio.to_thread(lambda: list(member.get("flocc/v2/field/*/status", timeout=1.0)))
        finally:
            member.close()
    assert [reply for reply in replies if reply.ok is not None] == []
