"""Messages between robots, versioned and checked on decode.

Everything but latents is a message. Latents are fetched by key (see `keys`), in chunks, for candidates only.
Every message but a heartbeat may be lost: heartbeats repeat, and what they say repairs the rest.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flocc_protocol.arrays import Array
from flocc_protocol.codec import (
    ARRAY,
    COORDINATE_MAX,
    COUNT,
    KEYFRAME_ID,
    LOG_ID,
    POSE,
    QUATERNION_NORM_TOLERANCE,
    TERM,
    Codec,
    Pose7,
    blob,
    boolean,
    from_bytes,
    integer,
    optional,
    sequence,
    struct,
    to_bytes,
)
from flocc_protocol.errors import DecodeError
from flocc_protocol.ids import INCARNATION_MAX, INDEX_MAX, TERM_COUNTER_MAX, KeyframeId, LogId, Term
from flocc_protocol.records import SEALED_RECORD_BYTES_MAX, SIGNATURE_BYTES, UPPER_TRIANGLE

PROTOCOL_VERSION = 3
VERSION_MAX = 127
MESSAGE_BYTES_MAX = 64 * 1024
LOGS_MAX = 256
WANTS_MAX = 16
OFFERS_MAX = 64
SEPARATORS_MAX = 200
RANK_MIN, RANK_MAX = 3, 5
RECORDS_BATCH_MAX = 64
BATCHES_MAX = 64
RECORDS_BATCH_BYTES_MAX = 32 * 1024
CORRECTION_KEYFRAMES_MAX = 1500
CORRECTIONS_MAX = 16
COMPUTE_CLASS_MAX = 9
HOPS_MAX = 255
COUNTER_MAX = 2**53 - 1
CHECKSUM_MAX = 2**32 - 1
REPEATED_MAX = 8192
CORRECTIONS_KEPT_MAX = 256
"""Corrections whose bytes are kept, because most are heard from several neighbours and passed on."""


class UnknownVersion(DecodeError):
    """The sender speaks another version of this protocol."""


class LogDigest(NamedTuple):
    """How much of one log the sender holds, with the chained checksum of those records."""

    log: LogId
    count: int  # type: ignore[assignment]  # tuples have a method of this name, which nobody needs here
    checksum: int


class CorrectionVersion(NamedTuple):
    """Which correction of one log the sender holds."""

    log: LogId
    term: Term
    round: int


@dataclass(frozen=True, slots=True)
class LeaderAdvert:
    """The leader that the sender follows, as far as the sender knows.

    Attributes:
        term: Term of that leader.
        compute_class: The leader's compute class.
        beat: The leader's own counter; a leader is alive as long as this grows.
        hops: Robots between the leader and the sender; 0 when the sender leads.
    """

    term: Term
    compute_class: int
    beat: int
    hops: int


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Who is there, what it holds, whom it follows.

    Attributes:
        sequence: Counts this boot's heartbeats.
        boot: Random per start; two boots that are heard alternately share one name by mistake.
        compute_class: 0 (small) to 9 (server with a GPU).
        leader: The followed leader, None while there is none.
        term_counter_max: Highest term counter the sender knows of.
        load: Registrations waiting at the sender.
        digests: What the sender holds of some logs: those that grew lately, and the others in turn.
        corrections: Which corrections the sender holds, of some logs in the same way.
        wants: Latents the sender needs and cannot reach, for relays.
        holds: Latents the sender holds for a neighbour that wanted them.
        lost: Latents that a neighbour wanted, and that exist no more as the sender knows from their owner.
    """

    sequence: int
    boot: int
    compute_class: int
    leader: LeaderAdvert | None
    term_counter_max: int
    load: int
    digests: tuple[LogDigest, ...]
    corrections: tuple[CorrectionVersion, ...] = ()
    wants: tuple[KeyframeId, ...] = ()
    holds: tuple[KeyframeId, ...] = ()
    lost: tuple[KeyframeId, ...] = ()


