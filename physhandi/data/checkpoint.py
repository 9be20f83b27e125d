"""The state of a loop inside an unfinished stage, from which a later attempt goes on.

A stage offers its state after every iteration; `FileCheckpointer` writes it now and then, so seldom
that the fit does not feel it. What a stage computes never depends on when that was.
"""

import json
import logging
import time
import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from physhandi.data.arrays import read_tensors
from physhandi.data.files import named_fields, write_bytes
from physhandi.data.run_folder import inside
from physhandi.errors import RunError, describe

logger = logging.getLogger(__name__)
CHECKPOINT_FORMAT = "physhandi-checkpoint/1"
CHECKPOINT_INTERVAL_S = 3.0
"""Least time between two checkpoints, and between the begin of a stage and its first one [s]."""
CHECKPOINT_SHARE = 0.005
"""Most of a stage's time that writing checkpoints may take."""
_DAMAGE = (RunError, ValueError, KeyError, TypeError, RecursionError, SafetensorError, OSError)


@dataclass(frozen=True, eq=False)
class SavedState:
    """The state of a loop after some of its iterations."""

    iteration: int
    """Finished iterations."""
    tensors: dict[str, ndarray]
    """Everything that the following iterations depend on, by names of the loop."""
    seconds: float = 0.0
    """Time that its stage had taken [s]."""


def resumed_note(iteration: int) -> str:
    """Say in a progress report that a loop goes on with a state of an earlier attempt."""
    return f"Resumed after iteration {iteration}."


class Checkpointer:
    """Keeps the states of loops; the base class keeps nothing and knows none."""

    def load(
        self, name: str, like: Mapping[str, ndarray], *, growing: Collection[str] = ()
    ) -> SavedState | None:
        """Find the latest state of a loop.

        Args:
            name: Name of the loop.
            like: Its state at the beginning: the names, kinds and shapes that its state must have.
            growing: Arrays that become longer along their first dimension, all alike.

        Returns:
            None if there is none that this loop can go on from; then it begins anew.
        """
        del name, like, growing

    def offer(self, name: str, iteration: int, state: Callable[[], Mapping[str, ndarray]]) -> None:
        """Keep the state of a loop, if it is time for it.

        Args:
            name: Name of the loop.
            iteration: Finished iterations.
            state: Gives everything that the following iterations depend on.
        """


