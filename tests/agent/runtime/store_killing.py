"""Start a robot's store again and again, kill it at random moments, and check what it published against the files.

A child appends records to its own log (and others' records, and latents) and writes the number of each own record to
a pipe once `put_record` has returned: from then on it counts as published. Usage: FOLDER KILLS SEED.
"""

import hashlib
import json
import os
import random
import select
import signal
import sys
from pathlib import Path

from flocc_agent.config import StoreConfig
from flocc_agent.runtime.store import Store
from flocc_protocol.ids import KeyframeId, LogId

CONFIG = StoreConfig(latent_bytes_max=1024 * 1024, record_bytes_max=512 * 1024 * 1024)


def record_data(number: int) -> bytes:
    """Content that the number alone decides, so that a wrong or torn record is noticed; the last byte is a latent's."""
    return hashlib.sha256(b"%d" % number).digest() * 20


def live(folder: Path, pipe: int) -> None:
    """Be a robot until killed."""
    store = Store.open(folder, "r1", CONFIG, incarnation=0, incarnation_after_loss=1)
    log = store.identity.log
    number = len(store.records(log))
    os.write(pipe, b"%s %d start\n" % (str(log).encode(), number))
    while True:
        store.put_latent(KeyframeId(log, number), record_data(number) * 20)
        store.put_record(LogId("r2"), number, record_data(number))
        store.put_record(log, number, record_data(number))
        os.write(pipe, b"%s %d\n" % (str(log).encode(), number))
        number += 1


def kill_after(child: int, pipe: int, delay_s: float) -> list[str]:
    """Kill a child after a while, and give the lines that it got out."""
    if select.select([pipe], [], [], 20.0)[0]:
        select.select([], [], [], delay_s)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    text = b""
    while chunk := os.read(pipe, 65536):
        text += chunk
    return text.decode().splitlines()


def check(folder: Path, published: int) -> int:
    """Check the files against the count of published records, and give the count of records."""
    store = Store.open(folder, "r1", CONFIG, incarnation=0, incarnation_after_loss=1)
    assert store.failure is None
    assert store.identity.log == LogId("r1"), store.identity
    records = store.records(LogId("r1"))
    assert [record.number for record in records] == list(range(len(records))), "numbers are missing"
    assert len(records) >= published, f"{published} were published, {len(records)} are there"
    assert all(record.data == record_data(record.number) for record in records[-50:])
    if records:
        newest = KeyframeId(LogId("r1"), len(records) - 1)
        assert store.has_latent(newest), "a record came before its latent"
    store.close()
    return len(records)


def main(folder: Path, kills: int, seed: int) -> None:
    """Kill as often as asked; an AssertionError says what was lost."""
    rng = random.Random(seed)
    published = written = while_writing = 0
    for _ in range(kills):
        ours, theirs = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(ours)
            live(folder, theirs)
        os.close(theirs)
        lines = kill_after(child, ours, rng.uniform(0.0, 0.03) if rng.random() < 0.9 else 0.1)
        os.close(ours)
        for line in lines:
            log, number, *start = line.split()
            assert log == "r1", line
            if start:
                assert int(number) == written, f"numbering starts at {number}, the files hold {written}"
            else:
                published = int(number) + 1
        written = check(folder, published)
        while_writing += len(lines) > 1
    print(
        json.dumps({"kills": kills, "published": published, "written": written, "kills_while_writing": while_writing})
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
