"""Small files whose headers announce any size."""

import struct
import zlib

import cv2
import numpy as np


def png(width: int, height: int, *, bits: int = 8, color: int = 0, content: bytes = b"") -> bytes:
    """Write a PNG by its specification: header, compressed rows, end."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        )

    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(content)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def jpeg(width: int, height: int) -> bytes:
    """Encode a small image, and let its header announce another size."""
    encoded = bytearray(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    at = encoded.index(b"\xff\xc0")
    encoded[at + 5 : at + 9] = struct.pack(">HH", height, width)
    return bytes(encoded)


def exr(
    width: int,
    height: int,
    *,
    flags: int = 0,
    names: tuple[str, ...] = ("Z",),
    sampling: int = 1,
    **changes: bytes,
) -> bytes:
    """Write the header of an OpenEXR image by its specification, and no pixels.

    Args:
        width: Width that it announces [px].
        height: Height [px].
        flags: Bits beside the version.
        names: Channels, of floats.
        sampling: Pixels of the picture for one of theirs, across and down.
        changes: Content of other attributes, or of these.
    """
    channels = b"".join(
        name.encode() + b"\0" + struct.pack("<i4x2i", 2, sampling, sampling) for name in names
    )
    window = struct.pack("<4i", 3, 5, width + 2, height + 4)
    fields = {
        "channels": channels + b"\0",
        "comments": b"a longer text than any other",
        "compression": b"\x03",
        "dataWindow": window,
        "displayWindow": window,
        **changes,
    }
    attributes = b"".join(
        name.encode() + b"\0kind\0" + struct.pack("<i", len(content)) + content
        for name, content in fields.items()
    )
    return b"\x76\x2f\x31\x01" + struct.pack("<i", 2 | flags) + attributes + b"\0"


def mp4(content: bytes, width: int, height: int) -> bytes:
    """Let a video that OpenCV wrote announce another size in its sample description."""
    at = content.index(b"mp4v", content.index(b"stsd")) + 28
    return content[:at] + struct.pack(">HH", width, height) + content[at + 4 :]
