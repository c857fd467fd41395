"""Checks a compose file against the Compose Specification's own schema.

`compose-spec.json` is a copy of it, of October 2021: Copyright 2020 The Compose Specification Authors, Apache-2.0.

As much of JSON Schema as that schema uses; variables are filled in as Docker Compose does.
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

SCHEMA = json.loads((Path(__file__).parent / "compose-spec.json").read_text())
TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,), "array": (list,), "string": (str,), "boolean": (bool,), "null": (type(None),),
    "integer": (int,), "number": (int, float),
}  # fmt: skip
VARIABLE = re.compile(r"\$\$|\$\{(\w+):-([^}]*)\}")


def loaded(path: Path) -> Any:
    """A YAML file as it stands."""
    return YAML(typ="safe", pure=True).load(path)


def read(path: Path, environment: Mapping[str, str] | None = None) -> dict[str, Any]:
    """A compose file with its variables filled in; `$$` stays a dollar."""
    given = environment or {}

    def filled(match: re.Match[str]) -> str:
        return "$" if match[0] == "$$" else given.get(match[1], match[2])

    def within(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: within(inner) for key, inner in value.items()}
        if isinstance(value, list):
            return [within(inner) for inner in value]
        return VARIABLE.sub(filled, value) if isinstance(value, str) else value

    read_: dict[str, Any] = within(loaded(path))
    return read_


def faults(document: object) -> list[str]:
    """What of a document the schema does not allow."""
    return list(_faults(document, SCHEMA, "compose"))


def _faults(value: Any, schema: dict[str, Any], where: str) -> list[str]:
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[-1]
        return _faults(value, SCHEMA["definitions"][name], where)
    for key in ("oneOf", "anyOf"):
        if key in schema:
            tried = [_faults(value, each, where) for each in schema[key]]
            return [] if [] in tried else min(tried, key=len)
    kinds = [schema["type"]] if isinstance(schema.get("type"), str) else schema.get("type", [])
    if kinds and not any(_is(value, kind) for kind in kinds):
        return [f"{where} is no {' or '.join(kinds)}: {value!r}"]
    if "enum" in schema and value not in schema["enum"]:
        return [f"{where} is none of {schema['enum']}: {value!r}"]
    if isinstance(value, dict):
        return _object_faults(value, schema, where)
    if isinstance(value, list):
        again = schema.get("uniqueItems") and len({json.dumps(each) for each in value}) < len(value)
        inner = [f for i, each in enumerate(value) for f in _faults(each, schema.get("items", {}), f"{where}[{i}]")]
        return [f"{where} repeats an item", *inner] if again else inner
    return []


def _is(value: object, kind: str) -> bool:
    return isinstance(value, TYPES[kind]) and (kind == "boolean" or not isinstance(value, bool))


def _object_faults(value: dict[str, Any], schema: dict[str, Any], where: str) -> list[str]:
    found = [f"{where}.{key} is missing" for key in schema.get("required", []) if key not in value]
    patterns = schema.get("patternProperties", {})
    for key, inner in value.items():
        fitting = [each for pattern, each in patterns.items() if re.search(pattern, str(key))]
        known = schema.get("properties", {}).get(key) or next(iter(fitting), None)
        if known is None and not fitting and key not in schema.get("properties", {}):
            rest = schema.get("additionalProperties", True)
            if rest is False:
                found.append(f"{where} has no key {key!r}")
            known = rest if isinstance(rest, dict) else None
        found += _faults(inner, known or {}, f"{where}.{key}")
    return found
