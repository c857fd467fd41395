"""Reads damaged bags from the front until they end, without the index that a recorder writes last.

A message is passed on only when it is whole; of a chunk that is cut, the part before the cut counts. Formats: ROS 1
bag 2.0, MCAP, and rosbag2's SQLite tables.
"""

import bz2
import os
import shutil
import sqlite3
import struct
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

Record = tuple[str, str, str, int, bytes]
"""Topic, message type (ROS 2's form), message definition or "", bag time in nanoseconds, raw message."""

ROS1_MAGIC = b"#ROSBAG V2.0\n"
MCAP_MAGIC = b"\x89MCAP0\r\n"
MCAP_CHUNK = 0x06
RECORD_BYTES_MAX = 1 << 32
"""A record that says to be longer is damaged."""


class Salvage:
    """A damaged bag's messages, and a decoder for them."""

    def __init__(self, path: Path, ros1: bool) -> None:
        self._path = path
        self._ros1 = ros1
        self._types: Any = None

    def topics(self) -> dict[str, str]:
        """Topics with their types, of everything that is whole."""
        found: dict[str, str] = {}
        definitions: dict[str, str] = {}
        for topic, kind, definition, _, _ in self._records():
            found.setdefault(topic, kind)
            definitions.setdefault(kind, definition)
        self._types = _types(definitions)
        return dict(sorted(found.items()))

    def messages(self, names: list[str]) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, bag time and raw message."""
        for topic, _, _, stamp_ns, raw in self._records():
            if topic in names:
                yield topic, stamp_ns, raw

    def decode(self, raw: bytes, kind: str) -> Any:
        """Decode a raw message."""
        return self._types.deserialize_ros1(raw, kind) if self._ros1 else self._types.deserialize_cdr(raw, kind)

    def _records(self) -> Iterator[Record]:
        readers = {".bag": _ros1_records, ".mcap": _mcap_records, ".db3": _sqlite_records}
        return readers[self._path.suffix](self._path)


def _types(definitions: dict[str, str]) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    described = {kind: text for kind, text in definitions.items() if text}
    if not described:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.EMPTY)
    for kind, text in described.items():
        store.register(get_types_from_msg(text, kind))
    return store


def _ros1_records(path: Path) -> Iterator[Record]:
    connections: dict[int, tuple[str, str, str]] = {}
    with path.open("rb") as file:
        if file.read(len(ROS1_MAGIC)) != ROS1_MAGIC:
            return
        while (record := _ros1_record(file.read)) is not None:
            header, data = record
            if header.get("op") == b"\x05":
                data = _decompressed(header.get("compression", b"none").decode(), data)
                yield from _ros1_chunk(data, connections)
            else:
                yield from _ros1_message(header, data, connections)


def _ros1_record(read: Any) -> tuple[dict[str, bytes], bytes] | None:
    """One record's header and data, or None where the file ends before it does; a chunk may be cut."""
    header = _sized(read)
    if header is None:
        return None
    fields = _ros1_fields(header[1])
    data = _sized(read)
    whole = data is not None and len(data[1]) == data[0]
    return (fields, data[1]) if data is not None and (whole or fields.get("op") == b"\x05") else None


def _sized(read: Any) -> tuple[int, bytes] | None:
    """A length and as many bytes as there are of it."""
    size = read(4)
    if len(size) < 4:
        return None
    length = struct.unpack("<I", size)[0]
    return length, read(length)


def _ros1_fields(header: bytes) -> dict[str, bytes]:
    fields, at = {}, 0
    while at + 4 <= len(header):
        length = struct.unpack_from("<I", header, at)[0]
        name, _, value = header[at + 4 : at + 4 + length].partition(b"=")
        fields[name.decode(errors="replace")] = value
        at += 4 + length
    return fields


def _ros1_chunk(data: bytes, connections: dict[int, tuple[str, str, str]]) -> Iterator[Record]:
    inner = BytesIO(data)
    while (record := _ros1_record(inner.read)) is not None:
        yield from _ros1_message(*record, connections)


def _ros1_message(
    header: dict[str, bytes], data: bytes, connections: dict[int, tuple[str, str, str]]
) -> Iterator[Record]:
    operation = header.get("op")
    if operation == b"\x07":
        fields = _ros1_fields(data)
        definition = fields["message_definition"].decode(errors="replace")
        connections[struct.unpack("<I", header["conn"])[0]] = (
            header["topic"].decode(),
            _ros2_name(fields["type"].decode()),
            definition,
        )
    elif operation == b"\x02":
        connection = connections.get(struct.unpack("<I", header["conn"])[0])
        seconds, nanoseconds = struct.unpack("<II", header["time"])
        if connection is not None:
            yield (*connection, seconds * 10**9 + nanoseconds, data)


def _ros2_name(kind: str) -> str:
    """A message type as ROS 2 calls it: `sensor_msgs/msg/Image` of `sensor_msgs/Image`."""
    return kind if "/msg/" in kind else kind.replace("/", "/msg/")


@dataclass(frozen=True, slots=True)
class McapMessage:
    """A message of an MCAP file with what its channel and schema say."""

    topic: str
    schema: str
    schema_encoding: str
    schema_data: bytes
    encoding: str
    log_ns: int
    data: bytes


