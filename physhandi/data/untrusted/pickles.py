"""Foreign pickles, read in a child process that cannot execute what they ask for.

A pickle is a program. Nothing in it is trusted: the child knows only stand-ins for containers and
arrays, has limits of memory and time, and hands back arrays (.npz) and a tree (JSON). NumPy is
loaded once, by a process that reads each file in a copy of itself, which ends with the file.
"""

import atexit
import encodings.cp437 as zip_text
import gc
import io
import json
import logging
import math
import os
import pickle
import resource
import signal
import sys
import tempfile
import threading
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy import ndarray
from numpy.lib.stride_tricks import as_strided

from physhandi.child import AnsweringChild, Channel, ChildEndedError, die_with_parent, run_child
from physhandi.errors import ImportFailedError, PhysHandiError, describe

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
    """Function of this module that a pickle may call; no attribute of it can be set."""

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
"""Stand-in of each name in a pickle; any other name is refused."""
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
"""Stand-ins of further names in torch checkpoints."""


TEXT_OF_ARCHIVES = zip_text.getregentry()
"""Loaded here, since names in an archive need it when nothing may be loaded any more."""
ZIP_MAGIC = b"PK\x03\x04"
_MOST_VALUES = 500_000
_DEEPEST = 64
_WIDEST_INTEGER = 1024
_CALLS = ("os", "subprocess", "socket", "exec", "compile", "import", "open", "ctypes", "shutil")


class InertUnpickler(pickle.Unpickler):
    """Builds a pickle's tree from stand-ins; any name without one is refused."""

    def __init__(self, stream: io.BufferedIOBase, archive: zipfile.ZipFile | None = None) -> None:
        super().__init__(stream, encoding="latin1")
        self._archive = archive
        self._storages: dict[str, Storage] = {}
        self._names = STAND_INS if archive is None else {**STAND_INS, **TORCH_STAND_INS}

    def find_class(self, module: str, name: str, /) -> Any:
        """Give the stand-in of a name.

        Raises:
            ImportFailedError: If it has none.
        """
        stand_in = self._names.get(module, {}).get(name)
        if stand_in is None:
            raise ImportFailedError(f"it asks for {module}.{name}"[:200])
        return stand_in

    def persistent_load(self, pid: Any) -> Storage:
        """Read the storage of a torch tensor from the archive.

        Raises:
            ImportFailedError: If there is no archive, or no such storage in it.
        """
        parts = cast("tuple[Any, ...]", pid) if isinstance(pid, tuple) else ()
        if self._archive is None or len(parts) != 5 or parts[0] != "storage":
            raise ImportFailedError("it refers to an object outside of the file")
        _, element, key, _, count = parts
        if not (isinstance(element, ElementType) and isinstance(key, str) and key.isdigit()):
            raise ImportFailedError("it refers to a torch storage of an unknown kind")
        if key not in self._storages:
            content = member(self._archive, f"data/{key}")
            self._storages[key] = Storage(_elements(content, element.code, self._order()))
        if len(self._storages[key].values) != count:
            raise ImportFailedError(f"its torch storage {key} has another size than is said")
        return self._storages[key]

    def _order(self) -> str:
        archive = cast("zipfile.ZipFile", self._archive)
        if any(name.endswith("/byteorder") for name in archive.namelist()):
            return ">" if member(archive, "byteorder") == b"big" else "<"
        return "<"


def member(archive: zipfile.ZipFile, name: str) -> bytes:
    """Read one file of a torch checkpoint, below its only folder.

    Raises:
        ImportFailedError: If it is missing or compressed (torch never compresses; bombs do).
    """
    folder = archive.namelist()[0].split("/")[0]
    try:
        entry = archive.getinfo(f"{folder}/{name}")
    except KeyError:
        raise ImportFailedError(f"it is a zip archive without {folder}/{name}"[:200]) from None
    if entry.compress_type != zipfile.ZIP_STORED:
        raise ImportFailedError(f"its {entry.filename} is compressed; torch does not do that"[:200])
    return archive.read(entry)


def _elements(content: bytes, code: str, order: str) -> ndarray:
    dtype = np.dtype("u2" if code == "bfloat16" else code)
    if len(content) % dtype.itemsize:
        raise ImportFailedError("one of its torch storages is cut off")
    values = np.frombuffer(content, dtype.newbyteorder(cast("Any", order)))
    values = values.astype(dtype.newbyteorder("="))
    return (values.astype("u4") << 16).view("f4") if code == "bfloat16" else values