@dataclass(frozen=True, slots=True)
class Election:
    """ELECTION of the bully algorithm (Garcia-Molina 1982), to robots that outrank the sender."""

    counter: int


@dataclass(frozen=True, slots=True)
class Answer:
    """ANSWER: a robot that outranks the asker is alive and takes over the election."""

    counter: int


@dataclass(frozen=True, slots=True)
class Coordinator:
    """COORDINATOR: the sender claims a term."""

    advert: LeaderAdvert


@dataclass(frozen=True, slots=True)
class Handover:
    """The leader leaves in order; nobody needs to wait for its silence."""

    term: Term


@dataclass(frozen=True, slots=True)
class RecordBatch:
    """Records of one log from number `first` on.

    Attributes:
        log: Whose log.
        first: Number of the first record.
        checksum_before: The sender's chained checksum of the records before `first`.
        records: Encoded records, in order; each ends in its writer's signature where the swarm signs records.
    """

    log: LogId
    first: int
    checksum_before: int
    records: tuple[bytes, ...]

    def __post_init__(self) -> None:
        if len(self.records) > RECORDS_BATCH_MAX or self.size_bytes > RECORDS_BATCH_BYTES_MAX:
            raise ValueError(f"{len(self.records)} records of {self.size_bytes} bytes are more than a batch may hold")
        if self.first + len(self.records) > INDEX_MAX:
            raise ValueError(f"a log does not hold {self.first + len(self.records)} records")

    @property
    def size_bytes(self) -> int:
        """Bytes of all its records."""
        return sum(map(len, self.records))

    @classmethod
    def of(
        cls,
        log: LogId,
        first: int,
        checksum_before: int,
        records: Iterable[bytes],
        room: int = RECORDS_BATCH_BYTES_MAX,
    ) -> "RecordBatch":
        """Build a batch from as many of the records, in order, as fit into that many bytes of one message."""
        taken: list[bytes] = []
        for record in records:
            room -= len(record)
            if room < 0 or len(taken) == RECORDS_BATCH_MAX:
                break
            taken.append(record)
        return cls(log, first, checksum_before, tuple(taken))


@dataclass(frozen=True, slots=True)
class Records:
    """Records of several logs; all together are no larger than one batch may be."""

    batches: tuple[RecordBatch, ...]

    def __post_init__(self) -> None:
        bytes_total = sum(batch.size_bytes for batch in self.batches)
        if len(self.batches) > BATCHES_MAX or bytes_total > RECORDS_BATCH_BYTES_MAX:
            raise ValueError(f"{len(self.batches)} batches of {bytes_total} bytes are more than a message may hold")


class LogPosition(NamedTuple):
    """A place in a log: the record of this number is the next one."""

    log: LogId
    first: int


@dataclass(frozen=True, slots=True)
class RecordRequest:
    """Please send records of these logs, of each from its position on, as many as fit one message."""

    positions: tuple[LogPosition, ...]


@dataclass(frozen=True, slots=True)
class LogCorrection:
    """A leader's correction of one log, which anyone may pass on.

    Attributes:
        log: Whose trajectory is corrected.
        term: Term of the leader that made it.
        round: Number of its optimisation round; (term, round) only grows.
        anchor: The component's anchor, after which the map frame is named.
        T_map_odom: Where the log's odom frame lies in the map.
        covariance: Upper triangle (21) of T_map_odom's covariance, or None.
        first: Number of the first corrected keyframe.
        step: Every `step`-th keyframe is listed; those between are interpolated.
        T_map_camera: (N, 7) float32 poses, translation and quaternion w x y z.
        signature: The leader's, over `encode_correction`; empty where the swarm has no keys.
    """

    log: LogId
    term: Term
    round: int
    anchor: LogId
    T_map_odom: Pose7
    covariance: Array | None
    first: int
    step: int
    T_map_camera: Array
    signature: bytes = b""

    def __post_init__(self) -> None:
        shape = self.T_map_camera.shape
        if self.T_map_camera.dtype != "f4" or len(shape) != 2 or shape[1] != 7 or shape[0] > CORRECTION_KEYFRAMES_MAX:
            raise ValueError(f"a correction has (N, 7) float32 poses, N at most {CORRECTION_KEYFRAMES_MAX}")
        if self.first + self.step * (shape[0] - 1) > INDEX_MAX:
            raise ValueError("a correction ends within its log")
        if self.covariance is not None and self.covariance.shape != (UPPER_TRIANGLE,):
            raise ValueError(f"a covariance is an upper triangle of {UPPER_TRIANGLE}")
        if len(self.signature) not in (0, SIGNATURE_BYTES):
            raise ValueError(f"a signature has {SIGNATURE_BYTES} bytes")
        _check_poses(self.T_map_camera.numpy())


