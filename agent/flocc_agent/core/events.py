"""What happens to a robot. Every event that can fail has its failure twin."""

from dataclasses import dataclass

from flocc_agent.core.measurements import Measurement
from flocc_agent.core.own_part import ConsensusStep
from flocc_agent.core.pose_graph import GraphSolution
from flocc_agent.core.registration import Registration, RegistrationFailed
from flocc_agent.core.reports import CameraDoubted
from flocc_protocol.arrays import Array
from flocc_protocol.codec import Pose7
from flocc_protocol.ids import KeyframeId, Term
from flocc_protocol.messages import CandidatePair, Envelope

LATENT_UNKNOWN = "unknown"
"""Reason of a LatentFetchFailed: the holder answered that it does not hold the latent (any more)."""
LATENT_FALSE = "wrong-hash"
"""Another reason: what the holder served is not what the owner's log says, or not what the holder itself says."""


@dataclass(frozen=True, slots=True)
class KeyframeCaptured:
    """The camera took a keyframe.

    Attributes:
        stamp_s: Time of the image on the robot's clock.
        T_odom_camera: Camera pose in the robot's odom frame, metric.
        image: Number under which the driver holds the pixels.
    """

    stamp_s: float
    T_odom_camera: Pose7
    image: int


@dataclass(frozen=True, slots=True)
class Withdrawn:
    """Keyframes before one that showed what is not the scene, as its image told.

    Attributes:
        count: How many.
        sha256: Of the latents that were made anew, as `KeyframeEncoded` has it, the earliest first; empty where there
            are none, or nobody asks for them.
        is_final: No latent can be better.
    """

    count: int
    sha256: tuple[bytes, ...] = ()
    is_final: bool = False


@dataclass(frozen=True, slots=True)
class KeyframeEncoded:
    """The latent is stored and the descriptor computed.

    Attributes:
        keyframe: Which.
        descriptor: For place recognition.
        doubts: What its image says against the camera, told for the first time.
        sha256: Of the latent as it is sent, 32 bytes for each form; empty where nobody asks for it.
        withdrawn: Keyframes before it that showed what is not the scene, where this image told so.
    """

    keyframe: KeyframeId
    descriptor: Array
    doubts: tuple[CameraDoubted, ...] = ()
    sha256: bytes = b""
    withdrawn: Withdrawn | None = None


@dataclass(frozen=True, slots=True)
class KeyframeEncodingFailed:
    """No descriptor and no latent; the keyframe still carries odometry.

    Attributes:
        keyframe: Which.
        reason: Why.
        doubts: What its image says against the camera, told for the first time.
        withdrawn: As of `KeyframeEncoded`.
    """

    keyframe: KeyframeId
    reason: str
    doubts: tuple[CameraDoubted, ...] = ()
    withdrawn: Withdrawn | None = None


@dataclass(frozen=True, slots=True)
class MessageReceived:
    """A checked message of another robot."""

    envelope: Envelope


@dataclass(frozen=True, slots=True)
class LatentFetched:
    """The latent of another robot's keyframe is in this robot's store."""

    keyframe: KeyframeId
    holder: str


@dataclass(frozen=True, slots=True)
class LatentFetchFailed:
    """The holder did not answer in time or does not have it."""

    keyframe: KeyframeId
    holder: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class PairRegistered:
    """A registration came to an end, with a relative pose or with a reason."""

    pair: CandidatePair
    result: Registration | RegistrationFailed


@dataclass(frozen=True, slots=True)
class LatentMissing:
    """A registration could not start: the store no longer holds this latent."""

    pair: CandidatePair
    keyframe: KeyframeId


@dataclass(frozen=True, slots=True, eq=False)
class GraphOptimised:
    """A round's solution."""

    term: Term
    round: int
    solution: GraphSolution


@dataclass(frozen=True, slots=True)
class GraphOptimisationFailed:
    """A round without a solution; the last good one stands."""

    term: Term
    round: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class ClosuresChosen:
    """One or two logs were solved for themselves."""

    number: int
    solution: GraphSolution


@dataclass(frozen=True, slots=True)
class ChoiceFailed:
    """They could not be solved; what was chosen before stands."""

    number: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class ConsensusStepped:
    """A step of the own part ended."""

    number: int
    step: ConsensusStep


@dataclass(frozen=True, slots=True)
class ConsensusStepFailed:
    """A step without a result; the part stands where it stood."""

    number: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Something was measured at one of the robot's own keyframes, given before or being encoded still.

    Attributes:
        measurement: It, of the camera.
        index: Number of the keyframe; a known start's is 0, given or not.
    """

    measurement: Measurement
    index: int


@dataclass(frozen=True, slots=True)
class Leaving:
    """The robot is about to stop in order."""


Event = (
    KeyframeCaptured
    | KeyframeEncoded
    | KeyframeEncodingFailed
    | MessageReceived
    | LatentFetched
    | LatentFetchFailed
    | PairRegistered
    | LatentMissing
    | GraphOptimised
    | GraphOptimisationFailed
    | ClosuresChosen
    | ChoiceFailed
    | ConsensusStepped
    | ConsensusStepFailed
    | Measured
    | Leaving
)
