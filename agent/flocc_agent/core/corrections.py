"""Corrections: made of a solution by the leader, applied by their owner when newer, known in short to everybody.

A robot holds the newest correction of each log in short: where the log's odom frame lies in the map. The knots, which
say how the log's earlier keyframes were corrected, are its owner's business: a leader sends them to owners in range,
and others ask for theirs, over robots that are nearer to the leader. (term, round) only grows, so a late or repeated
correction changes nothing, and a robot that was away gets the newest from whoever it meets.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flocc_agent.core.announcing import Announcer
from flocc_agent.core.claims import CorrectionClaim
from flocc_agent.core.correction_evidence import HeldGraph, Placed
from flocc_agent.core.effects import Broadcast, Deliver, Effect, PersistCorrection, Report, Unicast
from flocc_agent.core.gossip import Sealer, may_hold
from flocc_agent.core.knot_requests import GRACE_S, KnotRequests
from flocc_agent.core.knots import Track, corrected, knots_of, strays
from flocc_agent.core.parameters import GossipParameters
from flocc_agent.core.plausibility import FINAL, Doubts
from flocc_agent.core.pose_graph import Component, GraphSolution, map_frame
from flocc_agent.core.pulls import REMEMBERED_MAX, REQUEST_TIMEOUT_S, remember
from flocc_agent.core.reports import CorrectionApplied, PeerRefused, RoundFailed
from flocc_agent.geometry import pose7s, symmetric
from flocc_protocol.codec import Pose7
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import LogId, Term
from flocc_protocol.messages import (
    LOGS_MAX,
    CorrectionBatch,
    CorrectionRequest,
    CorrectionVersion,
    KnotRequest,
    LogCorrection,
    TableState,
    encode_correction,
)

Float = NDArray[np.float64]

ANSWERS_MAX = 8
"""Messages with which one request is answered."""
ASKED_MAX = 8
"""Times that a correction is asked for; what somebody says to hold and nobody sends is given up."""
TOLD_MAX = 16
"""Keyframes whose poses people are told with each correction; the report interpolates between them."""
COVARIANCE_CHANGE_RATIO = 0.1
"""A correction whose covariance changed by more than this is sent again although nothing moved."""
KNOTS_PAUSE_PER_LOG_S = 0.1
"""After knots of its log came a robot asks for newer ones only after this for each log that it knows a correction of:
in a large team every round moves every log, and each question goes over many robots."""

UNTRUE = "a correction that cannot be true"


def _nowhere(log: LogId) -> Float:  # noqa: ARG001
    return np.empty((0, 4, 4))


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
    """The newest correction of every log, as one robot knows them, and those knots that it needs.

    Attributes:
        failed_signers: Leaders who did not sign what stands under their names, until somebody clears it.
        doubts: Corrections of the own log that are not believed.
    """

    def __init__(
        self,
        own: LogId,
        gossip: GossipParameters,
        sealer: Sealer | None = None,
        odometry: Callable[[LogId], Float] = _nowhere,
        near: Callable[[str], bool] = lambda robot: False,  # noqa: ARG005
        towards: Callable[[Term], list[str]] = lambda term: [],  # noqa: ARG005
        evidence: HeldGraph | None = None,
    ) -> None:
        """Start without any.

        Args:
            own: The log that this robot writes.
            gossip: Limits.
            sealer: Signs and checks corrections, where the swarm has keys.
            odometry: T_odom_camera (N, 4, 4) of the known keyframes of a log.
            near: Whether a robot of this name is in range.
            towards: Robots in range, those that are nearest to the leader of a term first.
            evidence: What corrections of the own log are held against; None: they are believed.
        """
        self.failed_signers: set[str] = set()
        self.doubts = Doubts(evidence)
        self._own = own
        self._gossip = gossip
        self._sealer = sealer
        self._odometry = odometry
        self._near = near
        self._newest: dict[LogId, LogCorrection] = {}
        self._whole: dict[LogId, LogCorrection] = {}
        self._requests = KnotRequests(towards)
        self._knots_s = float("-inf")
        self._follows_all = False
        self._frame_unknown = False
        self._wanted: dict[LogId, _Wanted] = {}
        self._announcer: Announcer[CorrectionVersion] = Announcer()

    @property
    def applied(self) -> LogCorrection | None:
        """The correction that this robot applied last."""
        return self._whole.get(self._own)

    def of(self, log: LogId) -> LogCorrection | None:
        """The newest known correction of a log, with its knots where they are known and not older than asked for."""
        short, whole = self._newest.get(log), self._whole.get(log)
        if short is None or whole is None or log == self._own:
            return whole or (None if log == self._own else short)
        fresh = whole.version >= short.version or (self._follows(log) and whole.anchor == short.anchor)
        return whole if fresh else short

    def follow_all(self) -> None:
        """Ask for the knots of all logs from now on: somebody looks at where everybody was."""
        self._follows_all = True

    def _follows(self, log: LogId) -> bool:
        """Whether it matters where all of another log was: to somebody who looks, or for what is held back."""
        return self._follows_all or log in self.doubts.rests_on()

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Tables with their maximum."""
        return {
            "corrections": (len(self._newest), self._gossip.logs_max),
            "knots": (len(self._whole), self._gossip.logs_max + 1),
            "wanted_corrections": (len(self._wanted), REMEMBERED_MAX),
            **self._requests.sizes(),
        }

    def restore(self, message: LogCorrection | None, frame_changed: bool) -> None:
        """Put back the correction that was applied before a restart; consumers may not know its frame yet."""
        if message is not None:
            self._whole[message.log] = message
            self._keep(message)
            if message.log == self._own:
                self.doubts.on_applied(self._placed(message))
        self._frame_unknown = frame_changed

    # What is known in short

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

    def on_request(self, peer: str, request: CorrectionRequest) -> list[Effect]:
        """Pass corrections on, so many that a request cannot call forth a flood."""
        held = [self._newest[log] for log in request.logs if log in self._newest]
        return [Unicast(peer, batch) for batch in CorrectionBatch.batched(held)[:ANSWERS_MAX]]

    # Knots

    def ask_knots(self, now: float) -> list[Effect]:
        """Ask for the knots of newer corrections of this robot's log, and of those that it or somebody looks at."""
        followed = [log for log in self._newest if log == self._own or self._follows(log)]
        self._requests.keep(followed)
        for log in followed:
            short = self._newest.get(log)
            if short is not None and not self._has_knots(short) and not self.doubts.knows(short.version):
                self._requests.want(short.version, self._knots_not_before_s(short, now))
        return self._requests.ask(now)

    def _knots_not_before_s(self, short: LogCorrection, now: float) -> float:
        """When to ask for knots: at once but for the own ones, which may come by themselves, or came just now."""
        if short.log != self._own:
            return now
        grace_s = GRACE_S if self._near(short.term.leader.robot) else 0.0
        return max(now + grace_s, self._knots_s + KNOTS_PAUSE_PER_LOG_S * len(self._newest))

    def on_knot_request(self, peer: str, request: KnotRequest, now: float) -> list[Effect]:
        """Send the knots that are here; ask on for others, and pass them on when they come."""
        held = [self._whole[version.log] for version in request.versions if self._has_knots(version)]
        for version in request.versions:
            if not self._has_knots(version) and version.log != self._own:
                self._requests.on_interest(peer, version, now)
        answers: list[Effect] = [Unicast(peer, batch) for batch in CorrectionBatch.batched(held)[:ANSWERS_MAX]]
        return answers + self._requests.ask(now)

    def _has_knots(self, version: CorrectionVersion | LogCorrection) -> bool:
        whole = self._whole.get(version.log)
        return whole is not None and (whole.term, whole.round) >= (version.term, version.round)

    # Corrections that came

    def on_message(self, peer: str, message: LogCorrection, now: float = 0.0) -> list[Effect]:
        """Keep a newer correction that its leader made; apply it when it is this robot's."""
        return (self.refused(peer, message) or self.take(message, now)) if self.is_news(message, now) else []

    def is_news(self, message: LogCorrection, now: float = 0.0) -> bool:
        """Whether a correction is newer than the one that is held, or brings knots that somebody waits for."""
        if self._is_newer(message) or self._is_shorter(message):
            return True
        if message.knots is None or self._has_knots(message) or self.doubts.knows(message.version):
            return False
        return message.log == self._own or self._follows(message.log) or self._requests.waits(message.log, now)

    def claim(self, message: LogCorrection, now: float) -> CorrectionClaim | None:
        """What `refused` would check of a correction that is news; None where it would not come to that."""
        if not self.is_news(message, now) or (message.log not in self._newest and not self._is_room(message.log)):
            return None
        return CorrectionClaim(message.term.leader, encode_correction(message), message.signature)

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
        return may_hold(self._newest, log, self._gossip.logs_max)

    def take(self, message: LogCorrection, now: float = 0.0) -> list[Effect]:
        """Keep a newer correction that was not refused; apply it when it is this robot's, whole, and can be true."""
        own = message.log == self._own and message.knots is not None and not self._has_knots(message)
        if own:
            why = self.doubts.believes(self._placed(message), now)
            if why is not None:
                return [_untrue(message, why)] if why in FINAL else []
        if self._is_newer(message) or self._is_shorter(message):
            self._keep(message)
        if message.knots is None:
            return self.ask_knots(now) if message.log == self._own else []
        if self._has_knots(message):
            return []
        passed_on = self._requests.on_knots(message.version, now)
        if message.log != self._own and not (passed_on or self._follows(message.log)):
            return []
        held = self._whole.get(message.log)
        self._whole[message.log] = message
        if message.log == self._own:
            self._knots_s = now
        effects: list[Effect] = [Unicast(peer, CorrectionBatch((message,))) for peer in passed_on]
        return effects + (self._apply(message, held) if message.log == self._own else [])

    def forget(self, leader: str) -> None:
        """Hold nothing more that this leader made, but for what was applied, so that it fences nobody out."""
        for log in [log for log, held in self._newest.items() if held.term.leader.robot == leader]:
            del self._newest[log]
            self._announcer.remove(log)
        applied = self.applied
        if applied is not None and self._own not in self._newest:
            self._keep(applied)

    def forget_log(self, log: LogId) -> None:
        """A log is held no more, and neither is where it lies."""
        if self._newest.pop(log, None) is not None:
            self._announcer.remove(log)
        self._whole.pop(log, None)
        self._wanted.pop(log, None)

    def _placed(self, own: LogCorrection) -> Placed:
        """A correction of the own log and what is known of the other logs."""
        others = {log: known for log in self._newest if log != self._own and (known := self.of(log)) is not None}
        return Placed(own, others)

    def reconsider(self, now: float) -> list[Effect]:
        """Apply what was held back once it can be true; refuse it after a while."""
        held = self.doubts.to_look_at(now)
        if held is None:
            return []
        effects = self.take(held, now)
        why = self.doubts.given_up(now)
        return effects if why is None else [_untrue(held, why)]

    def on_own_solution(self, solution: GraphSolution | None, now: float) -> list[Effect]:
        """This robot solved the graph itself, None: in vain. What was held back and is borne out is applied."""
        components = () if solution is None else solution.components
        borne_out = self.doubts.on_solution(next((c for c in components if self._own in c.logs), None))
        return [] if borne_out is None else self.take(borne_out, now)

    def _is_newer(self, version: CorrectionVersion | LogCorrection) -> bool:
        held = self._newest.get(version.log)
        return held is None or (version.term, version.round) > (held.term, held.round)

    def _is_shorter(self, message: LogCorrection) -> bool:
        """Whether this is the short form of what is kept whole only because a signature covers all of it."""
        held = self._newest[message.log]
        return message.knots is None and held.knots is not None and held.version == message.version

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
        """Keep in short what came; where corrections are signed as they came, until the short form comes, too."""
        self._newest[message.log] = replace(message, knots=None) if self._sealer is None else message
        self._announcer.put(message.log, message.version)

    # Corrections that this robot makes

    def publish(self, term: Term, round_number: int, solution: GraphSolution) -> list[Effect]:
        """Send what a round changed, as the leader; a log whose solution leaves the map keeps its last correction."""
        return self._publish(term, round_number, [(c, log) for c in solution.components for log in c.logs])

    def publish_own(self, component: Component, round_number: int) -> tuple[list[Effect], str | None]:
        """Send this robot's own part of a distributed optimisation, or say what speaks against it.

        Its term is below every leader's; after a leader's correction, of a time when the swarm optimised centrally, it
        is above that one.
        """
        applied = self.applied
        term = Term(0 if applied is None else applied.term.counter + (applied.term.leader != self._own), self._own)
        try:
            made = self._made(component, self._own, term, round_number)
        except ValueError as error:
            return [], f"robot {self._own.robot}: {error}"
        if made is None:
            return [], None
        why = self.doubts.speaks_against(self._placed(made))
        return ([], why) if why is not None else (self._publish(term, round_number, [(component, self._own)]), None)

    def _publish(self, term: Term, round_number: int, solved: Sequence[tuple[Component, LogId]]) -> list[Effect]:
        """Knots to those owners that are in range, the rest in short to all."""
        effects: list[Effect] = []
        knots: list[Effect] = []
        published: list[LogCorrection] = []
        for component, log in solved:
            try:
                made = self._made(component, log, term, round_number)
            except ValueError as error:
                reason = f"robot {log.robot}: {error}"
                effects.append(Report(RoundFailed(term=term, round=round_number, reason=reason)))
                continue
            if made is not None:
                whole, short = (self._signed(each) for each in (made, replace(made, knots=None)))
                published.append(short)
                effects += self._take_own(whole, short)
                if log != self._own and self._near(log.robot):
                    knots.append(Unicast(log.robot, CorrectionBatch((whole,))))
        return [*knots, *(Broadcast(batch) for batch in CorrectionBatch.batched(published)), *effects]

    def _made(self, component: Component, log: LogId, term: Term, round_number: int) -> LogCorrection | None:
        """The correction of a log, None where its last one still says the same.

        Raises:
            ValueError: The solution leaves the map.
        """
        poses = np.asarray(component.T_map_keyframe[log])
        if not np.isfinite(poses).all() or not np.isfinite(component.T_map_odom[log]).all():
            raise ValueError("a correction's poses must be finite")
        odometry = self._odometry(log)[: len(poses)]
        track = Track(
            odometry, poses[: len(odometry)], component.T_map_odom[log], component.covariance_map_odom.get(log)
        )
        held = self._whole.get(log)
        same = held is not None and (held.term, held.anchor) == (term, component.anchor)
        if held is not None and same and strays(held, track) <= 1.0 and not _is_surer(held, track.covariance):
            return None
        T_map_odom, knots = knots_of(track)
        made = LogCorrection(log, term, round_number, component.anchor, T_map_odom, knots)
        try:
            encode_correction(made)
        except DecodeError as error:
            raise ValueError(str(error)) from error
        return made

    def _take_own(self, whole: LogCorrection, short: LogCorrection) -> list[Effect]:
        if not self._is_newer(short) or (short.log not in self._newest and not self._is_room(short.log)):
            return []
        self._keep(short)
        held = self._whole.get(whole.log)
        self._whole[whole.log] = whole
        return self._apply(whole, held) if whole.log == self._own else []

    def _signed(self, message: LogCorrection) -> LogCorrection:
        if self._sealer is None:
            return message
        return replace(message, signature=self._sealer.sign_correction(encode_correction(message)))

    def _apply(self, message: LogCorrection, held: LogCorrection | None) -> list[Effect]:
        changed = self._frame_unknown or (held is not None and held.anchor != message.anchor)
        self._frame_unknown = False
        self.doubts.on_applied(self._placed(message))
        knots, T_map_camera = told_poses(message, self._odometry(self._own))
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


