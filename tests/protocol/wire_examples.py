"""One plain example of everything that travels, the largest legal ones, and hypothesis strategies for all of it."""

import numpy as np
from hypothesis import strategies as st

from flocc_protocol.arrays import Array
from flocc_protocol.codec import COORDINATE_MAX, Pose7
from flocc_protocol.digests import HASH_MAX
from flocc_protocol.ids import INCARNATION_MAX, INDEX_MAX, TERM_COUNTER_MAX, KeyframeId, LogId, Term
from flocc_protocol.log_corrections import KNOT_REQUESTS_MAX, SHORT_WEIGHT
from flocc_protocol.messages import (
    BATCHES_MAX,
    COMPUTE_CLASS_MAX,
    CORRECTIONS_MAX,
    COUNTER_MAX,
    HOPS_MAX,
    KNOTS_MAX,
    LOGS_MAX,
    OFFERS_MAX,
    RECORDS_BATCH_BYTES_MAX,
    RECORDS_BATCH_MAX,
    SHARED_MAX,
    WANTS_MAX,
    Answer,
    CandidateOffer,
    CandidatePair,
    Coordinator,
    CorrectionBatch,
    CorrectionRequest,
    CorrectionVersion,
    DigestRequest,
    Digests,
    Election,
    Envelope,
    Handover,
    Heartbeat,
    KnotRequest,
    Knots,
    LeaderAdvert,
    LogCorrection,
    LogDigest,
    LogPosition,
    Message,
    RecordBatch,
    RecordRequest,
    Records,
    SharedPoses,
    TableState,
)
from flocc_protocol.records import (
    REASON_LENGTH_MAX,
    SEALED_RECORD_BYTES_MAX,
    SIGNATURE_BYTES,
    TAG_LENGTH_MAX,
    WITHDRAWN_MAX,
    ClosureRecord,
    FixRecord,
    GeodeticFixRecord,
    KeyframeRecord,
    LatentRecord,
    MetricClosureRecord,
    OdometryCovarianceRecord,
    PoseFixRecord,
    Record,
    RejectionRecord,
    RobotBearingRecord,
    RobotSightingRecord,
    TagSightingRecord,
    WithdrawalRecord,
    encode_record,
)
from flocc_protocol.shared_poses import stiffness_numbers

IDENTITY: Pose7 = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def knots(count: int, covariance: Array | None = None, seed: int = 0) -> Knots:
    """That many knots, two keyframes apart."""
    twists = np.random.default_rng(seed).integers(-8, 8, size=(count, 6)) / 8.0
    about = Array.of(np.array([1.0, -2.0, 0.5]), "f8")
    return Knots(covariance, about, Array.of(np.arange(1, 2 * count, 2), "u4"), Array.of(twists, "f4"))


def shared(anchor: LogId, step: int, count: int, listed: bool, stiff: bool) -> SharedPoses:
    """That many shared poses in a row, exact in binary; with their list, with a stiffness."""
    rows = np.zeros((count, 13))
    rows[:, 0], rows[:, 3], rows[:, 7:] = np.arange(count), 1.0, 0.25
    origin = (1.0, 2.0, -0.5, 1.0, 0.0, 0.0, 0.0)
    keyframes = tuple(range(INDEX_MAX - count + 1, INDEX_MAX + 1)) if listed else ()
    information = Array.of(np.full((len(keyframes), 2), 4.0))
    stiffness = Array.of(np.full(stiffness_numbers(count) if stiff else 0, 0.5))
    base_m = Array.of(np.array([10.0, -20.0, 0.5]), "f8")
    return SharedPoses(
        anchor,
        step,
        origin,
        step,
        step,
        keyframes,
        information,
        base_m,
        Array.of(rows),
        1,
        2 if stiff else 0,
        stiffness,
    )


def descriptor(dimension: int = 512, seed: int = 0) -> Array:
    """A unit vector as int8."""
    values = np.random.default_rng(seed).normal(size=dimension)
    return Array.int8(values / np.linalg.norm(values))


EXACT_DESCRIPTOR = Array("i1", (512,), bytes(k * 37 % 256 for k in range(512)), 0.0078125)
ALICE, BOB = LogId("alice"), LogId("bob-2", 0x18F0A1B2C3D)
TERM = Term(7, ALICE)
ADVERT = LeaderAdvert(TERM, 5, 123_456, 2)

