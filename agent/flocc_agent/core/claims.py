"""What is signed and not believed yet: a record of a place in a log, a correction of a leader.

Whoever runs a robot may have claims checked beforehand, off its loop: the robot names those that a message makes, once
everything that is cheaper to look at was looked at, and asks its sealer for them in any case when the message comes.
"""

from dataclasses import dataclass

from flocc_protocol.ids import LogId


@dataclass(frozen=True, slots=True)
class RecordClaim:
    """Sealed bytes that are said to be a record of a log, at a number."""

    log: LogId
    number: int
    sealed: bytes


@dataclass(frozen=True, slots=True)
class CorrectionClaim:
    """An encoded correction that is said to be a leader's."""

    leader: LogId
    correction: bytes
    signature: bytes


Claim = RecordClaim | CorrectionClaim
