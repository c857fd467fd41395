"""Lines of `events.jsonl`: a fact with its time and robot, as JSON and back.

    {"t": 2.5, "robot": "r1", "event": "neighbour_up", "peer": "r2"}

Identifiers are written as their text. A reader checks types, that numbers are finite and quaternions of unit length;
keys that it does not know it ignores, as a newer version may have written them. A kind that it does not know it keeps
as `UnknownFact`.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache, partial, reduce
from operator import or_
from types import UnionType
from typing import Annotated, Any, Generic, TypeGuard, TypeVar, Union, final, get_args, get_origin, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PlainValidator, ValidationError, create_model

import flocc_agent.runtime.facts  # noqa: F401  # its facts belong to the kinds
from flocc_agent.core.reports import KINDS, Fact, name_of
from flocc_agent.runtime.robot_result import with_direction
from flocc_protocol.codec import Pose7
from flocc_protocol.errors import FloccError
from flocc_protocol.ids import KeyframeId, LogId, Term

F = TypeVar("F", bound=Fact)
G_co = TypeVar("G_co", bound=Fact, covariant=True)


class BadLine(FloccError, ValueError):
    """A line that is cut off, is not JSON, or lacks a key; one sentence says which."""


@final
@dataclass(frozen=True, slots=True)
class Reported(Generic[G_co]):
    """A fact, when and where.

    Attributes:
        t: Seconds since the run started, on the run's clock (virtual or real).
        robot: Whom it concerns.
        fact: What happened.
    """

    t: float
    robot: str
    fact: G_co


@dataclass(frozen=True, slots=True)
class UnknownFact:
    """A fact of a kind that this version does not know, kept as it stands in the file.

    Attributes:
        name: Of its kind.
        values: Its other keys.
    """

    name: str
    values: Mapping[str, object]

    def __str__(self) -> str:
        return " ".join([self.name, *(f"{key}={value}" for key, value in self.values.items())])


def of_kind(reported: Iterable[Reported[Fact]], kind: type[F]) -> list[Reported[F]]:
    """Those of one kind, in their order."""
    return [each for each in reported if is_of(each, kind)]


def is_of(reported: Reported[Fact], kind: type[F]) -> TypeGuard[Reported[F]]:
    """Whether a fact is of a kind."""
    return isinstance(reported.fact, kind)


# Writing


def line_of(reported: Reported[Fact]) -> dict[str, object]:
    """What stands in the file, ready for JSON."""
    told = reported.fact
    head: dict[str, object] = {"t": round(reported.t, 6), "robot": reported.robot}
    if isinstance(told, UnknownFact):
        return {**head, "event": told.name, **told.values}
    return {**head, "event": name_of(told), **values_of(told)}


def values_of(told: Fact) -> dict[str, object]:
    """A fact's fields, ready for JSON."""
    return {each.name: _plain(getattr(told, each.name)) for each in fields(told)}


def _plain(value: Any) -> object:
    if isinstance(value, KeyframeId | LogId | Term):
        return str(value)
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    return values_of(value) if is_dataclass(value) and not isinstance(value, type) else value


# Reading


def reported_of(text: str) -> Reported[Fact]:
    """Read one line.

    Raises:
        BadLine: It is cut off, not JSON, or lacks a key.
    """
    try:
        line = json.loads(text)
    except RecursionError as error:
        raise BadLine("is nested too deeply") from error
    except ValueError as error:
        raise BadLine(f"is cut off or not JSON: {error}") from error
    try:
        head = _Head.model_validate(line)
        return Reported(head.t, head.robot, _fact_of(head.event, line))
    except ValidationError as error:
        complaint = error.errors()[0]
        key = ".".join(str(part) for part in complaint["loc"]) or "(top level)"
        raise BadLine(f"{key}: {complaint['msg']}") from error


class _Head(BaseModel):
    """What every line has."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)

    t: float
    robot: str
    event: str


def _fact_of(name: str, line: dict[str, object]) -> Fact:
    kind = KINDS.get(name)
    if kind is None:
        return UnknownFact(name, {key: value for key, value in line.items() if key not in _Head.model_fields})
    checked = _checker_of(kind).model_validate(line)
    return kind(**{each.name: getattr(checked, each.name) for each in fields(kind)})


@cache
def _checker_of(kind: type[Fact]) -> type[BaseModel]:
    """A model with the fields of a kind, which reads each as it is written."""
    types = get_type_hints(kind)
    config = ConfigDict(extra="ignore", allow_inf_nan=False)
    made: dict[str, Any] = {}
    for each in fields(kind):
        given: Any = ... if each.default is MISSING else each.default
        if each.default_factory is not MISSING:
            given = Field(default_factory=each.default_factory)
        made[each.name] = (_written(types[each.name]), given)
    return create_model(kind.__name__, __config__=config, **made)


def _written(kind: Any) -> Any:
    """The type of a field as it stands in the file: identifiers as text, poses with a direction."""
    if kind in (KeyframeId, LogId, Term):
        return Annotated[Any, PlainValidator(partial(_parsed, kind))]
    if kind == Pose7:
        return Annotated[kind, AfterValidator(with_direction)]
    parts = tuple(_written(each) for each in get_args(kind))
    if not parts:
        return kind
    return reduce(or_, parts) if get_origin(kind) in (Union, UnionType) else get_origin(kind)[parts]


def _parsed(kind: type[KeyframeId] | type[LogId] | type[Term], text: object) -> KeyframeId | LogId | Term:
    """An identifier of its text."""
    if not isinstance(text, str):
        raise ValueError(f"{text!r} is no text")
    return kind.parse(text)
