"""`flocc status`: every robot of a swarm in one table, asked over zenoh as an operator, or read from a run folder.

Agents answer an operator's query; nothing is subscribed to, so a look costs one small message per robot.
"""

import asyncio
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError
from rich.box import SIMPLE_HEAD
from rich.table import Table

from flocc_agent.config import TransportConfig
from flocc_agent.runtime.status import MergeStatus
from flocc_launch.dashboard.page_source import RunSource
from flocc_launch.dashboard.snapshot import RobotView
from flocc_launch.runs.run_folder import RunFolder
from flocc_protocol.errors import FloccError

OPTIONAL = frozenset({"waiting", "lost %", "refused"})
LEFT = frozenset({"robot", "state", "leader", "map frame", "hears"})


class StatusError(FloccError):
    """Nobody answered; one sentence says who was asked."""


class RobotStatus(MergeStatus):
    """What one robot says of itself, or its events tell; what is not known is null."""

    robot: str
    state: str = "running"
    leader: str | None = None
    term: int | None = None
    neighbours: tuple[str, ...] = ()
    map_frame: str | None = None
    keyframes: int | None = None
    closures: int | None = None
    candidates: int | None = None
    sent_bytes: int | None = None
    received_bytes: int | None = None
    refused: dict[str, int] = Field(default_factory=dict)
    compute_class: int = 0
    logs: dict[str, tuple[int, int]] = Field(default_factory=dict)
    loss: dict[str, float] = Field(default_factory=dict)
    queues: dict[str, int] = Field(default_factory=dict)


def status_of_swarm(config: TransportConfig, swarm: str, timeout_s: float = 3.0) -> list[RobotStatus]:
    """Ask every agent of a swarm in reach.

    Args:
        config: How to reach the swarm: its roster, or scouting.
        swarm: Name of the swarm.
        timeout_s: Time for finding agents, and again for their answers.

    Returns:
        One status per robot that answered, sorted.

    Raises:
        StatusError: No agent answered.
        TransportError: The network cannot be used as configured.
    """
    from flocc_agent.runtime.zenoh_admin import ask
    from flocc_protocol.keys import Admin

    answers = asyncio.run(ask(config, swarm, Admin.STATUS, timeout_s=timeout_s))
    if not answers:
        where = f"{len(config.roster)} robots of the roster" if config.roster else "anybody that scouting finds"
        raise StatusError(f"swarm {swarm}: no agent answered within {timeout_s:g} s; asked {where}")
    return [status_from(robot, answers[robot]) for robot in sorted(answers)]


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
        closures=robot.accepted,
        candidates=robot.candidates,
        sent_bytes=robot.sent_bytes,
        received_bytes=robot.received_bytes,
        loss={peer: link.loss_ratio for peer, link in robot.links.items() if link.loss_ratio is not None},
        queues=dict(robot.queues),
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
        "candidates": shown(row.candidates),
        "waiting": shown(sum(row.queues.values()) if row.queues else None),
        "lost %": f"{100 * max(row.loss.values()):.0f}" if row.loss else "-",
        "sent kB": kilobytes(row.sent_bytes),
        "received kB": kilobytes(row.received_bytes),
        "refused": shown(sum(row.refused.values()) or None),
    }


def shown(value: Any) -> str:
    """A value, or a dash where it is not known."""
    return "-" if value is None else str(value)


def kilobytes(count: int | None) -> str:
    """Bytes in thousands."""
    return "-" if count is None else f"{count / 1000:.1f}"
