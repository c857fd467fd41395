"""A map whose keys are taken one after the other, so that what nobody took can be said."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

from flocc_launch.datasets.calibrations.document import TwiceError, same, scalar


def plain(key: str) -> str:
    """A key without capitals, underscores, dots and dashes: `Camera_Matrix` and `cameraMatrix` are one."""
    return re.sub(r"[^a-z0-9]", "", key.lower())


class Keys:
    """Keys of a map, found by any of their usual spellings.

    Attributes:
        used: Plain names of those that were taken.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = dict(values)
        self.used: set[str] = set()

    def __contains__(self, name: str) -> bool:
        return any(True for _ in self._found(name))

    def _found(self, name: str) -> Iterator[tuple[str, Any]]:
        wanted = plain(name)
        return ((key, value) for key, value in self._values.items() if plain(key) == wanted and value is not None)

    def take(self, *names: str) -> Any:
        """Value of whichever of the names is there; None where none is.

        Raises:
            TwiceError: Two of them are, and say different things.
        """
        found = [(key, value) for name in names for key, value in self._found(name)]
        self.used.update(plain(name) for name in names)
        if not found:
            return None
        different = next((key for key, value in found if not same(value, found[0][1])), None)
        if different is not None:
            raise TwiceError(f"the keys {found[0][0]!r} and {different!r} say different things")
        return found[0][1]

    def number(self, *names: str) -> float | None:
        """A single number; None where no such key is there.

        Raises:
            ValueError: It is no number.
        """
        value = self.take(*names)
        if isinstance(value, list) and len(value) == 1:
            value = value[0]
        if isinstance(value, str):
            value = scalar(value)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{names[0]} must be a number, not {str(value)[:80]!r}")
        return float(value)

    def text(self, *names: str) -> str | None:
        """A text; None where no such key is there.

        Raises:
            ValueError: It is none.
        """
        value = self.take(*names)
        if value is None or isinstance(value, str):
            return value
        raise ValueError(f"{names[0]} must be a name, not {str(value)[:80]!r}")

    def numbers(self, *names: str) -> list[float] | None:
        """A list of numbers, flat: of a list, a list of rows, or an OpenCV matrix; None where no such key is there.

        Raises:
            ValueError: It is something else, or a matrix has not as many numbers as its size says.
        """
        value = self.take(*names)
        return None if value is None else flat_numbers(value, names[0])

    def value(self, key: str) -> Any:
        """What stands under a key, as it is spelled."""
        return self._values[key]

    def left(self) -> list[str]:
        """Keys that nobody took, and that hold something."""
        return [key for key, value in self._values.items() if plain(key) not in self.used and value is not None]


def flat_numbers(value: Any, name: str) -> list[float]:
    """Numbers of a list, a list of rows, or an OpenCV matrix.

    Raises:
        ValueError: It is something else, or of another size than it says.
    """
    if isinstance(value, dict):
        keys = Keys(value)
        rows, columns, data = keys.number("rows"), keys.number("cols", "columns"), keys.take("data")
        keys.used |= {"dt", "typeid"}
        if keys.left() or data is None:
            raise ValueError(f"{name} must be a list or a matrix, not {str(value)[:80]!r}")
        numbers = flat_numbers(data, name)
        if rows is not None and columns is not None and rows * columns != len(numbers):
            raise ValueError(f"{name} says {rows:g}x{columns:g} but has {len(numbers)} numbers")
        return numbers
    if isinstance(value, str):
        value = _listed_in_text(value)
    if not isinstance(value, list):
        raise ValueError(f"{name} must be a list of numbers, not {str(value)[:80]!r}")
    if any(isinstance(item, list) for item in value):
        if len({len(item) if isinstance(item, list) else -1 for item in value}) != 1:
            raise ValueError(f"{name} has rows of different lengths")
        return [number for row in value for number in flat_numbers(row, name)]
    wrong = next((item for item in value if isinstance(item, bool) or not isinstance(item, int | float)), None)
    if wrong is not None:
        raise ValueError(f"{name} must be a list of numbers; {str(wrong)[:80]!r} is none")
    return [float(item) for item in value]


def _listed_in_text(text: str) -> Any:
    """A list that somebody wrote as text: `0.1, 0.2` or `[0.1 0.2]`."""
    words = re.split(r"[\s,;]+", text.strip().strip("[]()").strip())
    try:
        return [float(word) for word in words if word]
    except ValueError:
        return text
