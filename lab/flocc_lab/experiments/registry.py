"""All experiments by name."""

from typing import Any

from flocc_lab.experiments.bandwidth import BANDWIDTH
from flocc_lab.experiments.candidate_orders import CANDIDATE_ORDER
from flocc_lab.experiments.distributed import DISTRIBUTED
from flocc_lab.experiments.experiment import Experiment, ExperimentError
from flocc_lab.experiments.faults import FAULTS
from flocc_lab.experiments.full_system import FULL_SYSTEM
from flocc_lab.experiments.registration_quality import REGISTRATION
from flocc_lab.experiments.scale import SCALE
from flocc_lab.experiments.sparse_keyframes import SPARSE_KEYFRAMES
from flocc_lab.experiments.split_compute import SPLIT_COMPUTE
from flocc_lab.experiments.team_size import TEAM_SIZE

ALL: tuple[Experiment[Any], ...] = (
    FULL_SYSTEM,
    REGISTRATION,
    SCALE,
    SPLIT_COMPUTE,
    SPARSE_KEYFRAMES,
    FAULTS,
    BANDWIDTH,
    CANDIDATE_ORDER,
    DISTRIBUTED,
    TEAM_SIZE,
)


def names() -> list[str]:
    """Names of all experiments, in the order of the paper."""
    return [experiment.name for experiment in ALL]


def find(name: str) -> Experiment[Any]:
    """An experiment by its name.

    Raises:
        ExperimentError: There is none of that name.
    """
    found = next((experiment for experiment in ALL if experiment.name == name), None)
    if found is None:
        raise ExperimentError(f"there is no experiment {name!r}; there are {', '.join(names())}")
    return found
