"""Measure what docs/reliability.md says of real agents over real zenoh on this machine.

    python -m flocc_launch.reliability failover --runs 30
    python -m flocc_launch.reliability partition --runs 3 --outage-s 60
    python -m flocc_launch.reliability idle
    python -m flocc_launch.reliability load --agents 30 --duration-s 1200

Each prints one JSON object. Robots see synthetic images; times come from the agents' own events, on one clock.
"""

import argparse
import asyncio
import json
import math
import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flocc_agent.config import KeyframeConfig, PerceptionConfig, RadioConfig, SourceConfig
from flocc_agent.core.parameters import CoreParameters, PlaceRecognitionParameters
from flocc_launch.data import recordings
from flocc_launch.processes import AgentProcess, loopback_transports
from flocc_launch.scenario import Scenario, TracksScenario, agent_config
from flocc_protocol.errors import FloccError

START_S = 60.0
CROWD_START_S = 120.0
LOOK_S = 0.1
CLOCK_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
MEBIBYTE = 1024 * 1024


class NotReached(FloccError):
    """What was waited for did not happen in time."""


class Swarm:
    """Agent processes on one folder, with one clock."""

    def __init__(self, scenario: Scenario, folder: Path, with_recordings: bool = True) -> None:
        self.epoch_s = time.monotonic()
        paths = recordings(scenario) if with_recordings else {}
        names = [f"r{i + 1}" for i in range(scenario.tracks.robots)] if scenario.tracks else scenario.names()
        transports = loopback_transports(names)
        self.agents = [
            AgentProcess(
                agent_config(
                    scenario,
                    name,
                    source=SourceConfig(recording=paths[name].resolve() if name in paths else None, rate=scenario.rate),
                    transport=transports[name],
                    folder=(folder / name).resolve(),
                ),
                folder / name,
            )
            for name in names
        ]

    def now_s(self) -> float:
        """Seconds on the clock of the agents' events."""
        return time.monotonic() - self.epoch_s

    async def start(self) -> None:
        """Start all."""
        await asyncio.gather(*(agent.start(self.epoch_s) for agent in self.agents))

    async def stop(self) -> None:
        """Stop all in order."""
        await asyncio.gather(*(agent.stop() for agent in self.agents))

    async def order(self, radio: RadioConfig) -> None:
        """Give everybody these links."""
        fields = json.loads(radio.model_dump_json())
        fields["partitions"] = [{k: v for k, v in p.items() if v is not None} for p in fields["partitions"]]
        await asyncio.gather(*(agent.order({"radio": fields}) for agent in self.agents))

    async def until(self, is_true: Callable[[], bool], timeout_s: float, what: str) -> float:
        """Wait for something, and give the time when it was so.

        Raises:
            NotReached: Not in time.
        """
        deadline_s = self.now_s() + timeout_s
        while not is_true():
            if self.now_s() > deadline_s:
                states = {agent.name: agent.status for agent in self.agents}
                raise NotReached(f"not within {timeout_s:g} s: {what}; {json.dumps(states)[:2000]}")
            await asyncio.sleep(LOOK_S)
        return self.now_s()


def events(agent: AgentProcess, name: str, after_s: float) -> list[dict[str, Any]]:
    """An agent's events of one name after a time, from its file."""
    path = agent.folder / "events.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    found = (json.loads(line) for line in lines if f'"{name}"' in line and line.endswith("}"))
    return [event for event in found if event.get("event") == name and event["t"] >= after_s]


def follow(agents: Iterable[AgentProcess], leader: str) -> bool:
    """Whether all follow one robot."""
    return all(agent.status.get("leader") == leader for agent in agents)


def one_frame(agents: Iterable[AgentProcess]) -> bool:
    """Whether all have a correction in one map frame."""
    frames = {agent.status.get("map_frame") for agent in agents}
    return len(frames) == 1 and None not in frames


def hold(agents: Iterable[AgentProcess], counts: Mapping[str, int]) -> bool:
    """Whether each holds at least so many records of each log."""
    return all(agent.status["logs"].get(log, [0])[0] >= count for agent in agents for log, count in counts.items())


