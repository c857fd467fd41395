"""Measure what docs/reliability.md says of real agents over real zenoh on this machine.

    python -m flocc_lab.reliability failover --runs 30
    python -m flocc_lab.reliability partition --runs 3 --outage-s 60
    python -m flocc_lab.reliability idle
    python -m flocc_lab.reliability load --agents 30 --duration-s 1200

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
from typing import Any, TypeVar

from flocc_agent.config import KeyframeConfig, PerceptionConfig, RadioConfig, SourceConfig
from flocc_agent.core.parameters import (
    KEYFRAMES_HELD,
    CoreParameters,
    MemoryParameters,
    PlaceRecognitionParameters,
)
from flocc_agent.core.reports import CorrectionApplied, Fact, LeaderFollowed, NeighbourDown
from flocc_agent.runtime.event_lines import Reported, of_kind, reported_of
from flocc_launch.scenarios.recordings import recordings
from flocc_launch.scenarios.scenario import Scenario, TracksScenario, agent_config
from flocc_launch.swarm.processes import AgentProcess, loopback_transports
from flocc_protocol.errors import FloccError

F = TypeVar("F", bound=Fact)

START_S = 60.0
CROWD_START_S = 120.0
CROWD_START_PER_AGENT_S = 1.5
"""Robots of a crowd begin to move when all have started, which takes two cores about a second each."""
SETTLE_S = 10.0
LOAD_LOOK_S = 1.0
RESIDENT_PERIOD_S = 60.0
KEYFRAMES_PER_S = 2.0
CROWD_AREA_M = 2000.0
"""Every keyframe is compared with every other robot's: in so large a town one in six has a partner after 5 minutes, two
in three after 20; in one of 60 m each has three all the time, which makes four records of each keyframe."""
LOOK_S = 0.1
NOTHING = (0, 0)
"""Records and checksum of a log that a robot does not hold."""
CLOCK_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
MEBIBYTE = 1024 * 1024


class NotReached(FloccError):
    """What was waited for did not happen in time."""


class LiveSwarm:
    """Agent processes on one folder, with one clock."""

    def __init__(self, scenario: Scenario, folder: Path, with_recordings: bool = True, start_s: float = 0.0) -> None:
        paths = recordings(scenario) if with_recordings else {}
        self.epoch_s = time.monotonic()
        names = [f"r{i + 1}" for i in range(scenario.tracks.robots)] if scenario.tracks else scenario.names()
        transports = loopback_transports(names)
        self.agents = [
            AgentProcess(
                agent_config(
                    scenario,
                    name,
                    source=SourceConfig(
                        recording=paths[name].resolve() if name in paths else None, rate=scenario.rate, start_s=start_s
                    ),
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
                states = {agent.name: agent.said.model_dump(mode="json") for agent in self.agents}
                raise NotReached(f"not within {timeout_s:g} s: {what}; {json.dumps(states)[:2000]}")
            await asyncio.sleep(LOOK_S)
        return self.now_s()


def events(agent: AgentProcess, kind: type[F], after_s: float) -> list[Reported[F]]:
    """An agent's events of one kind after a time, from its file."""
    path = agent.folder / "events.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    whole = [reported_of(line) for line in lines if line.endswith("}")]
    return [event for event in of_kind(whole, kind) if event.t >= after_s]


def follow(agents: Iterable[AgentProcess], leader: str) -> bool:
    """Whether all follow one robot."""
    return all(agent.said.leader == leader for agent in agents)


def one_frame(agents: Iterable[AgentProcess]) -> bool:
    """Whether all have a correction in one map frame."""
    frames = {agent.said.map_frame for agent in agents}
    return len(frames) == 1 and None not in frames


def hold(agents: Iterable[AgentProcess], counts: Mapping[str, int]) -> bool:
    """Whether each holds at least so many records of each log."""
    return all(agent.said.logs.get(log, NOTHING)[0] >= count for agent in agents for log, count in counts.items())


def agree(agents: Sequence[AgentProcess]) -> bool:
    """Whether all hold the same logs and have one map frame."""
    states = [(agent.said.logs, agent.said.map_frame) for agent in agents]
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
    swarm = LiveSwarm(meeting(), folder)
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


