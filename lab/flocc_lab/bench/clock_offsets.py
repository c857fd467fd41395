"""How well an invented offset of clocks is found: `python -m flocc_lab.bench.clock_offsets FOLDER ...`."""

import json
import sys
from pathlib import Path

from flocc_launch.datasets.clocks import measured
from flocc_launch.datasets.detect import read_source
from flocc_protocol.errors import FloccError

OFFSET_S = -1000.0


def error_s(folder: Path) -> float | str:
    """How far the measured offset is from the invented one, or why it was not measured."""
    source = read_source(folder)
    trajectory = source.odometry or source.truth
    if trajectory is None or source.lens is None:
        return "no trajectory or no intrinsics"
    try:
        return measured(source.images, source.lens.camera, trajectory.later(OFFSET_S)).offset_s + OFFSET_S
    except FloccError as error:
        return str(error)


def main() -> None:
    """Print the error of each folder, seconds."""
    sys.stdout.write(json.dumps({name: error_s(Path(name)) for name in sys.argv[1:]}, indent=1) + "\n")


if __name__ == "__main__":
    main()
