"""Measurements in their text form: a kind, names and numbers, as files beside a data set and scenarios have them."""

from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from typing import Any, get_args

import numpy as np

from flocc_agent.core.measurements import BadMeasurement, Measurement
from flocc_agent.geometry import R_from_q_wxyz, pose_from_tq
from flocc_protocol.ids import KeyframeId

KINDS: dict[str, type[Measurement]] = {kind.kind: kind for kind in get_args(Measurement)}


def measurement_of(kind: str, values: Mapping[str, Any]) -> Measurement:
    """Read a measurement of its text form, as files have it: names and numbers.

    Names say how numbers are read: `T_*` is x y z and a quaternion w x y z, `R_*` a quaternion w x y z, `covariance*`
    all numbers of a square matrix, row by row, or its diagonal.

    Raises:
        BadMeasurement: The kind or a field is not known, one is missing, or its value cannot be used.
    """
    cls = KINDS.get(kind)
    if cls is None:
        raise BadMeasurement(f"{kind!r} is no kind of measurement; kinds are {', '.join(KINDS)}")
    known = [field.name for field in fields(cls) if not field.name.startswith("_")]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise BadMeasurement(f"{kind}: {unknown[0]!r} is not one of its fields: {', '.join(known)}")
    try:
        return cls(**{field.name: _read(field, values[field.name]) for field in fields(cls) if field.name in values})
    except TypeError as error:
        if missing := [field for field in known if field not in values and _is_needed(cls, field)]:
            raise BadMeasurement(f"{kind}: {missing[0]} is missing") from error
        raise BadMeasurement(f"{kind}: a field has a value of the wrong type") from error
    except BadMeasurement:
        raise
    except (ValueError, OverflowError) as error:
        raise BadMeasurement(f"{kind}: {error}") from error


def _typed(value: Any, types: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, types):
        raise TypeError(f"{value!r} is of the wrong type")
    return value


def _is_needed(cls: type[Measurement], name: str) -> bool:
    return next(field.default is MISSING for field in fields(cls) if field.name == name)


def _read(field: Field[Any], value: Any) -> Any:
    """One field of a text form; what its class checks stays as it is.

    Raises:
        TypeError: It is of another type than the field.
    """
    name = field.name
    if field.type is KeyframeId:
        return KeyframeId.parse(_typed(value, str))
    if field.type is float:
        return float(_typed(value, int | float))
    if field.type is str:
        return str(_typed(value, str | int))
    if value is None and field.default is None:
        return None
    numbers = np.array(_typed(value, list), dtype=float)
    if name.startswith("T_") and numbers.shape == (7,):
        return pose_from_tq(numbers)
    if name.startswith("R_") and numbers.shape == (4,):
        return R_from_q_wxyz(numbers)
    if name.startswith("covariance") and numbers.ndim == 1:
        side = {3: 3, 9: 3, 6: 6, 36: 6}.get(len(numbers), 0)
        return np.diag(numbers) if len(numbers) == side else numbers.reshape(side, -1) if side else numbers
    return numbers