class Tree:
    """A tree of plain values as JSON, its arrays apart."""

    def __init__(self, most_bytes: int) -> None:
        self.arrays: list[ndarray] = []
        self._index: dict[int, int] = {}
        self._value_count = 0
        self._free = most_bytes

    def encode(self, value: Any, depth: int = 0) -> Any:
        """Turn a value into what JSON has: containers are tagged, arrays are numbered.

        Raises:
            ImportFailedError: If the tree is too deep (or a loop), too large, or has another kind.
        """
        value = resolved(value)
        self._value_count += 1
        if depth > _DEEPEST:
            raise ImportFailedError(f"it is nested deeper than {_DEEPEST} levels, or in a loop")
        if self._value_count > _MOST_VALUES:
            raise ImportFailedError(f"it holds more than {_MOST_VALUES} values")
        if value is None or isinstance(value, bool | float | str):
            return value
        if isinstance(value, int) and value.bit_length() <= _WIDEST_INTEGER:
            return value
        if isinstance(value, bytes | bytearray):
            return value.decode("latin1")
        if isinstance(value, ndarray):
            return {"array": self._array(cast("Any", value))}
        return self._container(value, depth + 1)

    def _container(self, value: Any, depth: int) -> Any:
        if isinstance(value, dict):
            pairs = cast("dict[Any, Any]", value).items()
            return {"dict": [[self.encode(k, depth), self.encode(v, depth)] for k, v in pairs]}
        for kind, tag in ((tuple, "tuple"), (list, "list"), (set, "list"), (frozenset, "list")):
            if isinstance(value, kind):
                return {tag: [self.encode(item, depth) for item in cast("list[Any]", value)]}
        raise ImportFailedError(f"it holds a {type(value).__name__}, which is no plain value")

    def _array(self, value: ndarray) -> int:
        if id(value) not in self._index:
            self._free -= value.nbytes
            if self._free < 0:
                raise ImportFailedError("its arrays need more memory than is allowed")
            self._index[id(value)] = len(self.arrays)
            self.arrays.append(value)
        return self._index[id(value)]


def build_tree(stream: io.BufferedIOBase) -> Any:
    """Build the tree of a pickle or a torch checkpoint from stand-ins.

    Raises:
        ImportFailedError: If it names anything else.
    """
    is_archive = stream.read(4) == ZIP_MAGIC
    stream.seek(0)
    if not is_archive:
        tree = InertUnpickler(stream).load()
        if stream.read(1):
            raise ImportFailedError("more follows its first pickle, as in torch files before 1.6")
        return tree
    with zipfile.ZipFile(stream) as archive:
        content = io.BytesIO(member(archive, "data.pkl"))
        return InertUnpickler(content, archive).load()


def convert(stream: io.BufferedIOBase, most_bytes: int) -> tuple[Any, list[ndarray]]:
    """Read a file into what JSON has, and its arrays, which may take a quarter of the bytes.

    Raises:
        ImportFailedError: If the file is refused or broken.
    """
    tree = Tree(most_bytes // 4)
    try:
        return tree.encode(build_tree(stream)), tree.arrays
    except ImportFailedError:
        raise
    except (MemoryError, OverflowError):
        raise ImportFailedError("it needs more memory than is allowed") from None
    except RecursionError:
        raise ImportFailedError("it is nested too deeply") from None
    except Exception as error:  # noqa: BLE001 - a broken pickle can raise nearly anything
        raise ImportFailedError(f"it is no whole pickle ({error})"[:200]) from None


def read(source: Path, out: Path, most_bytes: int) -> None:
    """Read a file and write what it holds in formats that cannot execute anything.

    Raises:
        ImportFailedError: If the file is refused or broken.
    """
    with source.open("rb") as stream:
        watched = forbid_calls()
        try:
            tree, arrays = convert(stream, most_bytes)
        finally:
            watched.clear()
    named: Any = {str(number): array for number, array in enumerate(arrays)}
    np.savez(out / "array.npz", allow_pickle=False, **named)
    (out / "tree.json").write_text(json.dumps(tree), encoding="ascii")


def forbid_calls() -> list[bool]:
    """Refuse files, sockets and programs while the returned list holds something.

    The last line of defence: stand-ins have no way to any of these.
    """
    watched = [True]

    def hook(event: str, arguments: Any) -> None:
        if watched and event.partition(".")[0] in _CALLS:
            raise ImportFailedError(f"it tries to use {event} {arguments[:1]}"[:200])

    sys.addaudithook(hook)
    return watched


def limit(seconds: int, most_bytes: int) -> None:
    """Limit this process; what exceeds the limits fails or is ended by the system."""
    for kind, value in (
        (resource.RLIMIT_AS, most_bytes),
        (resource.RLIMIT_FSIZE, most_bytes),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NOFILE, 32),
    ):
        hard = resource.getrlimit(kind)[1]
        least = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(kind, (least, least))


def limit_data(most_bytes: int) -> None:
    """Limit what this process may hold in memory, files that it maps apart."""
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    least = most_bytes if hard == resource.RLIM_INFINITY else min(most_bytes, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (least, least))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _work(channel: Channel) -> None:
    """Read the files that requests name, each in a copy of this process."""
    this = os.getpid()
    for request in channel.requests():
        copy = os.fork()
        if copy == 0:
            os._exit(_read_alone(channel, this, **request))
        code = os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1])
        if code != _REFUSED:
            channel.tell(code=code)


