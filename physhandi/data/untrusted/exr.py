"""OpenEXR images: what their headers announce, whether they are whole, and depth out of them.

Headers are read here, by the format's description (https://openexr.com/en/latest/OpenEXRFileLayout.html);
pixels by the package OpenEXR, in the child process that decodes what others made.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from jaxtyping import Float, Shaped
from numpy import ndarray

from physhandi.errors import UsageError

MAGIC = b"\x76\x2f\x31\x01"
"""How such a file begins."""
_TILED, _DEEP, _PARTS = 0x200, 0x800, 0x1000
"""Flags in the field of the version."""
_MOST_ATTRIBUTES, _LONGEST_NAME = 4096, 255
_MOST_CHANNELS = 64
_SHOWN = 8
"""Channels that a message names."""
_LONGEST_LIST = 1 << 16
_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256, 256, 32, 256, 1)
"""Rows of a chunk by how it is compressed."""
_NUMBERS = {0: np.dtype(np.uint32), 1: np.dtype(np.float16), 2: np.dtype(np.float32)}
_PLACES = 1 << 16
"""Places of chunks that are read at once."""
_DEPTH_NAMES = ("z", "depth")
_PICTURE = ("r", "g", "b")


@dataclass(frozen=True)
class ExrHeader:
    """Header of a file with one flat image."""

    width: int
    """Width [px]."""
    height: int
    """Height [px]."""
    channels: Mapping[str, np.dtype[Any]]
    """Kind of number of each channel, by name."""
    table_at: int
    """Where the places of its chunks are listed [byte]."""
    chunk_count: int
    """Chunks that it has."""
    is_tiled: bool
    """Whether they are tiles, not rows."""


def read_exr_header(stream: BinaryIO) -> ExrHeader:
    """Read what an OpenEXR file announces.

    Raises:
        ValueError: If it is damaged, or holds something else than one flat image; the message
            continues a sentence that begins with the file's name.
        struct.error: If it ends within its header.
    """
    stream.seek(len(MAGIC))
    (version,) = struct.unpack("<I", stream.read(4))
    if version & (_DEEP | _PARTS):
        raise ValueError(
            "is an OpenEXR file of several parts, or of deep pixels. Export depth alone, as one "
            "flat image"
        )
    fields = _attributes(stream)
    table_at = stream.tell()
    if "dataWindow" not in fields:
        raise ValueError("has no size in its OpenEXR header")
    left, top, right, bottom = struct.unpack("<4i", fields["dataWindow"])
    if fields.get("displayWindow", fields["dataWindow"]) != fields["dataWindow"]:
        raise ValueError(
            "holds another part of the picture than it shows (dataWindow and displayWindow of its "
            "OpenEXR header differ). Export the whole picture"
        )
    width, height = right - left + 1, bottom - top + 1
    is_tiled = bool(version & _TILED)
    return ExrHeader(
        width=width,
        height=height,
        channels=_channels(fields.get("channels", b"")),
        table_at=table_at,
        chunk_count=_tile_count(fields, width, height) if is_tiled else _row_count(fields, height),
        is_tiled=is_tiled,
    )


def is_whole_exr(path: Path) -> bool:
    """Tell whether all chunks of an OpenEXR file are there, as far as their places tell.

    Raises:
        ValueError: See `read_exr_header`.
        struct.error: See `read_exr_header`.
    """
    with path.open("rb") as stream:
        header = read_exr_header(stream)
        end = path.stat().st_size
        if header.table_at + 8 * header.chunk_count > end:
            return False
        stream.seek(header.table_at)
        last = 0
        # A file of tiles of one pixel has as many places as pixels: not all are held at once.
        for first in range(0, header.chunk_count, _PLACES):
            count = min(_PLACES, header.chunk_count - first)
            place = np.frombuffer(stream.read(8 * count), "<u8")
            # Places are written last: those of a file that was left half written are 0.
            if place.min() < header.table_at or place.max() >= end:
                return False
            last = max(last, int(place.max()))
        size_at = last + (16 if header.is_tiled else 4)
        stream.seek(size_at)
        size = stream.read(4)
        return len(size) == 4 and size_at + 4 + struct.unpack("<I", size)[0] <= end


def depth_channels(names: list[str]) -> list[str]:
    """Choose the channels that may hold depth: one, or those of a picture.

    Names may be those of layers (``ViewLayer.Depth.Z``).

    Raises:
        ValueError: If none, or several, can be meant; see `read_exr_header`.
    """
    if len(names) == 1:
        return names
    named = [name for name in names if name.rpartition(".")[2].lower() in _DEPTH_NAMES]
    if len(named) == 1:
        return named
    by_name = {name.lower(): name for name in names}
    if all(name in by_name for name in _PICTURE):
        return [by_name[name] for name in _PICTURE]
    for name in ("y", "r"):
        if not named and name in by_name:
            return [by_name[name]]
    shown = ", ".join(names[:_SHOWN])
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    several = ", several of which may be depth" if named else ""
    raise ValueError(
        f"has the channels {shown}{more}{several or ', and none is called Z, depth, Y or R'}. "
        "Export depth alone"
    )


def depth_of_picture(
    image: Shaped[ndarray, "row column channel"],
) -> Shaped[ndarray, "row column"] | None:
    """Take depth out of red, green and blue: all of them alike, or the last two empty.

    Returns:
        Depth; None if they are a picture.
    """
    first = image[..., 0]
    for other in (image[..., 1], image[..., 2]):
        if other.any() and not np.array_equal(other, first, equal_nan=image.dtype.kind == "f"):
            return None
    return first


def require_exr(path: Path) -> None:
    """Refuse to go on if the package is missing that reads pixels.

    Raises:
        UsageError: If it is; says what to install.
    """
    if find_spec("OpenEXR") is None:
        raise UsageError(
            f"Reading {path.name} needs the package OpenEXR, which is not installed: pip install "
            "'physhandi[capture]'. Or convert depth to 16-bit PNG or .npy."
        )


def decode_exr(path: str, names: list[str]) -> Float[ndarray, "row column *channel"] | None:
    """Decode channels of an image, in the child; halves become floats.

    Returns:
        The channels, side by side if there are several; None if they cannot be decoded.
    """
    package: Any = import_module("OpenEXR")
    try:
        by_name = package.File(path, separate_channels=True, num_threads=0).channels()
        channels = [cast("ndarray", by_name[name].pixels) for name in names]
    except (RuntimeError, ValueError, KeyError):
        return None
    image = channels[0] if len(channels) == 1 else np.stack(channels, axis=-1)
    return image.astype(np.float32) if image.dtype.kind == "f" else image


def _attributes(stream: BinaryIO) -> dict[str, bytes]:
    """Read the attributes that are needed; the others are skipped."""
    needed = {"channels", "compression", "dataWindow", "displayWindow", "tiles"}
    attributes: dict[str, bytes] = {}
    for _ in range(_MOST_ATTRIBUTES):
        name = _text(stream)
        if not name:
            return attributes
        _text(stream)  # Type of the attribute.
        (length,) = struct.unpack("<i", stream.read(4))
        if length < 0 or (name in needed and length > _LONGEST_LIST):
            break
        if name in needed:
            attributes[name] = stream.read(length)
            if len(attributes[name]) < length:
                raise struct.error
        else:
            stream.seek(length, 1)
    raise ValueError("has a damaged OpenEXR header")


def _text(stream: BinaryIO) -> str:
    text = b""
    while len(text) <= _LONGEST_NAME:
        (byte,) = struct.unpack("c", stream.read(1))
        if byte == b"\0":
            return text.decode("latin-1")
        text += byte
    raise ValueError("has a damaged OpenEXR header")


def _channels(content: bytes) -> dict[str, np.dtype[Any]]:
    channels: dict[str, np.dtype[Any]] = {}
    at = 0
    while at < len(content) and content[at]:
        end = content.find(b"\0", at)
        kind, x, y = struct.unpack_from("<i4x2i", content, end + 1)
        # Names are shown in messages, where control characters could pretend anything.
        name = content[at:end].decode("utf-8", "replace")
        is_sound = 0 < end <= at + _LONGEST_NAME and name.isprintable() and "\ufffd" not in name
        if not is_sound or kind not in _NUMBERS or len(channels) == _MOST_CHANNELS:
            raise ValueError(f"has a damaged list of channels, or more than {_MOST_CHANNELS}")
        if (x, y) != (1, 1):
            raise ValueError("has channels of several resolutions. Export depth alone")
        channels[name] = _NUMBERS[kind]
        at = end + 17
    if not channels:
        raise ValueError("has no channels in its OpenEXR header")
    return channels


def _row_count(fields: Mapping[str, bytes], height: int) -> int:
    kind = fields.get("compression", b"")
    if len(kind) != 1 or kind[0] >= len(_LINES):
        raise ValueError("is compressed in a way that is not read. Export it as ZIP")
    return -(-height // _LINES[kind[0]])


def _tile_count(fields: Mapping[str, bytes], width: int, height: int) -> int:
    across, down, mode = struct.unpack("<IIB", fields.get("tiles", b""))
    if mode & 15:
        raise ValueError("holds its picture in several sizes. Export depth as one image")
    if not across or not down:
        raise ValueError("has a damaged OpenEXR header")
    return -(-width // across) * -(-height // down)
