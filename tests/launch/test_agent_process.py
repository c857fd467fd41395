"""Claims: an agent whose log turns out to be lost begins another one without being started again, once."""

import asyncio
import os
import signal
import time
from pathlib import Path

import pytest
from tests.agent.runtime.test_agent_api import CONFIG

import flocc_agent.agent
from flocc_agent.agent import Agent
from flocc_agent.core.events import MessageReceived
from flocc_agent.runtime.status import AgentStatus
from flocc_launch.swarm.agent_process import run_agent
from flocc_protocol.ids import LogId
from flocc_protocol.messages import Envelope, RecordBatch, Records
from flocc_protocol.records import KeyframeRecord, encode_record

LOST = KeyframeRecord(0, 1.0, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), None)


class Forgetful(Agent):
    """Peers hold a record of its log that is not on its disk, in every life."""

    async def __aenter__(self) -> Agent:
        agent = await super().__aenter__()
        copy = RecordBatch(self.log, 0, 0, (encode_record(LOST),))
        self._started.put(MessageReceived(Envelope(LogId("r2"), Records((copy,)))))
        return agent


async def test_a_robot_whose_disk_is_behind_what_it_published_begins_another_log_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(flocc_agent.agent, "Agent", Forgetful)
    config = CONFIG.model_copy(update={"folder": tmp_path, "incarnation": 0})
    logs: list[str] = []

    def on_status(status: AgentStatus) -> None:
        logs.append(status.log)

    running = asyncio.create_task(run_agent(config, time.monotonic(), on_status))
    async with asyncio.timeout(60.0):
        while sum(log != "r1" for log in logs) < 3:
            await asyncio.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)
        await running
    assert len(set(logs) - {"r1"}) == 1, "it begins anew once at most"
    assert caplog.text.count("begins anew, with another log") == 1
    assert (tmp_path / "events.jsonl").read_text().count('"agent_stopped"') == 1
