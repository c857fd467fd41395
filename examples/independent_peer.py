"""A member of the swarm that is not flocc: written from protocol/README.md alone, with zenoh, msgpack and numpy.

    python examples/independent_peer.py --connect tcp/127.0.0.1:7447 --sees r1

It drives straight on without a camera, sees another robot 2 m ahead now and then, and writes both into its log.
It exchanges logs, follows the leader that it hears of, and prints what the leader says of every robot. A start for
peers in other languages; it is no candidate for leadership, has no disk and no keys.
"""

import argparse
import json
import struct
import threading
import time
import zlib
from hashlib import blake2b
from typing import Any

import msgpack
import numpy as np
import zenoh

VERSION = 5
HEARTBEAT_S = 0.5
BATCH_RECORDS = 30
Log = tuple[str, int]


def array(values: Any, dtype: str) -> list[Any]:
    """The wire's array: type, shape, bytes, scale."""
    numbers = np.asarray(values, dtype=f"<{dtype}")
    return [dtype, list(numbers.shape), numbers.tobytes(), 1.0]


def pose(x: float, y: float, z: float) -> bytes:
    """The wire's pose: position in metres, quaternion with its real part first."""
    return struct.pack("<7d", x, y, z, 1.0, 0.0, 0.0, 0.0)


def covariance(rotation_sigma_rad: float, translation_sigma_m: float) -> list[Any]:
    """The upper triangle of a diagonal covariance, rotation first."""
    S = np.diag([rotation_sigma_rad**2] * 3 + [translation_sigma_m**2] * 3)
    return array(S[np.triu_indices(6)], "f8")


def checksum(records: list[bytes]) -> int:
    """Chained CRC-32 of records."""
    value = 0
    for record in records:
        value = zlib.crc32(record, value)
    return value


def table_hash(entries: list[Any]) -> int:
    """Exclusive or of the entries' hashes: BLAKE2b with a digest of 7 bytes."""
    value = 0
    for entry in entries:
        value ^= int.from_bytes(blake2b(msgpack.packb(entry), digest_size=7).digest(), "big")
    return value


