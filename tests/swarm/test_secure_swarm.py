"""Claims on whole agents that trust only the members of their swarm: mutual TLS and signed records."""

import asyncio
import json
import sqlite3
from pathlib import Path

import pytest
from tests.agent.runtime.loopback import loopback_configs
from tests.swarm.robots import RobotProcess, agent_configs, frames, leaders, logs_equal, reached

from flocc_agent.config import TlsConfig
from flocc_agent.runtime.security import RecordSealer
from flocc_launch.setup.credentials import make_keys
from flocc_protocol.ids import LogId
from flocc_protocol.records import decode_record

pytestmark = [pytest.mark.swarm, pytest.mark.beside, pytest.mark.slow]

NAMES = ("r1", "r2", "r3")


async def test_members_build_one_map_and_their_records_are_signed(tmp_path: Path) -> None:
    folders = make_keys(tmp_path / "keys", "test", NAMES)
    transports = {
        name: config.model_copy(update={"tls": TlsConfig(folder=folders[name])})
        for name, config in loopback_configs(NAMES, tls=TlsConfig(folder=folders["r1"])).items()
    }
    robots = [
        RobotProcess(config, tmp_path / "logs") for config in agent_configs(transports, tmp_path / "agents").values()
    ]
    try:
        await asyncio.gather(*(robot.start(12, phase_rad=0.6 * i) for i, robot in enumerate(robots)))
        await reached(robots, lambda: leaders(robots) == {"r1"} and frames(robots) == {"map/r1"}, 60.0, "one frame")
        await reached(
            robots,
            lambda: logs_equal(robots) and all(not robot.status["busy"] for robot in robots),
            30.0,
            "all logs equal",
        )
    finally:
        await asyncio.gather(*(robot.close() for robot in robots))
    assert all(robot.status["refused"] == {} for robot in robots)
    held = sqlite3.connect(tmp_path / "agents/r3/store/robot.sqlite").execute("SELECT log, number, data FROM records")
    judge = RecordSealer.of(TlsConfig(folder=folders["r2"]))
    records = [decode_record(judge.opened(LogId.parse(log), number, data)) for log, number, data in held]
    assert len(records) > 3 * 12
    assert set(json.loads((tmp_path / "keys/authority/members.json").read_text())["robots"]) == set(NAMES)
