"""The live table of a launch: one line per robot, the newest notes below."""

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from flocc_launch.runs.plain_numbers import duration
from flocc_launch.swarm.launching import Watch
from flocc_launch.swarm.processes import AgentProcess

NOTES_MAX = 6
COLUMNS = (
    "robot",
    "state",
    "leader",
    "term",
    "neighbours",
    "keyframes",
    "closures",
    "to register",
    "map frame",
    "sent kB",
)


class LiveTable:
    """Shows a `Watch` in place on a terminal; on a pipe it prints a line now and then."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, refresh_per_second=4, transient=True)
        self._printed_s = 0.0

    def __enter__(self) -> "LiveTable":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._live.stop()

    def show(self, watch: Watch) -> None:
        """Show the newest state."""
        if self._console.is_terminal:
            self._live.update(Group(table_of(watch), Text("\n".join(watch.notes[-NOTES_MAX:]))))
        elif watch.elapsed_s >= self._printed_s:
            self._printed_s = watch.elapsed_s + PRINT_PERIOD_S
            self._console.print(line_of(watch), highlight=False, soft_wrap=True)


PRINT_PERIOD_S = 10.0


def table_of(watch: Watch) -> Table:
    """The table of one moment."""
    table = Table(title=f"{watch.scenario.name}   {duration(watch.elapsed_s)}", title_justify="left")
    for column in COLUMNS:
        table.add_column(column, justify="left" if column in ("robot", "state", "leader", "map frame") else "right")
    for agent in watch.agents:
        table.add_row(*cells_of(agent))
    return table


def cells_of(agent: AgentProcess) -> list[str]:
    """One robot's line."""
    status = agent.status
    if status is None:
        return [agent.name, state_of(agent), *[""] * (len(COLUMNS) - 2)]
    return [
        agent.name,
        state_of(agent),
        status.leader or "-",
        "-" if status.term is None else str(status.term),
        str(len(status.neighbours)),
        str(status.keyframes),
        str(status.closures),
        str(status.candidates),
        status.map_frame or "-",
        f"{status.sent_bytes / 1000:.0f}",
    ]


def state_of(agent: AgentProcess) -> str:
    """Whether an agent plays, works, waits or is gone."""
    if agent.process is None:
        return "not started"
    if agent.exit_code is not None:
        return "stopped" if agent.exit_code == 0 else "died"
    if agent.status is None:
        return "starting"
    if agent.status.playing:
        return "playing"
    return "working" if agent.status.busy else "idle"


def line_of(watch: Watch) -> str:
    """One line for logs."""
    parts = []
    for agent in watch.agents:
        said = agent.said
        counts = f"{said.keyframes} keyframes, {said.closures} closures, {said.map_frame or '-'}"
        parts.append(f"{agent.name} {state_of(agent)}: {counts}")
    return f"{duration(watch.elapsed_s):>10}  " + "; ".join(parts)
