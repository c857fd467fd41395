"""What a robot wants done. The driver carries effects out in order: what is persisted comes before what is sent."""

from dataclasses import dataclass
from typing import NamedTuple

from flocc_agent.core.own_part import ConsensusProblem
from flocc_agent.core.pose_graph import GraphSolution, PoseGraph
from flocc_agent.core.reports import Fact
from flocc_protocol.codec import Pose7
from flocc_protocol.ids import KeyframeId, LogId, Term
from flocc_protocol.messages import CandidatePair, LogCorrection, Message
from flocc_protocol.records import LatentRecord


@dataclass(frozen=True, slots=True)
class Encode:
    """Describe and encode an image; answer KeyframeEncoded or KeyframeEncodingFailed.

    Attributes:
        keyframe: Whose image.
        image: Number under which the driver holds the pixels.
        T_odom_camera: Where odometry says that it was taken, metric.
    """

    keyframe: KeyframeId
    image: int
    T_odom_camera: Pose7


@dataclass(frozen=True, slots=True)
class Broadcast:
    """Send to every robot in range; may be lost."""

    message: Message


@dataclass(frozen=True, slots=True)
class Unicast:
    """Send to one robot in range; may be lost."""

    to: str
    message: Message


@dataclass(frozen=True, slots=True)
class FetchLatent:
    """Get a latent from a robot in range into the store; answer LatentFetched or LatentFetchFailed.

    Attributes:
        keyframe: Whose.
        holder: The robot.
        deadline_s: Time for it, seconds.
        named: What its owner's log says that it is, where it does.
    """

    keyframe: KeyframeId
    holder: str
    deadline_s: float
    named: LatentRecord | None = None


@dataclass(frozen=True, slots=True)
class Register:
    """Register two latents of the store; answer PairRegistered or LatentMissing.

    Attributes:
        pair: The candidate.
        query: Which of the two is the query.
        match: The other one.
        neighbour: The query's neighbour in its log, for the odometry pair of Eq. (1).
        T_neighbour_query: Odometry between the two, metric.
    """

    pair: CandidatePair
    query: KeyframeId
    match: KeyframeId
    neighbour: KeyframeId
    T_neighbour_query: Pose7


@dataclass(frozen=True, slots=True, eq=False)
class Optimise:
    """Optimise a pose graph; answer GraphOptimised or GraphOptimisationFailed."""

    term: Term
    round: int
    graph: PoseGraph
    initial: GraphSolution | None


@dataclass(frozen=True, slots=True, eq=False)
class ChooseClosures:
    """Solve one or two logs for themselves (distributed optimisation); answer ClosuresChosen or ChoiceFailed."""

    number: int
    graph: PoseGraph


@dataclass(frozen=True, slots=True, eq=False)
class StepConsensus:
    """Do one step of the own part (distributed optimisation); answer ConsensusStepped or ConsensusStepFailed."""

    number: int
    problem: ConsensusProblem


@dataclass(frozen=True, slots=True)
class Deliver:
    """Tell the robot's consumers that a correction applies from now on.

    Attributes:
        correction: Of this robot's own log.
        frame_changed: The map frame differs from the last correction's: everything jumps.
    """

    correction: LogCorrection
    frame_changed: bool


class PersistRecord(NamedTuple):
    """Put a record on disk; an own record must be there before it is sent."""

    log: LogId
    number: int
    data: bytes


@dataclass(frozen=True, slots=True)
class DropLog:
    """Keep nothing more of another robot's log."""

    log: LogId


@dataclass(frozen=True, slots=True)
class PersistTerm:
    """Remember the highest term counter that this robot claimed."""

    counter: int


@dataclass(frozen=True, slots=True)
class PersistCorrection:
    """Remember the correction that this robot applied.

    Attributes:
        correction: It.
        frame_changed: Consumers may not have heard of its map frame yet: the power may go before they do.
    """

    correction: LogCorrection
    frame_changed: bool


@dataclass(frozen=True, slots=True)
class Report:
    """Tell people and files a fact."""

    fact: Fact


Effect = (
    Encode
    | Broadcast
    | Unicast
    | FetchLatent
    | Register
    | Optimise
    | ChooseClosures
    | StepConsensus
    | Deliver
    | PersistRecord
    | PersistTerm
    | PersistCorrection
    | DropLog
    | Report
)
