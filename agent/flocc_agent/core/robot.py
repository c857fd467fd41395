"""The robot: composes the machines of the core, events in, effects out.

The driver calls `handle` for each event and `tick` when `deadline` is due; both return effects to carry out in
order. Same seed and same events give the same effects, on virtual time and on a robot.
"""

from collections.abc import Mapping

from flocc_agent.core.assembly import POSES_OF_A_PIECE, GraphAssembly
from flocc_agent.core.candidate_order import SpectralOrder
from flocc_agent.core.claims import Claim
from flocc_agent.core.closure_rows import ROWS_OF_A_PIECE
from flocc_agent.core.cold_storage import ColdPieces, ColdStorage
from flocc_agent.core.comparing import Comparisons
from flocc_agent.core.corrections import Corrections
from flocc_agent.core.distributed_optimisation import STEPS_AFTER_RESTART, DistributedOptimisation
from flocc_agent.core.distrust import Distrust
from flocc_agent.core.effects import Broadcast, DropLog, Effect, Optimise, Report, Unicast
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
from flocc_agent.core.gossip import Gossip, Sealer
from flocc_agent.core.in_map import InMap
from flocc_agent.core.insisted import Insisted, said_only_in
from flocc_agent.core.judgement import judged
from flocc_agent.core.latents import Peer
from flocc_agent.core.log_copy import BLOCK_RECORDS
from flocc_agent.core.loop_closing import LoopClosing
from flocc_agent.core.neighbours import Neighbours
from flocc_agent.core.own_heartbeat import OwnHeartbeat
from flocc_agent.core.own_log import OwnLog
from flocc_agent.core.parameters import CoreParameters
from flocc_agent.core.peer_budgets import AnswerBudget, Muted
from flocc_agent.core.place_recognition import PlaceRecognition
from flocc_agent.core.prospects import UNLIKELY
from flocc_agent.core.record_intake import RecordIntake
from flocc_agent.core.registration import Registration, RegistrationFailed
from flocc_agent.core.reports import (
    ClosureRejected,
    EncodingFailed,
    LatentArrived,
    LatentFailed,
    LogGivenUp,
    NeighbourDown,
    PeerRefused,
    RoundFailed,
    SolutionIgnored,
)
from flocc_agent.core.restored import Restored
from flocc_agent.core.rounds import Rounds, solution_report
from flocc_agent.core.spared import TOLD
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
    Record,
    RejectionRecord,
)