class Peer:
    """One robot's side of the wire; zenoh calls `hear` on a thread of its own."""

    def __init__(self, session: zenoh.Session, swarm: str, name: str) -> None:
        self.log: Log = (name, int(time.time()))
        self.logs: dict[Log, list[bytes]] = {self.log: []}
        self.corrections: dict[Log, list[Any]] = {}
        self.leader: list[Any] | None = None
        self._counter_max = self._sequence = 0
        self._changes = [1, 1]  # of the table of logs, and of that of corrections
        self._lock = threading.RLock()
        self._session, self._key = session, f"flocc/v2/{swarm}/{name}"
        keys = (f"flocc/v2/{swarm}/*/*", f"flocc/v2/{swarm}/*/to/{name}/*")
        self._declared = [session.declare_subscriber(key, self.hear) for key in keys]
        self._token = session.liveliness().declare_token(f"{self._key}/alive/{self.log[1]}")

    def append(self, code: int, *fields: Any) -> None:
        """Add a record to the own log."""
        with self._lock:
            self.logs[self.log].append(msgpack.packb([code, fields]))
            self._changes[0] += 1

    def digests(self) -> list[Any]:
        """What is held of every log."""
        return [[list(log), len(records), checksum(records)] for log, records in sorted(self.logs.items())]

    def versions(self) -> list[Any]:
        """Which correction is held of every log."""
        return [[list(log), c[1], c[2]] for log, c in sorted(self.corrections.items())]

    def send(self, kind: str, fields: list[Any], to: str | None = None) -> None:
        """Say something to everybody in range, or to one robot."""
        key = f"{self._key}/{kind}" if to is None else f"{self._key}/to/{to}/{kind}"
        self._session.put(key, msgpack.packb([VERSION, kind, self.log, fields]))

    def heartbeat(self) -> None:
        """Say that this robot is there, whom it follows, and in two hashes what it holds."""
        with self._lock:
            self._sequence += 1
            own = self.logs[self.log]
            states = [
                [table_hash(table), changes]
                for table, changes in zip((self.digests(), self.versions()), self._changes, strict=True)
            ]
            said = [self._sequence, self.log[1], 0, self.leader, self._counter_max, 0, len(own), checksum(own)]
            self.send("heartbeat", [*said, *states, [], [], []])

    def hear(self, sample: zenoh.Sample) -> None:
        """Take one message."""
        version, kind, (sender, _), fields = msgpack.unpackb(bytes(sample.payload))
        answer = getattr(self, f"_on_{kind.replace('-', '_')}", None)
        if version == VERSION and sender != self.log[0] and answer is not None:
            with self._lock:
                answer(sender, *fields)

    def _on_heartbeat(self, sender: str, *fields: Any) -> None:
        advert, counter_max, digests, versions = fields[3], fields[4], fields[8], fields[9]
        self._counter_max = max(self._counter_max, counter_max)
        if advert is not None:
            self._follow(advert)
        if digests[0] != table_hash(self.digests()) or versions[0] != table_hash(self.versions()):
            self.send("want-digests", [0, 0], sender)

    def _on_coordinator(self, _: str, advert: list[Any]) -> None:
        self._follow(advert)

    def _follow(self, advert: list[Any]) -> None:
        term, compute_class, beat, hops = advert
        if self.leader is None or (term[0], beat) > (self.leader[0][0], self.leader[2]):
            self.leader = [term, compute_class, beat, hops + 1]

    def _on_want_digests(self, sender: str, *_: int) -> None:
        tables = [self._changes[0], self.digests(), self._changes[1], self.versions()]
        self.send("digests", [self.log[1], *tables], sender)

    def _on_digests(self, sender: str, _: int, __: int, digests: list[Any], ___: int, versions: list[Any]) -> None:
        short = []
        for log, count, _checksum in digests:
            held = len(self.logs.get(tuple(log), []))
            if tuple(log) != self.log and held < count:
                short.append([log, held])
        if short:
            self.send("want-records", [short], sender)
        old = [log for log, term, number in versions if self._held_version(log) < [*term, number]]
        if old:
            self.send("want-correction", [old], sender)

    def _held_version(self, log: list[Any]) -> list[Any]:
        held = self.corrections.get(tuple(log))
        return [] if held is None else [*held[1], held[2]]

    def _on_want_records(self, sender: str, positions: list[Any]) -> None:
        batches = []
        for log, first in positions:
            records = self.logs.get(tuple(log), [])
            if first < len(records):
                batches.append([log, first, checksum(records[:first]), records[first : first + BATCH_RECORDS]])
        if batches:
            self.send("records", [batches], sender)

    def _on_records(self, _: str, batches: list[Any]) -> None:
        for log, first, checksum_before, records in batches:
            held = self.logs.get(tuple(log), [])
            if tuple(log) == self.log or first > len(held) or first + len(records) <= len(held):
                continue
            if checksum(held[:first]) == checksum_before:
                self.logs[tuple(log)] = held[:first] + records
                self._changes[0] += 1

    def _on_correction(self, sender: str, corrections: list[Any]) -> None:
        for said, _signature in corrections:
            correction = msgpack.unpackb(said)
            log, term, number, _anchor, _T_map_odom, knots = correction
            version, held = [*term, number], self._held_version(log)
            if version > held or (version == held and knots):
                self.corrections[tuple(log)] = correction
                self._changes[1] += version > held
                if tuple(log) == self.log and not knots:
                    self.send("want-knots", [[[log, term, number]]], sender)


def main() -> None:
    """Take part in a swarm for a while."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--connect", required=True, help="control endpoint of a robot")
    parser.add_argument("--swarm", default="team")
    parser.add_argument("--name", default="other")
    parser.add_argument("--sees", required=True, help="name of the robot that it sees")
    parser.add_argument("--seconds", type=float, default=60.0)
    arguments = parser.parse_args()

    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([arguments.connect]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        peer = Peer(session, arguments.swarm, arguments.name)
        start_s, keyframes = time.time(), 0
        told: dict[Log, list[Any]] = {}
        while time.time() < start_s + arguments.seconds:
            peer.append(1, keyframes, time.time(), pose(0.5 * keyframes, 0.0, 0.0), None)
            if keyframes % 5 == 2:
                peer.append(8, keyframes, arguments.sees, pose(0.0, 0.0, 2.0), covariance(0.01, 0.1))
            keyframes += 1
            peer.heartbeat()
            for log, correction in list(peer.corrections.items()):
                if correction[:3] != told.get(log):
                    told[log] = correction[:3]
                    position_m = struct.unpack("<7d", correction[4])[:3]
                    told_of = {"log": log, "round": correction[2], "map": correction[3], "odom_at_m": position_m}
                    print(json.dumps(told_of), flush=True)  # noqa: T201
            time.sleep(HEARTBEAT_S)


if __name__ == "__main__":
    main()