RECORDS: tuple[Record, ...] = (
    KeyframeRecord(12, 1_700_000_000.25, (1.5, -2.0, 0.25, 0.5, 0.5, -0.5, 0.5), EXACT_DESCRIPTOR),
    KeyframeRecord(13, 0.0, IDENTITY, None),
    ClosureRecord(
        KeyframeId(ALICE, 3), KeyframeId(BOB, 8), IDENTITY, 480, 510, 480 / 510, 1.7, Array.of(np.arange(21.0))
    ),
    ClosureRecord(KeyframeId(ALICE, 3), KeyframeId(BOB, 9), IDENTITY, 48, 51, 48 / 51),
    RejectionRecord(KeyframeId(ALICE, 4), KeyframeId(BOB, 1), "few correspondences: 12 < 30", 12, 530),
    FixRecord(5, Array.of(np.array([1.0, 2.0, 3.0]), "f8"), Array.of(np.eye(3).ravel())),
    GeodeticFixRecord(5, 48.137, 11.575, 519.5, Array.of(np.eye(3).ravel(), "f8")),
    PoseFixRecord(0, IDENTITY, Array.of(np.arange(21.0), "f8")),
    TagSightingRecord(6, "36h11/7", IDENTITY, Array.of(np.arange(21.0), "f8")),
    RobotSightingRecord(6, "bob-2", IDENTITY, Array.of(np.arange(21.0), "f8")),
    RobotBearingRecord(7, "bob-2", Array.of(np.array([1.0, 2.0, 3.0]), "f8"), Array.of(np.eye(3).ravel(), "f8")),
    MetricClosureRecord(KeyframeId(ALICE, 4), KeyframeId(BOB, 1), IDENTITY, Array.of(np.arange(21.0), "f8")),
    OdometryCovarianceRecord(7, Array.of(np.arange(21.0), "f8")),
    LatentRecord(7, bytes(range(32))),
    WithdrawalRecord(BOB, 3, 7, False),
)
IN_BATCH = 13
"""Records of the example of a batch, which stays as it was when later kinds came."""
ENCODED = tuple(encode_record(record) for record in RECORDS)

CORRECTIONS = (
    LogCorrection(ALICE, TERM, 5, ALICE, (1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0), knots(3, Array.of(np.ones(21), "f2"))),
    LogCorrection(BOB, TERM, 0, ALICE, IDENTITY, None, bytes(range(SIGNATURE_BYTES))),
)

MESSAGES: tuple[Message, ...] = (
    Heartbeat(
        812,
        0xBEEF,
        3,
        ADVERT,
        7,
        2,
        40,
        17,
        TableState(2**56 - 1, 53),
        TableState(0, 2),
        (KeyframeId(BOB, 8),),
        (KeyframeId(ALICE, 3),),
        (KeyframeId(BOB, 7),),
    ),
    Heartbeat(0, 0, 0, None, 0, 0),
    Digests(
        0xBEEF,
        53,
        (LogDigest(ALICE, 13, 0xDEADBEEF), LogDigest(BOB, 40, 17)),
        2,
        (CorrectionVersion(ALICE, TERM, 4), CorrectionVersion(BOB, TERM, 4)),
    ),
    DigestRequest(12, 0),
    Election(8),
    Answer(8),
    Coordinator(ADVERT),
    Handover(TERM),
    Records((RecordBatch(ALICE, 12, 0x1234, ENCODED[:IN_BATCH]), RecordBatch(BOB, 0, 0, ENCODED[:1]))),
    RecordRequest((LogPosition(ALICE, 12), LogPosition(BOB, 41))),
    CorrectionBatch(CORRECTIONS),
    CorrectionRequest((ALICE, BOB)),
    KnotRequest((CorrectionVersion(ALICE, TERM, 4),)),
    CandidateOffer((CandidatePair.of(KeyframeId(BOB, 8), KeyframeId(ALICE, 3)),), True),
    shared(ALICE, 17, 2, listed=True, stiff=False),
)
ENVELOPES = tuple(Envelope(BOB, message) for message in MESSAGES)


def _long(number: int) -> LogId:
    return LogId(f"{number:032d}", INCARNATION_MAX)


