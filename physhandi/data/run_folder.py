"""The files of a run folder: their names, what they hold, and how damage is reported."""

import hashlib
import os
import re
import secrets
import stat
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, NotRequired, Required, TypedDict, TypeVar, cast

import msgspec
from msgspec import Meta
from safetensors import SafetensorError

from physhandi.data.files import named_fields, parse_yaml, require_plain, require_shallow
from physhandi.errors import RunError, UsageError, describe
from physhandi.typed import decode_json, to_typed

RUN_FORMAT = "physhandi-run/1"
SAFE_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
JOB, RUN, LEASE, EVENTS = "job.yaml", "run.yaml", "lease.json", "events.jsonl"
PROGRESS, LOG, ATTEMPTS, CURRENT = "progress.json", "log.txt", "attempts", "current"
EXIT, CANCEL, MANIFEST, STAGES_FILE = "exit.json", "CANCEL", "MANIFEST.json", "stages.json"
OUT, CHECKPOINTS = "out", "ckpt"
RESERVE = ".reserve"
"""File of a run at work that is given up for the note on its end, where a disk is full."""

_SAFE_PART = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*")
_NUMBER = re.compile(r"[0-9]{1,9}")
_BASE32 = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"


def new_run_id() -> str:
    """Make a ULID: 26 letters and digits that sort by time."""
    number = int(time.time() * 1000) << 80 | secrets.randbits(80)
    return "".join(_BASE32[number >> shift & 31] for shift in range(125, -1, -5))


def now() -> str:
    """Give the current time in UTC as ISO 8601 text."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def moment_of(text: object) -> float | None:
    """Read a time as `now` writes it [s since the epoch]; None if it is none."""
    try:
        return datetime.fromisoformat(text).timestamp() if isinstance(text, str) else None
    except (ValueError, OverflowError):
        return None


def inside(folder: Path, rel: str) -> Path:
    """Resolve the name of an artefact below a folder.

    Raises:
        RunError: If the name is unsafe or leads out of the folder.
    """
    parts = PurePosixPath(rel).parts
    if not parts or not all(_SAFE_PART.fullmatch(part) for part in parts):
        raise RunError(
            f"{rel!r} is not a file name inside a run; use letters, digits, '_', '-', '.' and '/'."
        )
    return folder.joinpath(*parts)


def attempt_numbers(run_folder: Path) -> list[int]:
    """List the numbers of a run's attempts."""
    folder = run_folder / ATTEMPTS
    if not folder.is_dir():
        return []
    return sorted(int(path.name) for path in folder.iterdir() if _NUMBER.fullmatch(path.name))


def is_filled(run_folder: Path) -> bool:
    """Tell whether the latest attempt of a run has published its results, however it is told."""
    numbers = attempt_numbers(run_folder)
    if not numbers or read_number(run_folder / CURRENT) != numbers[-1]:
        return False
    return (run_folder / ATTEMPTS / str(numbers[-1]) / MANIFEST).is_file()


