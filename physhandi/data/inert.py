"""Stand-ins for what a foreign pickle may name: they hold numbers and do nothing.

A pickle is a program that calls whatever it names. Here every name on a short list stands for an
object of this module, so that the program can only put numbers together; no class of NumPy,
SciPy, chumpy or torch is ever given to it, since their own ways to be rebuilt trust their input.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
from numpy import ndarray
from numpy.lib.stride_tricks import as_strided

from physhandi.errors import ImportFailedError

_PLAIN_KINDS = "biufcSU"
_BYTE_ORDERS = {"<", ">", "|", "="}


class Inert(ABC):
    """Something a pickle rebuilt; only `resolve` gives its value."""

    __slots__ = ("_arguments", "_state", "_value")
    _arguments: tuple[Any, ...]
    _state: Any
    _value: Any

    def __new__(cls, *arguments: Any) -> "Inert":
        """Keep what the pickle passes; nothing is done with it before `resolve`."""
        inert = super().__new__(cls)
        inert._arguments, inert._state, inert._value = arguments, None, None
        return inert

    def __setstate__(self, state: Any) -> None:
        self._state = state

    def resolve(self) -> Any:
        """Give the array (or plain value) that this stands for.

        Raises:
            ImportFailedError: If its parts do not fit together.
        """
        if self._value is None:
            self._value = self._build()
        return self._value

    @abstractmethod
    def _build(self) -> Any:
        """Rebuild the value from what the pickle passed."""

    def _fields(self, what: str) -> dict[Any, Any]:
        state = self._state
        if isinstance(state, tuple) and len(cast("tuple[Any, ...]", state)) == 2:
            state = cast("tuple[Any, ...]", state)[0]
        if not isinstance(state, dict):
            raise ImportFailedError(f"it holds {what} without content")
        return cast("dict[Any, Any]", state)


class Callee:
    """What a pickle may call: one function of this module, and nothing of it can be set."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        return self._function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise ImportFailedError("it sets attributes of a function")


class DataType(Inert):
    """A NumPy data type; only plain numbers and text."""

    __slots__ = ()

    def _build(self) -> Any:
        code = self._arguments[0] if self._arguments else None
        dtype = np.dtype(code) if isinstance(code, str) and len(code) < 12 else None
        if dtype is None or dtype.kind not in _PLAIN_KINDS or dtype.fields:
            kind = "Python objects" if dtype is not None and dtype.kind == "O" else repr(code)[:40]
            raise ImportFailedError(f"it holds a NumPy array of {kind}, not of plain numbers")
        state = self._state
        if isinstance(state, tuple) and len(cast("tuple[Any, ...]", state)) > 1:
            order = cast("tuple[Any, ...]", state)[1]
            if order not in _BYTE_ORDERS:
                raise ImportFailedError(f"it holds an array of unknown byte order {order!r}"[:80])
            dtype = dtype.newbyteorder(order)
        return dtype


class Array(Inert):
    """A NumPy array that is rebuilt from its state (version, shape, type, order, bytes)."""

    __slots__ = ()

    def _build(self) -> ndarray:
        state = self._state
        if not isinstance(state, tuple) or len(cast("tuple[Any, ...]", state)) != 5:
            raise ImportFailedError("it holds a NumPy array without content")
        _, shape, dtype, is_fortran, raw = cast("tuple[Any, ...]", state)
        return array_from_bytes(raw, dtype, shape, "F" if is_fortran else "C")


class Buffered(Inert):
    """A NumPy array that is rebuilt by one call (bytes, type, shape, order)."""

    __slots__ = ()

    def _build(self) -> ndarray:
        if len(self._arguments) != 4:
            raise ImportFailedError("it holds a NumPy array without content")
        return array_from_bytes(*self._arguments)


class Scalar(Inert):
    """A NumPy number; resolves to a Python number."""

    __slots__ = ()

    def _build(self) -> Any:
        if len(self._arguments) != 2:
            raise ImportFailedError("it holds a NumPy number without content")
        dtype, raw = self._arguments
        return array_from_bytes(raw, dtype, (), "C").item()


class SparseMatrix(Inert):
    """A SciPy matrix of compressed columns or rows; resolves to a dense array."""

    __slots__ = ()
    is_by_column = True

    def _build(self) -> ndarray:
        fields = self._fields("a sparse matrix")
        shape = tuple(integers(fields.get("_shape", fields.get("shape"))))
        parts = [resolved(fields.get(key)) for key in ("data", "indices", "indptr")]
        is_flat = all(
            isinstance(part, ndarray) and np.ndim(cast("Any", part)) == 1 for part in parts
        )
        if len(shape) != 2 or not is_flat:
            raise ImportFailedError("it holds a sparse matrix without content")
        data, index, end = parts
        major, minor = shape[::-1] if self.is_by_column else shape
        if len(end) != major + 1 or len(index) != len(data):
            raise ImportFailedError("it holds a sparse matrix whose parts do not fit together")
        count = np.diff(end)
        if len(index) and (index.min() < 0 or index.max() >= minor):
            raise ImportFailedError("it holds a sparse matrix with an index outside of it")
        if end[0] != 0 or end[-1] != len(index) or (count < 0).any():
            raise ImportFailedError("it holds a sparse matrix with indptr out of order")
        dense: Any = np.zeros((major, minor), data.dtype)
        np.add.at(dense, (np.repeat(np.arange(major), count), index), data)
        return np.ascontiguousarray(dense.T if self.is_by_column else dense)


