"""A robot's store, damaged in many ways: does it start, are its records the ones that were put, does it get the rest?

    python -m flocc_lab.damaged_stores 1000 --seed 7

Each trial copies the files of a store that is in use, as a power cut leaves them, damages one of them (a bit, eight
bits, 64 bytes, a page, a write-ahead log that is cut, an older copy), starts a robot on it, and lets it hear a peer
that holds everything for ten seconds. The seed draws where the damage is; without one it is drawn, and printed.
"""

import argparse
import logging
import random
import secrets
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flocc_agent.config import StoreConfig
from flocc_agent.core.effects import Effect, Unicast
from flocc_agent.core.gossip import Gossip
from flocc_agent.core.parameters import CoreParameters, GossipParameters
from flocc_agent.core.robot import Robot
from flocc_agent.runtime.persistence import restore
from flocc_agent.runtime.store import Store
from flocc_protocol.arrays import Array
from flocc_protocol.ids import KeyframeId, LogId
from flocc_protocol.messages import RecordRequest, Records
from flocc_protocol.records import KeyframeRecord, encode_record

OWN, OTHERS = LogId("r1", 5), (LogId("r2", 77), LogId("r3"))
ANEW = LogId("r1", 99)
"""The log with which a robot goes on that lost something of its own."""
RECORDS, CHECKPOINTED = 60, 40
TERM_COUNTER = 12
PAGE_BYTES = 4096
IN_RANGE_S = 10
CONFIG = StoreConfig()

Put = Mapping[LogId, list[bytes]]
"""Records of each log, as they were put."""


def encoded(log: LogId, index: int) -> bytes:
    """A keyframe's record, different for each log and number."""
    descriptor = np.random.default_rng([log.incarnation, index]).standard_normal(64).astype(np.float32)
    pose = (float(index), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    return encode_record(KeyframeRecord(index, float(index), pose, Array.of(descriptor, "f4")))


def three_logs() -> dict[LogId, list[bytes]]:
    """What is put into a store."""
    return {log: [encoded(log, index) for index in range(RECORDS)] for log in (OWN, *OTHERS)}


def use_store(folder: Path, put: Put) -> Path:
    """A store's files while it is in use: most of it in the database, the rest in the write-ahead log."""
    working, used = folder / "working", folder / "used"
    store = Store.open(working, OWN.robot, CONFIG, incarnation=OWN.incarnation)
    try:
        for number in range(RECORDS):
            if number == CHECKPOINTED:
                store._records._connections[0].execute("PRAGMA wal_checkpoint(TRUNCATE)")
            for log, records in put.items():
                store.put_record(log, number, records[number])
            store.put_latent(KeyframeId(OWN, number), bytes(2000))
        store.put_term_counter(TERM_COUNTER)
        shutil.copytree(working, used)
    finally:
        store.close()
    return used


# --- damage


def flip(content: bytearray, draw: random.Random, bits: int) -> None:
    """Flip bits anywhere."""
    for _ in range(bits):
        content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)


def one_bit(content: bytearray, draw: random.Random) -> None:
    """A bit."""
    flip(content, draw, 1)


def eight_bits(content: bytearray, draw: random.Random) -> None:
    """Eight bits."""
    flip(content, draw, 8)


def bytes_64(content: bytearray, draw: random.Random) -> None:
    """64 bytes of something else."""
    at = draw.randrange(len(content) - 64)
    content[at : at + 64] = draw.randbytes(64)


