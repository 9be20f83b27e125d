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

PAUSE, RESUME, STEP = "pause", "resume", "step"
"""Messages that change the pace of a simulation and leave what is simulated alone."""
STEER, DRIVE = "steer", "drive"
"""Messages that begin to simulate what somebody steers, and that tell where its hands shall go."""

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
    """Kind of the message, for example ``"frame"``."""
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
        The message, or None when the other side has closed the connection, also if it did so
        without reading all that was sent to it.

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
        try:
            count = connection.recv_into(view[filled:])
        except ConnectionResetError:  # Linux's word for "closed, and did not read everything".
            return None
        if count == 0:
            return None
        filled += count
    return buffer