def largest_messages() -> list[Message]:
    """Of every kind, a message that no limit allows to be longer: long names, full lists, large numbers."""
    leader = Term(TERM_COUNTER_MAX, _long(0))
    advert = LeaderAdvert(leader, COMPUTE_CLASS_MAX, COUNTER_MAX, HOPS_MAX)
    keyframe = KeyframeId(_long(0), INDEX_MAX)
    other = KeyframeId(_long(1), INDEX_MAX)

    def correction(number: int, count: int) -> LogCorrection:
        told = knots(count, Array.of(np.ones(21), "f8")) if count else None
        return LogCorrection(_long(number), leader, INDEX_MAX, _long(1), IDENTITY, told, bytes(SIGNATURE_BYTES))

    return [
        Heartbeat(
            COUNTER_MAX,
            INCARNATION_MAX,
            COMPUTE_CLASS_MAX,
            advert,
            TERM_COUNTER_MAX,
            INDEX_MAX,
            INDEX_MAX,
            2**32 - 1,
            TableState(HASH_MAX, INDEX_MAX),
            TableState(HASH_MAX, INDEX_MAX),
            (keyframe,) * WANTS_MAX,
            (keyframe,) * WANTS_MAX,
            (keyframe,) * WANTS_MAX,
        ),
        Digests(
            INCARNATION_MAX,
            INDEX_MAX,
            tuple(LogDigest(_long(k), INDEX_MAX, 2**32 - 1) for k in range(LOGS_MAX)),
            INDEX_MAX,
            tuple(CorrectionVersion(_long(k), leader, INDEX_MAX) for k in range(LOGS_MAX)),
        ),
        DigestRequest(INDEX_MAX, INDEX_MAX),
        Election(TERM_COUNTER_MAX),
        Answer(TERM_COUNTER_MAX),
        Coordinator(advert),
        Handover(leader),
        Records(
            tuple(
                RecordBatch(
                    _long(k), INDEX_MAX - 8, 2**32 - 1, (bytes(RECORDS_BATCH_BYTES_MAX // BATCHES_MAX // 8),) * 8
                )
                for k in range(BATCHES_MAX)
            )
        ),
        Records(
            (RecordBatch(_long(0), INDEX_MAX - 4, 2**32 - 1, (bytes(SEALED_RECORD_BYTES_MAX),) * 3 + (bytes(8000),)),)
        ),
        RecordRequest(tuple(LogPosition(_long(k), INDEX_MAX) for k in range(BATCHES_MAX))),
        CorrectionBatch(
            tuple(correction(k, KNOTS_MAX // CORRECTIONS_MAX - SHORT_WEIGHT) for k in range(CORRECTIONS_MAX))
        ),
        CorrectionBatch((correction(0, KNOTS_MAX),)),
        CorrectionBatch(tuple(correction(k, 0) for k in range(CORRECTIONS_MAX))),
        KnotRequest(tuple(CorrectionVersion(_long(k), leader, INDEX_MAX) for k in range(KNOT_REQUESTS_MAX))),
        CorrectionRequest(tuple(_long(k) for k in range(LOGS_MAX))),
        CandidateOffer((CandidatePair(keyframe, other),) * OFFERS_MAX, True),
        shared(_long(0), INDEX_MAX, SHARED_MAX, listed=True, stiff=True),
    ]


# --- hypothesis strategies -------------------------------------------------------------------------------------------

_counts = st.integers(0, INDEX_MAX)
_counters = st.integers(0, COUNTER_MAX)
_term_counters = st.integers(0, TERM_COUNTER_MAX)
_names = st.from_regex(r"\A[a-z0-9][a-z0-9_-]{0,31}\Z")
log_ids = st.builds(LogId, _names, st.integers(0, INCARNATION_MAX))
keyframe_ids = st.builds(KeyframeId, log_ids, _counts)
terms = st.builds(Term, _term_counters, log_ids)


def reals(low: float, high: float) -> st.SearchStrategy[float]:
    """Finite floats in [low, high]."""
    return st.floats(low, high, allow_nan=False, allow_infinity=False)


@st.composite
def poses(draw: st.DrawFn) -> Pose7:
    """Poses within the map, any rotation."""
    x, y, z = (draw(reals(-COORDINATE_MAX, COORDINATE_MAX)) for _ in range(3))
    q = np.random.default_rng(draw(st.integers(0, 2**32 - 1))).normal(size=4)
    qw, qx, qy, qz = (float(value) for value in q / np.linalg.norm(q))
    return (x, y, z, qw, qx, qy, qz)


@st.composite
def arrays(draw: st.DrawFn, shape: tuple[int, ...] | None = None, dtypes: str = "f8 f4 f2 i1 u1") -> Array:
    """Arrays of any dtype, up to three short dimensions unless a shape is given."""
    sizes = draw(st.lists(st.integers(0, 9), max_size=3).map(tuple)) if shape is None else shape
    dtype = draw(st.sampled_from(dtypes.split()))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    if dtype == "i1":
        return Array.int8(rng.normal(size=sizes) * draw(reals(1e-6, 1e6)))
    return Array.of(rng.uniform(0, 255, size=sizes), dtype)


def optional_arrays(shape: tuple[int, ...]) -> st.SearchStrategy[Array | None]:
    """An array of that shape, or None."""
    return st.none() | arrays(shape)


adverts = st.builds(LeaderAdvert, terms, st.integers(0, COMPUTE_CLASS_MAX), _counters, st.integers(0, HOPS_MAX))
pairs = (
    st.tuples(keyframe_ids, keyframe_ids).filter(lambda both: both[0] != both[1]).map(lambda b: CandidatePair.of(*b))
)
records: st.SearchStrategy[Record] = st.one_of(
    st.builds(KeyframeRecord, _counts, reals(-1e12, 1e12), poses(), optional_arrays((32,))),
    pairs.flatmap(
        lambda pair: st.builds(
            ClosureRecord,
            st.just(pair.low),
            st.just(pair.high),
            poses(),
            _counts,
            _counts,
            reals(0, 1e6),
            st.none() | reals(1e-9, 1e9),
            optional_arrays((21,)),
        )
    ),
    pairs.flatmap(
        lambda pair: st.builds(
            RejectionRecord,
            st.just(pair.low),
            st.just(pair.high),
            st.text(max_size=REASON_LENGTH_MAX),
            _counts,
            _counts,
        )
    ),
    st.builds(FixRecord, _counts, arrays((3,), "f8 f4"), arrays((9,))),
    st.builds(GeodeticFixRecord, _counts, reals(-90.0, 90.0), reals(-180.0, 180.0), reals(-1e5, 1e5), arrays((9,))),
    st.builds(PoseFixRecord, _counts, poses(), arrays((21,))),
    st.builds(TagSightingRecord, _counts, st.text(max_size=TAG_LENGTH_MAX), poses(), arrays((21,))),
    st.builds(RobotSightingRecord, _counts, _names, poses(), arrays((21,))),
    st.builds(RobotBearingRecord, _counts, _names, arrays((3,), "f8 f4"), arrays((9,))),
    pairs.flatmap(
        lambda pair: st.builds(MetricClosureRecord, st.just(pair.low), st.just(pair.high), poses(), arrays((21,)))
    ),
    st.builds(OdometryCovarianceRecord, _counts, arrays((21,))),
    st.builds(LatentRecord, _counts, st.sampled_from([32, 64]).flatmap(lambda n: st.binary(min_size=n, max_size=n))),
    st.integers(1, INDEX_MAX).flatmap(
        lambda end: st.builds(
            WithdrawalRecord, log_ids, st.integers(max(0, end - WITHDRAWN_MAX), end - 1), st.just(end), st.booleans()
        )
    ),
)


def _tuples(items: st.SearchStrategy[object], longest: int) -> st.SearchStrategy[tuple[object, ...]]:
    return st.lists(items, max_size=min(longest, 5)).map(tuple)


_starts = st.integers(0, 2**30)
_states = st.builds(TableState, st.integers(0, HASH_MAX), _counts)
batches = st.builds(
    RecordBatch, log_ids, _starts, st.integers(0, 2**32 - 1), _tuples(st.binary(max_size=64), RECORDS_BATCH_MAX)
)
corrections = st.builds(
    LogCorrection,
    log_ids,
    terms,
    _counts,
    log_ids,
    poses(),
    st.none() | st.builds(knots, st.integers(1, 20), optional_arrays((21,)), st.integers(0, 2**32 - 1)),
    st.sampled_from((b"", bytes(SIGNATURE_BYTES))),
)
messages: st.SearchStrategy[Message] = st.one_of(
    st.builds(
        Heartbeat,
        _counters,
        st.integers(0, INCARNATION_MAX),
        st.integers(0, COMPUTE_CLASS_MAX),
        st.none() | adverts,
        _term_counters,
        _counts,
        _counts,
        st.integers(0, 2**32 - 1),
        _states,
        _states,
        _tuples(keyframe_ids, WANTS_MAX),
        _tuples(keyframe_ids, WANTS_MAX),
        _tuples(keyframe_ids, WANTS_MAX),
    ),
    st.builds(
        Digests,
        st.integers(0, INCARNATION_MAX),
        _counts,
        _tuples(st.builds(LogDigest, log_ids, _counts, st.integers(0, 2**32 - 1)), LOGS_MAX),
        _counts,
        _tuples(st.builds(CorrectionVersion, log_ids, terms, _counts), LOGS_MAX),
    ),
    st.builds(DigestRequest, _counts, _counts),
    st.builds(Election, _term_counters),
    st.builds(Answer, _term_counters),
    st.builds(Coordinator, adverts),
    st.builds(Handover, terms),
    st.builds(Records, _tuples(batches, BATCHES_MAX)),
    st.builds(RecordRequest, _tuples(st.builds(LogPosition, log_ids, _counts), BATCHES_MAX)),
    st.builds(CorrectionBatch, _tuples(corrections, CORRECTIONS_MAX)),
    st.builds(CorrectionRequest, _tuples(log_ids, LOGS_MAX)),
    st.builds(KnotRequest, _tuples(st.builds(CorrectionVersion, log_ids, terms, _counts), KNOT_REQUESTS_MAX)),
    st.builds(CandidateOffer, _tuples(pairs, OFFERS_MAX), st.booleans()),
    st.builds(shared, log_ids, _counts, st.integers(0, 20), st.booleans(), st.booleans()),
)