@dataclass(frozen=True, slots=True)
class CorrectionBatch:
    """Corrections of several logs; all together list no more keyframes than one may."""

    corrections: tuple[LogCorrection, ...]

    def __post_init__(self) -> None:
        keyframes = sum(correction.T_map_camera.shape[0] for correction in self.corrections)
        if len(self.corrections) > CORRECTIONS_MAX or keyframes > CORRECTION_KEYFRAMES_MAX:
            raise ValueError(f"{len(self.corrections)} corrections of {keyframes} keyframes do not fit one message")

    @classmethod
    def packed(cls, corrections: Iterable[LogCorrection]) -> "list[CorrectionBatch]":
        """Put any number of corrections, in their order, into messages."""
        batches: list[list[LogCorrection]] = [[]]
        room = CORRECTION_KEYFRAMES_MAX
        for correction in corrections:
            keyframes = correction.T_map_camera.shape[0]
            if keyframes > room or len(batches[-1]) == CORRECTIONS_MAX:
                batches.append([])
                room = CORRECTION_KEYFRAMES_MAX
            batches[-1].append(correction)
            room -= keyframes
        return [cls(tuple(each)) for each in batches if each]


@dataclass(frozen=True, slots=True)
class CorrectionRequest:
    """Please send your corrections of these logs."""

    logs: tuple[LogId, ...]


@dataclass(frozen=True, slots=True)
class CandidateOffer:
    """Candidate pairs that the sender found and that the receiver is to register.

    Attributes:
        pairs: (query of the receiver, match of the sender) and so on, each pair sorted.
        transferred: The sender gives up a pair that was its own; it waits for the receiver's record.
    """

    pairs: tuple["CandidatePair", ...]
    transferred: bool = False


class _PairFields(NamedTuple):
    low: KeyframeId
    high: KeyframeId


class CandidatePair(_PairFields):
    """Two keyframes of different robots that may show one place; `low < high`."""

    __slots__ = ()

    def __new__(cls, low: KeyframeId, high: KeyframeId) -> "CandidatePair":
        """Check the order.

        Raises:
            ValueError: They are not sorted, or the same.
        """
        if not low < high:
            raise ValueError("a candidate pair is sorted and joins two keyframes")
        return super().__new__(cls, low, high)

    def other(self, end: KeyframeId) -> KeyframeId:
        """The end that is not the given one."""
        return self.high if end == self.low else self.low

    @classmethod
    def of(cls, a: KeyframeId, b: KeyframeId) -> "CandidatePair":
        """Sort two keyframes into a pair."""
        return cls(min(a, b), max(a, b))