class SparseRows(SparseMatrix):
    """A SciPy matrix of compressed rows."""

    __slots__ = ()
    is_by_column = False


class Ch(Inert):
    """chumpy's array: its state's ``x``."""

    __slots__ = ()

    def _build(self) -> ndarray:
        value: Any = resolved(self._fields("chumpy.ch.Ch").get("x"))
        if not isinstance(value, ndarray):
            raise ImportFailedError("it holds a chumpy.ch.Ch without an array")
        return cast("Any", value)


class Select(Inert):
    """chumpy's choice of elements: ``a.ravel()[idxs].reshape(preferred_shape)``."""

    __slots__ = ()

    def _build(self) -> ndarray:
        fields = self._fields("chumpy.reordering.Select")
        source, chosen = resolved(fields.get("a")), resolved(fields.get("idxs"))
        if not isinstance(source, ndarray):
            raise ImportFailedError("it holds a chumpy.reordering.Select without an array")
        source, chosen = cast("Any", source), np.asarray(chosen)
        if chosen.dtype.kind not in "iu" or (
            chosen.size and not 0 <= chosen.min() <= chosen.max() < source.size
        ):
            raise ImportFailedError("it holds a chumpy.reordering.Select with an index outside")
        value: Any = source.ravel()[chosen]
        if "preferred_shape" in fields:
            value = value.reshape(tuple(integers(fields["preferred_shape"])))
        return value


class Ordered(dict[Any, Any]):
    """A dictionary whose extra attributes are dropped."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        """Drop attributes, such as the version notes of a torch module."""


class Storage:
    """The numbers behind torch tensors."""

    __slots__ = ("values",)

    def __init__(self, values: ndarray) -> None:
        self.values = values

    def __setstate__(self, state: Any) -> None:
        raise ImportFailedError("it sets attributes of a torch storage")


class ElementType:
    """The number type of a torch storage."""

    __slots__ = ("code",)

    def __init__(self, code: str) -> None:
        self.code = code

    def __setstate__(self, state: Any) -> None:
        raise ImportFailedError("it sets attributes of a torch class")


def tensor(storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> ndarray:
    """Copy a torch tensor out of its storage.

    Raises:
        ImportFailedError: If it reaches beyond its storage.
    """
    if not isinstance(storage, Storage):
        raise ImportFailedError("it holds a torch tensor without a storage")
    shape, steps, (first,) = integers(size), integers(stride), integers([offset])
    values = storage.values
    last = first + sum((n - 1) * step for n, step in zip(shape, steps, strict=True))
    is_empty = math.prod(shape) == 0
    if min([first, *shape, *steps, 0]) < 0 or (not is_empty and last >= len(values)):
        raise ImportFailedError("it holds a torch tensor that reaches beyond its storage")
    if is_empty:
        return np.zeros(shape, values.dtype)
    width = values.itemsize
    view = as_strided(values[first:], shape, [step * width for step in steps], writeable=False)
    return np.array(view)


def array_from_bytes(raw: Any, dtype: Any, shape: Any, order: Any) -> ndarray:
    """Rebuild an array in the machine's byte order.

    Raises:
        ImportFailedError: If bytes, type and shape do not fit together.
    """
    kind: Any = resolved(dtype)
    if not isinstance(dtype, DataType) or order not in {"C", "F"}:
        raise ImportFailedError("it holds a NumPy array of an unknown type")
    if isinstance(raw, list):
        raise ImportFailedError("it holds a NumPy array of Python objects, not of plain numbers")
    if isinstance(raw, str):
        raw = raw.encode("latin1")
    if not isinstance(raw, bytes | bytearray | memoryview):
        raise ImportFailedError("it holds a NumPy array without content")
    size, content = tuple(integers(shape)), bytes(cast("bytes", raw))
    if min(size, default=0) < 0 or math.prod(size) * kind.itemsize != len(content):
        raise ImportFailedError(f"it holds a NumPy array of shape {size} in {len(content)} bytes")
    if not content:
        return np.zeros(size, kind.newbyteorder("="))
    array: Any = np.frombuffer(content, kind).reshape(size, order=order)
    return np.array(array, dtype=kind.newbyteorder("="), order="C")


def integers(value: Any) -> list[int]:
    """Check a shape or the like.

    Raises:
        ImportFailedError: If it is something else than a short list of integers.
    """
    value = resolved(value)
    if isinstance(value, ndarray):
        value = value.tolist()
    if not isinstance(value, list | tuple):
        raise ImportFailedError("it holds an array whose shape is no list of integers")
    numbers = [resolved(number) for number in cast("Sequence[Any]", value)]
    if len(numbers) > 32 or not all(type(number) is int for number in numbers):
        raise ImportFailedError("it holds an array whose shape is no list of integers")
    return numbers


def resolved(value: Any) -> Any:
    """Give what a stand-in stands for, and anything else as it is."""
    return value.resolve() if isinstance(value, Inert) else value
