"""Which names a foreign pickle may use, and the stand-in that each gets."""

from collections.abc import Iterable
from typing import Any, cast

from physhandi.data.inert import (
    Array,
    Buffered,
    Callee,
    Ch,
    DataType,
    ElementType,
    Inert,
    Ordered,
    Scalar,
    Select,
    SparseMatrix,
    SparseRows,
    tensor,
)
from physhandi.errors import ImportFailedError


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    if not isinstance(text, str) or encoding not in {"latin1", "latin-1"}:
        raise ImportFailedError(f"it encodes text as {encoding!r}"[:80])
    return text.encode("latin1")


def _ordered(pairs: Any = ()) -> Ordered:
    return Ordered(cast("Iterable[tuple[Any, Any]]", pairs))


def _default(*_: Any) -> Ordered:
    return Ordered()


def _items(items: Any = ()) -> list[Any]:
    if not isinstance(items, list | tuple):
        raise ImportFailedError("it makes a container of something that is no list")
    return list(cast("Iterable[Any]", items))


def _bytes(content: Any = b"", encoding: Any = "latin1") -> bytes:
    if isinstance(content, str):
        return _encode(content, encoding)
    if not isinstance(content, bytes):
        raise ImportFailedError("it makes bytes of something that is no text")
    return content


def _blank(kind: Any, *_: Any) -> Inert:
    if not (isinstance(kind, type) and issubclass(kind, Inert)):
        raise ImportFailedError("it rebuilds an object of no known class")
    return kind()


def _same(value: Any, *_: Any) -> Any:
    return value


def _text(value: Any = "", *_: Any) -> str:
    return str(value) if isinstance(value, str | int) else ""


_BUILTINS = {
    "set": Callee(_items),
    "frozenset": Callee(_items),
    "list": Callee(_items),
    "dict": Callee(_ordered),
    "bytes": Callee(_bytes),
    "bytearray": Callee(_bytes),
    "object": Callee(_default),
}
_MULTIARRAY = {"_reconstruct": Callee(_blank), "scalar": Scalar}
_TORCH_CODES = {
    "Double": "f8", "Float": "f4", "Half": "f2", "BFloat16": "bfloat16", "Long": "i8", "Int": "i4",
    "Short": "i2", "Char": "i1", "Byte": "u1", "Bool": "?",
}  # fmt: skip
_COLUMNS = {"csc_matrix": SparseMatrix, "csc_array": SparseMatrix}
_ROWS = {"csr_matrix": SparseRows, "csr_array": SparseRows}
STAND_INS: dict[str, dict[str, Any]] = {
    "builtins": _BUILTINS,
    "__builtin__": _BUILTINS,
    "_codecs": {"encode": Callee(_encode)},
    "collections": {"OrderedDict": Callee(_ordered), "defaultdict": Callee(_default)},
    "copyreg": {"_reconstructor": Callee(_blank)},
    "copy_reg": {"_reconstructor": Callee(_blank)},
    "numpy": {"ndarray": Array, "dtype": DataType},
    "numpy.core.multiarray": _MULTIARRAY,
    "numpy._core.multiarray": _MULTIARRAY,
    "numpy.core.numeric": {"_frombuffer": Buffered},
    "numpy._core.numeric": {"_frombuffer": Buffered},
    "scipy.sparse.csc": _COLUMNS,
    "scipy.sparse._csc": _COLUMNS,
    "scipy.sparse.csr": _ROWS,
    "scipy.sparse._csr": _ROWS,
    "chumpy.ch": {"Ch": Ch},
    "chumpy.reordering": {"Select": Select},
}
"""What each name in a pickle stands for; any other name is refused."""
TORCH_STAND_INS: dict[str, dict[str, Any]] = {
    "torch": {
        **{f"{name}Storage": ElementType(code) for name, code in _TORCH_CODES.items()},
        "Size": Callee(_items),
        "device": Callee(_text),
    },
    "torch._utils": {
        "_rebuild_tensor_v2": Callee(tensor),
        "_rebuild_tensor": Callee(tensor),
        "_rebuild_parameter": Callee(_same),
    },
}
"""What else a torch checkpoint may name."""