@dataclass(frozen=True, slots=True)
class Separators:
    """The sender's present estimate of keyframes that closures join to other robots' (distributed optimisation).

    Attributes:
        anchor: Log after which the frame of the poses is named; poses of two frames are not compared.
        iteration: Counts the sender's block iterations; it only grows.
        epoch: Counts graduations of robust weights; who hears of a later one begins it, too.
        origin: (4, r) float64: where the map frame lies among the poses, as the sender last heard from the anchor.
        origin_iteration: Iteration of the anchor from which that is.
        keyframes: Numbers of the keyframes in the sender's log.
        poses: (N, 4, r) float64: three rows of a 3-frame in r dimensions (a relaxed rotation, transposed), then the
            position, metres.
        pairs: Closures between two robots whose robust weight is the sender's to decide.
        weights: (M,) float32 in [0, 1], one per pair.
    """

    anchor: LogId
    iteration: int
    epoch: int
    origin: Array
    origin_iteration: int
    keyframes: tuple[int, ...]
    poses: Array
    pairs: tuple[CandidatePair, ...]
    weights: Array

    def __post_init__(self) -> None:
        shape = self.poses.shape
        if self.poses.dtype != "f8" or len(shape) != 3 or shape[:2] != (len(self.keyframes), 4):
            raise ValueError("separators have (N, 4, r) float64 poses, one per keyframe")
        if self.origin.dtype != "f8" or self.origin.shape != shape[1:]:
            raise ValueError("the origin is a float64 pose like the separators")
        if not RANK_MIN <= shape[2] <= RANK_MAX or len(self.keyframes) > SEPARATORS_MAX:
            raise ValueError(f"separators have rank {RANK_MIN} to {RANK_MAX} and at most {SEPARATORS_MAX} keyframes")
        if self.weights.dtype != "f4" or self.weights.shape != (len(self.pairs),) or len(self.pairs) > OFFERS_MAX:
            raise ValueError(f"separators have one float32 weight per pair, at most {OFFERS_MAX}")
        _check_lifted(self.poses.numpy())
        _check_lifted(self.origin.numpy()[None])
        if np.any((self.weights.numpy() < 0.0) | (self.weights.numpy() > 1.0)):
            raise ValueError("a robust weight lies in [0, 1]")


Message = (
    Heartbeat
    | Election
    | Answer
    | Coordinator
    | Handover
    | Records
    | RecordRequest
    | CorrectionBatch
    | CorrectionRequest
    | CandidateOffer
    | Separators
)


@dataclass(frozen=True, slots=True)
class Envelope:
    """A message with its sender's log."""

    sender: LogId
    message: Message


def _check_poses(poses: NDArray[np.float64]) -> None:
    """Refuse (N, 7) poses that leave the map or whose quaternions are not of unit length."""
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    if np.any(np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE) or np.any(np.abs(poses[:, :3]) > COORDINATE_MAX):
        raise ValueError("a correction's poses lie within the map and have unit quaternions")


def _check_lifted(poses: NDArray[np.float64]) -> None:
    """Refuse (N, 4, r) poses that leave the map or whose frames are not orthonormal."""
    frames = np.clip(poses[:, :3], -2.0, 2.0)
    gram = frames @ np.swapaxes(frames, 1, 2)
    if np.any(np.abs(gram - np.eye(3)) > QUATERNION_NORM_TOLERANCE) or np.any(np.abs(poses[:, 3]) > COORDINATE_MAX):
        raise ValueError("separators lie within the map and have orthonormal frames")


_BEAT = integer(0, COUNTER_MAX)
_TERM_COUNTER = integer(0, TERM_COUNTER_MAX)
_CHECKSUM = integer(0, CHECKSUM_MAX)
_COMPUTE_CLASS = integer(0, COMPUTE_CLASS_MAX)
_ADVERT = struct(LeaderAdvert, term=TERM, compute_class=_COMPUTE_CLASS, beat=_BEAT, hops=integer(0, HOPS_MAX))
_ANY_DIGEST = struct(LogDigest, log=LOG_ID, count=COUNT, checksum=_CHECKSUM)
_ANY_VERSION = struct(CorrectionVersion, log=LOG_ID, term=TERM, round=COUNT)


@lru_cache(maxsize=REPEATED_MAX, typed=True)
def _digest(robot: Any, incarnation: Any, count: Any, checksum: Any) -> LogDigest:
    """Heartbeats repeat most of what they say: the same digest comes back as the same object, checked once."""
    return _ANY_DIGEST.unpack([[robot, incarnation], count, checksum])