def artefacts(folder: Path) -> Iterator[tuple[str, Path]]:
    """List files below a folder with their relative names, in order; temporary ones are skipped."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.startswith("."):
            yield path.relative_to(folder).as_posix(), path


def file_record(path: Path) -> dict[str, Any]:
    """Give size and SHA-256 of a file."""
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
        size = os.fstat(stream.fileno()).st_size
    return {"size": size, "sha256": digest}


def find_damage(folder: Path, records: dict[str, Any]) -> str | None:
    """Name the first file that is not what its record says; None if all are whole."""
    for rel, entry in records.items():
        record = named_fields(entry) or {}
        try:
            path = inside(folder, rel)
        except RunError as error:
            return str(error).rstrip(".")
        if not {"size", "sha256"} <= set(record):
            return f"{rel} has no size and SHA-256 on record"
        if not path.is_file():
            return f"{rel} is missing"
        if path.stat().st_size != record["size"]:
            return f"{rel} has {path.stat().st_size} bytes instead of {record['size']}"
        if file_record(path)["sha256"] != record["sha256"]:
            return f"{rel} has changed (its SHA-256 differs)"
    return None


# ---- what the files hold; they may have fields beside these

RunKind = Literal["reconstruction", "simulation"]
RunEnd = Literal["succeeded", "failed", "cancelled"]

Text = Annotated[str, Meta(pattern=r"^[^\x00]*$")]
SomeText = Annotated[str, Meta(pattern=r"^[^\x00]*$", min_length=1)]
WholeNumber = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Seconds = Annotated[float, Meta(ge=0.0)]


class JobFile(TypedDict):
    """``job.yaml``: what a run was asked for."""

    kind: RunKind
    sequences: Annotated[list[SomeText], Meta(min_length=1)]
    sequence_names: Annotated[list[SomeText], Meta(min_length=1)]
    config: dict[str, Any]


class AboutFile(TypedDict):
    """``run.yaml``: what its user calls a run."""

    name: Text
    created: Text
    label: NotRequired[Text]
    note: NotRequired[Text]


class ExitFile(TypedDict, total=False):
    """``exit.json``: how a run ended."""

    state: Required[RunEnd]
    error: Text | None
    error_type: Text | None
    time: Text


class EventLine(TypedDict, total=False):
    """A line of ``events.jsonl``: one report; ``progress.json`` holds the latest."""

    stage: Required[Text]
    seq: Annotated[int, Meta(ge=-1, le=2**63 - 1)]
    time: float
    attempt: WholeNumber
    iteration: float
    total: float
    loss: float | None
    message: Text
    eta_s: float | None


class LeaseFile(TypedDict):
    """``lease.json``: who works on a run."""

    nonce: Text
    pid: Annotated[int, Meta(ge=1, le=2**31 - 1)]
    host: Text
    time: float
    process: NotRequired[Text | None]
    process_created: NotRequired[float]


class StageEntry(TypedDict, total=False):
    """An entry of ``stages.json``: a finished stage."""

    name: Required[SomeText]
    time: Text
    seconds: Seconds
    summary: dict[str, Any]
    files: dict[str, Any]


class FileRecord(TypedDict):
    """A file as ``MANIFEST.json`` knows it."""

    size: WholeNumber
    sha256: Text


class ManifestFile(TypedDict):
    """``MANIFEST.json``: what was published."""

    files: dict[str, FileRecord]


class EnvironmentFile(TypedDict, total=False):
    """``environment.json``: what a run was computed with, as far as it is shown."""

    started: Text
    device: Text
    device_name: Text | None
    cpu_count: WholeNumber | None
    system: Text
    python: Text
    commit: Text | None
    packages: dict[str, Text]


class RecordingFile(TypedDict, total=False):
    """``sequences/<name>/meta.yaml``: what a viewer needs of a recording."""

    frame_rate: Required[Annotated[float, Meta(gt=0.0, le=1e6)]]
    frame_count: Required[Annotated[int, Meta(ge=1, le=10_000_000)]]
    metric: bool
    length_unit: Text
    ground_height: float | None
    gravity: float
    hands: list[Text]
    reconstruction_frames: WholeNumber
    fingerprint: Text
    mass: Annotated[float, Meta(gt=0.0)] | None


PartsFile = dict[str, dict[str, Any]]
"""``metrics.json`` and ``losses.json``: fields of each sequence, or of each stage."""
Checked = TypeVar("Checked")


def checked(content: Any, kind: type[Checked], where: object) -> Checked:
    """Check what was read from a file.

    Args:
        content: Plain data, as JSON and YAML give it.
        kind: One of the classes above, or a list of them.
        where: The file, for the message.

    Returns:
        The same content.

    Raises:
        RunError: If a field is missing or wrong; names file and field.
    """
    try:
        to_typed(content, kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise RunError(f"{where} is damaged: {_told(str(error))}.") from None
    return cast("Checked", content)


_WORDS = {
    "str": "text",
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "object": "named fields",
    "array": "a list",
    "null": "nothing",
}


def _told(problem: str) -> str:
    """Put what msgspec finds into our words."""
    what, _, place = problem.partition(" - at ")
    lost = re.fullmatch(r"Object missing required field `(.+)`", what)
    field = place.strip("`").removeprefix("$").lstrip(".").replace("[...]", "[…]")
    if place.startswith("`key`"):
        field, what = place.partition("`$.")[2].rstrip("`") or "it", "A name of a field is no text"
    if lost:
        return f"field '{f'{field}.' if field else ''}{lost[1]}' is missing"
    what = re.sub(r"`([^`]*)`", lambda match: _kinds(match[1]), what)
    what = re.sub(r"^Invalid enum value (.*)", r"\1 is not known", what)
    what = what[:1].lower() + what[1:]
    return f"field '{field}' is wrong ({what})" if field else what


def _kinds(types: str) -> str:
    return " or ".join(_WORDS.get(name, name) for name in types.split(" | "))


@contextmanager
def reading(path: Path) -> Generator[None]:
    """Turn whatever a missing or damaged file of a run raises into one error that names it.

    Raises:
        RunError: If reading fails.
    """
    try:
        yield
    except FileNotFoundError:
        raise RunError(f"{path} is missing. Run it again.") from None
    except (SafetensorError, KeyError, IndexError, TypeError, ValueError, OSError) as error:
        reason = f"{error} is not in it" if isinstance(error, KeyError) else describe(error)
        raise RunError(f"{path} is damaged: {reason.rstrip('.')}. Run it again.") from error
    except UsageError as error:
        raise RunError(f"{path} is damaged: {error}") from error


_LARGEST = {".json": 2**28, ".yaml": 2**22}
"""Largest file that is read, by its ending [bytes]."""


def _content_of(path: Path) -> bytes:
    """Read a file of a run that is a plain file of sane size.

    Raises:
        FileNotFoundError: If it is missing.
        ValueError: If it is something else than a file, or too large.
        OSError: If it cannot be read.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("it is not a file")
    most = _LARGEST.get(path.suffix, 2**22)
    if status.st_size > most:
        raise ValueError(f"it is larger than {most} bytes")
    return path.read_bytes()


