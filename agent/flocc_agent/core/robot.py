"""The robot: composes the machines of the core, events in, effects out.

The driver calls `handle` for each event and `tick` when `deadline` is due; both return effects to carry out in
order. Same seed and same events give the same effects, on virtual time and on a robot.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from flocc_agent.core.assembly import POSES_OF_A_PIECE, GraphAssembly
from flocc_agent.core.candidate_order import SpectralOrder
from flocc_agent.core.claims import Claim
from flocc_agent.core.closure_rows import ROWS_OF_A_PIECE
from flocc_agent.core.cold_storage import ColdPieces, ColdStorage
from flocc_agent.core.comparing import Comparisons
from flocc_agent.core.corrections import Corrections
from flocc_agent.core.distributed_optimisation import STEPS_AFTER_RESTART, DistributedOptimisation
from flocc_agent.core.effects import Broadcast, DropLog, Effect, Encode, Optimise, Report, Unicast
from flocc_agent.core.election import LeaderElection
from flocc_agent.core.events import (
    LATENT_FALSE,
    LATENT_UNKNOWN,
    ChoiceFailed,
    ClosuresChosen,
    ConsensusStepFailed,
    ConsensusStepped,
    Event,
    GraphOptimisationFailed,
    GraphOptimised,
    KeyframeCaptured,
    KeyframeEncoded,
    KeyframeEncodingFailed,
    LatentFetched,
    LatentFetchFailed,
    LatentMissing,
    Leaving,
    Measured,
    MessageReceived,
    PairRegistered,
)
from flocc_agent.core.giving_up import LOOK_PERIOD_S, expendable
from flocc_agent.core.gossip import Gossip, NewRecord, Sealer
from flocc_agent.core.in_map import InMap
from flocc_agent.core.judgement import judged, told
from flocc_agent.core.latents import Peer
from flocc_agent.core.log_copy import BLOCK_RECORDS
from flocc_agent.core.loop_closing import LoopClosing
from flocc_agent.core.measurements import (
    WAITING_MAX,
    BadMeasurement,
    Measurement,
    belongs_to,
    measurement_refused,
    measurement_report,
    record_of,
)
from flocc_agent.core.neighbours import Neighbours
from flocc_agent.core.parameters import CoreParameters
from flocc_agent.core.peer_budgets import AnswerBudget, Muted
from flocc_agent.core.place_recognition import PlaceRecognition
from flocc_agent.core.prospects import UNLIKELY
from flocc_agent.core.registration import Registration, RegistrationFailed
from flocc_agent.core.reports import (
    ClosureRejected,
    EncodingFailed,
    FrontEndsDiffer,
    KeyframeTaken,
    LatentArrived,
    LatentFailed,
    LatentLost,
    LogGivenUp,
    NeighbourDown,
    PeerRefused,
    RoundFailed,
    SolutionIgnored,
)
from flocc_agent.core.rounds import Rounds, solution_report
from flocc_agent.core.saved_map import SavedMap
from flocc_agent.core.spared import TOLD
from flocc_protocol.arrays import Array
from flocc_protocol.codec import Pose7
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import KeyframeId, LogId, Term
from flocc_protocol.messages import (
    Answer,
    CandidateOffer,
    CandidatePair,
    Coordinator,
    CorrectionBatch,
    CorrectionRequest,
    DigestRequest,
    Digests,
    Election,
    Envelope,
    Handover,
    Heartbeat,
    KnotRequest,
    LogCorrection,
    LogDigest,
    RecordRequest,
    Records,
    SharedPoses,
)
from flocc_protocol.records import (
    ClosureRecord,
    KeyframeRecord,
    LatentRecord,
    Record,
    RejectionRecord,
)

NOBODY = -1
"""Compute class, as loop closing sees it, of a name under which two robots run: both would register what it gets."""
DISTRUSTED_FIRST_S, DISTRUSTED_MAX_S = 60.0, 3600.0
"""How long a leader whose signed correction cannot be true is not followed: the first time, and at most."""
OVERTAKEN_PERIOD_S = 1.0
OTHER_MODE_MAX = 256
GREETING_RATIO = 0.2
"""Least pause between heartbeats that greet new neighbours, against the usual one."""


@dataclass(frozen=True, slots=True)
class Restored:
    """What a robot finds on its disk when it starts.

    Attributes:
        records: (log, encoded records in order) of every log, the own one included.
        latents: Keyframes whose latents are stored.
        term_counter: Highest term counter the robot claimed.
        correction: The correction it applied last.
        frame_changed: That correction changed the map frame, and nobody knows whether consumers heard of it.
        saved: The map that it opens; its logs are among the records, its latents among the latents.
        journeys: Earlier logs of its own that it goes on from.
    """

    records: tuple[tuple[LogId, tuple[bytes, ...]], ...] = ()
    latents: tuple[KeyframeId, ...] = ()
    term_counter: int = 0
    correction: LogCorrection | None = None
    frame_changed: bool = False
    saved: SavedMap | None = None
    journeys: frozenset[LogId] = frozenset()

    def closed(self) -> frozenset[LogId]:
        """Logs that nobody writes any more, and whose latents are on this robot's disk."""
        return self.journeys if self.saved is None else self.journeys | self.saved.closed

    def counter_max(self) -> int:
        """Highest term counter that the robot knew of: a term it claims must be above what it applied."""
        return max(self.term_counter, self.correction.term.counter if self.correction else 0)


