"""ROS 1 and ROS 2 bags (bag, db3, mcap) as a stream of messages, without a ROS installation, through `rosbags`.

A bag that was cut off in the middle is read as far as it goes; `Bag.damage` then says what is wrong with it.
"""

import re
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

from flocc_launch.datasets.bag_salvage import Salvage, decompression_errors, mcap_encoding, mcap_is_whole
from flocc_launch.datasets.foxglove import FOREIGN, ROS_TYPES, ForeignMcap, as_ros, short_name
from flocc_launch.datasets.source import DatasetError

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
SALVAGE_ERRORS = (struct.error, ValueError, KeyError, IndexError, EOFError, OSError, RuntimeError, sqlite3.Error)
"""What bytes that are no bag make of those who read them."""
UNENDED = "it does not end as an MCAP ends"
PARTS_GAP_MAX_S = 60.0
"""Parts of one ROS 1 recording follow each other; bags of several robots overlap, or are of other days."""


@dataclass(frozen=True, slots=True)
class BagTopic:
    """A topic of a bag.

    Attributes:
        name: As published.
        type: Message type in ROS 2's form, `sensor_msgs/msg/Image`.
        count: Messages, or None where a damaged bag does not say.
    """

    name: str
    type: str
    count: int | None

    def __str__(self) -> str:
        return f"{self.name} ({self.type}, {'?' if self.count is None else self.count} messages)"


def is_bag(path: Path) -> bool:
    """Whether a path is one bag: a file by its suffix, or a folder with one inside, also in parts."""
    if path.is_file():
        return path.suffix in BAG_SUFFIXES
    return path.is_dir() and (_is_rosbag2(path) or _is_one_bag(_storages(path)) or bool(ros1_parts(path)))


def _is_one_bag(storages: list[Path]) -> bool:
    """Whether files are parts of one bag, as rosbag2 names them: `run_0.db3`, `run_1.db3`."""
    return len({re.sub(r"_\d+$", "", file.stem) for file in storages}) == 1


def _is_rosbag2(folder: Path) -> bool:
    metadata = folder / "metadata.yaml"
    try:
        return metadata.is_file() and b"rosbag2_bagfile_information" in metadata.read_bytes()[:4096]
    except OSError:
        return False


def _storages(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix in (".db3", ".mcap"))