async def _failed_over(swarm: LiveSwarm) -> tuple[float, float]:
    """Kill r1, and give the seconds until the others follow r2, and until each has its first correction."""
    rest, killed_s = swarm.agents[1:], swarm.now_s()
    swarm.agents[0].kill()

    def told(kind: type[LeaderFollowed] | type[CorrectionApplied]) -> list[float]:
        """When each heard of r2 first."""
        found = [[e.t for e in events(agent, kind, killed_s) if e.fact.leader == "r2"] for agent in rest]
        return [min(times) - killed_s for times in found if times]

    await swarm.until(lambda: len(told(CorrectionApplied)) == len(rest), START_S, "r2 leads and corrects")
    return max(told(LeaderFollowed)), max(told(CorrectionApplied))


async def partition(folder: Path, runs: int, outage_s: float) -> dict[str, Any]:
    """Part four robots with one map two and two while they go on, heal, and give the seconds until all is one again."""
    healed_s = [await _healed_after_s(folder / str(run), outage_s) for run in range(runs)]
    return {"runs": runs, "outage_s": outage_s, "robots": 4, "one_again_s": spread(healed_s)}


async def _healed_after_s(folder: Path, outage_s: float) -> float:
    swarm = LiveSwarm(meeting(robots=4, rate=2.0, length_m=160.0), folder)
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
        parts = {agent.name: agent.said.logs[agent.name][0] for agent in swarm.agents}
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
    swarm = LiveSwarm(meeting(), folder, with_recordings=False)
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


async def load(
    folder: Path, agents: int, duration_s: float, area_m: float = CROWD_AREA_M, held: int = KEYFRAMES_HELD
) -> dict[str, Any]:
    """Many agents with two keyframes per second each, once all have started: CPU, memory, queues, late heartbeats."""
    start_s = CROWD_START_PER_AGENT_S * agents
    swarm = LiveSwarm(crowd(agents, duration_s, area_m, held), folder, start_s=start_s)
    await swarm.start()
    watched = WatchedSwarm()
    try:
        await swarm.until(lambda: follow(swarm.agents, "r1"), CROWD_START_S, "r1 leads")
        await asyncio.sleep(max(start_s + SETTLE_S - swarm.now_s(), 0.0))
        began_s, used_s, before = swarm.now_s(), sum(map(cpu_s, swarm.agents)), _sums(swarm.agents)
        while swarm.now_s() - began_s < duration_s:
            await asyncio.sleep(LOAD_LOOK_S)
            watched.look(swarm.agents, swarm.now_s() - began_s)
        lasted_s, used_s = swarm.now_s() - began_s, sum(map(cpu_s, swarm.agents)) - used_s
        lost = sum(len(events(agent, NeighbourDown, began_s)) for agent in swarm.agents)
        after, refused = _sums(swarm.agents), _refused(swarm.agents)
        behind = _records_behind(swarm.agents)
    finally:
        await swarm.stop()
    return {
        "agents": agents,
        "held": held,
        "duration_s": round(lasted_s, 1),
        "keyframes": after["keyframes"] - before["keyframes"],
        "keyframes_intended": round(KEYFRAMES_PER_S * lasted_s * agents),
        "closures": after["closures"] - before["closures"],
        "cores_used": round(used_s / lasted_s, 2),
        "heartbeat_gap_s": watched.gaps_s,
        "neighbours_lost": lost,
        "fullest_queues": watched.fullest(),
        "records_behind": behind,
        "refused_or_dropped": refused,
        "rss_mib_over_time": watched.resident,
    }


