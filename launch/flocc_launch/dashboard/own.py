"""What one agent knows of its swarm: its own events, and of the others what their logs and corrections say.

Others' neighbours, bytes and queues are not known to it. Everything is read on the agent's own event loop, and only
while somebody looks, so that a page nobody has open costs the agent nothing but a little memory.
"""

import asyncio
import json
from collections.abc import Callable

import numpy as np

from flocc_agent.agent import Agent
from flocc_agent.core.knots import corrected
from flocc_agent.core.reports import ClosureAccepted, ClosureRejected, CorrectionApplied, Fact, KeyframeTaken
from flocc_agent.core.robot import Robot
from flocc_agent.geometry import Float
from flocc_agent.runtime.event_lines import Reported
from flocc_launch.dashboard.snapshot import Snapshot
from flocc_launch.dashboard.state import SwarmState
from flocc_launch.runs.heard import Heard
from flocc_protocol.ids import LogId
from flocc_protocol.messages import Knots, LogCorrection

ANSWER_S_MAX = 5.0
RECORDS_MAX = 2000
"""Records of one log that one look takes in, so that a long log does not keep the agent from its work."""
FROM_LOGS = (KeyframeTaken, ClosureAccepted, ClosureRejected, CorrectionApplied)


class AgentSource:
    """One agent's view as a `SnapshotSource`: `take` takes the agent's facts, `attach` the running agent."""

    def __init__(self, swarm: str, robot: str, steepness: float, clock_s: Callable[[], float]) -> None:
        """Prepare, on the event loop of the agent to come.

        Args:
            swarm: Name of the swarm.
            robot: Name of the agent's robot.
            steepness: k of Eq. (2), for the probability of closures.
            clock_s: The clock of the agent's events.
        """
        self._swarm = swarm
        self._name = robot
        self._clock_s = clock_s
        self._state = SwarmState([robot])
        self._heard = Heard(steepness)
        self._knots: dict[LogId, Knots | None] = {}
        self._read: dict[LogId, int] = {}
        self._agent: Agent | None = None
        self._loop = asyncio.get_running_loop()

    def attach(self, agent: Agent) -> None:
        """Look at this agent, which runs, from now on."""
        self._agent = agent

    def take(self, event: Reported[Fact]) -> None:
        """Take one of the agent's facts; what stands in its logs is read there, also after a restart."""
        if not isinstance(event.fact, FROM_LOGS):
            self._state.apply(event)

    def snapshot_text(self) -> str:
        """The newest state as JSON; from any thread but the loop's own.

        Raises:
            TimeoutError: The agent is too busy to answer.
        """
        asked = asyncio.run_coroutine_threadsafe(self._look(), self._loop)
        return json.dumps(asked.result(ANSWER_S_MAX).as_json(), allow_nan=False)

    async def _look(self) -> Snapshot:
        if self._agent is not None:
            self._read_robot(self._agent.robot)
        return self._state.snapshot(self._clock_s(), self._swarm, self._name)

    def _read_robot(self, robot: Robot) -> None:
        """Take in what is new in the core: records, corrections, and whom the neighbours follow."""
        robot.corrections.follow_all()
        t = self._clock_s()
        for log, copy in sorted(robot.gossip.logs.items()):
            read = self._read.get(log, 0)
            for record in copy.records[read : read + RECORDS_MAX]:
                self._apply(self._heard.record(log, record, t))
            self._read[log] = min(read + RECORDS_MAX, len(copy.records))
            correction = robot.corrections.of(log)
            if correction is not None:
                self._correct(correction, robot.assembly.odometry(log), t)
        for name in robot.neighbours.names():
            neighbour = robot.neighbours.get(name)
            if neighbour is not None:
                self._apply(self._heard.heartbeat(neighbour.log, neighbour.heartbeat, t))
                self._state.heard(name, neighbour.heard_s)

    def _correct(self, correction: LogCorrection, T_odom_camera: Float, t: float) -> None:
        """Take a newer correction, or its knots, and where that puts the log's keyframes."""
        event = self._heard.correction(correction, t)
        if event is not None:
            self._state.apply(event, by_itself=event.robot == self._name)
        if event is not None or correction.knots is not self._knots.get(correction.log):
            self._knots[correction.log] = correction.knots
            poses = corrected(correction, T_odom_camera, np.arange(len(T_odom_camera)))
            self._state.place(correction.log.robot, dict(enumerate(poses[:, :3, 3])))

    def _apply(self, event: Reported[Fact] | None) -> None:
        if event is not None:
            self._state.apply(event)