def a_page(content: bytearray, draw: random.Random) -> None:
    """A page of nothing, or of something else."""
    at = draw.randrange(len(content) // PAGE_BYTES) * PAGE_BYTES
    content[at : at + PAGE_BYTES] = draw.choice([bytes(PAGE_BYTES), draw.randbytes(PAGE_BYTES)])


def cut(content: bytearray, draw: random.Random) -> None:
    """The end is missing."""
    del content[draw.randrange(len(content)) :]


def older(content: bytearray, draw: random.Random) -> None:  # noqa: ARG001
    """What was written last is missing as a whole: an older copy, beside the file that says how much there was."""
    content.clear()


Damage = Callable[[bytearray, random.Random], None]
DATABASE, LOG, LATENTS_LOG = "robot.sqlite", "robot.sqlite-wal", "latents.sqlite-wal"
KINDS: tuple[tuple[Damage, tuple[str, ...]], ...] = (
    (one_bit, (DATABASE, LOG, LATENTS_LOG)),
    (eight_bits, (DATABASE, LOG, LATENTS_LOG)),
    (bytes_64, (DATABASE, LOG)),
    (a_page, (DATABASE, LOG)),
    (cut, (LOG,)),
    (older, (LOG,)),
)
"""What is done, and to which files in turn."""


def damage(folder: Path, used: Path, kind: Damage, names: Sequence[str], seed: int) -> None:
    """Lay a copy of the store into a folder, with one file damaged."""
    shutil.copytree(used, folder)
    (folder / "robot.sqlite-shm").unlink(missing_ok=True)
    draw = random.Random(f"{kind.__name__}-{seed}")
    path = folder / names[seed % len(names)]
    content = bytearray(path.read_bytes())
    kind(content, draw)
    path.write_bytes(content)


# --- trials


@dataclass(frozen=True, slots=True)
class Trial:
    """What came of one damaged store.

    Attributes:
        log: The log with which the robot goes on.
        kept: Records that its disk still gave.
        faults: What must not be, in words.
    """

    log: LogId
    kept: int
    faults: tuple[str, ...]


def tried(folder: Path, put: Put) -> Trial:
    """Start a robot on a store, and let it hear a peer that holds everything."""
    store = Store.open(folder, OWN.robot, CONFIG, incarnation_after_loss=ANEW.incarnation)
    try:
        restored = restore(store)
        robot = Robot(store.identity.log, 0, 1, CoreParameters(), 0.0, restored)
        records = dict(restored.records)
        faults = [f"{log} gives other records" for log in records if [*records[log]] != put[log][: len(records[log])]]
        if store.identity.log == OWN:
            if len(records.get(OWN, ())) < RECORDS:
                faults.append("goes on with a log of which it lost something")
            if store.term_counter() != TERM_COUNTER:
                faults.append("forgot its term")
        elif store.identity.log != ANEW:
            faults.append(f"goes on as {store.identity.log}")
        faults += [f"lacks records of {log} that a peer holds" for log in lacking(robot.gossip, put)]
        return Trial(store.identity.log, sum(map(len, records.values())), tuple(faults))
    finally:
        store.close()


def lacking(gossip: Gossip, put: Put) -> list[LogId]:
    """Logs that a robot does not hold whole after ten seconds in range of a peer that does."""
    peer = Gossip(LogId("peer"), GossipParameters())
    for log, records in put.items():
        for data in records:
            peer.restore(log, data)
    for second in range(IN_RANGE_S):
        effects = gossip.on_digests(LogId("peer"), peer.digests(), float(second))
        while request := next((r for r in map(_request, effects) if r is not None), None):
            answers = peer.on_request(OWN, request)
            effects = []
            for answer in answers:
                assert isinstance(answer, Unicast)
                assert isinstance(answer.message, Records)
                effects += gossip.on_records(LogId("peer"), answer.message, float(second))[1]
    return [log for log in put if log not in gossip.logs or [*gossip.logs[log].encoded] != put[log]]


def _request(effect: Effect) -> RecordRequest | None:
    is_request = isinstance(effect, Unicast) and isinstance(effect.message, RecordRequest)
    return effect.message if is_request else None  # type: ignore[union-attr, return-value]


# --- many of them


def tried_many(stores: int, seed: int) -> str:
    """Damage so many stores, each kind in turn; a table of what came of them, and each fault."""
    put, lines, logs = three_logs(), [], []
    found: dict[str, Counter[str]] = {kind.__name__: Counter() for kind, _ in KINDS}
    with tempfile.TemporaryDirectory() as scratch:
        used = use_store(Path(scratch), put)
        for number in range(stores):
            kind, names = KINDS[number % len(KINDS)]
            folder, drawn = Path(scratch) / "r1", seed + number // len(KINDS)
            damage(folder, used, kind, names, drawn)
            try:
                trial = tried(folder, put)
            except Exception as error:  # noqa: BLE001 - a robot that does not start is what this looks for
                trial = Trial(OWN, 0, (f"does not start: {error!r}",))
            shutil.rmtree(folder)
            count = found[kind.__name__]
            count.update({"stores": 1, "new log": trial.log != OWN, "kept": trial.kept, "faults": len(trial.faults)})
            logs += [f"{kind.__name__} {drawn}: {fault}" for fault in trial.faults]
    lines = [f"| {'damage':10} | stores | same log | new log | records still on the disk | faults |", "|---" * 6 + "|"]
    for name, count in found.items():
        share = count["kept"] / max(count["stores"] * RECORDS * len(put), 1)
        same = count["stores"] - count["new log"]
        lines.append(
            f"| {name:10} | {count['stores']} | {same} | {count['new log']} | {share:.1%} | {count['faults']} |"
        )
    return "\n".join([*lines, *logs])


def main() -> int:
    """Entry point: 1 where something that must not be was."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stores", type=int)
    parser.add_argument("--seed", type=int, default=None)
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    seed = secrets.randbelow(10**9) if arguments.seed is None else arguments.seed
    table = tried_many(arguments.stores, seed)
    sys.stdout.write(f"seed {seed}\n{table}\n")
    return int(": " in table)


if __name__ == "__main__":
    sys.exit(main())
