"""Writing files so that a reader sees the old content or the new, never half of it."""

import io
import json
import math
import os
import secrets
import shutil
import socket
import zipfile
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from itertools import islice
from pathlib import Path, PurePath
from stat import S_ISREG
from typing import Any, BinaryIO, ClassVar, cast

import psutil
import yaml

_FIRST_TIME = (1980, 1, 1, 0, 0, 0)
"""The earliest time that a ZIP archive can tell."""
_HOST = socket.gethostname().replace("-", "_").replace(".", "_")[:32] or "host"


def temporary_name(name: str) -> str:
    """Name a hidden sibling of a file that tells which process is writing it."""
    return f".{name}.{_HOST}-{os.getpid()}-{secrets.token_hex(4)}.tmp"


def stopped_name(name: str) -> str:
    """Name a hidden sibling of a file that nobody writes any more, but that may be gone on with."""
    return f".{name}.{_HOST}-0-{secrets.token_hex(4)}.tmp"


def is_abandoned(path: Path) -> bool:
    """Tell whether a temporary file or folder was left by a process of this host that is gone."""
    name = path.name if path.suffix == ".tmp" else path.stem  # See `replacing`.
    parts = name.split(".")
    if len(parts) < 4 or parts[0] or parts[-1] != "tmp":
        return False
    fields = parts[-2].split("-")
    if len(fields) != 3 or fields[0] != _HOST or not fields[1].isdigit():
        return False
    return int(fields[1]) != os.getpid() and not psutil.pid_exists(int(fields[1]))


def with_status(paths: Iterable[Path]) -> Iterator[tuple[Path, os.stat_result]]:
    """Give paths with their status, passing over what was removed since it was listed."""
    for path in paths:
        try:
            status = path.stat()
        except OSError:
            continue
        yield path, status


def files_by_age(paths: Iterable[Path]) -> list[tuple[float, int, Path]]:
    """List files, the oldest first, passing over what was removed since it was listed.

    Returns:
        Of each when it changed last [s since 1970], its size [B] and its path.
    """
    return sorted(
        (status.st_mtime, status.st_size, path)
        for path, status in with_status(paths)
        if S_ISREG(status.st_mode)
    )


def sweep_temporary(paths: Iterator[Path]) -> int:
    """Remove temporary files and folders whose process is gone; return how many there were."""
    count = 0
    for path in list(paths):
        if is_abandoned(path):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
            count += 1
    return count


def _named(error: OSError, path: Path) -> OSError:
    """Name what is being written, which a full disk does not."""
    return OSError(error.errno, error.strerror, str(path))


def sync_folder(folder: Path) -> None:
    """Make a folder's entries durable (a rename is lost in a power cut otherwise)."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        raise _named(error, folder) from error
    finally:
        os.close(descriptor)


def write_atomically(
    path: Path, write: Callable[[BinaryIO], Any], *, is_durable: bool = True
) -> None:
    """Let `write` fill a temporary file and move it to `path`.

    Args:
        path: File to replace; its folder must exist.
        write: Writes the content.
        is_durable: Whether the content must survive a power cut; costs milliseconds.
    """
    temporary = path.with_name(temporary_name(path.name))
    try:
        with temporary.open("wb") as stream:
            write(stream)
            stream.flush()
            if is_durable:
                os.fsync(stream.fileno())
        temporary.replace(path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None:
            raise _named(error, path) from error
        raise
    if is_durable:
        sync_folder(path.parent)


@contextmanager
def replacing(path: Path) -> Generator[Path]:
    """Let a writer that tells the format by the suffix of a file write beside it, then move it.

    After an error what was there stays. For all other writers there is `write_atomically`.

    Args:
        path: File to replace; its folder must exist.

    Yields:
        The file to write.
    """
    temporary = path.with_name(temporary_name(path.stem) + path.suffix)
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Replace a file's content."""
    write_atomically(path, lambda stream: stream.write(content))


