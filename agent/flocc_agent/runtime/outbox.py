"""Own records on their way out: a robot with many neighbours sends several in one message.

What a small message costs is sending and waking up for it, once for each neighbour. So after one message with own
records the next pauses, the longer the more neighbours there are; with few of them nobody notices. A heartbeat never
says more than was sent: what waits goes before it.
"""

from flocc_protocol.messages import RECORDS_BATCH_BYTES_MAX, RECORDS_BATCH_MAX, RecordBatch, Records

PAUSE_PER_NEIGHBOUR_S = 0.02


class Outbox:
    """The own log's records that were not sent yet, without gaps."""

    def __init__(self) -> None:
        self._batch: RecordBatch | None = None
        self._not_before_s = float("-inf")

    def add(self, batch: RecordBatch) -> Records | None:
        """Let records wait; gives what must be sent at once because both together are too long for a message."""
        held, self._batch = self._batch, batch
        if held is None:
            return None
        records = (*held.records, *batch.records)
        if len(records) > RECORDS_BATCH_MAX or held.size_bytes + batch.size_bytes > RECORDS_BATCH_BYTES_MAX:
            return Records((held,))
        assert batch.first == held.first + len(held.records), "own records come in order"
        self._batch = RecordBatch(held.log, held.first, held.checksum_before, records)
        return None

    def due_s(self) -> float:
        """When what waits is to be sent."""
        return float("inf") if self._batch is None else self._not_before_s

    def take(self, neighbours: int, now_s: float) -> Records | None:
        """Take what waits, to send it now to so many neighbours."""
        batch, self._batch = self._batch, None
        if batch is None:
            return None
        self._not_before_s = now_s + PAUSE_PER_NEIGHBOUR_S * neighbours
        return Records((batch,))