class FileCheckpointer(Checkpointer):
    """Writes each loop's states in turn to two files, so that one is whole whatever happens.

    A state counts only where everything that it came from is the same: `origin` names that.
    """

    def __init__(self, folder: Path, origin: Mapping[str, str]) -> None:
        """Prepare; nothing is read or written yet.

        Args:
            folder: Where the files are; it need not exist.
            origin: What a state depends on, such as settings and inputs, by their names.
        """
        self._folder = folder
        self._origin = dict(origin)
        self._begin = time.monotonic()
        self._due = self._begin + CHECKPOINT_INTERVAL_S
        self.spent_s = 0.0
        """Time that all writing took [s]."""
        self.earlier_s = 0.0
        """Time that earlier attempts had taken for the stage, as far as it is gone on with [s]."""

    def load(
        self, name: str, like: Mapping[str, ndarray], *, growing: Collection[str] = ()
    ) -> SavedState | None:
        """Find the latest state of a loop; why another is not used is logged."""
        for path in sorted(_slots(self._folder, name), key=_number, reverse=True):
            if not path.exists():
                continue
            try:
                state = self._read(path, name)
                _check_alike(state.tensors, like, growing)
            except _DAMAGE as error:
                logger.warning("Checkpoint %s is not used: %s", path, describe(error))
                continue
            logger.info("%s goes on after iteration %d (%s)", name, state.iteration, path)
            self.earlier_s = max(self.earlier_s, state.seconds)
            return state
        return None

    def offer(self, name: str, iteration: int, state: Callable[[], Mapping[str, ndarray]]) -> None:
        """Write the state of a loop, if the last one was long enough ago.

        Without it a fit is as good, only longer to repeat: what cannot be written is logged.
        """
        begin = time.monotonic()
        if begin < self._due:
            return
        try:
            self.write(name, iteration, state())
        except OSError as error:
            logger.warning("Checkpoint of %s was not written: %s", name, describe(error))
        end = time.monotonic()
        self.spent_s += end - begin
        self._due = max(end + CHECKPOINT_INTERVAL_S, self._begin + self.spent_s / CHECKPOINT_SHARE)

    def write(self, name: str, iteration: int, state: Mapping[str, ndarray]) -> None:
        """Replace the older of a loop's two files at once."""
        self._folder.mkdir(parents=True, exist_ok=True)
        numbers = {path: _number(path) for path in _slots(self._folder, name)}
        tensors = packed(state)
        header = {
            "format": CHECKPOINT_FORMAT,
            "name": name,
            "iteration": str(iteration),
            "seconds": f"{self.earlier_s + time.monotonic() - self._begin:.3f}",
            "number": str(max(numbers.values()) + 1),
            "origin": json.dumps(self._origin, sort_keys=True),
            "crc32": str(_checksum(tensors, iteration)),
        }
        oldest = min(numbers, key=lambda path: numbers[path])
        write_bytes(oldest, save(tensors, metadata=header))

    def _read(self, path: Path, name: str) -> SavedState:
        """Read a file, and compare what it says of itself with what is expected and in it."""
        header = _header(path)
        if header.get("format") != CHECKPOINT_FORMAT:
            raise RunError(f"it is damaged, or not in format {CHECKPOINT_FORMAT}.")
        if header.get("name") != name:
            raise RunError(f"it belongs to {header.get('name')}.")
        origin = named_fields(json.loads(header.get("origin", "{}"))) or {}
        changed = [
            part
            for part in sorted({*origin, *self._origin})
            if origin.get(part) != self._origin.get(part)
        ]
        if changed:
            raise RunError(f"it was made with other {', '.join(changed)}.")
        tensors, iteration = read_tensors(path), int(header.get("iteration", "-1"))
        if header.get("crc32") != str(_checksum(tensors, iteration)):
            raise RunError("it is damaged: its content does not have its checksum.")
        return SavedState(iteration, tensors, float(header.get("seconds", "nan")))


def packed(tensors: Mapping[str, ndarray]) -> dict[str, ndarray]:
    """Copy tensors into the layout that safetensors can store (C order)."""
    return {name: np.array(tensor, order="C") for name, tensor in tensors.items()}


def _slots(folder: Path, name: str) -> list[Path]:
    return [inside(folder, f"{name}.{slot}.safetensors") for slot in "ab"]


def _number(path: Path) -> int:
    """Give a file's running number; -1 if it is absent or damaged."""
    number = _header(path).get("number", "")
    return int(number) if number.isdecimal() else -1


def _header(path: Path) -> dict[str, str]:
    try:
        opened: Any = safe_open(path, framework="numpy")
        with opened as stream:
            return dict(stream.metadata() or {})
    except (SafetensorError, OSError):
        return {}


def _checksum(tensors: Mapping[str, ndarray], iteration: int) -> int:
    checksum = zlib.crc32(f"{iteration}".encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        header = f"{name} {tensor.dtype.str} {tensor.shape}".encode()
        checksum = zlib.crc32(tensor.tobytes(), zlib.crc32(header, checksum))
    return checksum


def _check_alike(
    tensors: Mapping[str, ndarray], like: Mapping[str, ndarray], growing: Collection[str]
) -> None:
    """Refuse a state that a loop cannot go on from.

    Raises:
        ValueError: If an array is missing, unknown, or of another kind or shape; names it.
    """
    odd = sorted({*tensors} ^ {*like})
    if odd:
        raise ValueError(f"array '{odd[0]}' is {'missing' if odd[0] in like else 'unknown'}.")
    for name, expected in like.items():
        array, is_growing = tensors[name], name in growing
        shape, wanted = array.shape[is_growing:], expected.shape[is_growing:]
        if array.dtype != expected.dtype or array.ndim != expected.ndim or shape != wanted:
            raise ValueError(
                f"array '{name}' is {array.dtype} {array.shape}; expected {expected.dtype} "
                f"{expected.shape}."
            )
    if len({len(tensors[name]) for name in growing}) > 1:
        raise ValueError(f"{', '.join(growing)} are not of one length.")