def zip_bytes(files: Iterable[tuple[str, bytes]]) -> bytes:
    """Pack files, by their names, as a ZIP archive; the same files give the same bytes."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files:
            entry = zipfile.ZipInfo(name, _FIRST_TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, content)
    return stream.getvalue()


def plain(value: Any) -> Any:
    """Turn NumPy values, paths and tuples into lists, numbers and text, as JSON and YAML have."""
    if value is None or type(value) in {str, int, float, bool}:
        return value
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in cast("Mapping[Any, Any]", value).items()}
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, list | tuple | set | frozenset | range):
        return [plain(item) for item in cast("Iterable[Any]", value)]
    import numpy as np  # The process that supervises a fit comes here with nothing of NumPy's.

    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, str | int | float | bool):
        return value
    raise TypeError(f"{type(value).__name__} cannot be stored in JSON or YAML")


def without_non_finite(value: Any) -> Any:
    """Replace NaN and infinity, which JSON does not know, by None in `plain` data."""
    if isinstance(value, dict):
        return {k: without_non_finite(v) for k, v in cast("dict[str, Any]", value).items()}
    if isinstance(value, list):
        return [without_non_finite(item) for item in cast("list[Any]", value)]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def json_line(value: Any) -> str:
    """Format a value as JSON on one line; NaN and infinity become null."""
    return json.dumps(without_non_finite(plain(value)), allow_nan=False)


def write_json(path: Path, value: Any, *, is_durable: bool = True) -> None:
    """Write a value as JSON; NaN and infinity become null."""
    text = json.dumps(without_non_finite(plain(value)), indent=1, allow_nan=False)
    content = text.encode() + b"\n"
    write_atomically(path, lambda stream: stream.write(content), is_durable=is_durable)


def write_yaml(path: Path, value: Any) -> None:
    """Write a value as YAML in the given key order (`plain` first)."""
    options = {"sort_keys": False, "allow_unicode": True, "width": 100}
    text: str = yaml.dump(plain(value), Dumper=_FastDumper, **options)
    write_bytes(path, text.encode())


def named_fields(value: Any) -> dict[str, Any] | None:
    """Give a mapping as one with text keys; None if it is something else."""
    if not isinstance(value, dict):
        return None
    return {str(key): item for key, item in cast("dict[Any, Any]", value).items()}


_ODD_CHARACTER = (ValueError, KeyError, IndexError, AttributeError, TypeError, OverflowError)


def parse_yaml(text: str, *, reads_dates: bool = True) -> Any:
    """Read plain data from YAML text; nothing that it names is imported or called.

    Args:
        text: The text.
        reads_dates: Whether what is written like a date becomes one; else it is text.

    Raises:
        ValueError: If it is not YAML, or a field is there twice; tells the line.
    """
    try:
        # Aliases make one value of several places, and tags others than `_copied` copies.
        if len(text) > _REMEMBERED_LENGTH or "*" in text or "!" in text:
            return _load_yaml(text, reads_dates)
        return _copied(_remembered_yaml(text, reads_dates))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        if mark and error.context_mark and mark.line > text.count("\n"):
            mark = error.context_mark  # What is missing at the end belongs to what began before it.
        where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise ValueError(f"{where}{error.problem or error.context}") from error
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except _ODD_CHARACTER as error:  # What PyYAML raises for a value that does not fit its own tag.
        raise ValueError(f"a value is not what its tag says ({error})") from error


_yaml: Any = yaml
_FastLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""PyYAML's reader in C, ten times as fast as that in Python, where PyYAML was built with it."""
_FastDumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
"""Its writer in C, five times as fast."""


_REMEMBERED_LENGTH = 16_384
"""Characters of the longest text whose content is remembered."""


def _load_yaml(text: str, reads_dates: bool) -> Any:
    _check_depth(text)
    # Both are a SafeLoader.
    return yaml.load(text, Loader=_Loader if reads_dates else _DatelessLoader)  # noqa: S506


# Lists and pages of runs read the same small files again and again, each time for milliseconds.
_remembered_yaml = lru_cache(maxsize=64)(_load_yaml)


