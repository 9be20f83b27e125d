"""A viewer client for tests: speaks viser's wire format over a websocket, without a browser."""

import time
from typing import Any

import msgspec.msgpack
import numpy as np
import viser
import zstandard
from websockets.sync.client import connect

PROTOCOL = f"viser-v{viser.__version__}"


class ViewerClient:
    """Keeps what the server says about its panel and scene."""

    def __init__(self, url: str, **options: Any) -> None:
        self.connection = connect(
            url,
            subprotocols=[PROTOCOL],
            max_size=None,
            compression=None,
            proxy=None,
            ping_interval=None,  # Many scenes in one process may answer late.
            **options,
        )
        self.gui: dict[str, dict[str, Any]] = {}
        self.nodes: dict[str, dict[str, Any]] = {}
        self.positions: dict[str, tuple[float, ...]] = {}
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
        self.bytes_received = 0

    def __enter__(self) -> "ViewerClient":
        self.tell_camera()
        return self

    def __exit__(self, *_: object) -> None:
        self.connection.close()

    def send(self, kind: str, **fields: Any) -> None:
        self.connection.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def set(self, label: str, value: Any) -> None:
        """Move a slider, tick a box, choose or press."""
        self.send("GuiUpdateMessage", uuid=self.find(label), updates={"value": value})

    def find(self, label: str) -> str:
        # A slider that is not as fitted has a dot before its name.
        labels = (
            (uuid, str(props.get("label")).removeprefix("● ")) for uuid, props in self.gui.items()
        )
        return next((uuid for uuid, known in labels if known == label), "")

    def value(self, label: str) -> Any:
        """The value of a slider, box or choice."""
        return self.gui[self.find(label)]["value"]

    def texts(self) -> str:
        """All Markdown of the panel."""
        return "\n".join(str(p["_markdown"]) for p in self.gui.values() if "_markdown" in p)

    def array(self, name: str, field: str, width: int = 3) -> np.ndarray:
        """The newest value of an array of a scene node, as rows."""
        return self.nodes[name][field].reshape(-1, width)

    def tell_camera(self, **changes: Any) -> None:
        """Tell the server where the camera is, as a browser does after every change of it."""
        self.camera |= changes
        self.send("ViewerCameraMessage", **self.camera)

    def until(self, condition: Any, seconds: float = 30.0) -> None:
        """Take in messages until a condition holds."""
        end = time.monotonic() + seconds
        while not condition():
            left = end - time.monotonic()
            assert left > 0, f"it did not come true; the panel says:\n{self.texts()}"
            try:
                self._take_in(self.connection.recv(timeout=min(left, 0.1)))
            except TimeoutError:
                continue

    def _take_in(self, raw: Any) -> None:
        self.bytes_received += len(raw)
        size, packed = (int.from_bytes(raw[i : i + 8], "little") for i in (0, 8))
        inner = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + packed], max_output_size=size)
        content = msgspec.msgpack.decode(inner)
        start, buffers = 16 + packed, []
        for length in content["binaryBufferLengths"]:
            start += -start % 8
            buffers.append(raw[start : start + length])
            start += length
        for message in content["messages"]:
            _fill_in(message, buffers)
            self.messages.append(message)
            props = message.get("props")
            if message["type"].startswith("Gui") and props is not None:
                self.gui[message["uuid"]] = {**props, "value": message.get("value")}
            elif message["type"] == "GuiUpdateMessage":
                self.gui.get(message["uuid"], {}).update(message["updates"])
            elif message["type"] == "RemoveGuiMessage" or message["type"] == "GuiRemoveMessage":
                self.gui.pop(message["uuid"], None)
            elif "name" in message and props is not None:
                self.nodes[message["name"]] = dict(props)
            elif message["type"] == "SceneNodeUpdateMessage":
                self.nodes.setdefault(message["name"], {}).update(message["updates"])
            self._place(message)

    def _place(self, message: dict[str, Any]) -> None:
        match message["type"]:
            case "SetPositionMessage":
                self.positions[message["name"]] = tuple(message["position"])
            case "SetSceneNodeVisibilityMessage":
                self.visible[message["name"]] = message["visible"]
            case str(kind) if kind.startswith("SetCamera") and not message["initial"]:
                self.camera |= {k: v for k, v in message.items() if k in self.camera}


def _fill_in(value: Any, buffers: list[Any]) -> None:
    """Put the arrays of a message in the place of the references to them."""
    entries = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in list(entries):
        if isinstance(inner, dict) and "__binary_index" in inner:
            value[key] = np.frombuffer(buffers[inner["__binary_index"]], inner["dtype"])
        elif isinstance(inner, dict | list):
            _fill_in(inner, buffers)