def _read_alone(
    channel: Channel, parent: int, *, path: str, out: str, seconds: int, most_bytes: int
) -> int:
    """Read a file within limits; tells why it is refused, and gives the code to exit with."""
    # Nothing is thrown away here; the collector would search a growing tree again and again.
    gc.disable()
    try:
        die_with_parent(parent)
        limit(seconds, most_bytes)
        read(Path(path), Path(out), most_bytes)
    except (ImportFailedError, OSError, MemoryError) as error:
        channel.tell(refused=describe(error))
        return _REFUSED
    except Exception:
        logger.exception("stopped by a defect of the program")
        return 1
    return 0


logger = logging.getLogger(__name__)

_WORKER = "physhandi.data.untrusted.pickles"
_REFUSED = 3
"""Exit code of a copy that has told why it refuses its file."""
_ADVICE = (
    "Only numbers, text, containers, NumPy arrays, sparse matrices, chumpy arrays and tensors of "
    "a torch checkpoint are read. Nothing of the file was executed; use the file as its publisher "
    "released it, or store plain arrays."
)


def read_untrusted(path: Path, *, time_limit_s: float = 120.0, memory_limit: int = 8 << 30) -> Any:
    """Read a foreign pickle or torch checkpoint without executing anything of it.

    NumPy numbers become Python numbers, sparse matrices dense arrays, chumpy arrays and torch
    tensors NumPy arrays, sets lists, and bytes text (latin1, as Python 2 meant it).

    Args:
        path: A pickle of any protocol, Python 2's included, or what ``torch.save`` wrote (the zip
            format of torch 1.6 and later).
        time_limit_s: Most time that reading may take [s].
        memory_limit: Most address space that reading may take [byte]; the arrays may take a
            quarter of it.

    Returns:
        A tree of dict, list, tuple, str, int, float, bool, None and arrays.

    Raises:
        ImportFailedError: If the file is missing, broken, too large, or asks for anything else;
            names the file and what it asks for.
    """
    path = Path(path)
    if not path.is_file():
        raise ImportFailedError(f"{path} is not a file.")
    with tempfile.TemporaryDirectory(prefix="physhandi-import-") as folder:
        refusal = _reader().read(path.absolute(), Path(folder), time_limit_s, memory_limit)
        if refusal:
            raise ImportFailedError(f"{path}: refused, because {refusal}. {_ADVICE}")
        return _collect(Path(folder))


class _Reader:
    """A process that reads one file after another; it is started by the first one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._child = AnsweringChild(_WORKER, threads=1)
        atexit.register(self._child.close)

    def read(self, path: Path, out: Path, time_limit_s: float, memory_limit: int) -> str:
        """Have a file read; returns why it is refused, nothing if it is not."""
        request = {
            "path": str(path),
            "out": str(out),
            "seconds": max(1, round(time_limit_s)),
            "most_bytes": memory_limit,
        }
        try:
            with self._lock:
                answer = self._child.ask(request, time_limit_s)
        except ChildEndedError as end:
            logger.debug("the reader of %s said: %s", path, end.last_words)
            if end.is_late:
                return f"reading it took more than {time_limit_s:g} s"
            answer = {"code": end.code}
        except PhysHandiError as error:
            return str(error)
        if "refused" in answer:
            return str(answer["refused"])
        code = int(answer["code"])
        return f"its reader ended {_ending(code)}" if code else ""


@cache
def _reader() -> _Reader:
    """Give the reader that all of this process share, so that NumPy is loaded once."""
    return _Reader()


def _ending(code: int) -> str:
    if code >= 0:
        return f"with exit code {code}"
    reasons = {signal.SIGKILL: "for want of memory or time", signal.SIGXCPU: "for want of time"}
    return reasons.get(signal.Signals(-code), f"by signal {-code}; it may be nested too deeply")


def _collect(folder: Path) -> Any:
    with np.load(folder / "array.npz", allow_pickle=False) as stored:
        arrays = [np.array(stored[str(number)]) for number in range(len(stored.files))]
    return _decode(json.loads((folder / "tree.json").read_text(encoding="ascii")), arrays)


def _decode(value: Any, arrays: list[Any]) -> Any:
    if not isinstance(value, dict):
        return value
    ((tag, content),) = cast("dict[str, Any]", value).items()
    if tag == "array":
        return arrays[content]
    if tag == "dict":
        return {_decode(key, arrays): _decode(item, arrays) for key, item in content}
    items: list[Any] = [_decode(item, arrays) for item in content]
    return tuple(items) if tag == "tuple" else items


if __name__ == "__main__":
    run_child(_work)
