"""A team in a saved map, as `flocc launch` and `flocc simulate` begin it."""

from dataclasses import dataclass
from pathlib import Path

from flocc_agent.config import BackendMode
from flocc_agent.config.agent_config import NO_MAPS
from flocc_agent.core.interfaces import Perception
from flocc_agent.perception.backends import build_perception
from flocc_agent.runtime.map_folder import BadMap, MapFolder
from flocc_launch.scenarios.scenario import Scenario


@dataclass(frozen=True, slots=True)
class MapUse:
    """The map in which robots are to find themselves.

    Attributes:
        folder: Where it is.
        fixed: It does not move.
    """

    folder: Path
    fixed: bool = False

    def checked(self, scenario: Scenario) -> dict[str, int]:
        """The incarnation with which each robot begins: a log that the map does not hold.

        A robot that is in the map under its name goes on as a new journey of that name.

        Raises:
            BadMap: It is no map, or the scenario's back end or front end cannot work in it.
        """
        opened = MapFolder.open(self.folder)
        opened.check_whole()
        if scenario.backend.mode is BackendMode.DISTRIBUTED:
            raise BadMap(f"{self.folder}: {NO_MAPS}")
        if scenario.simulation.optimiser == "quick":
            raise BadMap(f"{self.folder}: simulation.optimiser = 'quick' knows no maps")
        made = opened.manifest.front_end.method
        if made is not None and made != scenario.perception.method:
            raise BadMap(
                f"{self.folder}: was made with perception.method {made!r}, and {scenario.name} has "
                f"{scenario.perception.method!r}"
            )
        held = opened.closed()
        return {
            name: max((log.incarnation + 1 for log in held if log.robot == name), default=0)
            for name in scenario.names()
        }

    def check_fully(self, scenario: Scenario) -> None:
        """Whether the scenario's robots can work in it, their front end's own latents included.

        Raises:
            BadMap: They cannot.
            FloccError: There is no such front end here.
        """
        self.checked(scenario)
        opened_for(self, scenario, build_perception(scenario.perception, scenario.seed))

    def settings(self) -> dict[str, object]:
        """What a run folder says of it."""
        return {"map": str(self.folder.resolve()), "map_fixed": self.fixed}


def opened_for(use: MapUse, scenario: Scenario, perception: Perception) -> MapFolder:
    """The map, for robots with this front end.

    Raises:
        BadMap: Its latents are of another one, or its logs are signed.
    """
    opened = MapFolder.open(use.folder)
    opened.check_front_end(scenario.perception.method, perception.encoder.model)
    opened.check_keys(None)
    return opened