def _copied(content: Any) -> Any:
    """Copy lists and fields, so that whoever changes them changes nothing that is remembered."""
    if isinstance(content, dict):
        return {key: _copied(value) for key, value in cast("dict[Any, Any]", content).items()}
    if isinstance(content, list):
        return [_copied(value) for value in cast("list[Any]", content)]
    return content


def _check_depth(text: str) -> None:
    depth = 0
    for event in _yaml.parse(text, Loader=_FastLoader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise RecursionError


class _Loader(_FastLoader):
    """Refuses a field that is there twice, of which YAML's own reader keeps the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Check the fields of a mapping, then read it."""
        seen: set[str] = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if not isinstance(key, yaml.ScalarNode) or key.tag == "tag:yaml.org,2002:merge":
                continue
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"field '{key.value}' is there twice; keep one", key.start_mark
                )
            seen.add(key.value)
        return _FastLoader.construct_mapping(self, node, deep=deep)


class _DatelessLoader(_Loader):
    """Takes dates for text, as whoever writes one by hand means it."""

    yaml_implicit_resolvers: ClassVar[Any] = {
        first: [(tag, form) for tag, form in forms if tag != "tag:yaml.org,2002:timestamp"]
        for first, forms in _FastLoader.yaml_implicit_resolvers.items()
    }


DEEPEST = 100
"""Levels of nesting that are read; the YAML reader in C has no limit of its own but the stack."""
_TOO_LARGE = 2**64
"""Whole numbers from here on are read nowhere."""
_MOST_VALUES = 200_000
"""Values that are read from YAML, whose aliases can make a few lines stand for any number."""


def require_shallow(content: Any) -> None:
    """Refuse what is nested so deeply that who walks through it would fail, and numbers too large.

    Raises:
        ValueError: If it holds such a thing.
    """
    level: list[Any] = [content]
    for _ in range(DEEPEST + 1):
        below: list[Any] = []
        # One loop without calls: whoever follows a run looks at a thousand values at each reading.
        for value in level:
            if isinstance(value, dict):
                below.extend(cast("dict[Any, Any]", value).values())
            elif isinstance(value, list):
                below.extend(cast("list[Any]", value))
            elif isinstance(value, int) and abs(value) >= _TOO_LARGE:
                raise ValueError("it holds a number that is too large")
        if not below:
            return
        level = below
    raise ValueError("it is nested too deeply")


def require_plain(content: Any) -> None:
    """Refuse what YAML has and JSON has not: dates, bytes, sets, names that are no text, NaN.

    Raises:
        ValueError: If it holds such a thing, or is nested too deeply or endlessly; tells where.
    """
    level: list[tuple[str, Any]] = [("", content)]
    count = 0
    for _ in range(DEEPEST + 1):
        if not level:
            return
        count += len(level)
        if count > _MOST_VALUES:
            raise ValueError(f"it holds more than {_MOST_VALUES} values")
        for place, value in level:
            _require_plain_value(place, value)
        level = list(islice((pair for v in level for pair in _places(*v)), _MOST_VALUES + 1))
    raise ValueError("it is nested too deeply")


def _require_plain_value(place: str, value: Any) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"field '{place}' is {value}, not a finite number")
    if isinstance(value, int) and abs(value) >= _TOO_LARGE:
        raise ValueError(f"field '{place}' is a number that is too large")
    if value is not None and not isinstance(value, str | int | float | list | dict):
        kind = type(cast("object", value)).__name__
        raise ValueError(f"field '{place}' is a {kind}; expected text, numbers, lists or fields")


def _places(place: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, list):
        yield from ((f"{place}[{i}]", v) for i, v in enumerate(cast("list[Any]", value)))
    elif isinstance(value, dict):
        for name, inner in cast("dict[Any, Any]", value).items():
            if not isinstance(name, str):
                raise ValueError(  # noqa: TRY004 - of the file, not of an argument
                    f"a name in field '{place}' is no text: {str(name)[:40]}"
                )
            yield f"{place}.{name}" if place else name, inner