@dataclass(slots=True)
class _Pending:
    """A keyframe between capture and its record; records are appended in the order of capture."""

    index: int
    stamp_s: float
    T_odom_camera: Pose7
    encoded: bool = False
    descriptor: Array | None = None
    sha256: bytes = b""


class Robot:
    """One agent's whole behaviour."""

    def __init__(
        self,
        log: LogId,
        compute_class: int,
        boot: int,
        parameters: CoreParameters,
        now: float,
        restored: Restored | None = None,
        sealer: Sealer | None = None,
        distributed: bool = False,
        compute_classes: Mapping[str, int] | None = None,
        cold: ColdStorage | None = None,
    ) -> None:
        restored = restored or Restored()
        self.log = log
        self._compute_class = compute_class
        self._boot = boot
        self._parameters = parameters
        self._sequence = 0
        self._heartbeat_due_s = now
        self._heartbeat_s = float("-inf")
        self._pending: list[_Pending] = []
        self._waiting: dict[int, list[Measurement]] = {}
        self._served = frozenset(restored.latents if restored.saved is not None else ())
        self._partnered: set[tuple[KeyframeId, LogId]] = set()
        self.neighbours = Neighbours(log, boot, parameters.neighbours)
        held = parameters.memory.keyframes_held
        cold_records = None if cold is None else ColdPieces(cold, max(1, held // BLOCK_RECORDS))
        cold_odometry = None if cold is None else ColdPieces(cold, max(1, held // POSES_OF_A_PIECE))
        self.gossip = Gossip(log, parameters.gossip, sealer, self.neighbours.was_near, cold_records)
        self.comparisons = Comparisons(parameters.neighbours.neighbours_max)
        self._answers = AnswerBudget()
        self._muted = Muted()
        cold_closures = None if cold is None else ColdPieces(cold, max(1, held // ROWS_OF_A_PIECE))
        self.assembly = GraphAssembly(restored.saved, cold_odometry, cold_closures, held)
        closed = restored.closed()
        self.recognition = PlaceRecognition(log, parameters.place_recognition, closed, held)
        spectral = SpectralOrder() if parameters.place_recognition.candidate_order == "spectral" else None
        comes_back = any(each not in closed for each, _ in restored.records)
        listens_until_s = now + parameters.election.startup_s if comes_back else float("-inf")
        pair_of = self.assembly.odometry_pair
        self.closing = LoopClosing(
            log,
            compute_class,
            pair_of,
            parameters.loop_closing,
            spectral,
            closed,
            listens_until_s,
            self.recognition.agreement,
            self.assembly,
        )
        self.closing.latents.names.record_at = self._record_at
        self.in_map = None if restored.saved is None else InMap(restored.saved, now)
        self.corrections = Corrections(
            log,
            parameters.gossip,
            sealer,
            odometry=self.assembly.odometry,
            near=self.neighbours.__contains__,
            towards=self.neighbours.towards,
            evidence=self.assembly,
        )
        self._has_keys = sealer is not None
        self._overtaken_s = float("-inf")
        self._looked_for_room_s = float("-inf")
        self._closed = closed
        self._distrusted = Muted(DISTRUSTED_FIRST_S, DISTRUSTED_MAX_S)
        self.election = LeaderElection(
            log, compute_class, restored.counter_max(), parameters.election, now, compute_classes
        )
        self.rounds = Rounds(self.assembly, parameters.rounds, cold, held)
        self.distributed = self._distributed(restored.correction) if distributed else None
        self._of_other_mode: set[LogId] = set()
        self._restore(restored, now)

    # The three entry points

    def handle(self, event: Event, now: float) -> list[Effect]:
        """Something happened."""
        effects = self._dispatch(event, now)
        if self.gossip.wanting_room is not None:
            effects += self._make_room(self.gossip.wanting_room, now)
            self.gossip.wanting_room = None
        return self._placed(effects + self._settle(now), now)

    def tick(self, now: float) -> list[Effect]:
        """Time passed."""
        effects = self._lose_silent(now)
        effects += self.election.tick(now)
        if self._heartbeat_due_s <= now:
            effects += self._heartbeat(now)
        return self._placed(effects + self._settle(now), now)

    def _placed(self, effects: list[Effect], now: float) -> list[Effect]:
        """Tell of the opened map, and when this robot finds itself in it."""
        if self.in_map is None:
            return effects
        return effects + self.in_map.told(effects, self.gossip.logs[self.log].keyframes, now)

    def claims(self, envelope: Envelope, now: float) -> list[Claim]:
        """What of a message its sealer will be asked for, as far as this robot knows now; nothing changes."""
        peer, message = envelope.sender.robot, envelope.message
        if peer == self.log.robot:
            return []
        match message:
            case Records(batches):
                heard = [batch for batch in batches if not self._muted.is_muted(peer, batch.log.robot, now)]
                return [claim for batch in heard for claim in self.gossip.claims(batch)]
            case CorrectionBatch(corrections):
                heard_of = [c for c in corrections if not self._muted.is_muted(peer, c.term.leader.robot, now)]
                trusted = [c for c in heard_of if not self._is_distrusted(c.term.leader, now)]
                found = [self.corrections.claim(correction, now) for correction in trusted]
                return [claim for claim in found if claim is not None]
            case _:
                return []

    def deadline(self) -> float:
        """When `tick` is due next, in seconds of the driver's clock."""
        return min(
            self._heartbeat_due_s,
            self.neighbours.deadline(),
            self.election.deadline(),
            self.closing.deadline(),
            self.rounds.deadline() if self.distributed is None else self.distributed.deadline(),
        )

    def keyframes_given(self) -> int:
        """Own keyframes that were captured, recorded or not: the next one's number."""
        return self.gossip.logs[self.log].keyframes + len(self._pending)

    @property
    def closures_enough(self) -> int:
        """Agreeing closures of two stretches beside which no more pairs are registered; 0: all are."""
        return self._parameters.loop_closing.closures_enough

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Every queue, table and cache: how much is in it, and its maximum."""
        neighbours = (len(self.neighbours.names()), self._parameters.neighbours.neighbours_max)
        return {
            "neighbours": neighbours,
            "measurements": (sum(map(len, self._waiting.values())), WAITING_MAX * max(len(self._pending), 1)),
            **self.gossip.sizes(),
            **self.comparisons.sizes(),
            **self.closing.sizes(),
            **self.corrections.sizes(),
            **self.election.sizes(),
            **self._answers.sizes(),
            **self._muted.sizes("muted"),
            **self.assembly.sizes(),
            **self._distrusted.sizes("distrusted"),
            **({} if self.distributed is None else self.distributed.sizes()),
        }

    # Events

    def _dispatch(self, event: Event, now: float) -> list[Effect]:
        match event:
            case MessageReceived(envelope):
                return self._on_message(envelope, now)
            case KeyframeCaptured():
                return self._on_captured(event)
            case KeyframeEncoded(keyframe, descriptor, doubts, sha256):
                self.closing.on_held(keyframe)
                return [*map(Report, doubts), *self._on_encoded(keyframe, descriptor, now, sha256)]
            case KeyframeEncodingFailed(keyframe, reason, doubts):
                reports = [*map(Report, doubts), Report(EncodingFailed(keyframe=keyframe, reason=reason))]
                return [*reports, *self._on_encoded(keyframe, None, now)]
            case LatentFetched(keyframe, holder):
                self.closing.on_held(keyframe)
                return [Report(LatentArrived(keyframe=keyframe, holder=holder))]
            case LatentFetchFailed(keyframe, holder, reason):
                return self._on_fetch_failed(keyframe, holder, reason, now)
            case PairRegistered(pair, result):
                return self._on_registered(pair, result, now)
            case LatentMissing(pair, keyframe):
                return self._reject_lost(self.closing.on_latent_missing(pair, keyframe), keyframe, now)
            case GraphOptimised():
                return self._on_optimised(event, now)
            case GraphOptimisationFailed(term=term) if term == self._own_term:
                return self.corrections.on_own_solution(None, now)
            case GraphOptimisationFailed(term, round_number, reason):
                self.rounds.on_failed(term, round_number, now)
                return [Report(RoundFailed(term=term, round=round_number, reason=reason))]
            case ClosuresChosen() | ChoiceFailed() | ConsensusStepped() | ConsensusStepFailed():
                return [] if self.distributed is None else self._on_agreeing(self.distributed, event, now)
            case Measured(measurement, index):
                return self._on_measured(measurement, index, now)
            case Leaving():
                return self.election.leave()

    def _on_message(self, envelope: Envelope, now: float) -> list[Effect]:
        sender, message = envelope.sender, envelope.message
        if sender.robot == self.log.robot and not isinstance(message, Heartbeat):
            return []
        if isinstance(message, Election | Answer | Coordinator | Handover) and self._is_distrusted(sender, now):
            return []
        match message:
            case Heartbeat():
                return self._on_heartbeat(sender, message, now)
            case Digests():
                return self._on_digests(sender, message, now)
            case DigestRequest():
                return self._on_digest_request(sender, message, now)
            case Election():
                return self.election.on_election(sender, now)
            case Answer():
                return self.election.on_answer(sender, now)
            case Coordinator():
                return self.election.on_coordinator(sender, message, now)
            case Handover():
                return self.election.on_handover(sender, message, now)
            case Records() | CorrectionBatch():
                return self._on_signed(sender, message, now)
            case RecordRequest():
                return self._answers.within(sender.robot, self.gossip.on_request(sender, message), now)
            case CorrectionRequest():
                return self._answers.within(sender.robot, self.corrections.on_request(sender.robot, message), now)
            case KnotRequest():
                near = sender.robot in self.neighbours
                answers = self.corrections.on_knot_request(sender.robot, message, now) if near else []
                return self._answers.within(sender.robot, answers, now)
            case CandidateOffer():
                self.closing.on_offer(message, now)
                return []
            case SharedPoses():
                return self._on_shared_poses(sender, message, now)

    def _on_signed(self, sender: LogId, message: Records | CorrectionBatch, now: float) -> list[Effect]:
        """Take in what is signed, but for what of this sender failed lately."""
        peer, muted = sender.robot, self._muted
        if isinstance(message, Records):
            batches = tuple([b for b in message.batches if not muted.is_muted(peer, b.log.robot, now)])
            heard = message if len(batches) == len(message.batches) else Records(batches)
            new, effects = self.gossip.on_records(sender, heard, now)
            effects += self._take(new, now)
        else:
            taken = [c for c in message.corrections if not muted.is_muted(peer, c.term.leader.robot, now)]
            effects = [effect for correction in taken for effect in self._on_correction(sender, correction, now)]
        effects += self._reconsider(now)
        for failed in (self.gossip.failed_signers, self.corrections.failed_signers):
            for signer in failed:
                muted.on_failed(peer, signer, now)
            failed.clear()
        return effects

    def _on_heartbeat(self, sender: LogId, heartbeat: Heartbeat, now: float) -> list[Effect]:
        known = sender.robot in self.neighbours
        effects = self.neighbours.on_heartbeat(sender, heartbeat, now)
        if sender.robot not in self.neighbours:
            return effects
        if not known:
            self._greet(heartbeat, now)
        if self.in_map is not None:
            effects += self.in_map.on_heartbeat(sender)
        effects += self.election.on_heartbeat(sender, self._believed(heartbeat, now), now)
        effects += self._compare(sender, heartbeat, now)
        compute_class = self.election.class_of(sender.robot, heartbeat.compute_class)
        helps = NOBODY if self.neighbours.is_double(sender.robot) else compute_class
        self.closing.on_peer(sender.robot, Peer(helps, heartbeat.load, heartbeat.holds, sender))
        self.closing.on_wants(sender.robot, heartbeat.wants, now)
        for keyframe, pair in self.closing.on_lost_elsewhere(heartbeat.lost, now) if heartbeat.lost else ():
            effects += self._reject_lost([pair], keyframe, now)
        return effects

    def _on_correction(self, sender: LogId, message: LogCorrection, now: float) -> list[Effect]:
        """Take a correction that its leader made; one of an absurd term would fence out every leader to come."""
        if message.log in self.gossip.given_up:
            return []
        if self._is_distrusted(message.term.leader, now):
            return self._overtaken(sender, message, now)
        if self.distributed is not None and message.term.leader != message.log:
            return self._other_mode(message.term.leader)
        if self.distributed is not None and message.log == self.log:
            self.distributed.on_own_correction(message.round)
        if not self.corrections.is_news(message, now):
            return []
        refused = self.corrections.refused(sender.robot, message) or self.election.on_applied(sender, message.term, now)
        return refused or self.corrections.take(message, now)

    def _reconsider(self, now: float) -> list[Effect]:
        """Look again at a correction that was not believed; where leaders sign, one that lies is not followed."""
        effects, doubts = self.corrections.reconsider(now), self.corrections.doubts
        if doubts.wants_solution:
            doubts.wants_solution = False
            effects.append(Optimise(self._own_term, 0, self.assembly.graph(), None))
        if self._has_keys:
            for leader in sorted(doubts.doubted):
                self._distrusted.on_failed(leader.robot, leader.robot, now)
                self.corrections.forget(leader.robot)
                effects += self.election.on_distrusted(leader.robot, now)
            for leader in sorted(doubts.confirmed):
                self._distrusted.forgive(leader.robot, leader.robot)
        doubts.doubted.clear()
        doubts.confirmed.clear()
        return effects

    def _believed(self, heartbeat: Heartbeat, now: float) -> Heartbeat:
        """A heartbeat as the election hears it: without a leader that is not followed."""
        advert = heartbeat.leader
        distrusted = advert is not None and self._is_distrusted(advert.term.leader, now)
        return replace(heartbeat, leader=None) if distrusted else heartbeat

    def _overtaken(self, sender: LogId, message: LogCorrection, now: float) -> list[Effect]:
        """Lead above the terms of a robot that is not followed, now and then: others may have applied what it said."""
        if not self.election.leading or now < self._overtaken_s + OVERTAKEN_PERIOD_S:
            return []
        self._overtaken_s = now
        refused = self.corrections.refused(sender.robot, message)
        return refused or self.election.on_applied(sender, message.term, now)

    def _is_distrusted(self, leader: LogId, now: float) -> bool:
        return self._distrusted.is_muted(leader.robot, leader.robot, now)

    def _compare(self, sender: LogId, heartbeat: Heartbeat, now: float) -> list[Effect]:
        """Ask a neighbour for what it has more of, and for what changed in its tables where they are others."""
        peer, digests, versions = sender.robot, self.gossip.state(), self.corrections.state()
        own = (LogDigest(sender, heartbeat.records, heartbeat.checksum),) if heartbeat.records else ()
        effects = self.gossip.on_digests(sender, own, now)
        if heartbeat.versions.hash != versions.hash:
            effects += self.corrections.ask(peer, now)
        effects += [*self.corrections.ask_knots(now), *self._reconsider(now)]
        return effects + self.comparisons.on_heartbeat(peer, heartbeat, digests, versions, now)

    def _on_digests(self, sender: LogId, message: Digests, now: float) -> list[Effect]:
        """What others hold: whoever has less of a log or an older correction asks for it."""
        versions = tuple(
            each
            for each in message.versions
            if each.log not in self.gossip.given_up and not self._is_distrusted(each.term.leader, now)
        )
        helped = self.gossip.has_news(message.digests) or self.corrections.has_news(versions)
        self.comparisons.on_digests(sender.robot, message, helped, now)
        effects = self.gossip.on_digests(sender, message.digests, now, at_once=True)
        return effects + self.corrections.on_versions(sender.robot, versions, now)

    def _on_digest_request(self, sender: LogId, request: DigestRequest, now: float) -> list[Effect]:
        if sender.robot not in self.neighbours or not self.comparisons.may_answer(sender.robot, now):
            return []
        digests = self.gossip.digests_since(request.digests_since)
        versions = self.corrections.versions_since(request.versions_since)
        return [Unicast(sender.robot, Digests(self._boot, *digests, *versions))]

    def _on_fetch_failed(self, keyframe: KeyframeId, holder: str, reason: str, now: float) -> list[Effect]:
        """Try again later, with another holder if this one served a false one, unless its owner lost the latent."""
        self.closing.on_fetch_failed(keyframe, now)
        if reason == LATENT_FALSE:
            self.closing.on_false_latent(keyframe, holder)
        report = Report(LatentFailed(keyframe=keyframe, holder=holder, reason=reason))
        lost = reason == LATENT_UNKNOWN and holder == keyframe.log.robot
        return [report, *self._reject_lost(self.closing.on_latent_lost(keyframe, now) if lost else [], keyframe, now)]

    def _reject_lost(self, pairs: list[CandidatePair], keyframe: KeyframeId, now: float) -> list[Effect]:
        """Pairs whose latent exists no more are rejected, so that nobody waits for them."""
        effects: list[Effect] = [Report(LatentLost(keyframe=keyframe))] if pairs else []
        for pair in pairs:
            record = RejectionRecord(pair.low, pair.high, "a latent was lost", 0, 0)
            effects += [*self._append(record, now), Report(told(record, self.log))]
        return effects

    def _has(self, keyframe: KeyframeId) -> bool:
        """Whether a keyframe's record is here; of others anybody can speak."""
        copy = self.gossip.logs.get(keyframe.log)
        return copy is not None and keyframe.index < copy.keyframes

    def _on_captured(self, event: KeyframeCaptured) -> list[Effect]:
        index = self.keyframes_given()
        self._pending.append(_Pending(index, event.stamp_s, event.T_odom_camera))
        return [Encode(KeyframeId(self.log, index), event.image, event.T_odom_camera)]

    def _on_encoded(
        self, keyframe: KeyframeId, descriptor: Array | None, now: float, sha256: bytes = b""
    ) -> list[Effect]:
        """Append the records of all keyframes that are ready, in the order of capture, and what was measured there.

        A keyframe that failed to encode has a record all the same, with its odometry: measurements need no more.
        """
        for pending in self._pending:
            if pending.index == keyframe.index:
                pending.encoded, pending.descriptor, pending.sha256 = True, descriptor, sha256
        effects: list[Effect] = []
        while self._pending and self._pending[0].encoded:
            ready = self._pending.pop(0)
            record = KeyframeRecord(ready.index, ready.stamp_s, ready.T_odom_camera, ready.descriptor)
            effects += self._append(record, now)
            effects.append(_keyframe_report(self.log, record))
            if self._has_keys and ready.sha256:
                effects += self._append(LatentRecord(ready.index, ready.sha256), now)
            for measurement in self._waiting.pop(ready.index, ()):
                effects += self._append_measurement(measurement, KeyframeId(self.log, ready.index), now)
        return effects

    def _on_measured(self, measurement: Measurement, index: int, now: float) -> list[Effect]:
        """Append what was measured at a recorded keyframe; what belongs to a later one waits for its record."""
        keyframe = belongs_to(measurement, self.log, index)
        recorded = self.gossip.logs[self.log].keyframes
        if keyframe.index < recorded:
            return self._append_measurement(measurement, keyframe, now)
        if keyframe.index >= max(self.keyframes_given(), 1):
            return [measurement_refused(measurement, keyframe, "there is no such keyframe")]
        waiting = self._waiting.setdefault(keyframe.index, [])
        if len(waiting) >= WAITING_MAX:
            return [measurement_refused(measurement, keyframe, f"{WAITING_MAX} others wait for this keyframe")]
        waiting.append(measurement)
        return []

    def _append_measurement(self, measurement: Measurement, keyframe: KeyframeId, now: float) -> list[Effect]:
        try:
            record = record_of(measurement, keyframe)
        except BadMeasurement as error:
            return [measurement_refused(measurement, keyframe, str(error))]
        return [*self._append(record, now), measurement_report(measurement, keyframe)]

    def _on_registered(
        self, pair: CandidatePair, result: Registration | RegistrationFailed, now: float
    ) -> list[Effect]:
        """Accept by the ratio of Eq. (1), or refuse; either way a record says so to everybody.

        A pair that another robot's record resolved in the meantime needs no second one.
        """
        roles = self.closing.roles(pair)
        if roles is None:
            return []
        record = judged(*roles, result, self._parameters.loop_closing)
        return [*self._append(record, now), Report(told(record, self.log))]

    @property
    def _own_term(self) -> Term:
        """Under which a robot solves the graph for itself only; every leader's is above it."""
        return Term(0, self.log)

    def _on_optimised(self, event: GraphOptimised, now: float) -> list[Effect]:
        if event.term == self._own_term:
            return self.corrections.on_own_solution(event.solution, now)
        if not self.rounds.on_solution(event.term, event.round, event.solution, now):
            return [Report(SolutionIgnored(term=event.term, round=event.round))]
        report = solution_report(event.term, event.round, event.solution)
        return [report, *self.corrections.publish(event.term, event.round, event.solution)]

    # Records

    def _record_at(self, log: LogId, number: int) -> Record:
        return self.gossip.logs[log].records[number]

    def _append(self, record: Record, now: float) -> list[Effect]:
        new, effects, batch = self.gossip.append(record)
        return [*effects, Broadcast(Records((batch,))), *self._take([new], now)]

    def _take(self, new_records: Iterable[NewRecord], now: float) -> list[Effect]:
        """Let everything that is derived from the logs know of new records; places are recognised at the end."""
        described: list[tuple[KeyframeId, Array]] = []
        effects: list[Effect] = []
        filled: list[tuple[LogId, int]] = []
        for new in new_records:
            self.assembly.add(new)
            if (new.number + 1) % BLOCK_RECORDS == 0:
                filled.append((new.log, new.number))
            match new.record:
                case KeyframeRecord(index, _, _, descriptor):
                    self.closing.on_keyframe(new.log)
                    keyframe = KeyframeId(new.log, index)
                    if descriptor is not None and self._may_match(keyframe):
                        described.append((keyframe, descriptor))
                case LatentRecord(index):
                    self.closing.latents.names.add(KeyframeId(new.log, index), new.number)
                case ClosureRecord(query, match):
                    self.closing.on_closure(CandidatePair.of(query, match), now)
                case RejectionRecord(query, match, reason, _, odometry_correspondences):
                    was_seen = odometry_correspondences > 0
                    if self.closing.on_rejection(CandidatePair.of(query, match), reason, was_seen):
                        effects += self._front_ends_differ(query.log, match.log)
                case _:
                    pass  # what was measured, and what a later version says, concerns the graph only
        effects += self._recognise(described, now) if described else []
        for log, number in filled:
            self._lend_rows(log, number // BLOCK_RECORDS)
        return effects

    def _make_room(self, wanting: LogId, now: float) -> list[Effect]:
        """Give up a log that nothing refers to, where one is asked for that has no room."""
        if now < self._looked_for_room_s + LOOK_PERIOD_S:
            return []
        self._looked_for_room_s = now
        kept = self.assembly.tied() | self._closed | {self.log}
        log = expendable(
            self.gossip.logs,
            wanting,
            lambda each: each not in kept and not self.closing.is_written(each),
            lambda each: self.gossip.silent_s(each, now),
        )
        if log is None:
            return []
        self.gossip.forget(log)
        self.assembly.forget(log)
        self.recognition.forget(log)
        self.closing.forget(log)
        self.corrections.forget_log(log)
        return [DropLog(log), Report(LogGivenUp(log=log))]

    def _lend_rows(self, log: LogId, block: int) -> None:
        """Descriptors of a full block are held once, by the log."""
        self.recognition.lend(log, *self.gossip.logs[log].descriptors(block))

    def _may_match(self, keyframe: KeyframeId) -> bool:
        """Whether a keyframe can be registered; of a pruned map not all have a latent."""
        saved = None if self.in_map is None else self.in_map.saved
        return saved is None or keyframe.log not in saved.closed or keyframe in self._served

    def _recognise(self, keyframes: list[tuple[KeyframeId, Array]], now: float) -> list[Effect]:
        """Look for keyframes' candidates; after a restart not where both already had a partner in the other's log."""
        found = self.recognition.on_keyframes(keyframes)
        if self._partnered:
            found = [(k, c) for k, c in found if not self._had_partners(k, c.pair.other(k))]
        return self.closing.on_candidates([candidate for _, candidate in found], now) if found else []

    def _had_partners(self, one: KeyframeId, other: KeyframeId) -> bool:
        """Whether each of two keyframes was registered with one of the other's log; else their pair waits still."""
        return (one, other.log) in self._partnered and (other, one.log) in self._partnered

    def _distributed(self, correction: LogCorrection | None) -> DistributedOptimisation:
        """This robot's part of a distributed optimisation; after a restart it counts on above what it said before."""
        number = 0 if correction is None else correction.round + STEPS_AFTER_RESTART
        near = self.neighbours.__contains__
        return DistributedOptimisation(self.log, self.assembly, self._parameters.distributed, near, number)

    def _on_agreeing(
        self,
        distributed: DistributedOptimisation,
        event: ClosuresChosen | ChoiceFailed | ConsensusStepped | ConsensusStepFailed,
        now: float,
    ) -> list[Effect]:
        match event:
            case ClosuresChosen(number, solution):
                return distributed.on_chosen(number, solution, now)
            case ChoiceFailed(number, reason):
                return distributed.on_choice_failed(number, reason, now)
            case ConsensusStepped(number, step):
                return distributed.on_step(number, step, now)
            case ConsensusStepFailed(number, reason):
                return distributed.on_failed(number, reason, now)

    def _on_shared_poses(self, sender: LogId, message: SharedPoses, now: float) -> list[Effect]:
        """Agree with a robot in distributed mode, where this one is; else the two have nothing to tell each other."""
        if self.distributed is not None:
            return self.distributed.on_shared_poses(sender, message, now)
        return self._other_mode(sender)

    def _other_mode(self, sender: LogId) -> list[Effect]:
        """Name a robot that optimises in another mode, once."""
        if sender in self._of_other_mode or len(self._of_other_mode) >= OTHER_MODE_MAX:
            return []
        self._of_other_mode.add(sender)
        return [Report(PeerRefused(peer=sender.robot, reason="its backend.mode is another one"))]

    def _front_ends_differ(self, first: LogId, second: LogId) -> list[Effect]:
        """Tell, where it concerns this robot."""
        others = [log.robot for log in (first, second) if log != self.log]
        return [Report(FrontEndsDiffer(peer=others[0]))] if len(others) == 1 else []

    def _restore(self, restored: Restored, now: float) -> None:
        """Resolved pairs first, so that no pair of the past is found again, nor another one in its place."""
        news = [new for log, records in restored.records for new in self._restore_log(log, records)]
        self._take([new for new in news if not isinstance(new.record, KeyframeRecord)], now)
        for new in news:
            if isinstance(new.record, ClosureRecord | RejectionRecord):
                query, match = new.record.query, new.record.match
                self._partnered |= {(query, match.log), (match, query.log)}
        self._take([new for new in news if isinstance(new.record, KeyframeRecord)], now)
        self._partnered.clear()
        for log, copy in self.gossip.logs.items():
            for block in range(len(copy) // BLOCK_RECORDS):
                self._lend_rows(log, block)
        for keyframe in restored.latents:
            self.closing.on_held(keyframe)
        self.corrections.restore(restored.correction, restored.frame_changed)

    def _restore_log(self, log: LogId, records: Iterable[bytes]) -> Iterable[NewRecord]:
        """A log as it is on the disk, up to a record that nobody would take any more; others have the rest."""
        try:
            for data in records:
                yield self.gossip.restore(log, data)
        except DecodeError:
            if log == self.log:
                raise  # whoever reads the disk checks the own log before: its numbers must not be used twice

    # Time

    def _heartbeat(self, now: float) -> list[Effect]:
        """Say who is here; a late tick does not make up for heartbeats it missed."""
        period = self._parameters.neighbours.period_s(len(self.neighbours))
        self._heartbeat_due_s += period
        if self._heartbeat_due_s <= now:
            self._heartbeat_due_s = now + period
        self._heartbeat_s = now
        self._sequence += 1
        own = self.gossip.logs[self.log]
        return [
            Broadcast(
                Heartbeat(
                    sequence=self._sequence,
                    boot=self._boot,
                    compute_class=self._compute_class,
                    leader=self.election.advert(),
                    term_counter_max=self.election.counter_max,
                    load=self.closing.load,
                    records=len(own),
                    checksum=own.checksum,
                    digests=self.gossip.state(),
                    versions=self.corrections.state(),
                    wants=self.closing.wants(now),
                    holds=self.closing.holds(now),
                    lost=self.closing.lost(now),
                )
            )
        ]

    def _greet(self, heartbeat: Heartbeat, now: float) -> None:
        """Greet a new neighbour at once; where groups meet, a leader expects news."""
        term = self.election.term
        if term is None or heartbeat.leader is None or heartbeat.leader.term.leader != term.leader:
            self.rounds.hurry(now)
        pause_s = GREETING_RATIO * self._parameters.neighbours.heartbeat_period_s
        self._heartbeat_due_s = min(self._heartbeat_due_s, max(now, self._heartbeat_s + pause_s))

    def _lose_silent(self, now: float) -> list[Effect]:
        gone = self.neighbours.tick(now)
        for name in gone:
            self.election.on_lost(name)
            self.gossip.on_lost(name)
            self.comparisons.on_lost(name)
            self.closing.on_lost(name, now)
        return [Report(NeighbourDown(peer=name)) for name in gone]

    def _settle(self, now: float) -> list[Effect]:
        """Let the machines act on what changed."""
        effects = self.closing.tick(now)
        for pair in self.closing.take_unlikely():
            record = RejectionRecord(pair.low, pair.high, UNLIKELY, 0, 0)
            effects += [*self._append(record, now), Report(told(record, self.log))]
        for pair in self.closing.take_told():
            effects.append(Report(ClosureRejected(query=pair.low, match=pair.high, by=self.log.robot, reason=TOLD)))
        for keyframe in self.closing.own_lost():
            if self._has(keyframe):
                pairs = self.closing.on_latent_lost(keyframe, now)
                known = [pair for pair in pairs if self._has(pair.low) and self._has(pair.high)]
                effects += self._reject_lost(known, keyframe, now)
        if self.distributed is not None:
            return [*effects, *self._optimise_together(self.distributed, now)]
        self.rounds.on_term(self.election.term if self.election.leading else None)
        return [*effects, *self.rounds.tick(now)]

    def _optimise_together(self, distributed: DistributedOptimisation, now: float) -> list[Effect]:
        """Step with the own part, and correct itself; what its own log contradicts is not applied."""
        effects = distributed.tick(now)
        component = distributed.component(now)
        if component is None:
            return effects
        published, why = self.corrections.publish_own(component, distributed.number)
        return [*effects, distributed.report(), *published, *distributed.on_judged(why, now)]


def _keyframe_report(log: LogId, record: KeyframeRecord) -> Report:
    keyframe = KeyframeId(log, record.index)
    return Report(KeyframeTaken(keyframe=keyframe, stamp_s=record.stamp_s, T_odom_body=record.T_odom_camera))
