"""Messages between the server and the live simulation process: a JSON header and raw arrays."""

import json
import math
import socket
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy import ndarray

_LENGTH = struct.Struct("<I")
_MAX_HEADER = 1 << 20
_MAX_ARRAY = 1 << 30
_DTYPES = {"float32", "float64", "int32", "int64", "uint8", "bool"}


class WireError(Exception):
    """The other side sent something that is not a message."""


@dataclass(frozen=True)
class Message:
    """One message: what it is, plain fields, and arrays."""

    kind: str
    """What the message says, for example ``"frame"``."""
    fields: Mapping[str, Any] = field(default_factory=dict[str, Any])
    """Plain JSON values."""
    arrays: Mapping[str, ndarray] = field(default_factory=dict[str, ndarray])
    """Arrays, sent as their bytes."""

    def __getitem__(self, name: str) -> Any:
        return self.fields[name]


def send(connection: socket.socket, message: Message) -> None:
    """Write one message; the caller makes sure that only one thread writes at a time.

    Args:
        connection: Stream socket to the other process.
        message: What to send.

    Raises:
        OSError: If the other side is gone.
    """
    arrays = {name: np.ascontiguousarray(array) for name, array in message.arrays.items()}
    header = json.dumps(
        {
            "kind": message.kind,
            "fields": dict(message.fields),
            "arrays": [[name, str(a.dtype), list(a.shape)] for name, a in arrays.items()],
        }
    ).encode()
    connection.sendall(_LENGTH.pack(len(header)) + header)
    for array in arrays.values():
        connection.sendall(array.data.cast("B") if array.size else b"")


def receive(connection: socket.socket) -> Message | None:
    """Read the next message.

    Args:
        connection: Stream socket to the other process.

    Returns:
        The message, or None when the other side has closed the connection.

    Raises:
        WireError: If the bytes are not a message.
    """
    prefix = _read(connection, _LENGTH.size)
    if prefix is None:
        return None
    (length,) = _LENGTH.unpack(prefix)
    if length > _MAX_HEADER:
        raise WireError(f"a header of {length} bytes was announced; at most {_MAX_HEADER} fit")
    header = _read(connection, length)
    if header is None:
        return None
    try:
        content = json.loads(bytes(header))
        announced = [(str(n), str(d), tuple(map(int, s))) for n, d, s in content["arrays"]]
        kind, fields = str(content["kind"]), dict(content["fields"])
    except (ValueError, KeyError, TypeError) as error:
        raise WireError(f"the header is not one of ours: {error}") from error
    arrays: dict[str, ndarray] = {}
    for name, dtype, shape in announced:
        array = _read_array(connection, dtype, shape)
        if array is None:
            return None
        arrays[name] = array
    return Message(kind, fields, arrays)


def _read_array(connection: socket.socket, dtype: str, shape: tuple[int, ...]) -> ndarray | None:
    if dtype not in _DTYPES or any(extent < 0 for extent in shape):
        raise WireError(f"an array of {dtype} {shape} was announced")
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size > _MAX_ARRAY:
        raise WireError(f"an array of {size} bytes was announced; at most {_MAX_ARRAY} fit")
    content = _read(connection, size)
    return None if content is None else np.frombuffer(content, dtype).reshape(shape)


def _read(connection: socket.socket, size: int) -> bytearray | None:
    buffer = bytearray(size)
    view = memoryview(buffer)
    filled = 0
    while filled < size:
        count = connection.recv_into(view[filled:])
        if count == 0:
            return None
        filled += count
    return buffer


PAUSE, RESUME, STEP = "pause", "resume", "step"
CONTROLS = frozenset({PAUSE, RESUME, STEP})
"""Messages that change the pace of a simulation and leave what is simulated alone."""


class Holds:
    """The pace of every session's simulation.

    A held one computes its first frame, the state it starts from, and then one frame a step.
    """

    def __init__(self) -> None:
        self._steps: dict[str, int] = {}
        self._frames: dict[str, int] = {}

    def start(self, session: str, *, is_held: bool) -> None:
        """A session's simulation begins anew; steps that were left over are forgotten."""
        self._frames[session] = 0
        if is_held:
            self._steps[session] = 0
        else:
            self._steps.pop(session, None)

    def hear(self, message: Message) -> None:
        """Take in a message of `CONTROLS`."""
        session = message["session"]
        if message.kind == RESUME:
            self._steps.pop(session, None)
        elif message.kind == STEP:
            self._steps[session] = self._steps.get(session, 0) + 1
        else:
            self._steps[session] = 0

    def may_go_on(self, session: str) -> bool:
        """Tell whether a session's next frame may be computed."""
        return self._steps.get(session, 1) > 0 or self._frames.get(session, 0) == 0

    def count(self, session: str, frames: int) -> None:
        """Count the frames that a session's simulation has computed since it began."""
        before = self._frames.get(session, 0)
        self._frames[session] = frames
        if session in self._steps and before > 0:
            self._steps[session] = max(self._steps[session] - (frames - before), 0)

    def forget(self, session: str) -> None:
        """Forget a session that was closed."""
        self._steps.pop(session, None)
        self._frames.pop(session, None)
