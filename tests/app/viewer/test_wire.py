import socket
import struct
import threading

import numpy as np
import pytest

from app.viewer.live.wire import Message, WireError, receive, send


@pytest.fixture
def pair():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield ours, theirs


def test_a_message_arrives_as_it_was_sent(pair) -> None:
    ours, theirs = pair
    arrays = {
        "position": np.arange(30_000, dtype=np.float32).reshape(-1, 3),
        "empty": np.zeros((0, 2), np.int32),
        "strided": np.arange(20, dtype=np.int64)[::3],
    }
    sender = threading.Thread(target=send, args=(ours, Message("frame", {"frame": 7}, arrays)))
    sender.start()
    message = receive(theirs)
    sender.join()
    assert message is not None
    assert (message.kind, message["frame"]) == ("frame", 7)
    for name, array in arrays.items():
        np.testing.assert_array_equal(message.arrays[name], array)
        assert message.arrays[name].dtype == array.dtype


def test_a_closed_connection_is_the_end_also_inside_a_message(pair) -> None:
    ours, theirs = pair
    ours.sendall(struct.pack("<I", 100) + b"{")
    ours.shutdown(socket.SHUT_WR)
    assert receive(theirs) is None


@pytest.mark.parametrize(
    "header",
    [
        b"not json",
        b"[]",
        b'{"kind": "x", "fields": {}}',
        b'{"kind": "x", "fields": {}, "arrays": [["a", "object", [1]]]}',
        b'{"kind": "x", "fields": {}, "arrays": [["a", "float32", [-1]]]}',
        b'{"kind": "x", "fields": {}, "arrays": [["a", "float64", [1000000, 1000000]]]}',
    ],
)
def test_anything_else_is_refused(pair, header: bytes) -> None:
    ours, theirs = pair
    ours.sendall(struct.pack("<I", len(header)) + header)
    with pytest.raises(WireError):
        receive(theirs)


def test_an_endless_header_is_refused_before_it_is_read(pair) -> None:
    ours, theirs = pair
    ours.sendall(struct.pack("<I", 1 << 30))
    with pytest.raises(WireError, match="1073741824 bytes"):
        receive(theirs)


def test_a_connection_closed_before_everything_was_read_is_the_end_too(pair) -> None:
    ours, theirs = pair
    send(theirs, Message("ready"))
    ours.close()  # The kernel resets the other end.
    assert receive(theirs) is None
