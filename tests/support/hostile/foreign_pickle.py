"""Writes pickles as Python 2 wrote them, with classes that this machine need not have."""

import io
import pickle
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse


@dataclass(frozen=True)
class Global:
    """A name that the pickle asks for."""

    module: str
    name: str


@dataclass(frozen=True, eq=False)
class New:
    """An object of a named class, with its state."""

    kind: Global
    state: Any


@dataclass(frozen=True, eq=False)
class Call:
    """The result of a call."""

    function: Any
    arguments: tuple[Any, ...]
    state: Any = None


class _Pickler(pickle._Pickler):  # type: ignore[name-defined]  # its Python form, to extend it
    def save(self, value: Any, save_persistent_id: bool = True) -> None:
        if isinstance(value, Global):
            self.write(b"c" + f"{value.module}\n{value.name}\n".encode())
        elif isinstance(value, str | bytes):
            raw = value.encode("latin1") if isinstance(value, str) else value
            self.write(b"T" + struct.pack("<i", len(raw)) + raw)
        elif isinstance(value, New):
            self.save(value.kind)
            self.write(b")\x81")
            self.save(value.state)
            self.write(b"b")
        elif isinstance(value, Call):
            self.save(value.function)
            self.save(value.arguments)
            self.write(b"R")
            if value.state is not None:
                self.save(value.state)
                self.write(b"b")
        else:
            super().save(value, save_persistent_id)


def python2_pickle(value: Any) -> bytes:
    """Pickle by protocol 2, all text as Python 2's byte strings."""
    stream = io.BytesIO()
    _Pickler(stream, protocol=2).dump(_replaced(value))
    return stream.getvalue()


def chumpy_array(value: np.ndarray) -> New:
    """Write an array as ``chumpy.ch.Ch`` does."""
    notes = {"_dirty_vars": Call(Global("__builtin__", "set"), (["x"],)), "_itr": None}
    return New(Global("chumpy.ch", "Ch"), {"x": value, **notes, "_make_dense": False})


def chumpy_select(value: np.ndarray) -> New:
    """Write an array as ``chumpy.reordering.Select`` does, out of a larger array."""
    larger = np.concatenate([np.full(7, 99.0), value.ravel()[::-1]])
    chosen = np.arange(len(larger) - 1, 6, -1)
    state = {"a": chumpy_array(larger), "idxs": chosen, "preferred_shape": value.shape}
    return New(Global("chumpy.reordering", "Select"), state)


def _replaced(value: Any) -> Any:
    if isinstance(value, dict):
        value = {key: _replaced(item) for key, item in value.items()}
    elif isinstance(value, list | tuple):
        value = type(value)(_replaced(item) for item in value)
    elif isinstance(value, New):
        value = New(value.kind, _replaced(value.state))
    elif isinstance(value, Call):
        value = Call(value.function, _replaced(value.arguments), _replaced(value.state))
    elif isinstance(value, np.ndarray):
        value = _array(value)
    elif scipy.sparse.issparse(value):
        value = _sparse_matrix(value)
    return value


def _array(value: np.ndarray) -> Call:
    kind = value.dtype.str[1:]
    dtype = Call(Global("numpy", "dtype"), (kind, 0, 1), (3, "<", None, None, None, -1, -1, 0))
    is_fortran = value.flags.f_contiguous and not value.flags.c_contiguous
    raw = value.tobytes(order="F" if is_fortran else "C")
    state = (1, value.shape, dtype, is_fortran, raw)
    blank = (Global("numpy", "ndarray"), (0,), "b")
    return Call(Global("numpy.core.multiarray", "_reconstruct"), blank, state)


def _sparse_matrix(value: Any) -> New:
    parts = {"data": value.data, "indices": value.indices, "indptr": value.indptr}
    state = {"_shape": value.shape, "maxprint": 50, "format": value.format, **parts}
    kind = Global(f"scipy.sparse.{value.format}", f"{value.format}_matrix")
    return New(kind, _replaced(state))
