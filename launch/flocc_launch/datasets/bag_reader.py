"""ROS 1 and ROS 2 bags (bag, db3, mcap) as a stream of messages, without a ROS installation, through `rosbags`.

A bag that was cut off in the middle is read as far as it goes; `Bag.damage` then says what is wrong with it.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from flocc_launch.datasets.source import DatasetError

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
Decoder = Callable[[bytes], Any]


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
    """Whether a path is a bag: a file by its suffix, or a folder with one inside."""
    return (path.suffix in BAG_SUFFIXES and path.is_file()) or (path.is_dir() and bool(_storages(path)))


def _storages(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix in (".db3", ".mcap"))


class Bag:
    """An open bag; a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[str, BagTopic] = {}
        self.damage: str | None = None
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self._stack = ExitStack()
        self._reader: Any = None
        self._salvage: Any = None
        self._known_errors: tuple[type[Exception], ...] = ()

    def __enter__(self) -> "Bag":
        try:
            from rosbags.highlevel import AnyReader, AnyReaderError
        except ImportError:
            raise DatasetError(f"{self.path}: bags are read with rosbags: pip install rosbags") from None
        if not self.path.exists():
            raise DatasetError(f"{self.path}: does not exist")
        self._known_errors = (AnyReaderError, *_storage_errors(), OSError, EOFError, AssertionError)
        path = self._storage()
        try:
            self._reader = self._stack.enter_context(AnyReader([path], default_typestore=_default_types()))
        except self._known_errors as error:
            self._open_damaged(path, str(error))
            return self
        self.topics = {
            name: BagTopic(name, info.msgtype or "?", info.msgcount) for name, info in self._reader.topics.items()
        }
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def ros1(self) -> bool:
        """Whether messages are in ROS 1's serialisation, not in CDR."""
        return self.path.suffix == ".bag"

    def messages(
        self, names: list[str], start_ns: int | None = None, decoders: Mapping[str, Decoder] | None = None
    ) -> Iterator[tuple[BagTopic, int, Any]]:
        """Yield topic, bag time in nanoseconds and message, in the bag's order.

        Args:
            names: Topics.
            start_ns: Leave out what the bag recorded before.
            decoders: By topic, what is called with raw bytes in place of rosbags' decoder.

        Raises:
            DatasetError: A message is not of the type that the bag says.
        """
        if self._reader is None:
            yield from self._salvaged(names, start_ns, decoders or {})
            return
        connections = [c for c in self._reader.connections if c.topic in names]
        stream = self._reader.messages(connections=connections, start=start_ns)
        while True:
            try:
                connection, stamp_ns, raw = next(stream)
            except StopIteration:
                return
            except self._known_errors as error:
                self.damage = f"{self.path}: is damaged or cut off: {error}"
                return
            topic = self.topics[connection.topic]
            decoder = decoders.get(topic.name) if decoders else None
            yield topic, stamp_ns, self.decoded(raw, topic) if decoder is None else decoder(raw)

    def decoded(self, raw: bytes, topic: BagTopic) -> Any:
        """Decode a message.

        Raises:
            DatasetError: The bytes are not of the topic's type.
        """
        decode = self._salvage.decode if self._reader is None else self._reader.deserialize
        try:
            return decode(raw, topic.type)
        except Exception as error:
            raise DatasetError(
                f"{self.path}: topic {topic.name}: a message cannot be read as {topic.type}; "
                f"the type may be of another ROS distribution ({type(error).__name__}: {error})"
            ) from error

    def _storage(self) -> Path:
        """What to open: a ROS 2 folder without its metadata (a recorder that was killed) is opened by its file."""
        if not self.path.is_dir() or (self.path / "metadata.yaml").exists():
            return self.path
        found = _storages(self.path)
        if not found:
            raise DatasetError(f"{self.path}: has no metadata.yaml and no db3 or mcap file")
        self.damage = None if len(found) == 1 else f"{self.path}: has no metadata.yaml; only {found[0].name} was read"
        return found[0]

    def _open_damaged(self, path: Path, reason: str) -> None:
        from flocc_launch.datasets.bag_salvage import Salvage

        file = path if path.is_file() else next(iter(_storages(path)), None)
        if file is None:
            raise DatasetError(f"{self.path}: cannot be opened: {reason}")
        self._salvage = Salvage(file)
        self.topics = {name: BagTopic(name, kind, None) for name, kind in self._salvage.topics().items()}
        if not self.topics:
            raise DatasetError(f"{self.path}: cannot be opened, and no message could be found in it: {reason}")
        self.damage = f"{self.path}: is damaged or cut off: {reason}"

    def _salvaged(
        self, names: list[str], start_ns: int | None, decoders: Mapping[str, Decoder]
    ) -> Iterator[tuple[BagTopic, int, Any]]:
        for name, stamp_ns, raw in self._salvage.messages(names):
            if start_ns is None or stamp_ns >= start_ns:
                topic, decoder = self.topics[name], decoders.get(name)
                yield topic, stamp_ns, self.decoded(raw, topic) if decoder is None else decoder(raw)


def _default_types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _storage_errors() -> tuple[type[Exception], ...]:
    import apsw
    from rosbags.rosbag1 import ReaderError as ReaderError1
    from rosbags.rosbag2 import ReaderError as ReaderError2

    return ReaderError1, ReaderError2, apsw.Error
