"""A client of a live scene without a browser: speaks viser's wire format over a websocket."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Self, cast

import msgspec.msgpack
import numpy as np
import viser
import zstandard
from numpy import ndarray
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

PROTOCOL = f"viser-v{viser.__version__}"
PATIENCE_S = 300.0
"""So long a busy machine may take for what has to come; what takes longer does not come [s]."""


def read_messages(raw: bytes) -> list[dict[str, Any]]:
    """Unpack the messages of one websocket frame; arrays are flat."""
    size, packed = (int.from_bytes(raw[i : i + 8], "little") for i in (0, 8))
    inner = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + packed], max_output_size=size)
    content = msgspec.msgpack.decode(inner)
    start, buffers = 16 + packed, list[bytes]()
    for length in content["binaryBufferLengths"]:
        start += -start % 8
        buffers.append(raw[start : start + length])
        start += length
    for message in content["messages"]:
        _fill_in(message, buffers)
    return content["messages"]


class ViewerClient:
    """Keeps what the server says about its panel and scene.

    Attributes:
        gui: Properties of each element of the panel, by its id.
        nodes: Properties of each scene node, by its path.
        positions: Where scene nodes were moved to, by path.
        turns: Quaternions to which scene nodes were turned, w first, by path.
        visible: Whether scene nodes are shown, by path.
        camera: Where this client's camera is.
        messages: All messages in their order, if they are to be remembered.
        bytes_received: Size of all websocket frames [B].
        moment: When the newest websocket frame arrived [s, clock of `time.perf_counter`].
    """

    def __init__(self, url: str, *, remembers: bool = True, **options: Any) -> None:
        """Connect.

        Args:
            url: Websocket address of a live scene.
            remembers: Whether to keep all messages, which takes memory while a scene plays.
            options: More for ``websockets.sync.client.connect``.
        """
        self.connection = connect(
            url,
            subprotocols=[PROTOCOL],  # type: ignore[list-item]  # a NewType of str
            max_size=None,
            compression=None,
            proxy=None,
            ping_interval=None,  # Many scenes in one process may answer late.
            **options,
        )
        self.gui: dict[str, dict[str, Any]] = {}
        self.nodes: dict[str, dict[str, Any]] = {}
        self.positions: dict[str, tuple[float, ...]] = {}
        self.turns: dict[str, tuple[float, ...]] = {}
        self.visible: dict[str, bool] = {}
        self.camera: dict[str, Any] = {
            "wxyz": (1.0, 0.0, 0.0, 0.0),
            "position": (1.0, 1.0, 1.0),
            "fov": 0.8,
            "near": 0.01,
            "far": 100.0,
            "image_height": 480,
            "image_width": 640,
            "look_at": (0.0, 0.0, 0.0),
            "up_direction": (0.0, 0.0, 1.0),
        }
        self.messages: list[dict[str, Any]] = []
        self._remembers = remembers
        self.bytes_received = 0
        self.moment = 0.0

    def __enter__(self) -> Self:
        self.tell_camera()
        return self

    def __exit__(self, *_: object) -> None:
        # Of a connection whose messages nobody takes, the answer to its closing is not read either.
        reader = threading.Thread(target=self._drop_messages)
        reader.start()
        self.connection.close()
        reader.join()

    def _drop_messages(self) -> None:
        with suppress(ConnectionClosed):
            while True:
                self.connection.recv()

    def send(self, kind: str, **fields: Any) -> None:
        """Send one message of viser's."""
        self.connection.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def set(self, label: str, value: Any) -> None:
        """Move a slider, tick a box, choose or press."""
        self.until(lambda: self.find(label))
        self.send("GuiUpdateMessage", uuid=self.find(label), updates={"value": value})

    def find(self, label: str) -> str:
        """Find the id of an element of the panel; empty if there is none of that name."""
        # A slider that is not as fitted has a dot before its name.
        labels = (
            (uuid, str(props.get("label")).removeprefix("● ")) for uuid, props in self.gui.items()
        )
        return next((uuid for uuid, name in labels if name == label), "")

    def value(self, label: str) -> Any:
        """The value of a slider, box or choice."""
        return self.gui[self.find(label)]["value"]

    def texts(self) -> str:
        """All Markdown of the panel."""
        return "\n".join(str(p["_markdown"]) for p in self.gui.values() if "_markdown" in p)

    def array(self, name: str, field: str, width: int = 3) -> ndarray:
        """The newest value of an array of a scene node, as rows."""
        return self.nodes[name][field].reshape(-1, width)

    def tell_camera(self, **changes: Any) -> None:
        """Tell the server where the camera is, as a browser does after every change of it."""
        self.camera |= changes
        self.send("ViewerCameraMessage", **self.camera)

    def until(self, condition: Callable[[], Any], seconds: float = PATIENCE_S) -> None:
        """Take in messages until a condition holds.

        Raises:
            TimeoutError: If it does not in time; says what the panel shows.
        """
        end = time.monotonic() + seconds
        while not condition():
            left = end - time.monotonic()
            if left <= 0:
                raise TimeoutError(f"it did not come true; the panel says:\n{self.texts()}")
            self.take_in(min(left, 0.1))

    def listen(self, seconds: float) -> None:
        """Take in what comes for some time."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.take_in(left)

    def take_in(self, seconds: float) -> list[dict[str, Any]]:
        """Take in the next websocket frame; returns its messages, none if it is late."""
        messages = self._receive(seconds)
        for message in messages:
            self._keep(message)
        return messages

    def _receive(self, seconds: float) -> list[dict[str, Any]]:
        try:
            raw = self.connection.recv(timeout=seconds)
        except TimeoutError:
            return []
        self.moment = time.perf_counter()
        if isinstance(raw, str):
            return []
        self.bytes_received += len(raw)
        return read_messages(raw)

    def _keep(self, message: dict[str, Any]) -> None:
        if self._remembers:
            self.messages.append(message)
        props = message.get("props")
        if message["type"].startswith("Gui") and props is not None:
            self.gui[message["uuid"]] = {**props, "value": message.get("value")}
        elif message["type"] == "GuiUpdateMessage":
            self.gui.get(message["uuid"], {}).update(message["updates"])
        elif message["type"] in {"RemoveGuiMessage", "GuiRemoveMessage"}:
            self.gui.pop(message["uuid"], None)
        elif "name" in message and props is not None:
            self.nodes[message["name"]] = dict(props)
        elif message["type"] == "SceneNodeUpdateMessage":
            self.nodes.setdefault(message["name"], {}).update(message["updates"])
        else:
            self._keep_place(message)

    def _keep_place(self, message: dict[str, Any]) -> None:
        """Keep where a part of the scene or the camera is, and whether it is shown."""
        match message["type"]:
            case "SetPositionMessage":
                self.positions[message["name"]] = tuple(message["position"])
            case "SetOrientationMessage":
                self.turns[message["name"]] = tuple(message["wxyz"])
            case "SetSceneNodeVisibilityMessage":
                self.visible[message["name"]] = message["visible"]
            case str(kind) if kind.startswith("SetCamera") and not message["initial"]:
                self.camera |= {k: v for k, v in message.items() if k in self.camera}
            case _:
                pass


def _fill_in(value: dict[Any, Any] | list[Any], buffers: list[bytes]) -> None:
    """Put the arrays of a message in the place of the references to them."""
    entries: list[tuple[Any, Any]] = list(
        value.items() if isinstance(value, dict) else enumerate(value)
    )
    for key, inner in entries:
        if isinstance(inner, dict) and "__binary_index" in inner:
            reference = cast("dict[str, Any]", inner)
            index = int(reference["__binary_index"])
            value[key] = np.frombuffer(buffers[index], reference["dtype"])
        elif isinstance(inner, dict | list):
            _fill_in(cast("dict[Any, Any] | list[Any]", inner), buffers)
