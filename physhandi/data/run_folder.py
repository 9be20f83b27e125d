"""The files of a run folder: their names, how they are hashed and how damage is reported."""

import hashlib
import json
import os
import re
import secrets
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

from safetensors import SafetensorError

from physhandi.data.files import named_fields, parse_yaml
from physhandi.errors import RunError, UsageError, describe

RUN_FORMAT = "physhandi-run/1"
SAFE_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
JOB, RUN, LEASE, EVENTS = "job.yaml", "run.yaml", "lease.json", "events.jsonl"
PROGRESS, LOG, ATTEMPTS, CURRENT = "progress.json", "log.txt", "attempts", "current"
EXIT, CANCEL, MANIFEST, STAGES_FILE = "exit.json", "CANCEL", "MANIFEST.json", "stages.json"
OUT, CHECKPOINTS = "out", "ckpt"
RESERVE = ".reserve"
"""File of a run at work that is given up for the note on its end, where a disk is full."""

_SAFE_PART = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*")
_BASE32 = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"


def new_run_id() -> str:
    """Make a ULID: 26 letters and digits that sort by time."""
    number = int(time.time() * 1000) << 80 | secrets.randbits(80)
    return "".join(_BASE32[number >> shift & 31] for shift in range(125, -1, -5))


def now() -> str:
    """Give the current time in UTC as ISO 8601 text."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


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
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdigit())


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
        path = inside(folder, rel)
        if not {"size", "sha256"} <= set(record):
            return f"{rel} has no size and SHA-256 on record"
        if not path.is_file():
            return f"{rel} is missing"
        if path.stat().st_size != record["size"]:
            return f"{rel} has {path.stat().st_size} bytes instead of {record['size']}"
        if file_record(path)["sha256"] != record["sha256"]:
            return f"{rel} has changed (its SHA-256 differs)"
    return None


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


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        RunError: If it is missing or damaged.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RunError(f"{path} is missing.") from None
    except (ValueError, RecursionError, OSError) as error:
        raise RunError(f"{path} cannot be read as JSON: {error}") from error


def read_mapping(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds named fields; an absent file has none.

    Raises:
        RunError: If it is damaged.
    """
    if not path.is_file():
        return {}
    content = named_fields(read_json(path))
    if content is None:
        raise RunError(f"{path} must hold named fields; it is damaged.")
    return content


def read_yaml(path: Path) -> Any:
    """Read a YAML file.

    Raises:
        RunError: If it is missing or damaged.
    """
    try:
        return parse_yaml(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RunError(f"{path} is missing.") from None
    except (ValueError, OSError) as error:
        raise RunError(f"{path} cannot be read as YAML: {error}.") from error


def read_events(run_folder: Path, offset: int = 0) -> tuple[list[dict[str, Any]], int]:
    """Read the events that were added to a run's ``events.jsonl``.

    Args:
        run_folder: The run.
        offset: Byte position up to which events are known already.

    Returns:
        The new events (fields ``seq time stage iteration total loss message``) and the offset for
        the next call. A line that is still being written is left for the next call; a line that a
        crash tore is skipped.
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
            event = named_fields(json.loads(line))
        except ValueError:
            continue
        if event is not None:
            events.append(event)
    return events, offset + len(whole)
