"""Which closures of a component reach the solver, and what hangs together by those that are left (Sec. III-C)."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from flocc_agent.backend.consistency import inconsistent
from flocc_agent.backend.joining import too_few
from flocc_agent.backend.results import rejected
from flocc_agent.config import BackendConfig
from flocc_agent.core.pose_graph import ClosureResult, ClosureState, LoopClosure, Trajectory, components_of
from flocc_protocol.ids import LogId


@dataclass(frozen=True, slots=True)
class Filtered:
    """A component's closures, and those of them that are turned away so far.

    Attributes:
        trajectories: Odometry of its logs.
        closures: All of its closures, by their number in the graph.
        turned_away: Results of those that do not count any more.
        closures_min: How many closures join two maps.
        held: Closures that alarms hold: they count once the solution agrees with them.
    """

    trajectories: Mapping[LogId, Trajectory]
    closures: Mapping[int, LoopClosure]
    turned_away: Mapping[int, ClosureResult]
    closures_min: int
    held: Mapping[int, LoopClosure] = field(default_factory=dict)

    @property
    def left(self) -> dict[int, LoopClosure]:
        """Closures that still count."""
        return {k: c for k, c in self.closures.items() if k not in self.turned_away}

    @property
    def taking_part(self) -> dict[int, LoopClosure]:
        """Those, and the ones that are held."""
        return {**self.left, **self.held}

    @property
    def groups(self) -> tuple[tuple[LogId, ...], ...]:
        """Logs that the closures left connect."""
        return components_of(list(self.trajectories), list(self.left.values()))

    @property
    def is_connected(self) -> bool:
        """Whether they still connect all logs."""
        return len(self.groups) == 1

    def released(self, results: Mapping[int, ClosureResult]) -> "Filtered":
        """The same in which held closures that a solution uses are closures like others, and the rest are gone."""
        agreed = {k: c for k, c in self.held.items() if k in results and results[k].state is ClosureState.USED}
        return replace(self, closures={**self.closures, **agreed}, held={})

    def without(self, turned_away: Mapping[int, ClosureResult]) -> "Filtered":
        """The same without these closures, and without those that are then too few to join maps."""
        fewer = replace(self, turned_away={**self.turned_away, **turned_away})
        left, reason = fewer.left, f"fewer than {self.closures_min} closures join these maps"
        lonely = {k: rejected(left[k], reason) for k in too_few(list(self.trajectories), left, self.closures_min)}
        return replace(fewer, turned_away={**fewer.turned_away, **lonely})


def filtered(
    trajectories: Mapping[LogId, Trajectory],
    closures: Mapping[int, LoopClosure],
    held: Mapping[int, LoopClosure],
    config: BackendConfig,
) -> Filtered:
    """Turn away closures that contradict each other pairwise, where asked for, and those too few to join maps."""
    dropped = inconsistent(trajectories, closures, config) if config.pairwise_consistency else {}
    every = Filtered(trajectories, closures, {}, config.closures_to_join_min, held)
    return every.without({k: rejected(closures[k], reason) for k, reason in dropped.items()})
