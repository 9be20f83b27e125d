"""Checkpoints: two files used in turn, so that one is always whole."""

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from physhandi.data.atomic import read_tensors, write_bytes


def packed(tensors: Mapping[str, ndarray]) -> dict[str, ndarray]:
    """Copy tensors into the layout that safetensors can store (C order)."""
    return {name: np.array(tensor, order="C") for name, tensor in tensors.items()}


def write_checkpoint(folder: Path, name: str, tensors: Mapping[str, ndarray]) -> None:
    """Replace the older of a checkpoint's two files."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers = {slot: _number(folder / f"{name}.{slot}.safetensors") for slot in "ab"}
    slot = min("ab", key=lambda slot: numbers[slot])
    content = packed(tensors)
    note = {"number": str(max(numbers.values()) + 1), "crc32": str(_checksum(content))}
    write_bytes(folder / f"{name}.{slot}.safetensors", save(content, metadata=note))


def read_checkpoint(folder: Path, name: str) -> dict[str, ndarray] | None:
    """Read the newest whole checkpoint of a name; None if there is none."""
    paths = [folder / f"{name}.{slot}.safetensors" for slot in "ab"]
    for path in sorted(paths, key=_number, reverse=True):
        if _number(path) < 0:
            continue
        tensors = read_tensors(path)
        if _note(path).get("crc32") == str(_checksum(tensors)):
            return tensors
    return None


def _number(path: Path) -> int:
    """Give a checkpoint file's running number; -1 if it is absent or damaged."""
    number = _note(path).get("number", "")
    return int(number) if number.isdigit() else -1


def _note(path: Path) -> dict[str, str]:
    try:
        opened: Any = safe_open(path, framework="numpy")
        with opened as stream:
            return dict(stream.metadata() or {})
    except (SafetensorError, OSError):
        return {}


def _checksum(tensors: Mapping[str, ndarray]) -> int:
    checksum = 0
    for name in sorted(tensors):
        tensor = tensors[name]
        header = f"{name} {tensor.dtype.str} {tensor.shape}".encode()
        checksum = zlib.crc32(tensor.tobytes(), zlib.crc32(header, checksum))
    return checksum
