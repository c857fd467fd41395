"""Robots of different front ends: their latents cannot be registered with each other, so they are not fetched.

Records tell: two rejections for that reason, and no closure, between two logs set them apart, at every robot alike. One
pair in `TRIED_EVERY` is still tried, since a robot may be started again with the front end of the others; a closure
brings its logs together again.
"""

import zlib

from flocc_agent.core.pulls import remember
from flocc_agent.core.registration import RegistrationFailure
from flocc_protocol.ids import LogId
from flocc_protocol.messages import CandidatePair

FAILURES_MIN = 2
TRIED_EVERY = 32

Logs = tuple[LogId, LogId]


class FrontEnds:
    """Which logs are apart: the latest that turned out to fit or not, a bounded number of them."""

    def __init__(self) -> None:
        self._failures: dict[Logs, int] = {}
        self._fitting: dict[Logs, None] = {}

    def on_closure(self, pair: CandidatePair) -> None:
        """A pair was registered: its logs' latents fit."""
        logs = _logs(pair)
        remember(self._fitting, logs, None)
        self._failures.pop(logs, None)

    def on_rejection(self, pair: CandidatePair, reason: str) -> bool:
        """A pair was refused; whether its logs are apart from now on."""
        logs = _logs(pair)
        if reason != RegistrationFailure.OTHER_FRONT_END.value or logs in self._fitting:
            return False
        remember(self._failures, logs, self._failures.get(logs, 0) + 1)
        return self._failures[logs] == FAILURES_MIN

    def are_apart(self, pair: CandidatePair) -> bool:
        """Whether a pair's logs are apart, and it is none of those that are still tried."""
        is_tried = zlib.crc32(f"{pair.high} {pair.low}".encode()) % TRIED_EVERY == 0
        return self._failures.get(_logs(pair), 0) >= FAILURES_MIN and not is_tried


def _logs(pair: CandidatePair) -> Logs:
    return pair.low.log, pair.high.log
