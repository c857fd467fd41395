"""Who and what: swarms, robots, their logs, keyframes and leadership terms.

A robot that lost its disk comes back with a new incarnation and so with a new log; the old log stays valid for
the others. Everything sorts the same way on every robot: ties are broken by identifiers, never by arrival.

Identifiers are tuples: they are keys of most tables and sorted in most steps, and a tuple is hashed and compared
several times as fast as a dataclass.
"""

import re
from typing import NamedTuple, TypeVar

from flocc_protocol.errors import FloccError

NAME_PATTERN = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")
INCARNATION_MAX = 2**53 - 1
INDEX_MAX = 2**31 - 1
TERM_COUNTER_MAX = 2**48

Identifier = TypeVar("Identifier", "LogId", "KeyframeId", "Term")


class BadName(FloccError, ValueError):
    """A swarm or robot name that cannot be a chunk of a key expression."""


def checked_name(name: str, what: str = "robot name") -> str:
    """Return the name, or say why it cannot be one.

    Raises:
        BadName: Not 1 to 32 of a-z, 0-9, '-', '_', starting with a letter or digit.
    """
    if not NAME_PATTERN.fullmatch(name):
        raise BadName(f"{what} {name!r} must be 1 to 32 of a-z, 0-9, '-' and '_', and start with a letter or digit")
    return name


class _LogFields(NamedTuple):
    robot: str
    incarnation: int


class LogId(_LogFields):
    """One robot's append-only log: its name and the incarnation that writes it.

    Incarnation 0 is a robot's first life in a swarm whose start the launcher controls; elsewhere it is drawn from
    the wall clock when a robot starts without a disk.
    """

    __slots__ = ()

    def __new__(cls, robot: str, incarnation: int = 0) -> "LogId":
        """Check both.

        Raises:
            ValueError: The name cannot be one, or the incarnation is out of range.
        """
        checked_name(robot)
        if not 0 <= incarnation <= INCARNATION_MAX:
            raise ValueError(f"incarnation {incarnation} is out of range")
        return tuple.__new__(cls, (robot, incarnation))

    def __str__(self) -> str:
        return self.robot if self.incarnation == 0 else f"{self.robot}~{self.incarnation:x}"

    @classmethod
    def parse(cls, text: str) -> "LogId":
        """Read what `str()` wrote.

        Raises:
            ValueError: The text is not a log identifier.
        """
        robot, separator, incarnation = text.partition("~")
        return _as_written(cls(robot, int(incarnation, 16) if separator else 0), text)


class _KeyframeFields(NamedTuple):
    log: LogId
    index: int  # type: ignore[assignment]  # tuples have a method of this name, which nobody needs here


class KeyframeId(_KeyframeFields):
    """One keyframe: its robot's log and its number there, counted from 0 without gaps."""

    __slots__ = ()

    def __new__(cls, log: LogId, index: int) -> "KeyframeId":
        """Check the number.

        Raises:
            ValueError: It is out of range.
        """
        if not 0 <= index <= INDEX_MAX:
            raise ValueError(f"keyframe index {index} is out of range")
        return tuple.__new__(cls, (log, index))

    def __str__(self) -> str:
        return f"{self.log}/{self.index}"

    @classmethod
    def parse(cls, text: str) -> "KeyframeId":
        """Read what `str()` wrote.

        Raises:
            ValueError: The text is not a keyframe identifier.
        """
        log, _, index = text.rpartition("/")
        return _as_written(cls(LogId.parse(log), int(index)), text)


class _TermFields(NamedTuple):
    counter: int
    leader: LogId


class Term(_TermFields):
    """A leadership term: a counter and the one log whose robot may claim it. Terms are totally ordered."""

    __slots__ = ()

    def __new__(cls, counter: int, leader: LogId) -> "Term":
        """Check the counter.

        Raises:
            ValueError: It is out of range.
        """
        if not 0 <= counter <= TERM_COUNTER_MAX:
            raise ValueError(f"term counter {counter} is out of range")
        return tuple.__new__(cls, (counter, leader))

    def __str__(self) -> str:
        return f"{self.counter}:{self.leader}"

    @classmethod
    def parse(cls, text: str) -> "Term":
        """Read what `str()` wrote.

        Raises:
            ValueError: The text is not a term.
        """
        counter, _, leader = text.partition(":")
        return _as_written(cls(int(counter), LogId.parse(leader)), text)


def _as_written(identifier: Identifier, text: str) -> Identifier:
    """Refuse other spellings (`a~0`, `a/+1`, `a/1_0`): one identifier, one text."""
    if str(identifier) != text:
        raise ValueError(f"{text[:80]!r} is not how {identifier} is written")
    return identifier
