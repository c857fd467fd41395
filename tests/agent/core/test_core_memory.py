"""What a keyframe of another robot costs in memory, for every robot of a swarm that holds it."""

import gc
import tracemalloc

import numpy as np
import pytest

from flocc_agent.core.descriptor_rows import comparable
from flocc_agent.core.events import MessageReceived
from flocc_agent.core.log_copy import decoded
from flocc_agent.core.parameters import CoreParameters, PlaceRecognitionParameters
from flocc_agent.core.robot import Robot
from flocc_protocol.arrays import Array
from flocc_protocol.ids import LogId
from flocc_protocol.messages import Envelope, RecordBatch, Records, decode, encode
from flocc_protocol.records import KeyframeRecord, chain, encode_record

LOGS = (LogId("r2"), LogId("r3"))
KEYFRAMES = 1000
"""Of each log: the interpreter's own caches, some 35 kB, and the logs' last blocks then hardly count."""
COST_BYTES_MAX = {128: 400, 512: 900}
"""The record's bytes, its descriptor among them, pose, stamp, number, checksum and what Python puts around them."""


@pytest.mark.parametrize("dimension", [128, 512])
def test_a_keyframe_costs_its_bytes_and_little_more(dimension: int) -> None:
    rng = np.random.default_rng(0)
    never_alike = PlaceRecognitionParameters(similarity_threshold=1.0)
    robot = Robot(LogId("r1"), 0, 1, CoreParameters(place_recognition=never_alike), 0.0)
    checksums = dict.fromkeys(LOGS, 0)

    def grow(first: int, end: int) -> int:
        """Hand over keyframes of each log; gives the bytes of the last."""
        record = b""
        for number in range(first, end):
            for log in LOGS:
                descriptor = Array.int8(rng.standard_normal(dimension))
                pose = (float(number), 0.5, 0.0, 1.0, 0.0, 0.0, 0.0)
                record = encode_record(KeyframeRecord(number, number / 2, pose, descriptor))
                message = encode(Envelope(log, Records((RecordBatch(log, number, checksums[log], (record,)),))))
                checksums[log] = chain(checksums[log], record)
                robot.handle(MessageReceived(decode(message)), number / 2)
        return len(record)

    grow(0, 1)
    tracemalloc.start()
    try:
        record_bytes = grow(1, KEYFRAMES)
        for cache in (comparable, decoded):  # of a fixed size
            cache.cache_clear()
        gc.collect()
        cost_bytes = tracemalloc.get_traced_memory()[0] / (KEYFRAMES * len(LOGS))
    finally:
        tracemalloc.stop()
    print(f"{cost_bytes:.0f} bytes for a keyframe of {record_bytes} bytes")
    assert cost_bytes < COST_BYTES_MAX[dimension]
