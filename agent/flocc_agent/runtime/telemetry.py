"""What an agent tells of itself while it runs: its status, figures for a scrape, and what it reports."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.pose_graph import map_frame
from flocc_agent.core.reports import (
    CameraDoubted,
    ClosureAccepted,
    CorrectionApplied,
    Fact,
    FrontEndsDiffer,
    LatentLost,
    LeaderFollowed,
    LeaderLost,
    LogForked,
    LogGivenUp,
    NameTaken,
    NeighbourDown,
    NeighbourUp,
    PeerRefused,
    RoundFailed,
    RoundSolved,
    name_of,
)
from flocc_agent.core.robot import Robot
from flocc_agent.runtime.admission import Refusals
from flocc_agent.runtime.event_lines import Reported, values_of
from flocc_agent.runtime.facts import AccountKept, BytesCounted
from flocc_agent.runtime.jobs import Tools
from flocc_agent.runtime.metrics import Look
from flocc_agent.runtime.punctuality import LongestGap
from flocc_agent.runtime.reporting import Reporter
from flocc_agent.runtime.status import AgentStatus, CameraStatus, StageBrief
from flocc_agent.runtime.transport import TransportCounters
from flocc_agent.stages import brief_of, counts_of

logger = logging.getLogger(__name__)

Float = NDArray[np.float64]

BYTES_PERIOD_S = 1.0
ACCOUNT_PERIOD_S = 10.0

Sizes = dict[str, tuple[int, int]]
"""Every queue, table or cache: how much is in it, and its maximum."""


class Telemetry:
    """Looks at one agent and tells; it changes nothing.

    Attributes:
        reporter: Says when and where facts happened.
        refusals: What was refused of peers.
        heartbeat_gaps: How far heartbeats were apart, "sent" and "heard".
    """

    def __init__(
        self,
        robot: Robot,
        tools: Tools,
        reporter: Reporter,
        on_report: Callable[[Reported[Fact]], None],
        heartbeat_gaps: Mapping[str, LongestGap],
        driver_sizes: Callable[[], Sizes],
    ) -> None:
        """Prepare.

        Args:
            robot: The core.
            tools: What its driver works with.
            reporter: Says when and where facts happened.
            on_report: Takes each fact; must not block.
            heartbeat_gaps: "sent" and "heard", marked by the driver.
            driver_sizes: The driver's own queues.
        """
        self._robot = robot
        self._tools = tools
        self.reporter = reporter
        self._on_report = on_report
        self.heartbeat_gaps = heartbeat_gaps
        self._driver_sizes = driver_sizes
        self.refusals = Refusals()
        self._camera: dict[str, CameraDoubted] = {}
        self._began_s = tools.clock_s()
        self._bytes_due_s = self._began_s + BYTES_PERIOD_S
        self._account_due_s = self._began_s + ACCOUNT_PERIOD_S

    # When somebody asks

    def status(self, busy: bool) -> AgentStatus:
        """What this robot does now."""
        robot, counters, now = self._robot, self._tools.transport.counters(), self._tools.clock_s()
        applied, term = robot.corrections.applied, robot.election.term
        stages = brief_of(self._tools.workers.stages.snapshot())
        return AgentStatus(
            t=round(now, 3),
            robot=robot.log.robot,
            log=str(robot.log),
            leader=None if term is None else term.leader.robot,
            term=None if term is None else term.counter,
            role=robot.election.role.value,
            neighbours=tuple(robot.neighbours.names()),
            keyframes=robot.gossip.logs[robot.log].keyframes,
            closures=robot.assembly.closures,
            candidates=robot.closing.load,
            map_frame=None if applied is None else map_frame(applied.anchor),
            round=None if applied is None else applied.round,
            logs={str(digest.log): (digest.count, digest.checksum) for digest in robot.gossip.digests()},
            sent_bytes=sum(traffic.payload_bytes for traffic in counters.sent.values()),
            received_bytes=sum(traffic.payload_bytes for traffic in counters.received.values()),
            loss=self._losses(),
            queues=self._queues(),
            sizes=self._sizes(),
            heartbeat_gap_s={which: round(gap.longest_s(now), 3) for which, gap in self.heartbeat_gaps.items()},
            links={table: totals(peers) for table, peers in counters.links().items()},
            stages={name: StageBrief.model_validate(brief) for name, brief in stages.items()},
            refused=self.refused(),
            busy=busy,
            in_map=self._in_map(),
            doubles=robot.neighbours.doubles(),
            camera=tuple(CameraStatus.model_validate(values_of(told)) for told in self._camera.values()),
        )

    def _in_map(self) -> str | None:
        recognition, in_map = self._robot.recognition, self._robot.in_map
        return None if in_map is None else in_map.state(recognition.best_similarities, recognition.similarity_threshold)

    def look(self) -> Look:
        """What a scrape of the metrics sees."""
        robot = self._robot
        applied, term = robot.corrections.applied, robot.election.term
        return Look(
            counters=self._tools.transport.counters(),
            stages=self._tools.workers.stages.snapshot(),
            refused=self.refusals.by_reason(),
            gauges={
                "keyframes": robot.gossip.logs[robot.log].keyframes,
                "closures": robot.assembly.closures,
                "candidates": robot.closing.load,
                "neighbours": len(robot.neighbours.names()),
                "logs": len(robot.gossip.logs),
                "leading": float(robot.election.leading),
                "term": 0 if term is None else term.counter,
                "round": 0 if applied is None else applied.round,
            },
            queues=self._sizes(),
            info={"robot": robot.log.robot, "log": str(robot.log)},
        )

    def refused(self) -> dict[str, int]:
        """What was refused or dropped, by reason."""
        return {**self._tools.transport.counters().dropped, **self.refusals.by_reason()}

    def _losses(self) -> dict[str, float]:
        """Share of each neighbour's last heartbeats that did not arrive."""
        return {name: round(ratio, 3) for name, ratio in self._robot.neighbours.loss_ratios().items()}

    def _queues(self) -> dict[str, int]:
        """What waits: events for the core, images for the encoder, candidates for their registration."""
        sizes = self._driver_sizes()
        return {"inbox": sizes["inbox"][0], "images": sizes["images"][0], "candidates": self._robot.closing.load}

    def _sizes(self) -> Sizes:
        return {**self._driver_sizes(), **self._tools.transport.sizes(), **self._robot.sizes()}

    # By itself

    def report(self, fact: Fact) -> None:
        """Log a fact, and tell it; what is said of the camera stands in the status from then on."""
        if isinstance(fact, CameraDoubted):  # of nine kinds at most
            self._camera[fact.doubt] = fact
        if logger.isEnabledFor(level := _level(fact)):
            logger.log(level, "%s: %s %s", self._robot.log, name_of(fact), _brief(fact))
        self._on_report(self.reporter.reported(fact, self._tools.clock_s()))

    def refuse(self, peer: str, reason: str, detail: str = "") -> None:
        """Count what is refused of a peer by reason; the first is told, with what is special about it."""
        first = self.refusals.count(peer, reason)
        if first is not None:
            counted_peer, counted_reason = first
            self.report(PeerRefused(peer=counted_peer, reason=detail or counted_reason))

    def mount_camera(self, T_body_camera: Float) -> None:
        """Where the camera sits on the body, where that was not known at the start."""
        self.reporter = replace(self.reporter, T_body_camera=T_body_camera)

    def due_s(self) -> float:
        """When the next lines on traffic are due."""
        return self._bytes_due_s

    def count_bytes(self, last: bool = False) -> None:
        """Tell of traffic, and now and then of links and stages, when it is due or at the end."""
        now = self._tools.clock_s()
        if now < self._bytes_due_s and not last:
            return
        self._bytes_due_s = now + BYTES_PERIOD_S
        counters = self._tools.transport.counters()
        sent = {kind: traffic.payload_bytes for kind, traffic in sorted(counters.sent.items())}
        received = {kind: traffic.payload_bytes for kind, traffic in sorted(counters.received.items())}
        counted = BytesCounted(sent=sent, received=received, loss=self._losses(), queues=self._queues())
        self._on_report(self.reporter.reported(counted, now))
        if now >= self._account_due_s or last:
            self._account_due_s = now + ACCOUNT_PERIOD_S
            self._on_report(self.reporter.reported(self._account(counters), now))

    def _account(self, counters: TransportCounters) -> AccountKept:
        """Bytes by link and kind, and time by stage, since this start of the agent."""
        stages = counts_of(self._tools.workers.stages.snapshot())
        return AccountKept(since_s=round(self._began_s, 6), **counters.links(), stages=stages)


_WARNINGS = (
    CameraDoubted,
    FrontEndsDiffer,
    PeerRefused,
    NameTaken,
    LogForked,
    LogGivenUp,
    LatentLost,
    RoundFailed,
)
_INFOS = (LeaderFollowed, LeaderLost, NeighbourUp, NeighbourDown, ClosureAccepted, CorrectionApplied, RoundSolved)


def totals(peers: Mapping[str, Mapping[str, int]]) -> dict[str, int]:
    """Bytes by peer, all kinds together."""
    return {peer: sum(kinds.values()) for peer, kinds in peers.items()}


def _level(fact: Fact) -> int:
    if isinstance(fact, _WARNINGS):
        return logging.WARNING
    return logging.INFO if isinstance(fact, _INFOS) else logging.DEBUG


def _brief(fact: Fact) -> str:
    return " ".join(f"{key}={value}" for key, value in values_of(fact).items() if not isinstance(value, (list, dict)))
