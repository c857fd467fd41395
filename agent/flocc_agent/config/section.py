"""What all sections of a configuration are, and how fields become one: read, changed, checked.

A complaint is one sentence that names the file and the key.
"""

import dataclasses
import difflib
import json
import re
import tomllib
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from flocc_agent.config.removed import REMOVED
from flocc_agent.core.parameters import INNER
from flocc_protocol.errors import FloccError


class ConfigError(FloccError):
    """A configuration that cannot be used; the message names the file and the key."""


class Section(BaseModel):
    """Base of all sections: frozen, and an unknown key is an error."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, ser_json_inf_nan="constants", allow_inf_nan=False
    )

    @field_validator("*", mode="after")
    @classmethod
    def _is_relative_to_its_file(cls, value: object, info: ValidationInfo) -> object:
        """Paths that a file names are relative to that file."""
        folder = (info.context or {}).get("folder")
        return folder / value if folder is not None and isinstance(value, Path) else value


def inner(default: Any, **limits: Any) -> Any:
    """A parameter that a program may give, an experiment above all, but no file: it is no key and is not written.

    Args:
        default: Its value.
        limits: As of pydantic's `Field`.
    """
    return Field(default, exclude=True, **limits)


M = TypeVar("M", bound=BaseModel)


def validated(model: type[M], fields: Mapping[str, object], source: str, folder: Path | None = None) -> M:
    """Check fields against a model.

    Args:
        model: What they should be.
        fields: As they were read.
        source: Where they come from, for the error's sentence.
        folder: What relative paths in them start from; None leaves them as they are.

    Raises:
        ConfigError: One sentence that names the source and the key.
    """
    refuse_removed(fields, source)
    try:
        found = model.model_validate(fields, context={"folder": folder})
    except (ValidationError, FloccError) as error:
        raise ConfigError(
            first_error(error, source, model) if isinstance(error, ValidationError) else f"{source}: {error}"
        ) from error
    key = next(_truths_taken_for_numbers(fields, found), None)
    if key is not None:
        raise ConfigError(f"{source}: {key}: must be a number, neither true nor false")
    return found


def _truths_taken_for_numbers(fields: Mapping[str, object], found: object) -> Iterator[str]:
    """Keys whose value is true or false, which became 1 or 0: pydantic is lenient there, also in plain dataclasses."""
    for key, given in fields.items():
        taken = getattr(found, key, None)
        if isinstance(given, bool) and isinstance(taken, int | float) and not isinstance(taken, bool):
            yield key
        elif isinstance(given, Mapping):
            yield from (f"{key}.{below}" for below in _truths_taken_for_numbers(given, taken))
        elif isinstance(given, list) and isinstance(taken, tuple):
            for k, (table, made) in enumerate(zip(given, taken, strict=False)):
                if isinstance(table, Mapping):
                    yield from (f"{key}.{k}.{below}" for below in _truths_taken_for_numbers(table, made))


def first_error(error: ValidationError, source: str, model: type[BaseModel]) -> str:
    """Put pydantic's first complaint into one sentence that names the source and the key."""
    complaint = error.errors()[0]
    key = ".".join(str(part) for part in complaint["loc"]) or "(top level)"
    if complaint["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{source}: the key '{key}' does not exist{_meant(model, complaint['loc'])}"
    if complaint["type"] in ("missing", "missing_argument"):
        return f"{source}: the key '{key}' is missing"
    if complaint["type"] == "tuple_type" and isinstance(complaint["input"], Mapping):
        return f"{source}: {key}: is a list of tables, each of which begins with [[{key}]] in a file"
    return f"{source}: {key}: {complaint['msg'].removeprefix('Value error, ')}"


def _meant(model: type[BaseModel], location: tuple[int | str, ...]) -> str:
    """The key of the same section that is spelt most like one that does not exist."""
    *sections, wrong = location
    names = _keys(model, [part for part in sections if isinstance(part, str)])
    near = difflib.get_close_matches(str(wrong), names, n=1)
    return f"; did you mean '{near[0]}'?" if near else ""


def _keys(kind: Any, sections: list[str]) -> list[str]:
    """Keys of the section that lies below a model, or a union or list of models, at a path."""
    if isinstance(kind, type) and hasattr(kind, "__dataclass_fields__"):
        keys = {f.name for f in dataclasses.fields(kind) if INNER not in f.metadata}
        below = {name: hint for name, hint in typing.get_type_hints(kind).items() if name in keys}
    elif isinstance(kind, type) and issubclass(kind, BaseModel):
        below = {name: field.annotation for name, field in kind.model_fields.items() if not field.exclude}
    else:
        return [name for each in typing.get_args(kind) for name in _keys(each, sections)]
    if not sections:
        return list(below)
    return _keys(below[sections[0]], sections[1:]) if sections[0] in below else []


TEXT_BYTES_MAX = 16 * 1024 * 1024
"""Of a configuration or scenario; a device such as /dev/zero never ends."""
KEY_PARTS_MAX = 64
LONG_KEY = re.compile(rf"^\s*\[*(?:[\w-]+\s*\.\s*){{{KEY_PARTS_MAX},}}[\w-]", re.MULTILINE | re.ASCII)
"""The parser's time grows with the square of a key's parts: 50,000 of them take minutes."""


def read_toml(path: Path) -> dict[str, object]:
    """Read a TOML file.

    Raises:
        ConfigError: It is missing, unreadable or not TOML; the message names the file (and line).
    """
    try:
        text = _bounded(path).decode("utf-8-sig")
        if LONG_KEY.search(text):
            raise ConfigError(f"{path}: has a key of more than {KEY_PARTS_MAX} parts")
        return tomllib.loads(text)
    except RecursionError as error:
        raise ConfigError(f"{path}: is nested too deeply") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is no text, so no TOML file (byte {error.start + 1})") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from error


def _bounded(path: Path) -> bytes:
    with path.open("rb") as file:
        content = file.read(TEXT_BYTES_MAX + 1)
    if len(content) > TEXT_BYTES_MAX:
        raise ConfigError(f"{path}: has more than {TEXT_BYTES_MAX} bytes, which is no configuration")
    return content


def read_json(path: Path) -> dict[str, object]:
    """Read a JSON file that holds an object.

    Raises:
        ConfigError: It is missing, unreadable or no such file; the message names it.
    """
    try:
        content = json.loads(_bounded(path))
    except RecursionError as error:
        raise ConfigError(f"{path}: is nested too deeply") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: holds no JSON object")
    return content


def refuse_removed(fields: Mapping[str, object], source: str) -> None:
    """Refuse a key of an earlier version.

    Raises:
        ConfigError: One sentence that names the source, the key and what replaced it.
    """
    for key, replacement in REMOVED.items():
        if _is_given(fields, key.split(".")):
            raise ConfigError(f"{source}: the key '{key}' is gone: {replacement}")


def _is_given(fields: object, path: list[str]) -> bool:
    """Whether a key stands somewhere in fields; tables of a list are looked through, too."""
    if isinstance(fields, list | tuple):
        return any(_is_given(table, path) for table in fields)
    if not isinstance(fields, Mapping) or path[0] not in fields:
        return False
    return len(path) == 1 or _is_given(fields[path[0]], path[1:])


def parsed_change(text: str) -> tuple[str, object]:
    """Key and value of `KEY=VALUE`; the value is TOML, or text as it stands.

    Raises:
        ConfigError: There is no key.
    """
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"{text!r} is no change of the configuration; one looks like radio.loss_ratio=0.3")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


def put_value(fields: dict[str, object], key: str, value: object) -> None:
    """Put a value at a dotted key, such as `radio.loss_ratio`.

    Raises:
        ConfigError: A part of the key is no table.
    """
    *tables, name = key.split(".")
    for table in tables:
        inner = fields.setdefault(table, {})
        if not isinstance(inner, dict):
            raise ConfigError(f"{key}: {table} is no table")
        fields = inner
    fields[name] = value