@lru_cache(maxsize=REPEATED_MAX, typed=True)
def _version(robot: Any, incarnation: Any, counter: Any, leader: Any, life: Any, number: Any) -> CorrectionVersion:
    return _ANY_VERSION.unpack([[robot, incarnation], [counter, [leader, life]], number])


def _unpack_digest(value: Any) -> LogDigest:
    try:
        (robot, incarnation), count, checksum = value
        return _digest(robot, incarnation, count, checksum)
    except (TypeError, ValueError) as error:
        raise DecodeError("expected a digest") from error


def _unpack_version(value: Any) -> CorrectionVersion:
    try:
        (robot, incarnation), (counter, (leader, life)), number = value
        return _version(robot, incarnation, counter, leader, life, number)
    except (TypeError, ValueError) as error:
        raise DecodeError("expected the version of a correction") from error


def _pack_digest(value: LogDigest) -> LogDigest:
    """A digest is a tuple as it is on the wire."""
    log, count, checksum = value
    if not 0 <= count <= INDEX_MAX or not 0 <= checksum <= CHECKSUM_MAX:
        raise DecodeError(f"digest of {log} is out of range")
    return value


def _pack_version(value: CorrectionVersion) -> CorrectionVersion:
    if not 0 <= value.round <= INDEX_MAX:
        raise DecodeError(f"version of the correction of {value.log} is out of range")
    return value


_DIGEST = Codec(_pack_digest, _unpack_digest)
_VERSION = Codec(_pack_version, _unpack_version)
_PAIR = struct(CandidatePair, low=KEYFRAME_ID, high=KEYFRAME_ID)


def _unsigned(
    log: LogId,
    term: Term,
    round: int,
    anchor: LogId,
    T_map_odom: Pose7,
    covariance: Array | None,
    first: int,
    step: int,
    T_map_camera: Array,
) -> LogCorrection:
    return LogCorrection(log, term, round, anchor, T_map_odom, covariance, first, step, T_map_camera)


_UNSIGNED = struct(
    _unsigned,
    log=LOG_ID,
    term=TERM,
    round=COUNT,
    anchor=LOG_ID,
    T_map_odom=POSE,
    covariance=optional(ARRAY),
    first=COUNT,
    step=integer(1, 2**31 - 1),
    T_map_camera=ARRAY,
)


@lru_cache(maxsize=CORRECTIONS_KEPT_MAX)
def encode_correction(correction: LogCorrection) -> bytes:
    """A correction without its signature, as it is on the wire; every relay passes on the same bytes."""
    return to_bytes(_UNSIGNED.pack(correction))


@lru_cache(maxsize=CORRECTIONS_KEPT_MAX)
def _read_correction(data: bytes, signature: bytes) -> LogCorrection:
    unsigned = _UNSIGNED.unpack(from_bytes(data, MESSAGE_BYTES_MAX))
    return replace(unsigned, signature=signature) if signature else unsigned


def _unpack_correction(value: Any) -> LogCorrection:
    if type(value) is not list or len(value) != 2 or type(value[0]) is not bytes or type(value[1]) is not bytes:
        raise DecodeError("expected a correction and its signature")
    try:
        return _read_correction(*value)
    except ValueError as error:
        raise DecodeError(str(error)) from error


_CORRECTION = Codec(lambda correction: [encode_correction(correction), correction.signature], _unpack_correction)
_POSITION = struct(LogPosition, log=LOG_ID, first=COUNT)
_BATCH = struct(
    RecordBatch,
    log=LOG_ID,
    first=COUNT,
    checksum_before=_CHECKSUM,
    records=sequence(blob(SEALED_RECORD_BYTES_MAX), RECORDS_BATCH_MAX),
)

