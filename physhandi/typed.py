"""Plain data as typed objects, also where several threads read at once.

msgspec lays a class out when it is first read into, and another thread that reads into the same
class meanwhile meets a layout that is half made, which ends the process (segmentation fault with
msgspec 0.22, for Struct, dataclass and TypedDict alike). So one thread reads at a time; they would
wait for Python's own lock otherwise.
"""

import threading
from typing import Any, TypeVar

import msgspec

Typed = TypeVar("Typed")
_LOCK = threading.RLock()
"""Held again by classes that read while they are made, as settings do."""


def to_typed(content: Any, kind: type[Typed]) -> Typed:
    """Make typed objects of plain data, as JSON and YAML give it.

    Args:
        content: Plain data.
        kind: Any type that msgspec knows.

    Raises:
        msgspec.ValidationError: If something in it is of the wrong kind or out of bounds.
    """
    with _LOCK:
        return msgspec.convert(content, kind)


def decode_json(content: bytes | str, kind: type[Typed]) -> Typed:
    """Read typed objects from JSON.

    Args:
        content: The text.
        kind: Any type that msgspec knows.

    Raises:
        msgspec.DecodeError: If it is no JSON, or something in it is wrong (`ValidationError`).
        UnicodeError: If it is no UTF-8.
        RecursionError: If it is nested too deeply.
    """
    with _LOCK:
        return msgspec.json.decode(content, type=kind)
