"""Reads viser's recordings by their format alone, and plays them."""

from dataclasses import dataclass, field
from typing import Any

import msgspec.msgpack
import numpy as np
import zstandard


@dataclass
class Recording:
    """The messages of a recording with their times, arrays in their places."""

    seconds: float
    messages: list[tuple[float, dict[str, Any]]] = field(repr=False)

    @classmethod
    def read(cls, content: bytes) -> "Recording":
        size = int.from_bytes(content[:8], "little")
        inner = zstandard.ZstdDecompressor().decompressobj().decompress(content[8:])
        assert len(inner) == size
        length = int.from_bytes(inner[:8], "little")
        about = msgspec.msgpack.decode(inner[8 : 8 + length])
        start, buffers = 8 + length, []
        for count in about["binaryBufferLengths"]:
            start += -start % 8
            buffers.append(inner[start : start + count])
            start += count
        for _, message in about["messages"]:
            _fill_in(message, buffers)
        return cls(about["durationSeconds"], [tuple(entry) for entry in about["messages"]])

    def at(self, time: float) -> dict[str, dict[str, Any]]:
        """Play to a time; returns the properties of every node, with `visible`."""
        nodes: dict[str, dict[str, Any]] = {}
        for when, message in self.messages:
            if when > time + 1e-9:
                break
            name = message.get("name")
            if "props" in message and name is not None:
                nodes[name] = dict(message["props"], visible=True)
            elif message["type"] == "SceneNodeUpdateMessage":
                nodes[name].update(message["updates"])
            elif message["type"] == "SetSceneNodeVisibilityMessage" and name in nodes:
                nodes[name]["visible"] = message["visible"]
        return nodes


def _fill_in(value: Any, buffers: list[bytes]) -> None:
    entries = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in list(entries):
        if isinstance(inner, dict) and "__binary_index" in inner:
            value[key] = np.frombuffer(buffers[inner["__binary_index"]], inner["dtype"])
        elif isinstance(inner, dict | list):
            _fill_in(inner, buffers)