def read_json(path: Path) -> Any:
    """Read a JSON file; what it holds are text, finite numbers, lists and named fields.

    Raises:
        RunError: If it is missing or damaged.
    """
    try:
        return _present_json(path)
    except FileNotFoundError:
        raise RunError(f"{path} is missing.") from None


def _present_json(path: Path) -> Any:
    """Read a JSON file; as `read_json`, but a missing one is a FileNotFoundError."""
    try:
        return _parse_json(_content_of(path))
    except FileNotFoundError:
        raise
    except ValueError as error:
        raise RunError(f"{path} cannot be read as JSON: {str(error).rstrip('.')}.") from error
    except OSError as error:
        raise RunError(f"{path} cannot be read as JSON: {describe(error)}") from error


def _parse_json(content: bytes) -> Any:
    try:
        value = decode_json(content, Any)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    require_shallow(value)
    return value


def read_mapping(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds named fields; an absent file has none.

    Raises:
        RunError: If it is damaged.
    """
    try:
        content = named_fields(_present_json(path))
    except FileNotFoundError:
        return {}
    if content is None:
        raise RunError(f"{path} must hold named fields; it is damaged.")
    return content


def read_record(path: Path, kind: type[Checked]) -> Checked | None:
    """Read a JSON file with the fields of a class above; None if there is none.

    Raises:
        RunError: If it is damaged; names the field.
    """
    try:
        content = _present_json(path)
    except FileNotFoundError:
        return None
    return checked(content, kind, path)


def read_yaml(path: Path) -> Any:
    """Read a YAML file; what it holds are text, finite numbers, lists and named fields.

    Raises:
        RunError: If it is missing or damaged.
    """
    try:
        content = parse_yaml(_content_of(path).decode("utf-8"))
        require_plain(content)
    except FileNotFoundError:
        raise RunError(f"{path} is missing.") from None
    except ValueError as error:
        raise RunError(f"{path} cannot be read as YAML: {str(error).rstrip('.')}.") from error
    except OSError as error:
        raise RunError(f"{path} cannot be read as YAML: {describe(error)}") from error
    return content


def read_number(path: Path) -> int | None:
    """Read a file that holds nothing but the number of an attempt; None if it does not."""
    try:
        content = _content_of(path).strip()
    except (OSError, ValueError):
        return None
    return int(content) if _NUMBER.fullmatch(content.decode("ascii", "replace")) else None


def read_events(run_folder: Path, offset: int = 0) -> tuple[list[dict[str, Any]], int]:
    """Read the events that were added to a run's ``events.jsonl``.

    Args:
        run_folder: The run.
        offset: Byte position up to which events are known already.

    Returns:
        The new events (fields ``seq time stage iteration total loss message``) and the offset for
        the next call. A line that is still being written is left for the next call; a line that a
        crash tore, or that is no report, is skipped.
    """
    path = run_folder / EVENTS
    if not path.is_file():
        return [], offset
    with path.open("rb") as stream:
        stream.seek(offset)
        content = stream.read()
    whole = content[: content.rfind(b"\n") + 1]
    events: list[dict[str, Any]] = []
    for line in whole.splitlines():
        try:
            event: dict[str, Any] = dict(checked(_parse_json(line), EventLine, path))
        except (ValueError, RunError):
            continue
        events.append(event)
    return events, offset + len(whole)
