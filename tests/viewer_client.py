"""A viewer client for tests: speaks viser's wire format over a websocket, without a browser."""

import time
from typing import Any

import msgspec.msgpack
import viser
import zstandard
from websockets.sync.client import connect

PROTOCOL = f"viser-v{viser.__version__}"


class ViewerClient:
    """Keeps what the server says about its panel and scene."""

    def __init__(self, url: str, **options: Any) -> None:
        self.connection = connect(
            url, subprotocols=[PROTOCOL], max_size=None, compression=None, proxy=None, **options
        )
        self.gui: dict[str, dict[str, Any]] = {}
        self.nodes: dict[str, dict[str, Any]] = {}
        self.messages: list[dict[str, Any]] = []
        self.bytes_received = 0

    def __enter__(self) -> "ViewerClient":
        self.send(
            "ViewerCameraMessage",
            wxyz=(1.0, 0.0, 0.0, 0.0),
            position=(1.0, 1.0, 1.0),
            fov=0.8,
            near=0.01,
            far=100.0,
            image_height=480,
            image_width=640,
            look_at=(0.0, 0.0, 0.0),
            up_direction=(0.0, 0.0, 1.0),
        )
        return self

    def __exit__(self, *_: object) -> None:
        self.connection.close()

    def send(self, kind: str, **fields: Any) -> None:
        self.connection.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def set(self, label: str, value: Any) -> None:
        """Move a slider, tick a box, choose or press."""
        self.send("GuiUpdateMessage", uuid=self.find(label), updates={"value": value})

    def find(self, label: str) -> str:
        return next(uuid for uuid, props in self.gui.items() if props.get("label") == label)

    def texts(self) -> str:
        """All Markdown of the panel."""
        return "\n".join(str(p["_markdown"]) for p in self.gui.values() if "_markdown" in p)

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
        for message in msgspec.msgpack.decode(inner)["messages"]:
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