def agree(agents: Sequence[AgentProcess]) -> bool:
    """Whether all hold the same logs and have one map frame."""
    states = [(agent.status.get("logs"), agent.status.get("map_frame")) for agent in agents]
    return states[0][1] is not None and all(state == states[0] for state in states)


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, minimum and maximum."""
    return {
        "median": round(statistics.median(values), 3),
        "min": round(min(values), 3),
        "max": round(max(values), 3),
    }


def meeting(robots: int = 3, rate: float = 4.0, length_m: float = 40.0) -> Scenario:
    """Walks through one small town that overlap."""
    return Scenario(
        name="meeting",
        rate=rate,
        tracks=TracksScenario(robots=robots, seed=3, area_m=12.0, length_m=length_m),
        perception=PerceptionConfig(method="synthetic"),
    )


async def failover(folder: Path, runs: int) -> dict[str, Any]:
    """Kill the leader again and again: seconds until all others follow the next one, and until its first correction."""
    swarm = Swarm(meeting(), folder)
    times_s: list[tuple[float, float]] = []
    await swarm.start()
    try:
        await swarm.until(lambda: follow(swarm.agents, "r1") and agree(swarm.agents), START_S, "one map")
        for _ in range(runs):
            times_s.append(await _failed_over(swarm))
            await swarm.agents[0].wait(START_S)
            await swarm.agents[0].start(swarm.epoch_s)
            await swarm.until(lambda: follow(swarm.agents, "r1"), START_S, "r1 leads again")
    finally:
        await swarm.stop()
    led_s, corrected_s = zip(*times_s, strict=True)
    timeout_s = swarm.agents[0].config.core.neighbours.timeout_s
    return {
        "runs": runs,
        "heartbeat_timeout_s": timeout_s,
        "next_leader_s": spread(led_s),
        "correction_s": spread(corrected_s),
    }


async def _failed_over(swarm: Swarm) -> tuple[float, float]:
    """Kill r1, and give the seconds until the others follow r2, and until each has its first correction."""
    rest, killed_s = swarm.agents[1:], swarm.now_s()
    swarm.agents[0].kill()

    def told(name: str) -> list[float]:
        """When each heard of r2 first."""
        found = [[e["t"] for e in events(agent, name, killed_s) if e["leader"] == "r2"] for agent in rest]
        return [min(times) - killed_s for times in found if times]

    await swarm.until(lambda: len(told("correction")) == len(rest), START_S, "r2 leads and corrects")
    return max(told("leader")), max(told("correction"))


async def partition(folder: Path, runs: int, outage_s: float) -> dict[str, Any]:
    """Part four robots with one map two and two while they go on, heal, and give the seconds until all is one again."""
    healed_s = [await _healed_after_s(folder / str(run), outage_s) for run in range(runs)]
    return {"runs": runs, "outage_s": outage_s, "robots": 4, "one_again_s": spread(healed_s)}


async def _healed_after_s(folder: Path, outage_s: float) -> float:
    swarm = Swarm(meeting(robots=4, rate=2.0, length_m=160.0), folder)
    await swarm.start()
    try:
        await swarm.until(lambda: follow(swarm.agents, "r1") and one_frame(swarm.agents), START_S, "one map")
        parted_s = swarm.now_s()
        groups = {"groups": [["r1", "r3"], ["r2", "r4"]], "from_s": parted_s}
        await swarm.order(RadioConfig.model_validate({"partitions": [groups]}))
        await swarm.until(lambda: follow(swarm.agents[1::2], "r2"), START_S, "two leaders")
        await asyncio.sleep(max(outage_s - (swarm.now_s() - parted_s), 0.0))
        await swarm.order(RadioConfig())
        healed_s = swarm.now_s()
        parts = {agent.name: agent.status["logs"][agent.name][0] for agent in swarm.agents}
        one = "one leader, one frame, every log everywhere as long as it was at the healing"
        return (
            await swarm.until(
                lambda: follow(swarm.agents, "r1") and one_frame(swarm.agents) and hold(swarm.agents, parts),
                START_S,
                one,
            )
            - healed_s
        )
    finally:
        await swarm.stop()


async def idle(folder: Path, duration_s: float) -> dict[str, Any]:
    """CPU and memory of agents that have nothing to do, children included, once the warm-up is over."""
    swarm = Swarm(meeting(), folder, with_recordings=False)
    await swarm.start()
    try:
        await swarm.until(lambda: follow(swarm.agents, "r1"), START_S, "r1 leads")
        await asyncio.sleep(75.0)  # worker processes end when they were idle for 60 s
        before = [cpu_s(agent) for agent in swarm.agents]
        await asyncio.sleep(duration_s)
        used = [(cpu_s(agent) - b) / duration_s for agent, b in zip(swarm.agents, before, strict=True)]
        resident = [resident_bytes(agent) / MEBIBYTE for agent in swarm.agents]
    finally:
        await swarm.stop()
    return {"agents": len(used), "cpu_ratio": spread(used), "rss_mib": spread(resident)}


async def load(folder: Path, agents: int, duration_s: float) -> dict[str, Any]:
    """Many agents with two keyframes per second each: CPU, memory over time, late heartbeats, messages dropped."""
    swarm = Swarm(crowd(agents, duration_s), folder)
    await swarm.start()
    resident: list[float] = []
    try:
        await swarm.until(lambda: follow(swarm.agents, "r1"), CROWD_START_S, "r1 leads")
        began_s, used_s, before = swarm.now_s(), sum(map(cpu_s, swarm.agents)), _keyframes(swarm.agents)
        while swarm.now_s() - began_s < duration_s:
            await asyncio.sleep(min(10.0, duration_s))
            resident.append(statistics.median(resident_bytes(agent) / MEBIBYTE for agent in swarm.agents))
        lasted_s, used_s = swarm.now_s() - began_s, sum(map(cpu_s, swarm.agents)) - used_s
        lost = sum(len(events(agent, "neighbour_down", began_s)) for agent in swarm.agents)
        keyframes = _keyframes(swarm.agents)
        rates = [(keyframes[name] - before[name]) / lasted_s for name in before]
        refused = _refused(swarm.agents)
    finally:
        await swarm.stop()
    return {
        "agents": agents,
        "duration_s": round(lasted_s, 1),
        "keyframes_per_s": spread(rates),
        "cores_used": round(used_s / lasted_s, 2),
        "rss_mib_over_time": [round(value, 1) for value in resident],
        "neighbours_lost": lost,
        "refused_or_dropped": refused,
    }


def crowd(robots: int, duration_s: float) -> Scenario:
    """Many robots in one town, all in range of each other: 1 m/s, two keyframes per second each."""
    return Scenario(
        name="crowd",
        tracks=TracksScenario(
            robots=robots, seed=3, area_m=60.0, speed_m_s=1.0, length_m=CROWD_START_S + duration_s + 30.0
        ),
        keyframes=KeyframeConfig(distance_m=0.45, rotation_rad=math.pi),
        perception=PerceptionConfig(method="synthetic"),
        core=CoreParameters(place_recognition=PlaceRecognitionParameters(similarity_threshold=0.6)),
    )


def _keyframes(agents: Iterable[AgentProcess]) -> dict[str, int]:
    return {agent.name: agent.status.get("keyframes", 0) for agent in agents}


def _refused(agents: Iterable[AgentProcess]) -> dict[str, int]:
    """What all agents refused or dropped, by reason."""
    refused: dict[str, int] = {}
    for agent in agents:
        for reason, count in agent.status.get("refused", {}).items():
            refused[reason] = refused.get(reason, 0) + count
    return refused


def cpu_s(agent: AgentProcess) -> float:
    """CPU time of an agent and its children so far."""
    return sum(_cpu_s(pid) for pid in _family(agent))


def resident_bytes(agent: AgentProcess) -> int:
    """Memory of an agent and its children."""
    return sum(_resident_bytes(pid) for pid in _family(agent))


def _family(agent: AgentProcess) -> list[int]:
    assert agent.process is not None
    pid = agent.process.pid
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    return [pid, *map(int, children)]


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / CLOCK_TICKS_PER_S


def _resident_bytes(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]) * PAGE_BYTES


async def _measured(given: argparse.Namespace, folder: Path) -> dict[str, Any]:
    match given.what:
        case "failover":
            return await failover(folder, given.runs)
        case "partition":
            return await partition(folder, given.runs, given.outage_s)
        case "idle":
            return await idle(folder, given.duration_s)
        case _:
            return await load(folder, given.agents, given.duration_s)


def main() -> None:
    """Entry point of `python -m flocc_launch.reliability`."""
    parser = argparse.ArgumentParser(description="Measure a swarm of real agents on this machine.")
    parser.add_argument("what", choices=["failover", "partition", "idle", "load"])
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--outage-s", type=float, default=60.0)
    parser.add_argument("--duration-s", type=float, default=30.0)
    parser.add_argument("--agents", type=int, default=30)
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="flocc-reliability-"))
    try:
        result = asyncio.run(_measured(given, folder))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print(json.dumps({"what": given.what, "load_average": os.getloadavg()[0], **result}))  # noqa: T201


if __name__ == "__main__":
    main()
