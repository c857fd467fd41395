"""A folder or a bag of the user's own in place of a scenario file: which robots are in it, and how it is run.

One data set is cut by time into robots; a folder of several is a robot each. What was chosen is said in a sentence.
"""

import statistics
from dataclasses import dataclass, replace
from pathlib import Path

from flocc_launch.datasets.bag_convert import robots_of_bag
from flocc_launch.datasets.bag_reader import is_bag
from flocc_launch.datasets.commands import needed_drift
from flocc_launch.datasets.detect import detect_format, is_dataset, not_taken, read_source, team_folder
from flocc_launch.datasets.drift import kind_of
from flocc_launch.datasets.names import robot_name as name_of
from flocc_launch.datasets.source import DatasetError, Source
from flocc_launch.datasets.video import is_video
from flocc_launch.runs.plain_numbers import duration

ROBOTS = 3
ROBOTS_MAX = 16
KEYFRAMES_WANTED = 25
DISTANCE_MIN_M, DISTANCE_MAX_M = 0.05, 0.5
ROTATION_NEAR_RAD = 0.17


def is_own_data(path: Path) -> bool:
    """Whether a path is data rather than a scenario file."""
    return path.is_dir() or is_bag(path) or is_video(path)


@dataclass(frozen=True, slots=True)
class OwnData:
    """What was found.

    Attributes:
        path: Where the user said that the data is.
        folders: One data set or bag, or one of each robot by its name.
        sources: Those of `folders` that are no bags, read.
        parts: Into how many robots one data set is cut; 1 where every folder is a robot.
        left: What of a team's folder is not taken.
    """

    path: Path
    folders: dict[str, Path]
    sources: dict[str, Source]
    parts: int
    left: tuple[str, ...] = ()

    @classmethod
    def open(cls, path: Path, agents: int | None = None) -> "OwnData":
        """Look at a data set, a bag, or a folder of one per robot.

        Args:
            path: Where the data is.
            agents: Into how many robots one data set is cut; None means three.

        Raises:
            DatasetError: There is no data set, one of them cannot be used, or there are not `agents` of them.
        """
        single = is_bag(path) or is_dataset(path) or is_video(path)
        folders = _single(path) if single else _team(path)
        if not single and len(folders) == 1:
            return replace(cls.open(next(iter(folders.values())), agents), left=tuple(not_taken(path, folders)))
        single = single and len(folders) == 1
        if not single and agents not in (None, len(folders)):
            raise DatasetError(f"{path}: holds {len(folders)} robots ({', '.join(folders)}), not {agents}")
        sources = {name: read_source(folder) for name, folder in folders.items() if is_dataset(folder)}
        left = () if path in folders.values() else tuple(not_taken(path, folders))
        return cls(path, folders, sources, (agents or ROBOTS) if single else 1, left)

    @property
    def single(self) -> bool:
        """Whether it is one data set, to be cut."""
        return list(self.folders.values()) == [self.path]

    def fields(self) -> dict[str, object]:
        """Fields of a scenario that runs it."""
        fields: dict[str, object] = {"name": robot_name(self.path)}
        if self.single:
            fields["dataset"] = {"source": str(self.path.resolve()), "robots": self.parts}
        else:
            starts_s = self._starts_s()
            fields["robots"] = {
                name: {"recording": str(folder.resolve()), "start_s": starts_s.get(name, 0.0)}
                for name, folder in self.folders.items()
            }
        near_m = self._near_m()
        near = {} if near_m is None else {"keyframes": {"distance_m": near_m, "rotation_rad": ROTATION_NEAR_RAD}}
        return {**fields, **near}

    def sentence(self) -> str:
        """What was made of it, for whoever gave it without a scenario."""
        taken = f"cut by time into {self.parts} robots" if self.single else f"robots {', '.join(self.folders)}"
        near_m = self._near_m()
        spacing = "" if near_m is None else f"; a keyframe every {near_m:g} m, because robots move little"
        made = [name for name, source in self.sources.items() if needed_drift(source) is not None]
        kinds = sorted(
            {kind_of(self.sources[name].format, truth) for name in made if (truth := self.sources[name].truth)}
        )
        drift = f"; odometry is made of ground truth, with seeded drift as of {' and '.join(kinds)}" if made else ""
        return f"data: {self.path}, {taken}{self._moved()}{spacing}{drift}{self._not_taken()}{self._pairs()}"

    def _moved(self) -> str:
        """That recordings of different times are played as if they began together, and which began last."""
        first_s = self._first_s()
        if len(first_s) < 2 or self._starts_s():
            return ""
        last, apart_s = max(first_s, key=lambda name: first_s[name]), max(first_s.values()) - min(first_s.values())
        return (
            f"; {last} was recorded {duration(apart_s)} after the first, but they are played as if they began together"
        )

    def _not_taken(self) -> str:
        return f"; not taken: {', '.join(self.left[:12])}" if self.left else ""

    def _pairs(self) -> str:
        """How topics of a bag of several robots belong together."""
        shared = is_bag(self.path) and not self.single
        return "".join(f"\n  {robot}" for robot in robots_of_bag(self.path)) if shared else ""

    def _near_m(self) -> float | None:
        """Distance of keyframes where robots move so little that the usual one gives too few; by the median path."""
        moved = [source.odometry or source.truth for source in self.sources.values()]
        lengths_m = [trajectory.length_m() / self.parts for trajectory in moved if trajectory is not None]
        distance_m = statistics.median(lengths_m) / KEYFRAMES_WANTED if lengths_m else DISTANCE_MAX_M
        return max(round(distance_m, 3), DISTANCE_MIN_M) if distance_m < DISTANCE_MAX_M else None

    def _first_s(self) -> dict[str, float]:
        """Stamp of each robot's first image."""
        return {name: source.images[0][0] for name, source in self.sources.items()}

    def _starts_s(self) -> dict[str, float]:
        """When each robot begins, where all recorded at the same time; recordings of different times begin together."""
        first_s = self._first_s()
        last_s = [source.images[-1][0] for source in self.sources.values()]
        together = bool(first_s) and max(first_s.values()) < min(last_s)
        zero_s = min(first_s.values(), default=0.0)
        return {name: round(stamp_s - zero_s, 3) for name, stamp_s in first_s.items()} if together else {}


def robot_name(path: Path) -> str:
    """A name that keys can hold, made of a folder's or a file's."""
    return name_of(path.resolve().stem if path.is_file() else path.resolve().name)


def _single(path: Path) -> dict[str, Path]:
    """One data set, or the robots of a bag, each of which is found in it by its name."""
    robots = robots_of_bag(path) if is_bag(path) else []
    return {name_of(robot.name): path for robot in robots} if len(robots) > 1 else {robot_name(path): path}


def _team(path: Path) -> dict[str, Path]:
    """Data sets, bags and videos in a folder, by the robot's name."""
    found = team_folder(path)
    if not found:
        detect_format(path)  # says what a data set is
    if len(found) > ROBOTS_MAX:
        raise DatasetError(f"{path}: holds {len(found)} data sets; at most {ROBOTS_MAX} robots run on one machine")
    return found
