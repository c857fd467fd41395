"""Text tables as other tools write them: any UTF, any line end, commas, semicolons, tabs, decimal commas, comments.

What a table means is not known here; see `columns` and `trajectory_text`.
"""

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from flocc_protocol.errors import FloccError

COMMENTS = ("#", "%", "//")
BYTES_MAX = 1 << 30

_BOMS = (
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_CONTROLS = bytes([*range(1, 9), *range(14, 32)])
CONTROLS_RATIO_MAX = 0.02
_QUOTED = re.compile(r'"([^"]*)"')
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")
_BRACKETS = str.maketrans("", "", "[](){}")
"""Lists as programs print them."""


class RecordingError(FloccError):
    """A recording that cannot be used; the message names the file and, where there is one, the line."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of a text file.

    Attributes:
        path: The file.
        headers: Lines before the first row that may name its columns: comments, and a line without a number.
        rows: Line numbers and fields, as text.
        trailing_separator: Whether rows end with a separator, as some programs write them.
        remarks: Comments behind the first row.
    """

    path: Path
    headers: tuple[tuple[int, str], ...]
    rows: list[tuple[int, list[str]]]
    trailing_separator: bool
    remarks: tuple[tuple[int, str], ...] = ()


def read_text(path: Path) -> str:
    """A text file in UTF-8 or UTF-16, with or without a byte order mark, or else in Latin-1.

    Raises:
        RecordingError: It cannot be read, or is no text.
    """
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise RecordingError(f"{path}: is not a file")
        if path.stat().st_size > BYTES_MAX:
            raise RecordingError(f"{path}: has more than {BYTES_MAX >> 20} MiB, too many for a text")
        encoded = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    for mark, encoding in _BOMS:
        if encoded.startswith(mark):
            return _decoded(encoded[len(mark) :], encoding, path)
    head = encoded[:4096]
    even, odd = head[0::2].count(b"\0"), head[1::2].count(b"\0")
    if max(even, odd) >= 0.4 * len(head) / 2 and min(even, odd) <= 0.1 * len(head) / 2 and head:
        return _decoded(encoded, "utf-16-le" if odd > even else "utf-16-be", path)
    if len(head) - len(head.translate(None, _CONTROLS)) > CONTROLS_RATIO_MAX * len(head):
        raise RecordingError(f"{path}: is no text")
    try:
        return encoded.decode("utf-8")
    except UnicodeDecodeError:
        return encoded.decode("latin-1")


def _decoded(encoded: bytes, encoding: str, path: Path) -> str:
    try:
        return encoded.decode(encoding)
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: is no text: {error.reason} at byte {error.start}") from None


def numbered_lines(path: Path) -> list[tuple[int, str]]:
    """Line numbers and stripped lines that are not empty; comments are there.

    Raises:
        RecordingError: It cannot be read, or is no text.
    """
    lines = re.split(r"\r\n|\n|\r", read_text(path))
    return [(number, text) for number, line in enumerate(lines, start=1) if (text := line.strip("﻿ \t\0"))]


def is_number(word: str) -> bool:
    """Whether a word is a number, also nan and inf."""
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield (line number, text) of a text file, without comments and empty lines.

    Raises:
        RecordingError: It cannot be read, or is no text.
    """
    yield from ((line, text) for line, text in numbered_lines(path) if not text.startswith("#"))


def number_lines(path: Path, count: int) -> Iterator[tuple[int, list[float]]]:
    """Yield (line number, numbers) of a text table, without comments; commas separate as well.

    Raises:
        RecordingError: The file cannot be read, or a line has fewer than `count` numbers.
    """
    for line, text in text_lines(path):
        words = re.split(r"[\s,;]+", text.strip(",;"))
        odd = next((word for word in words if not is_number(word)), None)
        if odd is not None:
            raise RecordingError(f"{path}:{line}: {odd!r} is not a number")
        if len(words) < count:
            raise RecordingError(f"{path}:{line}: {count} numbers are needed, {len(words)} were found")
        yield line, [float(word) for word in words]


def read_table(path: Path) -> Table:
    """Split a text file into rows of fields.

    Raises:
        RecordingError: It cannot be read, or is no text.
    """
    headers: list[tuple[int, str]] = []
    remarks: list[tuple[int, str]] = []
    lines: list[tuple[int, str]] = []
    for number, text in numbered_lines(path):
        if text.startswith(COMMENTS):
            (remarks if lines else headers).append((number, text.lstrip("#%/ \t")))
        elif bare := re.sub(r"\s*(?:#|//).*", "", text):
            lines.append((number, bare))
    while lines and _is_words(lines[0][1]):
        headers.append(lines.pop(0))
    split = _Splitter(lines[0][1] if lines else "")
    rows = [(number, split(text)) for number, text in lines]
    trailing = bool(lines) and lines[0][1].rstrip().endswith((",", ";"))
    return Table(path, tuple(headers), rows, trailing, tuple(remarks))


def _is_words(text: str) -> bool:
    """Whether most of a line is no numbers, as of one that names columns."""
    words = [word.strip("\"'") for word in re.split(r"[\s;,]+", text) if word]
    return sum(is_number(word) for word in words) < len(words) / 2


def _without_commas(found: re.Match[str]) -> str:
    """A quoted field as one word: a number with a decimal comma gets a point, a list loses its commas."""
    inner = found[1].strip()
    return inner.replace(",", "." if _DECIMAL_COMMA.fullmatch(inner) else "\u00b7").replace(" ", "")


class _Splitter:
    """Splits rows as the first one is written."""

    def __init__(self, first: str) -> None:
        words = first.split()
        self._semicolons = ";" in first
        inner = [word for word in words if _DECIMAL_COMMA.fullmatch(word)]
        spaced = len(words) >= 4 and bool(inner) and not any("." in word or word.endswith(",") for word in words)
        self._decimal_comma = spaced or (self._semicolons and "," in first)
        self._commas = "," in first and not self._decimal_comma

    def __call__(self, text: str) -> list[str]:
        text = text.translate(_BRACKETS)
        if self._semicolons:
            text = _QUOTED.sub(lambda found: found[1].replace(";", "\u00b7"), text)
            fields = [field.strip(" \t\"'") for field in text.split(";")]
        elif self._commas:
            text = _QUOTED.sub(_without_commas, text)
            fields = [field.strip(" \t\"'") for field in text.split(",")]
            if any(" " in field and is_number(field.split()[0]) for field in fields):
                fields = re.split(r"[\s,]+", text)
        else:
            fields = text.split()
        while fields and not fields[-1]:
            fields.pop()
        return [field.replace(",", ".") for field in fields] if self._decimal_comma else fields
