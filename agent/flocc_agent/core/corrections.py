"""Corrections: made of a solution by the leader, kept by everybody, passed on, applied when newer.

A robot holds the newest correction of each log. (term, round) only grows, so a late or repeated one changes
nothing, and a robot that was away gets the newest from whoever it meets.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.announcing import Announcer
from flocc_agent.core.effects import Broadcast, Deliver, Effect, PersistCorrection, Report, Unicast
from flocc_agent.core.gossip import LIVES_MAX, Sealer, lives
from flocc_agent.core.parameters import GossipParameters
from flocc_agent.core.pose_graph import Component, GraphSolution, map_frame
from flocc_agent.core.pulls import REMEMBERED_MAX, REQUEST_TIMEOUT_S, remember
from flocc_agent.core.reports import CorrectionApplied, PeerRefused, RoundFailed
from flocc_agent.geometry import pose7, pose_from_tq, tq_from_poses, upper_triangle
from flocc_protocol.arrays import Array
from flocc_protocol.codec import Pose7
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import (
    LOGS_MAX,
    CorrectionBatch,
    CorrectionRequest,
    CorrectionVersion,
    LogCorrection,
    TableState,
    encode_correction,
)

Float = NDArray[np.float64]

ANSWERS_MAX = 8
"""Messages with which one request is answered."""
ASKED_MAX = 8
"""Times that a correction is asked for; what somebody says to hold and nobody sends is given up."""
LISTED_MAX = 400
"""Keyframes listed in a correction; a longer trajectory is thinned and interpolated, so that messages stay small."""
KNOTS_MAX = 16
"""Keyframes whose poses people are told with each correction; the report interpolates between them."""
TRANSLATION_TOLERANCE_M = 1e-3
ROTATION_TOLERANCE_RAD = 1e-4
"""A correction that moves no keyframe further is not sent again in one term: nobody would see the difference."""


@dataclass(slots=True)
class _Wanted:
    """A newer correction that a peer holds: how often it was asked for, and until when that may be answered."""

    version: CorrectionVersion
    peer: str
    asked: int = 0
    until_s: float = float("-inf")

    def may_ask(self, peer: str, now: float) -> bool:
        """Whether it is time to ask: the one that holds it, or anybody when that one was not heard for a while."""
        return self.until_s + (0.0 if peer == self.peer else REQUEST_TIMEOUT_S) <= now


class Corrections:
    """The newest correction of every log, as one robot knows them.

    Attributes:
        failed_signers: Leaders who did not sign what stands under their names, until somebody clears it.
    """

    def __init__(self, own: LogId, gossip: GossipParameters, sealer: Sealer | None = None) -> None:
        self.failed_signers: set[str] = set()
        self._own = own
        self._gossip = gossip
        self._sealer = sealer
        self._newest: dict[LogId, LogCorrection] = {}
        self._frame_unknown = False
        self._wanted: dict[LogId, _Wanted] = {}
        self._announcer: Announcer[CorrectionVersion] = Announcer()

    @property
    def applied(self) -> LogCorrection | None:
        """The correction that this robot applied last."""
        return self._newest.get(self._own)

    def of(self, log: LogId) -> LogCorrection | None:
        """The newest known correction of a log."""
        return self._newest.get(log)

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {
            "corrections": (len(self._newest), self._gossip.logs_max),
            "wanted_corrections": (len(self._wanted), REMEMBERED_MAX),
        }

    def restore(self, message: LogCorrection | None, frame_changed: bool) -> None:
        """Put back the correction that was applied before a restart; consumers may not know its frame yet."""
        if message is not None:
            self._keep(message)
        self._frame_unknown = frame_changed

    def state(self) -> TableState:
        """Which corrections this robot holds, as a heartbeat says it."""
        return self._announcer.state()

    def versions_since(self, changes: int) -> tuple[int, tuple[CorrectionVersion, ...]]:
        """What of that changed after so many changes, as far as one message tells, and up to which change that is."""
        return self._announcer.since(changes, LOGS_MAX)

    def has_news(self, versions: tuple[CorrectionVersion, ...]) -> bool:
        """Whether somebody holds newer ones than this robot."""
        return any(self._is_newer(version) for version in versions)

    def on_versions(self, peer: str, versions: tuple[CorrectionVersion, ...], now: float) -> list[Effect]:
        """Ask a peer for corrections that are newer than this robot's."""
        for version in versions:
            wanted = self._wanted.get(version.log)
            if self._is_newer(version) and (wanted is None or wanted.version < version):
                remember(self._wanted, version.log, _Wanted(version, peer))
        return self.ask(peer, now)

    def ask(self, peer: str, now: float) -> list[Effect]:
        """Ask a peer for what is wanted and was not asked of anybody just now; what nobody sends is given up."""
        asked: list[LogId] = []
        for log, wanted in list(self._wanted.items()):
            if not self._is_newer(wanted.version) or (wanted.asked == ASKED_MAX and wanted.until_s <= now):
                del self._wanted[log]
            elif wanted.may_ask(peer, now) and len(asked) < LOGS_MAX:
                wanted.asked, wanted.until_s = wanted.asked + 1, now + REQUEST_TIMEOUT_S
                asked.append(log)
        return [Unicast(peer, CorrectionRequest(tuple(asked)))] if asked else []

    def _is_newer(self, version: CorrectionVersion) -> bool:
        held = self._newest.get(version.log)
        return held is None or (version.term, version.round) > (held.term, held.round)

    def on_request(self, peer: str, request: CorrectionRequest) -> list[Effect]:
        """Pass corrections on, so many that a request cannot call forth a flood."""
        held = [self._newest[log] for log in request.logs if log in self._newest]
        return [Unicast(peer, batch) for batch in CorrectionBatch.batched(held)[:ANSWERS_MAX]]

    def on_message(self, peer: str, message: LogCorrection) -> list[Effect]:
        """Keep a newer correction that its leader made; apply it when it is this robot's."""
        return (self.refused(peer, message) or self.take(message)) if self.is_news(message) else []

    def is_news(self, message: LogCorrection) -> bool:
        """Whether a correction is newer than the one that is held."""
        held = self._newest.get(message.log)
        return held is None or (message.term, message.round) > (held.term, held.round)

    def refused(self, peer: str, message: LogCorrection) -> list[Effect]:
        """Refuse a newer correction for which there is no room, or which its leader did not make."""
        if message.log in self._wanted:
            self._wanted[message.log].asked = 0  # somebody does send it: a counter may rise in steps until it is taken
        if message.log not in self._newest and not self._is_room(message.log):
            return [Report(PeerRefused(peer=peer, reason="too many corrections"))]
        if not self._is_signed(message):
            return [Report(PeerRefused(peer=peer, reason="correction without its leader's signature"))]
        return []

    def _is_room(self, log: LogId) -> bool:
        return len(self._newest) < self._gossip.logs_max and lives(self._newest, log.robot) < LIVES_MAX

    def take(self, message: LogCorrection) -> list[Effect]:
        """Keep a newer correction that was not refused; apply it when it is this robot's."""
        held = self._newest.get(message.log)
        self._keep(message)
        return self._apply(message, held) if message.log == self._own else []

    def _is_signed(self, message: LogCorrection) -> bool:
        """Whether the leader of a correction's term made it, where the swarm has keys."""
        if self._sealer is None:
            return True
        try:
            self._sealer.check_correction(message.term.leader, encode_correction(message), message.signature)
        except DecodeError:
            self.failed_signers.add(message.term.leader.robot)
            return False
        return True

    def _keep(self, message: LogCorrection) -> None:
        self._newest[message.log] = message
        self._announcer.put(message.log, CorrectionVersion(message.log, message.term, message.round))

    def publish(self, term: Term, round_number: int, solution: GraphSolution) -> list[Effect]:
        """Send what a round changed, as the leader; a log whose solution leaves the map keeps its last correction."""
        return self._publish(term, round_number, [(c, log) for c in solution.components for log in c.logs])

    def publish_own(self, component: Component, round_number: int) -> list[Effect]:
        """Send this robot's own part of a distributed optimisation; its term is below every leader's.

        After a leader's correction, of a time when the swarm optimised centrally, the term is above that one.
        """
        applied = self.applied
        counter = 0 if applied is None else applied.term.counter + (applied.term.leader != self._own)
        return self._publish(Term(counter, self._own), round_number, [(component, self._own)])

    def _publish(self, term: Term, round_number: int, solved: Sequence[tuple[Component, LogId]]) -> list[Effect]:
        effects: list[Effect] = []
        published: list[LogCorrection] = []
        for component, log in solved:
            try:
                message = correction_of(component, log, term, round_number, LISTED_MAX)
            except ValueError as error:
                reason = f"robot {log.robot}: {error}"
                effects.append(Report(RoundFailed(term=term, round=round_number, reason=reason)))
                continue
            if self._changed(message):
                message = self._signed(message)
                published.append(message)
                effects += self.on_message(self._own.robot, message)
        return [*(Broadcast(batch) for batch in CorrectionBatch.batched(published)), *effects]

    def _signed(self, message: LogCorrection) -> LogCorrection:
        if self._sealer is None:
            return message
        return replace(message, signature=self._sealer.sign_correction(encode_correction(message)))

    def _changed(self, message: LogCorrection) -> bool:
        """Whether a follower would notice: another term, frame or thinning, or poses that moved."""
        held = self._newest.get(message.log)
        if held is None or (held.term, held.anchor, held.step) != (message.term, message.anchor, message.step):
            return True
        old, new = held.T_map_camera.numpy(), message.T_map_camera.numpy()
        if len(old) > len(new):
            return True
        shift = np.abs(new[: len(old)] - old)
        moved = shift[:, :3].max(initial=0.0) > TRANSLATION_TOLERANCE_M
        turned = shift[:, 3:].max(initial=0.0) > ROTATION_TOLERANCE_RAD
        return bool(moved or turned) or self._odom_moved(held, message)

    def _odom_moved(self, held: LogCorrection, message: LogCorrection) -> bool:
        shift = np.abs(np.array(held.T_map_odom) - np.array(message.T_map_odom))
        return bool(shift.max() > TRANSLATION_TOLERANCE_M)

    def _apply(self, message: LogCorrection, held: LogCorrection | None) -> list[Effect]:
        changed = self._frame_unknown or (held is not None and held.anchor != message.anchor)
        self._frame_unknown = False
        knots, T_map_camera = told_knots(message)
        fact = CorrectionApplied(
            term=message.term.counter,
            leader=message.term.leader.robot,
            round=message.round,
            map_frame=map_frame(message.anchor),
            frame_changed=changed,
            T_map_odom=message.T_map_odom,
            knots=knots,
            T_map_body=T_map_camera,
        )
        return [PersistCorrection(message, changed), Deliver(message, changed), Report(fact)]