def ros1_parts(folder: Path) -> list[Path]:
    """The ROS 1 bags of a folder in order, where they are one recording: a single one, or parts that follow each other.

    `rosbag record --split` names them STEM_DATE_0.bag, STEM_DATE_1.bag ...
    """
    entries = [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    files = [file for file in entries if file.suffix == ".bag" and file.is_file()]
    if len(files) < 2:
        return [] if any(entry.is_dir() for entry in entries) else files
    found = [re.fullmatch(r"(.*?)(?:_?\d{4}(?:-\d\d){5})?_(\d+)", file.stem) for file in files]
    if not all(found) or len({match[1] for match in found if match}) > 1:
        return []
    files = [
        file for _, file in sorted((int(match[2]), file) for match, file in zip(found, files, strict=True) if match)
    ]
    spans = [_span_s(file) for file in files]
    follow = all(
        before is not None and after is not None and -0.5 <= after[0] - before[1] <= PARTS_GAP_MAX_S
        for before, after in pairwise(spans)
    )
    return files if follow else []


def _span_s(file: Path) -> tuple[float, float] | None:
    """First and last time of a ROS 1 bag, or None where it cannot be opened."""
    try:
        from rosbags.rosbag1 import Reader, ReaderError
    except ImportError:
        return None
    try:
        with Reader(file) as reader:
            return reader.start_time * 1e-9, reader.end_time * 1e-9
    except (ReaderError, OSError, AssertionError, EOFError, ValueError):
        return None


class Bag:
    """An open bag; a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[str, BagTopic] = {}
        self.damage: str | None = None
        self.gap: str | None = None
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self._stack = ExitStack()
        self._reader: Any = None
        self._salvage: Any = None
        self._known_errors: tuple[type[Exception], ...] = ()
        self._ros1 = path.suffix == ".bag" and not path.is_dir()
        self._is_foreign = False
        self._foxglove: dict[str, str] = {}

    def __enter__(self) -> "Bag":
        try:
            from rosbags.highlevel import AnyReader, AnyReaderError
        except ImportError:
            raise DatasetError(f"{self.path}: bags are read with rosbags: pip install rosbags") from None
        if not self.path.exists():
            raise DatasetError(f"{self.path}: does not exist")
        self._known_errors = (AnyReaderError, *_storage_errors(), OSError, EOFError, AssertionError)
        paths = self._paths()
        try:
            self._reader = self._stack.enter_context(AnyReader(paths, default_typestore=_default_types()))
        except self._known_errors as error:
            self._open_damaged(paths[0], " ".join(str(error).split()))
            return self
        self.topics = {
            name: BagTopic(name, info.msgtype or "?", info.msgcount) for name, info in self._reader.topics.items()
        }
        for name, topic in self.topics.items():
            if (short := short_name(topic.type)) is not None:
                self._foxglove[name] = topic.type
                self.topics[name] = BagTopic(name, ROS_TYPES[short], topic.count)
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def ros1(self) -> bool:
        """Whether messages are in ROS 1's serialisation, not in CDR."""
        return self._ros1

    def raw(self, names: Sequence[str], start_ns: int | None = None) -> Iterator[tuple[BagTopic, int, bytes]]:
        """Yield topic, bag time in nanoseconds and the undecoded message, in the bag's order.

        Args:
            names: Topics.
            start_ns: Leave out what the bag recorded before.
        """
        if self._reader is None:
            yield from self._salvaged(names, start_ns)
            return
        connections = [c for c in self._reader.connections if c.topic in names]
        if not connections:
            return
        stream = self._reader.messages(connections=connections, start=start_ns)
        topics, last_ns = self.topics, start_ns or 0
        damage: tuple[type[Exception], ...] = (*self._known_errors, *decompression_errors(), LookupError)
        while True:
            try:
                connection, stamp_ns, message = next(stream)
            except StopIteration:
                return
            except damage as error:
                said = " ".join(str(error).split())
                break
            yield topics[connection.topic], stamp_ns, message
            last_ns = max(last_ns, stamp_ns)
        storage = self._only_mcap()
        if storage is None:
            self.damage = f"{self.path}: is damaged or cut off: {said}"
            return
        self.gap = f"{self.path}: is damaged behind {last_ns * 1e-9:.3f} s, and what is whole was read: {said}"
        try:
            for name, stamp_ns, message in Salvage(storage, self._ros1).messages(list(names)):
                if stamp_ns > last_ns:
                    yield topics[name], stamp_ns, message
        except SALVAGE_ERRORS as error:
            self.damage = f"{self.path}: is damaged or cut off: {error}"

    def _only_mcap(self) -> Path | None:
        """The one file of an MCAP bag, which can be read without its index; None where it is another kind."""
        files = _storages(self.path) if self.path.is_dir() else [self.path]
        return files[0] if len(files) == 1 and files[0].suffix == ".mcap" else None

    def _salvaged(self, names: Sequence[str], start_ns: int | None) -> Iterator[tuple[BagTopic, int, bytes]]:
        try:
            for name, stamp_ns, message in self._salvage.messages(list(names)):
                if start_ns is None or stamp_ns >= start_ns:
                    yield self.topics[name], stamp_ns, message
        except SALVAGE_ERRORS as error:
            self.damage = f"{self.path}: is damaged or cut off: {error}"

    def first(self, name: str) -> tuple[int, Any] | None:
        """Bag time and content of a topic's first message that can be decoded, or None."""
        return next(self.firsts(name), None)

    def firsts(self, name: str, tries: int = 20) -> Iterator[tuple[int, Any]]:
        """Bag time and content of those of a topic's first messages that can be decoded."""
        for topic, stamp_ns, message in islice(self.raw([name]), tries):
            try:
                yield stamp_ns, self.decoded(message, topic)
            except DatasetError:
                continue

    def decoded(self, raw: bytes, topic: BagTopic) -> Any:
        """Decode a message.

        Raises:
            DatasetError: The bytes are not of the topic's type.
        """
        try:
            if self._is_foreign:
                return self._salvage.decode(raw, topic.name)
            decode = self._salvage.decode if self._reader is None else self._reader.deserialize
            foxglove = self._foxglove.get(topic.name)
            if foxglove is None:
                return decode(raw, topic.type)
            return as_ros(short_name(foxglove) or "", decode(raw, foxglove))
        except Exception as error:
            raise DatasetError(
                f"{self.path}: topic {topic.name}: a message cannot be read as {topic.type}; "
                f"the type may be of another ROS distribution ({type(error).__name__}: {error})"
            ) from error

    def _paths(self) -> list[Path]:
        """What to open: a ROS 2 folder without its metadata (a recorder that was killed) is opened by its file."""
        if not self.path.is_dir():
            return [self.path]
        if (self.path / "metadata.yaml").exists():
            return [self._not_named_as_ros1()]
        parts = ros1_parts(self.path)
        if parts:
            self._ros1 = True
            return parts
        found = _storages(self.path)
        if not found:
            raise DatasetError(f"{self.path}: has no metadata.yaml and no db3 or mcap file")
        self.damage = None if len(found) == 1 else f"{self.path}: has no metadata.yaml; only {found[0].name} was read"
        return [found[0]]

    def _not_named_as_ros1(self) -> Path:
        """The folder under another name where it is called `run.bag`: rosbags takes that for a file of ROS 1."""
        if self.path.suffix != ".bag":
            return self.path
        link = Path(self._stack.enter_context(TemporaryDirectory())) / "bag"
        link.symlink_to(self.path.resolve())
        return link

    def _open_damaged(self, path: Path, reason: str) -> None:
        file = path if path.is_file() else next(iter(_storages(path)), None)
        if file is None:
            raise DatasetError(f"{self.path}: cannot be opened: {reason}")
        try:
            encoding = mcap_encoding(file) if file.suffix == ".mcap" else ""
        except SALVAGE_ERRORS:
            encoding = ""
        if encoding in FOREIGN:
            self._open_foreign(file)
            return
        is_mcap_of_ros1 = encoding == "ros1"
        self._ros1 = self._ros1 or is_mcap_of_ros1
        self._salvage = Salvage(file, self._ros1)
        try:
            self.topics = {name: BagTopic(name, kind, None) for name, kind in self._salvage.topics().items()}
        except SALVAGE_ERRORS as error:
            raise DatasetError(f"{self.path}: cannot be opened: {reason}") from error
        if not self.topics:
            reason = UNENDED if file.suffix == ".mcap" and not mcap_is_whole(file) else reason
            raise DatasetError(f"{self.path}: cannot be opened, and no message could be found in it: {reason}")
        if not (is_mcap_of_ros1 and mcap_is_whole(file)):
            self.damage = f"{self.path}: is damaged or cut off: {reason}"

    def _open_foreign(self, file: Path) -> None:
        """Open an MCAP file of protobuf or JSON, of which Foxglove's messages are read."""
        self._salvage, self._is_foreign = ForeignMcap(file), True
        try:
            self.topics = {name: BagTopic(name, kind, None) for name, kind in self._salvage.topics().items()}
        except ValueError as error:
            raise DatasetError(f"{self.path}: is an MCAP of protobuf messages, not of ROS: {error}") from error
        if not any(topic.type in ROS_TYPES.values() for topic in self.topics.values()):
            listed = ", ".join(f"{topic.name} ({topic.type})" for topic in self.topics.values())
            raise DatasetError(
                f"{self.path}: is an MCAP of {' and '.join(self._salvage.encodings)} messages, not of ROS; flocc reads "
                f"Foxglove's {', '.join(ROS_TYPES)}, and it has {listed}"
            )
        if not mcap_is_whole(file):
            self.damage = f"{self.path}: is damaged or cut off: {UNENDED}"


def _default_types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _storage_errors() -> tuple[type[Exception], ...]:
    import apsw
    from rosbags.rosbag1 import ReaderError as ReaderError1
    from rosbags.rosbag2 import ReaderError as ReaderError2

    return ReaderError1, ReaderError2, apsw.Error
