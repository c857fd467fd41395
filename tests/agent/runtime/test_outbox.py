"""Own records on their way out."""

from flocc_agent.runtime.outbox import PAUSE_PER_NEIGHBOUR_S, Outbox
from flocc_protocol.ids import LogId
from flocc_protocol.messages import RECORDS_BATCH_BYTES_MAX, RECORDS_BATCH_MAX, RecordBatch, Records
from flocc_protocol.records import chain

R1 = LogId("r1")


def batch(number: int, record: bytes = b"record") -> RecordBatch:
    """The record of one number, in a log of such records."""
    checksum = 0
    for _ in range(number):
        checksum = chain(checksum, record)
    return RecordBatch(R1, number, checksum, (record,))


def test_a_record_goes_at_once_when_none_went_lately() -> None:
    outbox = Outbox()
    assert outbox.add(batch(0)) is None
    assert outbox.due_s() <= 0.0
    assert outbox.take(neighbours=29, now_s=0.0) == Records((batch(0),))
    assert outbox.take(neighbours=29, now_s=0.0) is None


def test_those_that_follow_go_together_after_a_pause_for_each_neighbour() -> None:
    outbox = Outbox()
    outbox.add(batch(0))
    outbox.take(neighbours=10, now_s=5.0)
    for number in (1, 2, 3):
        outbox.add(batch(number))
    assert outbox.due_s() == 5.0 + 10 * PAUSE_PER_NEIGHBOUR_S
    together = RecordBatch(R1, 1, batch(1).checksum_before, (b"record",) * 3)
    assert outbox.take(neighbours=10, now_s=5.2) == Records((together,))
    assert outbox.due_s() == float("inf")


def test_what_is_too_long_for_one_message_goes_before() -> None:
    for record, count in ((b"r", RECORDS_BATCH_MAX), (bytes(4096), RECORDS_BATCH_BYTES_MAX // 4096)):
        outbox = Outbox()
        assert all(outbox.add(batch(number, record)) is None for number in range(count))
        full = outbox.add(batch(count, record))
        assert full == Records((RecordBatch(R1, 0, 0, (record,) * count),))
        assert outbox.take(neighbours=1, now_s=0.0) == Records((batch(count, record),))