NOBODY = -1
"""Compute class, as loop closing sees it, of a name under which two robots run: both would register what it gets."""
OTHER_MODE_MAX = 256
OF_LEADERSHIP = (Election, Answer, Coordinator, Handover)


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
        self._beat = OwnHeartbeat(now)
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
            self.assembly.foretelling,
        )
        self.closing.latents.names.record_at = self._record_at
        self._intake = RecordIntake(log, self.gossip, self.assembly, self.recognition, self.closing, restored)
        has_keys = sealer is not None
        self.own_log = OwnLog(log, self.gossip, self.assembly, self._intake, has_keys=has_keys)
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
        self._distrust = Distrust()
        self._insisted = Insisted()
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
        if self._beat.due_s <= now:
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
                trusted = [c for c in heard_of if not self._distrust.holds(c.term.leader, now)]
                found = [self.corrections.claim(correction, now) for correction in trusted]
                return [claim for claim in found if claim is not None]
            case _:
                return []

    def deadline(self) -> float:
        """When `tick` is due next, in seconds of the driver's clock."""
        return min(
            self._beat.due_s,
            self.neighbours.deadline(),
            self.election.deadline(),
            self.closing.deadline(),
            self.rounds.deadline() if self.distributed is None else self.distributed.deadline(),
        )

    @property
    def closures_enough(self) -> int:
        """Agreeing ways between two stretches beside which no more pairs are registered; 0: all are."""
        parameters = self._parameters.loop_closing
        is_large = self.assembly.foretelling.logs() >= parameters.sparing_logs_min
        return parameters.closures_enough if is_large else 0

    def sizes(self) -> dict[str, tuple[int, int]]:
        """Every queue, table and cache: how much is in it, and its maximum."""
        neighbours = (len(self.neighbours.names()), self._parameters.neighbours.neighbours_max)
        return {
            "neighbours": neighbours,
            **self.own_log.sizes(),
            **self.gossip.sizes(),
            **self.comparisons.sizes(),
            **self.closing.sizes(),
            **self.corrections.sizes(),
            **self.election.sizes(),
            **self._answers.sizes(),
            **self._muted.sizes("muted"),
            **self.assembly.sizes(),
            **self._distrust.sizes(),
            **self._insisted.sizes(),
            **({} if self.distributed is None else self.distributed.sizes()),
        }

    # Events

    def _dispatch(self, event: Event, now: float) -> list[Effect]:
        match event:
            case MessageReceived(envelope):
                return self._on_message(envelope, now)
            case KeyframeCaptured():
                return self.own_log.on_captured(event)
            case KeyframeEncoded(keyframe, descriptor, doubts, sha256, withdrawn):
                self.closing.on_held(keyframe)
                return [*map(Report, doubts), *self.own_log.on_encoded(keyframe, descriptor, now, sha256, withdrawn)]
            case KeyframeEncodingFailed(keyframe, reason, doubts, withdrawn):
                reports = [*map(Report, doubts), Report(EncodingFailed(keyframe=keyframe, reason=reason))]
                return [*reports, *self.own_log.on_encoded(keyframe, None, now, withdrawn=withdrawn)]
            case LatentFetched(keyframe, holder):
                self.closing.on_fetched(keyframe, now)
                return [Report(LatentArrived(keyframe=keyframe, holder=holder))]
            case LatentFetchFailed(keyframe, holder, reason):
                return self._on_fetch_failed(keyframe, holder, reason, now)
            case PairRegistered(pair, result):
                return self._on_registered(pair, result, now)
            case LatentMissing(pair, keyframe):
                return self.own_log.reject_lost(self.closing.on_latent_missing(pair, keyframe), keyframe, now)
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
                return self.own_log.on_measured(measurement, index, now)
            case Leaving():
                return self.election.leave()

    def _on_message(self, envelope: Envelope, now: float) -> list[Effect]:
        sender, message = envelope.sender, envelope.message
        if sender.robot == self.log.robot and not isinstance(message, Heartbeat):
            return []
        if isinstance(message, OF_LEADERSHIP) and self._distrust.holds(sender, now):
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
                return self._on_offer(sender, message, now)
            case SharedPoses():
                return self._on_shared_poses(sender, message, now)

    def _on_signed(self, sender: LogId, message: Records | CorrectionBatch, now: float) -> list[Effect]:
        """Take in what is signed, but for what of this sender failed lately."""
        peer, muted = sender.robot, self._muted
        if isinstance(message, Records):
            batches = tuple([b for b in message.batches if not muted.is_muted(peer, b.log.robot, now)])
            heard = message if len(batches) == len(message.batches) else Records(batches)
            new, effects = self.gossip.on_records(sender, heard, now)
            effects += self._intake.take(new, now)
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
        effects += self.election.on_heartbeat(sender, self._distrust.believed(heartbeat, now), now)
        effects += self._compare(sender, heartbeat, now)
        compute_class = self.election.class_of(sender.robot, heartbeat.compute_class)
        helps = NOBODY if self.neighbours.is_double(sender.robot) else compute_class
        holds = self.closing.held_by(sender.robot, heartbeat.holds, now)
        self.closing.on_peer(sender.robot, Peer(helps, heartbeat.load, holds, sender))
        self.closing.on_wants(sender.robot, heartbeat.wants, now)
        for keyframe, pair in self.closing.on_lost_elsewhere(heartbeat.lost, now) if heartbeat.lost else ():
            effects += self.own_log.reject_lost([pair], keyframe, now)
        return effects

    def _on_correction(self, sender: LogId, message: LogCorrection, now: float) -> list[Effect]:
        """Take a correction that its leader made; one of an absurd term would fence out every leader to come."""
        if message.log in self.gossip.given_up:
            return []
        if self._distrust.holds(message.term.leader, now):
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
                self._distrust.on_lie(leader, now)
                self.corrections.forget(leader.robot)
                effects += self.election.on_distrusted(leader.robot, now)
            for leader in sorted(doubts.confirmed):
                self._distrust.on_confirmed(leader)
        doubts.doubted.clear()
        doubts.confirmed.clear()
        return effects

    def _overtaken(self, sender: LogId, message: LogCorrection, now: float) -> list[Effect]:
        """Lead above the terms of a robot that is not followed, now and then: others may have applied what it said."""
        if not self.election.leading or not self._distrust.may_overtake(now):
            return []
        refused = self.corrections.refused(sender.robot, message)
        return refused or self.election.on_applied(sender, message.term, now)

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
            if each.log not in self.gossip.given_up and not self._distrust.holds(each.term.leader, now)
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
        return [
            report,
            *self.own_log.reject_lost(self.closing.on_latent_lost(keyframe, now) if lost else [], keyframe, now),
        ]

    def _on_offer(self, sender: LogId, offer: CandidateOffer, now: float) -> list[Effect]:
        """Take pairs to register, also settled ones whose record its sender will never take."""
        versions = self.gossip.held_otherwise_by(sender.robot)
        insisted = self._insisted.among(self.closing.settled(offer.pairs), now) if versions else set()
        if insisted:
            for pair in said_only_in(versions, self.log, self.gossip.logs, insisted):
                self.closing.do_again(pair)
        self.closing.on_offer(offer, now)
        return []

    def _has(self, keyframe: KeyframeId) -> bool:
        """Whether a keyframe's record is here; of others anybody can speak."""
        copy = self.gossip.logs.get(keyframe.log)
        return copy is not None and keyframe.index < copy.keyframes

    def _on_registered(
        self, pair: CandidatePair, result: Registration | RegistrationFailed, now: float
    ) -> list[Effect]:
        """Accept by the ratio of Eq. (1), or refuse; either way a record says so to everybody.

        A pair that another robot's record resolved in the meantime needs no second one.
        """
        roles = self.closing.roles(pair)
        if roles is None or self.closing.is_outdated(pair):
            return []
        return self.own_log.judge(judged(*roles, result, self._parameters.loop_closing), now)

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

    def _make_room(self, wanting: LogId, now: float) -> list[Effect]:
        """Give up a log that nothing refers to, where one is asked for that has no room."""
        log = self._intake.given_up_for(wanting, now)
        if log is None:
            return []
        self.corrections.forget_log(log)
        return [DropLog(log), Report(LogGivenUp(log=log))]

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

    def _restore(self, restored: Restored, now: float) -> None:
        """Know again what the disk holds."""
        self._intake.restore(restored.records, now)
        for keyframe in restored.latents:
            is_old = keyframe.log not in restored.closed() | {self.log} and self.assembly.withdrawals.is_withdrawn(
                keyframe
            )
            if not is_old:  # else nobody knows whether it is from before its owner made it anew
                self.closing.on_held(keyframe)
        self.corrections.restore(restored.correction, restored.frame_changed)

    # Time

    def _heartbeat(self, now: float) -> list[Effect]:
        """Say who is here."""
        self._beat.beat(self._parameters.neighbours.period_s(len(self.neighbours)), now)
        own = self.gossip.logs[self.log]
        return [
            Broadcast(
                Heartbeat(
                    sequence=self._beat.sequence,
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
        self._beat.greet(self._parameters.neighbours.heartbeat_period_s, now)

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
            effects += self.own_log.judge(RejectionRecord(pair.low, pair.high, UNLIKELY, 0, 0), now)
        for pair in self.closing.take_told():
            effects.append(Report(ClosureRejected(query=pair.low, match=pair.high, by=self.log.robot, reason=TOLD)))
        for keyframe in self.closing.own_lost():
            if self._has(keyframe):
                pairs = self.closing.on_latent_lost(keyframe, now)
                known = [pair for pair in pairs if self._has(pair.low) and self._has(pair.high)]
                effects += self.own_log.reject_lost(known, keyframe, now)
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
