"""`flocc status`: every robot of a swarm in one table, asked over zenoh as an operator, or read from a run folder.

Agents answer an operator's query; nothing is subscribed to, so a look costs one small message per robot.
"""

import asyncio
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field, ValidationError
from rich.box import SIMPLE_HEAD
from rich.table import Table

from flocc_agent.config import TransportConfig
from flocc_agent.runtime.event_lines import values_of
from flocc_agent.runtime.status import CameraStatus, MergeStatus
from flocc_launch.dashboard.page_source import RunSource
from flocc_launch.dashboard.snapshot import RobotView
from flocc_launch.runs.run_folder import RunFolder
from flocc_protocol.errors import FloccError

if TYPE_CHECKING:
    from flocc_agent.runtime.zenoh_admin import Survey

OPTIONAL = frozenset({"closures", "to register", "candidates", "accepted", "waiting", "lost %", "refused", "camera"})
NO_ANSWER = "no answer"
LEFT = frozenset({"robot", "state", "leader", "map frame", "hears", "camera"})


class StatusError(FloccError):
    """Nobody answered; one sentence says who was asked."""


class RobotStatus(MergeStatus):
    """What one robot says of itself, or its events tell; what is not known is null.

    Attributes:
        closures: Loop closures in all logs that it holds, as it says while it runs.
        candidates: Pairs that it is to register and can, at that moment.
        found: Candidates that it found since its start, as its events tell.
        accepted: Closures among the pairs that it registered itself, as its events tell.
    """

    robot: str
    state: str = "running"
    leader: str | None = None
    term: int | None = None
    neighbours: tuple[str, ...] = ()
    map_frame: str | None = None
    keyframes: int | None = None
    closures: int | None = None
    candidates: int | None = None
    found: int | None = None
    accepted: int | None = None
    sent_bytes: int | None = None
    received_bytes: int | None = None
    refused: dict[str, int] = Field(default_factory=dict)
    compute_class: int = 0
    logs: dict[str, tuple[int, int]] = Field(default_factory=dict)
    loss: dict[str, float] = Field(default_factory=dict)
    queues: dict[str, int] = Field(default_factory=dict)
    doubles: tuple[str, ...] = ()
    camera: tuple[CameraStatus, ...] = ()


def status_of_swarm(config: TransportConfig, swarm: str, timeout_s: float = 3.0) -> list[RobotStatus]:
    """Ask every agent of a swarm in reach.

    Args:
        config: How to reach the swarm: its roster, or scouting.
        swarm: Name of the swarm.
        timeout_s: Time for finding agents, and again for their answers, for which they are asked twice.

    Returns:
        One status per robot that answered, or whom one that did hears, sorted.

    Raises:
        StatusError: No agent answered; it says which of three reasons it has.
        TransportError: The network cannot be used as configured.
    """
    from flocc_agent.runtime.zenoh_admin import survey
    from flocc_protocol.keys import Admin

    found = asyncio.run(survey(config, swarm, Admin.STATUS, timeout_s=timeout_s, named=neighbours_in))
    if not found.answers:
        raise StatusError(f"swarm {swarm}: {why_silent(found, config, timeout_s)}")
    late = [RobotStatus(robot=robot, state=NO_ANSWER) for robot in found.present if robot not in found.answers]
    rows = [status_from(robot, answer) for robot, answer in found.answers.items()]
    return sorted([*rows, *late], key=lambda row: row.robot)


def why_silent(found: "Survey", config: TransportConfig, timeout_s: float) -> str:
    """Why nobody answered: they want keys, they are late, or nobody is there."""
    if found.refuses:
        held = "no keys were given" if config.tls is None else f"{config.tls.folder} holds a robot's keys"
        return f"there are agents, but they answer only to operators, and {held}; give --config with an operator's keys"
    if found.present:
        are = "is" if len(found.present) == 1 else "are"
        return (
            f"{', '.join(found.present)} {are} there, but did not answer within {timeout_s:g} s, asked twice; "
            "a machine under load answers late: give a longer --timeout"
        )
    where = f"the roster ({', '.join(sorted(config.roster))})" if config.roster else "anybody that scouting finds"
    there = f" (there: swarm {', '.join(found.others)})" if found.others else ""
    from flocc_agent.runtime.network_faults import with_faults
    from flocc_agent.runtime.zenoh_admin import FIND_TIMEOUTS

    return with_faults(
        f"nobody is there: in {FIND_TIMEOUTS * timeout_s:g} s no agent of it was found{there}; asked {where}; "
        "a machine under load is found late: give a longer --timeout",
        config,
    )