def mcap_messages(path: Path) -> Iterator[McapMessage]:
    """Yield the messages of an MCAP file from its front, as far as they are whole."""
    schemas: dict[int, tuple[str, str, bytes]] = {0: ("", "", b"")}
    channels: dict[int, tuple[int, str, str]] = {}
    with path.open("rb") as file:
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            return
        while (record := _mcap_record(file.read)) is not None:
            yield from _messages_of(*record, schemas, channels)


def mcap_encoding(path: Path) -> str:
    """How an MCAP file's first message is encoded: cdr, ros1, protobuf, json ...; "" where it has none."""
    first = next(mcap_messages(path), None)
    return first.encoding if first is not None else ""


def mcap_is_whole(path: Path) -> bool:
    """Whether an MCAP file ends as its recorder ends it."""
    with path.open("rb") as file:
        file.seek(-min(len(MCAP_MAGIC), path.stat().st_size), os.SEEK_END)
        return file.read() == MCAP_MAGIC


def _mcap_records(path: Path) -> Iterator[Record]:
    for message in mcap_messages(path):
        is_ros = message.schema_encoding in ("ros1msg", "ros2msg")
        described = message.schema_data.decode(errors="replace") if is_ros else ""
        yield message.topic, _ros2_name(message.schema), described, message.log_ns, message.data


def _mcap_record(read: Any) -> tuple[int, bytes] | None:
    head = read(9)
    if len(head) < 9:
        return None
    operation, length = struct.unpack("<BQ", head)
    if length > RECORD_BYTES_MAX:
        return None
    body = read(length)
    return (operation, body) if len(body) == length or (operation == MCAP_CHUNK and len(body) > 64) else None


def _messages_of(
    operation: int,
    body: bytes,
    schemas: dict[int, tuple[str, str, bytes]],
    channels: dict[int, tuple[int, str, str]],
) -> Iterator[McapMessage]:
    if operation == 0x03:
        name, at = _mcap_bytes(body, 2)
        encoding, at = _mcap_bytes(body, at)
        data, _ = _mcap_bytes(body, at)
        schemas[struct.unpack_from("<H", body)[0]] = (name.decode(errors="replace"), encoding.decode(), data)
    elif operation == 0x04:
        channel, schema = struct.unpack_from("<HH", body)
        topic, at = _mcap_bytes(body, 4)
        encoding, _ = _mcap_bytes(body, at)
        channels[channel] = (schema, topic.decode(errors="replace"), encoding.decode())
    elif operation == 0x05:
        channel, _, stamp_ns = struct.unpack_from("<HIQ", body)
        if channel in channels:
            schema, topic_name, coding = channels[channel]
            if schema in schemas:
                yield McapMessage(topic_name, *schemas[schema], coding, stamp_ns, body[22:])
    elif operation == MCAP_CHUNK:
        length = struct.unpack_from("<I", body, 28)[0]
        compression = body[32 : 32 + length].decode()
        size = struct.unpack_from("<Q", body, 32 + length)[0]
        try:
            inner = BytesIO(_decompressed(compression or "none", body[40 + length : 40 + length + size]))
        except decompression_errors():
            return  # a chunk that is damaged costs itself
        try:
            while (record := _mcap_record(inner.read)) is not None:
                yield from _messages_of(*record, schemas, channels)
        except (struct.error, UnicodeDecodeError):
            return


def _mcap_bytes(body: bytes, at: int) -> tuple[bytes, int]:
    """A part with its length before it, and where the next one begins."""
    length = struct.unpack_from("<I", body, at)[0]
    return body[at + 4 : at + 4 + length], at + 4 + length


def _sqlite_records(path: Path) -> Iterator[Record]:
    """Rows of rosbag2's tables, from a copy that is filled up to its length: SQLite opens no file that is too short."""
    with TemporaryDirectory(prefix="flocc-bag-") as folder:
        copy = Path(shutil.copy(path, folder))
        with copy.open("rb") as file:
            header = file.read(32)
        page, pages = struct.unpack_from(">H", header, 16)[0], struct.unpack_from(">I", header, 28)[0]
        os.truncate(copy, max((65536 if page == 1 else page) * pages, copy.stat().st_size))
        database = sqlite3.connect(copy)
        try:
            topics = {row[0]: (row[1], row[2]) for row in database.execute("SELECT id, name, type FROM topics")}
            for topic, stamp_ns, raw in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
                if topic in topics and raw:
                    yield (*topics[topic], "", stamp_ns, raw)
        except sqlite3.DatabaseError:
            return
        finally:
            database.close()


def decompression_errors() -> tuple[type[Exception], ...]:
    """What bytes raise that are none of what they are said to be."""
    errors: tuple[type[Exception], ...] = (ValueError, RuntimeError, EOFError, OSError, OverflowError, struct.error)
    try:
        zstd: Any = import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
    except ImportError:
        return errors
    return (*errors, zstd.ZstdError)


def _decompressed(compression: str, data: bytes) -> bytes:
    """As much as can be decompressed of data that may be cut."""
    if compression == "bz2":
        return bz2.BZ2Decompressor().decompress(data)
    if compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data))
    if compression == "zstd":
        module = import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
        return bytes(module.ZstdDecompressor().decompress(data))
    return data
