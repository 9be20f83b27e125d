"""Fields of a foreign case's files: taken by name, checked for kind, shape and plausible values."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from physhandi.data.length_unit import FARTHEST as FARTHEST
from physhandi.errors import ImportFailedError

_UNIT = "That looks like millimetres. Convert it to metres"
_LARGEST_JSON = 64_000_000


def fail(path: Path, reason: str) -> NoReturn:
    """Refuse a file; `reason` goes on after the file's name."""
    raise ImportFailedError(f"{path}: {reason}.")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds named fields.

    Raises:
        ImportFailedError: If it does not.
    """
    try:
        if path.stat().st_size > _LARGEST_JSON:
            fail(path, f"is larger than {_LARGEST_JSON} bytes")
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        reason = "is missing" if isinstance(error, FileNotFoundError) else f"is no JSON: {error}"
        raise ImportFailedError(f"{path}: {reason}.") from error
    return named(path, content)


def named(path: Path, content: Any) -> dict[str, Any]:
    """Take content as named fields.

    Raises:
        ImportFailedError: If it is something else.
    """
    if not isinstance(content, dict):
        fail(path, f"holds {type(content).__name__}; expected named fields")
    return cast("dict[str, Any]", content)


def numbers(
    path: Path, table: Mapping[str, Any], field: str, axes: tuple[str | int, ...]
) -> Float[ndarray, "*axis"]:
    """Take a field as float64 numbers.

    Args:
        path: File that the field is from, for messages.
        table: The file's fields.
        field: Name of the field.
        axes: Size of each axis, or a word for a size that is free.

    Raises:
        ImportFailedError: If it is missing or something else.
    """
    return _array(path, table, field, axes, "fiu").astype(np.float64)


def optional_points(path: Path, table: Mapping[str, Any], field: str) -> Float[ndarray, "point 3"]:
    """Take a field as points; without it, or if it is empty in any shape, there are none."""
    if np.size(table.get(field, ())) == 0:
        return np.zeros((0, 3))
    return numbers(path, table, field, ("point", 3))


def flags(
    path: Path, table: Mapping[str, Any], field: str, axes: tuple[str | int, ...]
) -> Bool[ndarray, "*axis"]:
    """Take a field as booleans; the numbers 0 and 1 will do.

    Raises:
        ImportFailedError: If it is missing or something else.
    """
    value = _array(path, table, field, axes, "bfiu")
    if not np.isin(value, (0, 1)).all():
        fail(path, f"{field} holds other values than true and false")
    return value.astype(np.bool_)


def check_points(
    path: Path,
    field: str,
    point: Float[ndarray, "frame point 3"],
    is_visible: Bool[ndarray, "frame point"] | None = None,
) -> None:
    """Check that visible points are finite, near, and not at PhysTwin's mark for invisible ones.

    Raises:
        ImportFailedError: At the first one that is not; names frame and point.
    """
    for is_wrong, remedy in (
        (~np.isfinite(point).all(axis=-1), "Repair it, or mark it as not visible"),
        (~point.any(axis=-1), "That stands for 'not visible', but it is not marked so"),
        (np.abs(np.nan_to_num(point)).max(axis=-1, initial=0.0) > FARTHEST, _UNIT),
    ):
        place = np.argwhere(is_wrong if is_visible is None else is_wrong & is_visible)
        if place.size:
            frame, number = place[0]
            value = point[frame, number].tolist()
            fail(path, f"{field}: frame {frame}, point {number} is {value}. {remedy}")


def _array(
    path: Path, table: Mapping[str, Any], field: str, axes: tuple[str | int, ...], kinds: str
) -> ndarray:
    text = "(" + ", ".join(map(str, axes)) + ")"
    if field not in table:
        known = ", ".join(map(str, table)) or "none"
        fail(path, f"field '{field}' {text} is missing; it has the fields {known}")
    try:
        value = np.asarray(table[field])
    except ValueError:
        fail(path, f"{field} is ragged; expected numbers {text}")
    if value.dtype.kind not in kinds:
        fail(path, f"{field} holds {value.dtype}; expected numbers {text}")
    fits = value.ndim == len(axes) and all(
        isinstance(axis, str) or size == axis for size, axis in zip(value.shape, axes, strict=True)
    )
    if not fits:
        fail(path, f"{field} has shape {value.shape}; expected {text}")
    return value