def neighbours_in(answer: bytes) -> tuple[str, ...]:
    """Whom an answer says to be there."""
    return status_from("", answer).neighbours


def status_from(robot: str, answer: bytes) -> RobotStatus:
    """Read one answer; a robot that answers something else is shown as such."""
    try:
        fields = json.loads(answer)
        return RobotStatus.model_validate({**fields, "robot": robot} if isinstance(fields, dict) else fields)
    except (ValueError, ValidationError):
        return RobotStatus(robot=robot, state="answers in another format")


def status_of_run(path: Path) -> list[RobotStatus]:
    """Read the newest state of every robot from a run folder, of a run that goes on or is over.

    Raises:
        RunFolderError: It is not a run folder.
    """
    snapshot = RunSource(RunFolder.open(path)).snapshot()
    return [status_of_robot(robot) for robot in snapshot.robots]


def status_of_robot(robot: RobotView) -> RobotStatus:
    """One robot of a snapshot."""
    return RobotStatus(
        robot=robot.robot,
        state=robot.state,
        leader=robot.leader,
        term=robot.term,
        neighbours=tuple(robot.neighbours),
        map_frame=robot.map_frame,
        keyframes=robot.keyframes,
        found=robot.candidates,
        accepted=robot.accepted,
        sent_bytes=robot.sent_bytes,
        received_bytes=robot.received_bytes,
        loss={peer: link.loss_ratio for peer, link in robot.links.items() if link.loss_ratio is not None},
        queues=dict(robot.queues),
        camera=tuple(CameraStatus.model_validate(values_of(told)) for told in robot.camera),
    )


def status_json(rows: Sequence[RobotStatus]) -> str:
    """All rows as one JSON list, for scripts."""
    return json.dumps([row.model_dump(mode="json") for row in rows], indent=1)


def status_table(rows: Sequence[RobotStatus], title: str = "") -> Table:
    """All rows as a table for the terminal; a column of which nothing is known is left out where it is not needed."""
    cells = [cells_of(row) for row in rows]
    empty = {column for column in OPTIONAL if all(row[column] == "-" for row in cells)}
    table = Table(title=title or None, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for column in (column for column in cells_of(RobotStatus(robot="")) if column not in empty):
        table.add_column(column, justify="left" if column in LEFT else "right", no_wrap=column == "robot")
    for row in cells:
        table.add_row(*(cell for column, cell in row.items() if column not in empty))
    return table


def cells_of(row: RobotStatus) -> dict[str, str]:
    """One robot's cells by column."""
    return {
        "robot": row.robot,
        "state": row.state,
        "leader": row.leader or "-",
        "term": shown(row.term),
        "hears": " ".join(row.neighbours) or "-",
        "map frame": row.map_frame or "-",
        "keyframes": shown(row.keyframes),
        "closures": shown(row.closures),
        "to register": shown(row.candidates),
        "candidates": shown(row.found),
        "accepted": shown(row.accepted),
        "waiting": shown(sum(row.queues.values()) if row.queues else None),
        "lost %": f"{100 * max(row.loss.values()):.0f}" if row.loss else "-",
        "sent kB": kilobytes(row.sent_bytes),
        "received kB": kilobytes(row.received_bytes),
        "refused": shown(sum(row.refused.values()) or None),
        "camera": "; ".join(doubted(doubt) for doubt in row.camera) or "-",
    }


def doubted(doubt: CameraStatus) -> str:
    """A doubt in a word, with its figure where it has one, and whether it keeps the robot's keyframes out."""
    figure = AMOUNTS.get(doubt.doubt, "").format(doubt.amount, 100 * doubt.amount)
    return doubt.doubt + figure + " (kept out)" * doubt.withheld


AMOUNTS = {
    "focal length": " x{0:.2f}",
    "focal length and mounting": " x{0:.2f}",
    "mounting": " {0:.0f}\N{DEGREE SIGN}",
    "overlay": " {1:.0f} %",
    "frozen": " {0:.0f}",
    "standing": " {0:.0f}",
}


def shown(value: Any) -> str:
    """A value, or a dash where it is not known."""
    return "-" if value is None else str(value)


def kilobytes(count: int | None) -> str:
    """Bytes in thousands."""
    return "-" if count is None else f"{count / 1000:.1f}"