_CODECS: dict[str, tuple[type[Message], Codec[Any]]] = {
    "heartbeat": (
        Heartbeat,
        struct(
            Heartbeat,
            sequence=_BEAT,
            boot=integer(0, INCARNATION_MAX),
            compute_class=_COMPUTE_CLASS,
            leader=optional(_ADVERT),
            term_counter_max=_TERM_COUNTER,
            load=COUNT,
            digests=sequence(_DIGEST, LOGS_MAX),
            corrections=sequence(_VERSION, LOGS_MAX),
            wants=sequence(KEYFRAME_ID, WANTS_MAX),
            holds=sequence(KEYFRAME_ID, WANTS_MAX),
            lost=sequence(KEYFRAME_ID, WANTS_MAX),
        ),
    ),
    "election": (Election, struct(Election, counter=_TERM_COUNTER)),
    "answer": (Answer, struct(Answer, counter=_TERM_COUNTER)),
    "coordinator": (Coordinator, struct(Coordinator, advert=_ADVERT)),
    "handover": (Handover, struct(Handover, term=TERM)),
    "records": (Records, struct(Records, batches=sequence(_BATCH, BATCHES_MAX))),
    "want-records": (RecordRequest, struct(RecordRequest, positions=sequence(_POSITION, BATCHES_MAX))),
    "correction": (CorrectionBatch, struct(CorrectionBatch, corrections=sequence(_CORRECTION, CORRECTIONS_MAX))),
    "want-correction": (CorrectionRequest, struct(CorrectionRequest, logs=sequence(LOG_ID, LOGS_MAX))),
    "candidates": (
        CandidateOffer,
        struct(CandidateOffer, pairs=sequence(_PAIR, OFFERS_MAX), transferred=boolean()),
    ),
    "separators": (
        Separators,
        struct(
            Separators,
            anchor=LOG_ID,
            iteration=COUNT,
            epoch=COUNT,
            origin=ARRAY,
            origin_iteration=COUNT,
            keyframes=sequence(COUNT, SEPARATORS_MAX),
            poses=ARRAY,
            pairs=sequence(_PAIR, OFFERS_MAX),
            weights=ARRAY,
        ),
    ),
}
_KINDS: dict[type[Message], str] = {cls: kind for kind, (cls, _) in _CODECS.items()}
MESSAGE_KINDS: tuple[str, ...] = tuple(_CODECS)


def kind_of(message: Message) -> str:
    """Name of a message's kind, as accounting and key expressions use it."""
    return _KINDS[type(message)]


def encode(envelope: Envelope) -> bytes:
    """Serialise a message: version, kind, sender, fields.

    Raises:
        ValueError: A field is outside its limits, so that every receiver would refuse the message.
    """
    kind = kind_of(envelope.message)
    try:
        body = _CODECS[kind][1].pack(envelope.message)
    except DecodeError as error:
        raise ValueError(f"{kind}: {error}") from error
    data = to_bytes([PROTOCOL_VERSION, kind, LOG_ID.pack(envelope.sender), body])
    assert len(data) <= MESSAGE_BYTES_MAX, f"{kind} of {len(data)} bytes is larger than a message may be"
    return data


def version_of(data: bytes) -> int:
    """Read the protocol version of a message, whatever else that version changed: its second byte.

    Raises:
        DecodeError: Not a message of any version: a short msgpack array that starts with 0 to 127.
    """
    if len(data) < 2 or data[0] & 0xF0 != 0x90 or data[1] > VERSION_MAX:
        raise DecodeError("a message starts with its version")
    return data[1]


def decode(data: bytes) -> Envelope:
    """Parse and check a message.

    Raises:
        UnknownVersion: The sender speaks another version.
        DecodeError: The bytes are anything else.
    """
    version = version_of(data)
    if version != PROTOCOL_VERSION:
        raise UnknownVersion(f"protocol version {version}, this robot speaks {PROTOCOL_VERSION}")
    value = from_bytes(data, MESSAGE_BYTES_MAX)
    if type(value) is not list or len(value) != 4 or type(value[1]) is not str or value[1] not in _CODECS:
        raise DecodeError("a message is version, kind, sender and fields")
    return Envelope(LOG_ID.unpack(value[2]), _CODECS[value[1]][1].unpack(value[3]))