def _is_surer(held: LogCorrection, covariance: Float | None) -> bool:
    """Whether a covariance is another one than a correction tells: surer or less sure, or known at last."""
    told = None if held.knots is None or held.knots.covariance is None else symmetric(held.knots.covariance.numpy())
    if told is None or covariance is None:
        return (told is None) != (covariance is None)
    return bool(np.linalg.norm(covariance - told) > COVARIANCE_CHANGE_RATIO * np.linalg.norm(told))


def _untrue(message: LogCorrection, why: str) -> Report:
    return Report(PeerRefused(peer=message.term.leader.robot, reason=f"{UNTRUE}: {why}"))


def told_poses(message: LogCorrection, T_odom_camera: Float) -> tuple[tuple[int, ...], tuple[Pose7, ...]]:
    """Numbers and poses of at most `TOLD_MAX` evenly spread keyframes of a correction, its last one among them."""
    if message.knots is None or not len(T_odom_camera):
        return (), ()
    last = min(int(message.knots.keyframes.numpy()[-1]), len(T_odom_camera) - 1)
    step = max(1, -(-(last + 1) // TOLD_MAX))
    numbers = np.arange(last % step, last + 1, step)
    poses = corrected(message, T_odom_camera[numbers], numbers)
    return tuple(numbers.tolist()), pose7s(poses)
