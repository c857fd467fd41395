"""Cores that are broken on purpose: each mutant changes one function of one machine, in this process only.

`catches` gives the first seed of the campaign under which a mutant is noticed. What a mutant does is a sentence, so
that a table of them reads as what the checkers are good for.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np

from flocc_agent.core import assembly, closure_rows, election, judgement, log_copy, loop_closing, plausibility, robot
from flocc_agent.core.assembly import GraphAssembly
from flocc_agent.core.closure_rows import ClosureTable
from flocc_agent.core.cold_storage import ColdPieces, RowPieces
from flocc_agent.core.correction_evidence import CorrectionEvidence
from flocc_agent.core.corrections import Corrections
from flocc_agent.core.effects import Broadcast, Deliver, PersistCorrection, PersistTerm, Report
from flocc_agent.core.election import LeaderElection
from flocc_agent.core.foretelling import Foretelling
from flocc_agent.core.gossip import Gossip
from flocc_agent.core.known_sets import KeyframeSet
from flocc_agent.core.latents import Latents, Reach, ToldNowAndThen
from flocc_agent.core.log_copy import EncodedRecords, _Block
from flocc_agent.core.loop_closing import LoopClosing
from flocc_agent.core.neighbours import Neighbours
from flocc_agent.core.offers import Offers
from flocc_agent.core.own_log import OwnLog
from flocc_agent.core.place_recognition import PlaceRecognition
from flocc_agent.core.plausibility import Doubts
from flocc_agent.core.prospects import Prospect, Prospects
from flocc_agent.core.pulls import Pulls
from flocc_agent.core.record_intake import RecordIntake
from flocc_agent.core.reports import LogForked
from flocc_agent.core.robot import Robot
from flocc_agent.core.rounds import Rounds
from flocc_agent.core.spared import Spared
from flocc_agent.core.withdrawals import Withdrawals
from flocc_agent.geometry import inverse, pose, pose7, pose_from_tq
from flocc_launch.simulation.campaign import run_seed
from flocc_protocol.arrays import Array
from flocc_protocol.records import ClosureRecord, RejectionRecord

Wrap = Callable[[Callable[..., Any]], Callable[..., Any]]
"""The function as it is to the one that takes its place."""


@dataclass(frozen=True)
class Mutant:
    """One broken core.

    Attributes:
        name: What it does wrong.
        owner: Class or module of the function.
        function: Its name.
        wrap: Makes the broken one.
        in_pieces: It shows in what left memory.
    """

    name: str
    owner: Any
    function: str
    wrap: Wrap
    in_pieces: bool = False

    @contextmanager
    def alive(self) -> Iterator[None]:
        """Put the broken function in its place for a while."""
        broken = patch.object(self.owner, self.function, self.wrap(getattr(self.owner, self.function)))
        with broken, small_pieces() if self.in_pieces else nullcontext():
            yield


@contextmanager
def small_pieces() -> Iterator[None]:
    """Logs, odometry and closures in pieces of four, of which one stays in memory: drawn swarms fill some."""
    with ExitStack() as stack:
        for owner, name in (
            (log_copy, "BLOCK_RECORDS"),
            (robot, "BLOCK_RECORDS"),
            (assembly, "POSES_OF_A_PIECE"),
            (robot, "POSES_OF_A_PIECE"),
            (closure_rows, "ROWS_OF_A_PIECE"),
            (robot, "ROWS_OF_A_PIECE"),
        ):
            stack.enter_context(patch.object(owner, name, 4))
        stack.enter_context(patch.object(robot, "ColdPieces", lambda storage, _held: ColdPieces(storage, 1)))
        yield


def first_caught(mutant: Mutant, seeds: range) -> tuple[int, str] | None:
    """The first seed under which a mutant breaks an invariant, and which one; None where none does."""
    with mutant.alive():
        for seed in seeds:
            violations = run_seed(seed).violations
            if violations:
                return seed, violations[0].invariant
    return None


def always(value: Any) -> Wrap:
    """A function that gives one value."""
    return lambda _: lambda *_args, **_details: value


def afterwards(change: Callable[[Any], Any]) -> Wrap:
    """A function whose result is changed."""
    return lambda original: lambda *args, **details: change(original(*args, **details))


def without(*kinds: type) -> Wrap:
    """A function that gives effects, without some kinds of them."""
    return afterwards(lambda effects: [effect for effect in effects if not isinstance(effect, kinds)])


def without_reports(*kinds: type) -> Wrap:
    """A function that gives effects, without reports of some facts."""
    return afterwards(lambda effects: [e for e in effects if not (isinstance(e, Report) and isinstance(e.fact, kinds))])


# --- what the mutants do


def _off_by_50_m(message: Any) -> Any:
    if message is None:
        return None
    x, *rest = message.T_map_odom
    return replace(message, T_map_odom=(x + 50.0, *rest))


def _component(change: Callable[[Any, Any], dict[str, Any]]) -> Wrap:
    """Let a correction be made of another part of the solution."""

    def wrap(original: Callable[..., Any]) -> Callable[..., Any]:
        def broken(self: Corrections, component: Any, log: Any, *rest: Any) -> Any:
            return original(self, replace(component, **change(component, log)), log, *rest)

        return broken

    return wrap


def _zero_poses(component: Any, log: Any) -> dict[str, Any]:
    nowhere = np.broadcast_to(np.eye(4), component.T_map_keyframe[log].shape)
    return {"T_map_keyframe": {**component.T_map_keyframe, log: nowhere}, "T_map_odom": {log: np.eye(4)}}


def _previous_poses(component: Any, log: Any) -> dict[str, Any]:
    poses = component.T_map_keyframe[log]
    return {"T_map_keyframe": {**component.T_map_keyframe, log: np.concatenate([poses[:1], poses[:-1]])}}


def _last_one_stays(component: Any, log: Any) -> dict[str, Any]:
    poses = component.T_map_keyframe[log].copy()
    poses[-1, :3, 3] += 3.0
    return {"T_map_keyframe": {**component.T_map_keyframe, log: poses}}


def _covariance(scale: float) -> Callable[[Any, Any], dict[str, Any]]:
    return lambda component, _: {
        "covariance_map_odom": {k: None if c is None else scale * c for k, c in component.covariance_map_odom.items()}
    }


def _inverted(record: Any) -> Any:
    if not isinstance(record, ClosureRecord):
        return record
    return replace(record, T_query_match_unscaled=pose7(inverse(pose_from_tq(np.array(record.T_query_match_unscaled)))))


def _refused(record: Any) -> Any:
    return RejectionRecord(record.query, record.match, "no", 0, 0) if isinstance(record, ClosureRecord) else record


def _without_covariance(record: Any) -> Any:
    if not isinstance(record, ClosureRecord) or record.covariance is None:
        return record
    return replace(record, covariance=Array.of(np.zeros(21), "f4"))


def _turned_closures(closures: Any) -> Any:
    return [replace(c, T_query_match_unscaled=inverse(c.T_query_match_unscaled)) for c in closures]


def _unscaled(closures: Any) -> Any:
    return [replace(c, scale_initial=3.0 * (c.scale_initial or 1.0)) for c in closures]


def _without_the_last_keyframe(graph: Any) -> Any:
    shorter = {
        log: replace(t, T_odom_keyframe=t.T_odom_keyframe[:-1], edge_covariances=None) if len(t) > 1 else t
        for log, t in graph.trajectories.items()
    }
    known = [c for c in graph.closures if all(k.index < len(shorter[k.log]) for k in (c.query, c.match))]
    return replace(graph, trajectories=shorter, closures=tuple(known), measured=())


def _drops_every_second_keyframe(original: Callable[..., Any]) -> Callable[..., Any]:
    taken: dict[int, int] = {}

    def broken(self: OwnLog, event: Any) -> Any:
        taken[id(self)] = taken.get(id(self), 0) + 1
        return original(self, event) if taken[id(self)] % 2 else []

    return broken


def _worst_ranked_leads(original: Callable[..., Any]) -> Callable[..., Any]:
    def broken(compute_class: int, log: Any) -> Any:
        worst, _ = original(compute_class, log)
        return (-worst, log)

    return broken


def _storms(original: Callable[..., Any]) -> Callable[..., Any]:
    def broken(self: LeaderElection, *args: Any) -> Any:
        return [*original(self, *args), *(self._claim() if self.leading else [])]

    return broken


def _beats_ten_times(original: Callable[..., Any]) -> Callable[..., Any]:
    def broken(self: Robot, now: float) -> Any:
        effects = original(self, now)
        self._beat.due_s = now + 0.1 * self._parameters.neighbours.heartbeat_period_s
        return effects

    return broken


def _keeps_no_pause(original: Callable[..., Any]) -> Callable[..., Any]:
    def broken(self: Pulls, *_args: Any) -> Any:
        self._next_s = float("-inf")
        return True

    return broken


def _delivers_twice(effects: Any) -> Any:
    return [e for effect in effects for e in ([effect, effect] if isinstance(effect, Deliver) else [effect])]


def _refetches(original: Callable[..., Any]) -> Callable[..., Any]:
    def broken(self: Latents, keyframe: Any, reach: Any, now: float) -> Any:
        held, self._held = self._held, KeyframeSet()
        try:
            return original(self, keyframe, reach, now)
        finally:
            self._held = held

    return broken


def _restores_all_but_the_newest(original: Callable[..., Any]) -> Callable[..., Any]:
    def broken(self: RecordIntake, log: Any, records: Any) -> Any:
        return original(self, log, list(records)[:-1])

    return broken


def _forgets_the_correction(original: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, *_: original(self, None, False)


def _ignores_hand_over(self: LeaderElection, sender: Any, message: Any, now: float) -> Any:
    return []


def _leaves_silently(original: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self: [e for e in original(self) if not isinstance(e, Broadcast)]


def _hears_for_ever(self: Neighbours, now: float) -> list[str]:
    self._due_s = float("inf")
    return []


def _follows_for_ever(original: Callable[..., Any]) -> Callable[..., Any]:
    def broken(self: LeaderElection, heard: Any, now: float) -> Any:
        effects = original(self, heard, now)
        self._due_s = float("inf")
        return effects

    return broken


def _gives_own_keyframes_only(original: Callable[..., Any]) -> Callable[..., Any]:
    def broken(self: GraphAssembly) -> Any:
        graph = original(self)
        return replace(graph, closures=graph.closures[::2])

    return broken


def _moves_keyframes(original: Callable[..., Any]) -> Callable[..., Any]:
    def broken(self: GraphAssembly, log: Any, record: Any) -> Any:
        moved = pose(np.eye(3), np.array([0.3 * record.index, 0.0, 0.0]))
        T = pose7(pose_from_tq(np.array(record.T_odom_camera)) @ moved)
        return original(self, log, replace(record, T_odom_camera=T))

    return broken


def _follows_whoever_came_first(original: Callable[..., Any]) -> Callable[..., Any]:
    def broken(self: LeaderElection, heard: Any) -> bool:
        return self._leader is None or (self._leader.term.leader == heard.term.leader and original(self, heard))

    return broken


def _gives_the_piece_before(original: Callable[..., Any]) -> Callable[..., Any]:
    def broken(self: RowPieces, number: int) -> Any:
        return original(self, max(0, number - isinstance(self._pieces[number], int)))

    return broken


def _gives_the_first_piece(original: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, place, size_bytes: original(self, 0, size_bytes)


def _gives_the_next_record(original: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, k: original(self, (k + 1) % len(self.ends))


def _takes_all_for_refused(original: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, pair, **_: original(self, pair, is_closure=False)


def _has_enough_with_two(original: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, held, _: original(self, held, 2)


def _joins_far_places(original: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, pair, low, high, reach: original(self, pair, low, high, 20 * reach)


def _lets_nothing_go(_: Callable[..., Any]) -> Callable[..., Any]:
    return lambda self, owner, number: self._warm.append((owner, number))


MUTANTS = (
    # corrections
    Mutant("T_map_odom is 50 m off", Corrections, "_made", afterwards(_off_by_50_m)),
    Mutant("corrections are zero poses", Corrections, "_made", _component(_zero_poses)),
    Mutant("the previous keyframe's pose", Corrections, "_made", _component(_previous_poses)),
    Mutant("the last keyframe stays uncorrected", Corrections, "_made", _component(_last_one_stays)),
    Mutant("a covariance of zero", Corrections, "_made", _component(_covariance(0.0))),
    Mutant("a covariance of NaN", Corrections, "_made", _component(_covariance(float("nan")))),
    Mutant("an inflated covariance", Corrections, "_made", _component(_covariance(4.0))),
    Mutant("a correction is not persisted", Corrections, "_apply", without(PersistCorrection)),
    Mutant("a correction is delivered twice", Corrections, "_apply", afterwards(_delivers_twice)),
    Mutant("a correction is never delivered", Corrections, "_apply", always([])),
    Mutant("an older correction is applied", Corrections, "_has_knots", always(False)),
    Mutant("the applied correction is forgotten at a restart", Corrections, "restore", _forgets_the_correction),
    # judgement, registration and the graph
    Mutant("closures are inverted", robot, "judged", afterwards(_inverted)),
    Mutant("all closures are rejected", robot, "judged", afterwards(_refused)),
    Mutant("closures without a covariance", robot, "judged", afterwards(_without_covariance)),
    Mutant("refusals become closures", judgement, "match_ratio", always(5.0)),
    Mutant("the graph has closures the other way round", ClosureTable, "closures", afterwards(_turned_closures)),
    Mutant("the graph has closures of another scale", ClosureTable, "closures", afterwards(_unscaled)),
    Mutant("the graph has half of the closures", GraphAssembly, "graph", _gives_own_keyframes_only),
    Mutant("the graph lacks the last keyframes", GraphAssembly, "graph", afterwards(_without_the_last_keyframe)),
    # keyframes and places
    Mutant("no candidates", PlaceRecognition, "on_keyframes", always([])),
    Mutant("candidates of own keyframes only", PlaceRecognition, "_among_own", always([])),
    Mutant("every second keyframe is dropped", OwnLog, "on_captured", _drops_every_second_keyframe),
    Mutant("the graph has other odometry than was recorded", GraphAssembly, "_add_keyframe", _moves_keyframes),
    # rounds
    Mutant("rounds only on new closures", Rounds, "_grown", always(0)),
    Mutant("one round per term", Rounds, "_stale", lambda _: lambda self: self._assembly.keyframes and not self._round),
    Mutant("a round's solution counts for nothing", Rounds, "on_solution", always(False)),
    # election
    Mutant("the worst-ranked leads", election, "rank", _worst_ranked_leads),
    Mutant("a hand-over is ignored", LeaderElection, "on_handover", lambda _: _ignores_hand_over),
    Mutant("a leader leaves without a word", LeaderElection, "leave", _leaves_silently),
    Mutant("an election storm", LeaderElection, "on_heartbeat", _storms),
    Mutant("a term is not persisted", LeaderElection, "_claim", without(PersistTerm)),
    Mutant("a better robot never takes over", LeaderElection, "_prefers", _follows_whoever_came_first),
    Mutant("nobody is preferred", LeaderElection, "_prefers", always(False)),
    Mutant("a leader that stands still is followed for ever", LeaderElection, "_refresh", _follows_for_ever),
    Mutant("what is proven of counters is not learned", LeaderElection, "_learn_counter", always([])),
    # neighbours and heartbeats
    Mutant("heartbeats ten times as often", Robot, "_heartbeat", _beats_ten_times),
    Mutant("nobody is ever lost", Neighbours, "tick", lambda _: _hears_for_ever),
    Mutant("a duplicate name is not reported", Neighbours, "_name_taken", always([])),
    # gossip
    Mutant("a fork is not reported", Gossip, "_fork", without_reports(LogForked)),
    Mutant("pulls without pause", Pulls, "_may_ask", _keeps_no_pause),
    Mutant("nobody asks for what it lacks", Pulls, "ask", always([])),
    Mutant("requests are not answered", Gossip, "on_request", always([])),
    Mutant("the newest records are forgotten at a restart", RecordIntake, "_restore_log", _restores_all_but_the_newest),
    # loop closing
    Mutant("pairs are not handed to stronger robots", Reach, "stronger", always(None)),
    Mutant("stronger robots have no room for pairs", Reach, "room", always(0)),
    Mutant("the lower owner registers all pairs", loop_closing, "registrar_of", lambda _: lambda pair: pair.low.log),
    Mutant("latents are fetched again", Latents, "_may_fetch", _refetches),
    Mutant("nobody fetches a latent", Latents, "fetch", always([])),
    Mutant("offers are not told", Offers, "tell", afterwards(lambda _: [])),
    Mutant("pairs of robots that are gone stay open", Offers, "_takeover_at_s", always(float("inf"))),
    Mutant("wishes and offers of latents are not told", ToldNowAndThen, "due", always(())),
    Mutant("latents out of reach are not asked for", Latents, "wants", always(())),
    Mutant("a resolved pair is registered again", LoopClosing, "on_resolved", lambda _: lambda *_a: None),
    # what may be believed
    Mutant("every correction is believed", plausibility, "contradiction", always(None)),
    Mutant("every correction is doubted", plausibility, "contradiction", always("so")),
    Mutant("all odometry counts as broken", CorrectionEvidence, "explains", always(False)),
    Mutant("closures always count as torn", CorrectionEvidence, "is_torn", always(True)),
    Mutant("what is held back is never looked at again", Doubts, "to_look_at", always(None)),
    Mutant("nothing ties a robot to its map", GraphAssembly, "joined", always(False)),
    # prospects
    Mutant("all pairs are unlikely", Prospects, "_is_unlikely", always(True)),
    Mutant("unlikely pairs wait for ever", Prospects, "of", always(Prospect.HELD)),
    Mutant("what was judged is taken for refused", Prospects, "on_judged", _takes_all_for_refused),
    # spared pairs
    Mutant("all pairs tell nothing new", Spared, "is_told", always(True)),
    Mutant("two closures are enough", Spared, "__init__", _has_enough_with_two),
    Mutant("a third log tells what it saw at two places", Foretelling, "_by_third", _joins_far_places),
    # keyframes taken back
    Mutant("nothing is taken back", OwnLog, "_withdraw", always([])),
    Mutant("what was taken back counts", Withdrawals, "counts", always(True)),
    Mutant("pairs of what was taken back stay as they are", Withdrawals, "asks_again", always(False)),
    Mutant("judgements name no withdrawal that they know of", Withdrawals, "unsaid", always([])),
    Mutant("latents made anew are not fetched again", Latents, "on_withdrawn", always(None)),
    Mutant("registrations of old latents count", LoopClosing, "is_outdated", always(False)),
    # logs in pieces
    Mutant("a block gives its next record", _Block, "record", _gives_the_next_record, in_pieces=True),
    Mutant(
        "a block's checksum is another", EncodedRecords, "block_checksum", afterwards(lambda c: c ^ 1), in_pieces=True
    ),
    Mutant("what left memory comes back as something else", ColdPieces, "get", _gives_the_first_piece, in_pieces=True),
    Mutant("rows come back as those before", RowPieces, "_piece", _gives_the_piece_before, in_pieces=True),
    Mutant("nothing leaves memory", ColdPieces, "add", _lets_nothing_go, in_pieces=True),
)
