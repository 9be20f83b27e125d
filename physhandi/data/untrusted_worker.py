"""The child process that reads a foreign pickle: inert names only, under limits (see `untrusted`).

Run as ``python -m physhandi.data.untrusted_worker FILE OUT SECONDS BYTES``. It writes
``OUT/tree.json`` and ``OUT/array.npz``, or the reason of its refusal to ``OUT/refusal.txt``.
"""

import encodings.cp437 as zip_text
import io
import json
import pickle
import resource
import sys
import zipfile
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy import ndarray

from physhandi.data.inert import ElementType, Storage, resolved
from physhandi.data.inert_names import STAND_INS, TORCH_STAND_INS
from physhandi.errors import ImportFailedError

REFUSED = 3
"""Exit code when the file was refused and ``refusal.txt`` says why."""
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
        found = self._names.get(module, {}).get(name)
        if found is None:
            raise ImportFailedError(f"it asks for {module}.{name}"[:200])
        return found

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


def load(stream: io.BufferedIOBase) -> Any:
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
        return tree.encode(load(stream)), tree.arrays
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
            tree, found = convert(stream, most_bytes)
        finally:
            watched.clear()
    arrays: Any = {str(number): array for number, array in enumerate(found)}
    np.savez(out / "array.npz", allow_pickle=False, **arrays)
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


def main(arguments: list[str]) -> int:
    """Read the file that the arguments name."""
    source, out = Path(arguments[0]), Path(arguments[1])
    most_bytes = int(arguments[3])
    limit(int(arguments[2]), most_bytes)
    try:
        read(source, out, most_bytes)
    except ImportFailedError as error:
        (out / "refusal.txt").write_text(str(error), encoding="utf-8")
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