def told_knots(message: LogCorrection) -> tuple[tuple[int, ...], tuple[Pose7, ...]]:
    """Numbers and poses of at most `KNOTS_MAX` evenly spread keyframes of a correction, the last listed among them."""
    rows = message.T_map_camera.numpy()
    step = max(1, -(-len(rows) // KNOTS_MAX))
    chosen = range((len(rows) - 1) % step, len(rows), step)
    return tuple(message.first + message.step * k for k in chosen), tuple(pose7(pose_from_tq(rows[k])) for k in chosen)


def correction_of(component: Component, log: LogId, term: Term, round_number: int, keyframes_max: int) -> LogCorrection:
    """A log's part of a solution, thinned to at most `keyframes_max` keyframes; the last one is always listed."""
    poses = np.asarray(component.T_map_keyframe[log])
    step = max(1, -(-len(poses) // keyframes_max))
    first = (len(poses) - 1) % step
    covariance = component.covariance_map_odom.get(log)
    return LogCorrection(
        log=log,
        term=term,
        round=round_number,
        anchor=component.anchor,
        T_map_odom=pose7(component.T_map_odom[log]),
        covariance=None if covariance is None else upper_triangle(covariance),
        first=first,
        step=step,
        T_map_camera=Array.of(tq_from_poses(poses[first::step]), "f4"),
    )
