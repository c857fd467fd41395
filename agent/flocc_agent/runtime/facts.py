"""Facts that are not the core's: what the driver counts, what a process or a bridge went through."""

from collections.abc import Mapping
from dataclasses import field

from flocc_agent.core.reports import fact
from flocc_agent.stages import StageCounts

Links = Mapping[str, Mapping[str, int]]
"""Peer -> kind of message -> payload bytes."""


@fact("bytes")
class BytesCounted:
    """Bytes by kind since the robot started; cumulative, the last one counts.

    Attributes:
        sent: A broadcast once.
        received: What reached the robot.
        loss: Peer in range -> share of its last heartbeats that did not arrive.
        queues: What waits: events for the core, images for the encoder, candidates for their registration.
    """

    sent: Mapping[str, int]
    received: Mapping[str, int]
    loss: Mapping[str, float] = field(default_factory=dict)
    queues: Mapping[str, int] = field(default_factory=dict)


@fact("account")
class AccountKept:
    """Payload bytes by peer and kind, and time by stage, since this start; the last one counts.

    Attributes:
        since_s: When the robot was started, on the run's clock: names the start.
        sent_to: On each link.
        received_from: On each link.
        lost_from: Arrived from a peer, but the emulated radio or a limit kept it away.
        repeated_from: Of what was received, copies that the emulated radio made.
        stages: Time by stage.
    """

    since_s: float
    sent_to: Links
    received_from: Links
    lost_from: Links
    repeated_from: Links
    stages: Mapping[str, StageCounts]


@fact("agent_died")
class AgentDied:
    """An agent ended, but not in order.

    Attributes:
        signal: That ended it.
        exit_code: With which it ended, where no signal did.
        scripted: A fault of the scenario killed it.
    """

    signal: int | str | None = None
    exit_code: int | None = None
    scripted: bool = False


@fact("killed_by_order")
class KilledByOrder:
    """An operator's `flocc chaos kill` ends the agent now."""


@fact("agent_stopped")
class AgentStopped:
    """An agent ended in order."""


@fact("journey_ended")
class JourneyEnded:
    """The robot's odometry began anew, as its ROS 2 service was told: from now on it is another journey."""


@fact("ros2_router")
class RouterConnected:
    """The robot's ROS 2 graph was reached (a router, or other nodes), or is gone."""

    router: str
    connected: bool


@fact("ros2_problem")
class RosProblem:
    """A message of the robot's ROS 2 graph cannot be used; each sentence is said once."""

    sentence: str
