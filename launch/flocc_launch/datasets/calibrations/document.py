"""A calibration file as nested maps, lists, numbers and texts: YAML (with OpenCV's dialect), JSON, OpenCV's XML.

YAML is parsed by ruamel.yaml and built up here, so that no key is lost: one that stands twice must say the same twice.
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from flocc_launch.datasets.source import DatasetError

Value = Any
"""dict[str, Value], list[Value], str, int, float, bool or None."""

BYTES_MAX = 16 * 1024 * 1024
NODES_MAX = 200_000
"""Values of a YAML file; one that refers to its own parts again and again would be endless."""
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?f?")
_WHOLE = re.compile(r"[-+]?\d+")
_WORDS = {"true": True, "false": False, "null": None, "~": None, "": None}
_SPECIAL = {
    ".nan": float("nan"),
    ".inf": float("inf"),
    "-.inf": float("-inf"),
    "nan": float("nan"),
    "inf": float("inf"),
}
_MARKS = ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))


class TwiceError(ValueError):
    """A key stands twice and says two things."""


def read_text(path: Path) -> str:
    """Text of a file in UTF-8 or UTF-16, or in Latin-1 where it is neither.

    Raises:
        DatasetError: It cannot be read, is large, or is no text.
    """
    try:
        if path.exists() and not path.is_file():
            raise DatasetError(f"{path}: is not a file")
        data = path.read_bytes() if path.stat().st_size <= BYTES_MAX else None
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
    if data is None:
        raise DatasetError(f"{path}: has more than {BYTES_MAX} bytes, which is no calibration")
    encoding = next((name for mark, name in _MARKS if data.startswith(mark)), None)
    if encoding is None and b"\0" in data:
        raise DatasetError(f"{path}: is a binary file; flocc reads calibrations as text{_binary_advice(path)}")
    try:
        return data.decode(encoding or "utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _binary_advice(path: Path) -> str:
    advice = {
        ".bin": ": COLMAP writes cameras.txt with colmap model_converter --output_type TXT",
        ".mat": ": write the numbers of MATLAB's file as YAML (docs/data-sets.md)",
        ".npz": ": write the numbers of numpy's file as YAML (docs/data-sets.md)",
        ".npy": ": write the numbers of numpy's file as YAML (docs/data-sets.md)",
        ".pkl": ": write the numbers of the pickle as YAML (docs/data-sets.md)",
    }
    return advice.get(path.suffix.lower(), "")


def parsed_yaml(text: str) -> Value:
    """Parse YAML; of several documents (`ros2 topic echo`), which must agree but for their headers, the first.

    Raises:
        ValueError: It is no YAML, or documents or keys contradict each other.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    try:
        nodes = [node for node in YAML(pure=True).compose_all(_plain_yaml(text)) if node is not None]
    except MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f" in line {error.problem_mark.line + 1}"
        raise ValueError(f"is no YAML{line}: {error.problem}") from error
    except YAMLError as error:
        raise ValueError(f"is no YAML: {' '.join(str(error).split())}") from error
    builder = _Builder()
    values = [value for node in nodes if (value := builder(node)) is not None]
    bare = [_without_header(value) for value in values]
    if any(value != bare[0] for value in bare[1:]):
        raise TwiceError(f"has {len(values)} documents that say different things; keep one of them")
    return values[0] if values else None


def _plain_yaml(text: str) -> str:
    """OpenCV's dialect as YAML: no `%YAML:1.0`, spaces for tabs, a space after every key's colon."""
    opencv = text.lstrip().startswith("%YAML:")
    text = re.sub(r"\A(\s*)%YAML[^\n]*", r"\1", text)
    if not opencv:
        return text
    text = "\n".join(line.expandtabs(4) for line in text.splitlines())
    return re.sub(r"^(\s*[\w.]+):(?=[-+\d\[\"'.])", r"\1: ", text, flags=re.MULTILINE)


