"""One robot's state as diagnostic_msgs, for rqt_robot_monitor and diagnostic_aggregator: one status, in sentences."""

from collections.abc import Mapping, Sequence
from typing import Any

from flocc_agent.runtime.ros2.types import DIAGNOSTICS, MessageTypes
from flocc_agent.runtime.status import AgentStatus

OK, WARN, ERROR = 0, 1, 2
FULL_RATIO = 0.9
VALUES_MAX = 64


def judged(status: AgentStatus, warnings: Sequence[str], connected: bool) -> tuple[int, str]:
    """Level and sentence of a robot: the worst thing first.

    Args:
        status: Of the robot.
        warnings: Of the last solution that it made itself.
        connected: Whether the robot's ROS is reached.
    """
    full = [name for name, (size, most) in sorted(status.sizes.items()) if most and size >= FULL_RATIO * most]
    if status.disk_failure is not None:
        return ERROR, f"the disk fails: {status.disk_failure}"
    if not connected:
        return ERROR, "nothing of the robot's ROS is reached"
    if status.leader is None:
        return WARN, "follows no leader"
    if status.keyframes == 0:
        return WARN, "has taken no keyframe yet; 'refused' says what was left out"
    if status.map_frame is None:
        return WARN, "is in no map yet: no correction has come"
    if warnings:
        return WARN, f"the solver warns: {warnings[0]}"
    if full:
        return WARN, f"nearly full: {', '.join(full)}"
    alone = "" if status.neighbours else ", hears no other robot"
    whom = "leads" if status.leader == status.robot else f"follows {status.leader}"
    return OK, f"{whom}, term {status.term}, in {status.map_frame}{alone}"


def diagnostics(
    types: MessageTypes,
    status: AgentStatus,
    warnings: Sequence[str],
    heard: Mapping[str, int],
    connected: bool,
    stamp_ns: int,
) -> Any:
    """DiagnosticArray of one robot.

    Args:
        types: Makes messages.
        status: Of the robot.
        warnings: Of the last solution that it made itself.
        heard: Messages of the robot's ROS so far, by kind.
        connected: Whether that ROS is reached.
        stamp_ns: Now, on the node's clock.
    """
    level, sentence = judged(status, warnings, connected)
    told = {
        "leader": status.leader or "",
        "term": status.term if status.term is not None else "",
        "role": status.role,
        "neighbours": " ".join(status.neighbours),
        "map frame": status.map_frame or "",
        "round": status.round if status.round is not None else "",
        "keyframes": status.keyframes,
        "closures": status.closures,
        "candidates": status.candidates,
        "sent, bytes": status.sent_bytes,
        "received, bytes": status.received_bytes,
        **{f"waiting: {name}": size for name, size in sorted(status.queues.items())},
        **{f"heard: {kind}": count for kind, count in sorted(heard.items())},
        **{f"refused: {reason}": count for reason, count in sorted(status.refused.items())},
        **{f"solver warns {k}": warning for k, warning in enumerate(warnings, start=1)},
    }
    values = [
        types.new("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
        for key, value in list(told.items())[:VALUES_MAX]
    ]
    one = types.new(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name=f"flocc: {status.robot}",
        message=sentence,
        hardware_id=status.robot,
        values=values,
    )
    sec, nanosec = divmod(stamp_ns, 10**9)
    stamp = types.new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    header = types.new("std_msgs/msg/Header", stamp=stamp, frame_id="")
    return types.new(DIAGNOSTICS, header=header, status=[one])