class WatchedSwarm:
    """What was seen of a crowd over time.

    Attributes:
        gaps_s: The longest time between two heartbeats, as sent and as heard by another robot.
        resident: Seconds since the beginning, and MiB: the median agent, the largest, the leader, all workers.
    """

    def __init__(self) -> None:
        self.gaps_s = {"sent": 0.0, "heard": 0.0}
        self.resident: list[dict[str, float]] = []
        self._sizes: dict[str, tuple[int, int]] = {}

    def look(self, agents: Sequence[AgentProcess], at_s: float) -> None:
        """Take in everybody's state, and once in `RESIDENT_PERIOD_S` the memory."""
        for agent in agents:
            for which, gap_s in agent.said.heartbeat_gap_s.items():
                self.gaps_s[which] = max(self.gaps_s[which], gap_s)
            for queue, (size, size_max) in agent.said.sizes.items():
                self._sizes[queue] = max(self._sizes.get(queue, (0, size_max)), (size, size_max))
        if at_s >= len(self.resident) * RESIDENT_PERIOD_S:
            self.resident.append({"at_s": round(at_s), **_resident(agents)})

    def fullest(self) -> dict[str, list[int]]:
        """The largest size of each queue and table of any robot, with its maximum, the fullest first."""
        fullest = sorted(self._sizes.items(), key=lambda item: -item[1][0] / item[1][1])
        return {queue: list(size) for queue, size in fullest if size[0] > 0}


def _resident(agents: Sequence[AgentProcess]) -> dict[str, float]:
    """Memory of the processes now, MiB."""
    families = [[_resident_bytes(pid) / MEBIBYTE for pid in _family(agent)] for agent in agents]
    own = [family[0] for family in families]
    return {
        "median": round(statistics.median(own), 1),
        "max": round(max(own), 1),
        "leader": round(own[0], 1),
        "workers": round(sum(sum(family[1:]) for family in families), 1),
    }


def _records_behind(agents: Sequence[AgentProcess]) -> int:
    """How many records of one log the robot that is furthest behind lacks, as of everybody's last state."""
    longest: dict[str, int] = {}
    for agent in agents:
        for log, (count, _) in agent.said.logs.items():
            longest[log] = max(longest.get(log, 0), count)
    held = [agent.said.logs for agent in agents]
    return max(count - logs.get(log, NOTHING)[0] for logs in held for log, count in longest.items())


def crowd(robots: int, duration_s: float, area_m: float, held: int) -> Scenario:
    """Many robots in one town, all in range of each other: 1 m/s, two keyframes per second each."""
    return Scenario(
        name="crowd",
        tracks=TracksScenario(
            robots=robots, seed=3, area_m=area_m, speed_m_s=1.0, length_m=duration_s + SETTLE_S + 30.0
        ),
        keyframes=KeyframeConfig(distance_m=0.45, rotation_rad=math.pi),
        perception=PerceptionConfig(method="synthetic"),
        core=CoreParameters(
            place_recognition=PlaceRecognitionParameters(similarity_threshold=0.6),
            memory=MemoryParameters(keyframes_held=held),
        ),
    )


def _sums(agents: Iterable[AgentProcess]) -> dict[str, int]:
    """Keyframes of all together, and closures as far as everybody knows them."""
    states = [agent.said for agent in agents]
    return {
        "keyframes": sum(state.keyframes for state in states),
        "closures": min(state.closures for state in states),
    }


def _refused(agents: Iterable[AgentProcess]) -> dict[str, int]:
    """What all agents refused or dropped, by reason."""
    refused: dict[str, int] = {}
    for agent in agents:
        for reason, count in agent.said.refused.items():
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
            return await load(folder, given.agents, given.duration_s, given.area_m, given.held)


def main() -> None:
    """Entry point of `python -m flocc_lab.reliability`."""
    parser = argparse.ArgumentParser(description="Measure a swarm of real agents on this machine.")
    parser.add_argument("what", choices=["failover", "partition", "idle", "load"])
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--outage-s", type=float, default=60.0)
    parser.add_argument("--duration-s", type=float, default=30.0)
    parser.add_argument("--agents", type=int, default=30)
    parser.add_argument("--area-m", type=float, default=CROWD_AREA_M, help="Of the town of `load`.")
    parser.add_argument("--held", type=int, default=KEYFRAMES_HELD, help="Keyframes that each agent holds in full.")
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="flocc-reliability-"))
    try:
        result = asyncio.run(_measured(given, folder))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print(json.dumps({"what": given.what, "load_average": os.getloadavg()[0], **result}))  # noqa: T201


if __name__ == "__main__":
    main()