class _Builder:
    """Values of YAML's nodes, at most `NODES_MAX` of them."""

    def __init__(self) -> None:
        self._count = 0

    def __call__(self, node: Any) -> Value:
        from ruamel.yaml.nodes import MappingNode, SequenceNode

        self._count += 1
        if self._count > NODES_MAX:
            raise ValueError(f"has more than {NODES_MAX} values, which is no calibration")
        if isinstance(node, SequenceNode):
            return [self(item) for item in node.value]
        if isinstance(node, MappingNode):
            return self._map(node)
        return str(node.value) if node.style in ('"', "'") else scalar(str(node.value))

    def _map(self, node: Any) -> dict[str, Value]:
        """A map; what `<<` takes over from others stands where the map itself says nothing."""
        pairs = [(str(key.value), self(value), f" in line {key.start_mark.line + 1}") for key, value in node.value]
        own = merged(pair for pair in pairs if pair[0] != "<<")
        taken = [
            each for key, value, _ in pairs if key == "<<" for each in (value if isinstance(value, list) else [value])
        ]
        if not all(isinstance(each, dict) for each in taken):
            raise ValueError("has a key '<<' that names no map")
        for each in taken:
            own = {**each, **own}
        return own


def merged(pairs: Iterable[tuple[str, Value, str]]) -> dict[str, Value]:
    """A map of keys and values that may stand more than once.

    Raises:
        TwiceError: A key has two values; the sentence says where.
    """
    values: dict[str, Value] = {}
    for key, value, where in pairs:
        if key in values and not same(values[key], value):
            raise TwiceError(f"the key {key!r} stands twice with different values{where}")
        values[key] = value
    return values


def same(a: Value, b: Value) -> bool:
    """Whether two values are equal, where no number is equal to itself too."""
    return bool(a == b) or (isinstance(a, float) and isinstance(b, float) and a != a and b != b)


def scalar(text: str) -> Value:
    """A number, a truth value, nothing, or text, as it is written."""
    plain = text.strip()
    if _WHOLE.fullmatch(plain):
        return int(plain)
    if _NUMBER.fullmatch(plain):
        return float(plain.rstrip("f"))
    lower = plain.lower()
    return _WORDS[lower] if lower in _WORDS else _SPECIAL.get(lower, plain)


def _without_header(value: Value) -> Value:
    return {key: each for key, each in value.items() if key != "header"} if isinstance(value, dict) else value


def parsed_json(text: str) -> Value:
    """Parse JSON.

    Raises:
        ValueError: It is none, or a key contradicts itself.
    """
    try:
        return json.loads(text, object_pairs_hook=lambda pairs: merged((key, value, "") for key, value in pairs))
    except json.JSONDecodeError as error:
        raise ValueError(f"is no JSON in line {error.lineno}: {error.msg}") from error


def parsed_xml(text: str) -> Value:
    """Parse the XML that OpenCV writes.

    Raises:
        ValueError: It is none, or not of OpenCV.
    """
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("is XML with a document type, which no calibration needs")
    try:
        root = ElementTree.fromstring(re.sub(r"\A\s*<\?xml.*?\?>", "", text, flags=re.DOTALL))
    except ElementTree.ParseError as error:
        raise ValueError(f"is no XML: {error}") from error
    if root.tag != "opencv_storage":
        raise ValueError(
            f"is XML with the root <{root.tag}>; flocc reads the XML of OpenCV (<opencv_storage>): of Metashape, "
            "export OpenCV's form"
        )
    return _element(root)


def _element(element: ElementTree.Element) -> Value:
    if element.get("type_id") == "opencv-matrix":
        children = {child.tag: (child.text or "").split() for child in element}
        data = [scalar(word) for word in children.pop("data", [])]
        return {**{key: scalar(words[0]) for key, words in children.items() if words}, "data": data}
    if len(element):
        if all(child.tag == "_" for child in element):
            return [_element(child) for child in element]
        return merged((child.tag, _element(child), "") for child in element)
    words = (element.text or "").split()
    return scalar(words[0]) if len(words) == 1 else [scalar(word) for word in words] or None
