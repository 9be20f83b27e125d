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


def mp4(content: bytes, width: int, height: int) -> bytes:
    """Let a video that OpenCV wrote announce another size in its sample description."""
    at = content.index(b"mp4v", content.index(b"stsd")) + 28
    return content[:at] + struct.pack(">HH", width, height) + content[at + 4 :]
