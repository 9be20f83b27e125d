"""The size that an image or a video announces, read before anything of it is decoded.

A file of a few hundred bytes can announce a picture that fills all memory.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np

from physhandi.data.arrays import read_array
from physhandi.data.untrusted.exr import MAGIC as _EXR
from physhandi.data.untrusted.exr import depth_channels, is_whole_exr, read_exr_header

MOST_PIXELS = 50_000_000
"""Pixels of the largest image that is decoded: 8,192 x 6,144."""
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_MOST_CHUNKS = 1 << 17
"""Chunks of a PNG that are passed; the largest image in chunks of 4 kB has fewer."""
_MARKER = b"\x02\x01"
"""A byte 0xff and one that makes both a marker, by `_MARKER_PARTS`."""
_MARKER_PARTS = bytes(
    2 if byte == 0xFF else 1 if 0xC0 <= byte <= 0xCF or byte >= 0xD8 else 0 for byte in range(256)
)
"""What each byte may be of a marker that begins a segment of a JPEG, or begins or ends a picture.

In a coded picture, 0x00 or a restart (0xd0 to 0xd7) follows each 0xff; any 0xff before a marker
fills.
"""
_BEGIN, _END = 0xD8, 0xD9
_BLOCK = 1 << 14
"""Bytes of a JPEG in which a marker is looked for at once."""
_MOST_SEGMENTS = 4096
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Numbers a pixel of each color type of PNG."""
_DEFLATE = 1032
"""Bytes that one compressed byte can stand for at most (zlib's technical details)."""
_FIRST_BOXES = {b"ftyp", b"moov", b"mdat", b"free", b"wide"}
"""Boxes with which MP4 and MOV files begin."""
_CONTAINERS = {b"moov", b"trak", b"mdia", b"minf", b"stbl"}
"""Boxes of MP4 that lead to sample descriptions."""


ImageForm = Literal["PNG", "JPEG", "EXR", "NPY"]


@dataclass(frozen=True)
class AnnouncedImage:
    """Format and size of an image, by the header of its file."""

    form: ImageForm
    """Its format, by its content."""
    width: int
    """Width [px]."""
    height: int
    """Height [px]."""
    channel_count: int
    """Numbers a pixel; of OpenEXR, channels that may hold depth."""
    number: np.dtype[Any]
    """Kind of these numbers."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [px]."""
        return self.width, self.height


def announced_size(path: Path) -> tuple[int, int]:
    """Read the width and height [px] that a PNG, JPEG, EXR or ``.npy`` file announces.

    Raises:
        ValueError: See `announced_image`.
        OSError: If it cannot be read.
    """
    return announced_image(path).size


def announced_image(path: Path) -> AnnouncedImage:
    """Read what a PNG, JPEG, EXR or ``.npy`` file announces.

    Raises:
        ValueError: If it is none of these, ends within its header, or announces more than
            `MOST_PIXELS`; the message continues a sentence that begins with the file's name.
        OSError: If it cannot be read.
    """
    with path.open("rb") as stream:
        start = stream.read(32)
        try:
            if start.startswith(_PNG):
                if start[12:16] != b"IHDR":
                    raise ValueError("has a damaged PNG header")
                announced = _png(start, path.stat().st_size)
            elif start.startswith(_JPEG):
                announced = _jpeg(stream)
            elif start.startswith(_EXR):
                announced = _exr(stream)
            else:
                announced = _npy(path)
        except struct.error:
            raise ValueError("ends within its header, so it was cut off") from None
    check_pixels(announced.size, path)
    return announced


def is_whole(path: Path, form: ImageForm) -> bool:
    """Tell whether an image has its end; decoders fill what is missing without a word.

    What follows the end is no part of it: cameras append a second picture, programs what they know.

    Args:
        path: File with a sound header; an ``.npy`` file without its end has none.
        form: Its format.
    """
    if form == "EXR":
        return is_whole_exr(path)
    if form == "NPY":
        return True
    with path.open("rb") as stream:
        try:
            return _ends_as_png(stream) if form == "PNG" else _END in _jpeg_markers(stream)
        except struct.error:
            return False


def check_pixels(size: tuple[int, int], path: Path) -> None:
    """Refuse a size without pixels, or with more than are decoded.

    Raises:
        ValueError: If it is not to be decoded; see `announced_size`.
    """
    width, height = size
    if width < 1 or height < 1 or width * height > MOST_PIXELS:
        raise ValueError(
            f"announces {width}x{height} px in a file of {path.stat().st_size} bytes; images of 1 "
            f"to {MOST_PIXELS} pixels are read"
        )


def video_size(path: Path) -> tuple[int, int] | None:
    """Read the width and height [px] that an MP4 video announces in its sample description.

    Returns:
        Those of the first track that has any; None if the file has no readable sample description,
        so that only its decoder can tell.

    Raises:
        ValueError: If it is too large to decode; see `announced_size`.
        OSError: If it cannot be read.
    """
    with path.open("rb") as stream:
        for kind, content in _boxes(stream, path.stat().st_size):
            if kind != b"stsd":
                continue
            stream.seek(content + 8)  # Version, flags and number of entries.
            entry = stream.read(36)
            if len(entry) < 36:
                continue
            width, height = struct.unpack(">HH", entry[32:36])
            if width and height:
                check_pixels((width, height), path)
                return width, height
    return None


def is_whole_video(path: Path) -> bool:
    """Tell whether an AVI or MP4 video is as long as its parts announce; True for other formats.

    Of a video that is shorter only its decoder can tell how many frames are left.
    """
    end = path.stat().st_size
    with path.open("rb") as stream:
        start = stream.read(12)
        if start[:4] == b"RIFF" and len(start) == 12:
            return struct.unpack("<I", start[4:8])[0] + 8 <= end
        if start[4:8] not in _FIRST_BOXES:
            return True
        at = 0
        for _ in range(_MOST_SEGMENTS):
            stream.seek(at)
            header = stream.read(16)
            if len(header) < 8:
                break
            size = struct.unpack(">I", header[:4])[0]
            if size == 1 and len(header) == 16:
                size = struct.unpack(">Q", header[8:])[0]
            if size < 8:  # The box goes on to the end of the file, or is none.
                break
            at += size
        return at <= end


def _boxes(stream: BinaryIO, end: int) -> Iterator[tuple[bytes, int]]:
    """Walk through the boxes of an MP4 file (ISO/IEC 14496-12) with those in its containers.

    Gives the kind of each box and where its content begins.
    """
    waiting = [(0, end)]
    for _ in range(_MOST_SEGMENTS):
        if not waiting:
            return
        at, until = waiting.pop()
        stream.seek(at)
        header = stream.read(16)
        if len(header) < 8 or at + 8 > until:
            continue
        size, kind, skipped = struct.unpack(">I", header[:4])[0], header[4:8], 8
        if size == 1 and len(header) == 16:
            size, skipped = struct.unpack(">Q", header[8:])[0], 16
        size = size or until - at
        if size < skipped:
            continue
        last = min(at + size, until)
        waiting.append((last, until))
        if kind in _CONTAINERS:
            waiting.append((at + skipped, last))
        yield kind, at + skipped


def _png(start: bytes, file_size: int) -> AnnouncedImage:
    width, height, bits, color = struct.unpack(">IIBB", start[16:26])
    channels = _CHANNELS.get(color, 1)
    row = 1 + (width * bits * channels + 7) // 8
    if width * height <= MOST_PIXELS and row * height > _DEFLATE * file_size:
        raise ValueError(
            f"announces {width}x{height} px, which a file of {file_size} bytes cannot hold"
        )
    number = np.dtype(np.uint16 if bits == 16 else np.uint8)
    return AnnouncedImage("PNG", width, height, channels, number)


def _ends_as_png(stream: BinaryIO) -> bool:
    """Go from chunk to chunk until the last one, and tell whether that is whole.

    Raises:
        struct.error: If the file ends before it.
    """
    stream.seek(len(_PNG))
    for _ in range(_MOST_CHUNKS):
        length, kind = struct.unpack(">I4s", stream.read(8))
        if kind == b"IEND":
            return length == 0 and len(stream.read(4)) == 4
        stream.seek(length + 4, 1)  # Content and checksum.
    return False


def _jpeg(stream: BinaryIO) -> AnnouncedImage:
    """Go from segment to segment until the one that describes the frame."""
    for marker in _jpeg_markers(stream):
        if 0xC0 <= marker <= 0xCF and marker not in {0xC4, 0xC8, 0xCC}:
            height, width, channels = struct.unpack(">xHHB", stream.read(6))
            return AnnouncedImage("JPEG", width, height, channels, np.dtype(np.uint8))
    raise ValueError("has no size in its JPEG header")


def _jpeg_markers(stream: BinaryIO) -> Iterator[int]:
    """Walk through the segments of a JPEG (ITU-T T.81) until it ends, or another one begins.

    Gives the marker of each and leaves the stream where its content begins. Small pictures of a
    header lie in segments of their own, which are passed over.

    Raises:
        struct.error: If the file ends before.
    """
    stream.seek(len(_JPEG))
    for _ in range(_MOST_SEGMENTS):
        marker = _next_marker(stream)
        if marker in {_BEGIN, _END}:
            yield marker
            return
        (length,) = struct.unpack(">H", stream.read(2))
        if length < 2:  # It counts its own bytes.
            return
        following = stream.tell() + length - 2
        yield marker
        stream.seek(following)


def _next_marker(stream: BinaryIO) -> int:
    """Find the next marker, in a coded picture too; the stream goes on behind it."""
    last = b""
    while block := stream.read(_BLOCK):
        block = last + block
        at = block.translate(_MARKER_PARTS).find(_MARKER)
        if at >= 0:
            stream.seek(at + 2 - len(block), 1)
            return block[at + 1]
        last = block[-1:]  # A marker may lie across two blocks.
    raise struct.error("no marker is left")


def _exr(stream: BinaryIO) -> AnnouncedImage:
    header = read_exr_header(stream)
    chosen = depth_channels([*header.channels])
    pixels = header.width * header.height
    # Every channel is decoded, also those that nobody asks for.
    if pixels <= MOST_PIXELS and pixels * len(header.channels) > 2 * MOST_PIXELS:
        raise ValueError(
            f"announces {len(header.channels)} channels of {header.width}x{header.height} px; "
            f"at most {2 * MOST_PIXELS} numbers are read"
        )
    number = header.channels[chosen[0]]
    return AnnouncedImage("EXR", header.width, header.height, len(chosen), number)


def _npy(path: Path) -> AnnouncedImage:
    try:
        array = read_array(path, mmap=True)
    except ValueError as error:
        raise ValueError(
            f"is neither PNG, JPEG, EXR nor a whole .npy file of plain numbers ({error})"
        ) from None
    shape = array.shape
    if len(shape) not in (2, 3) or (len(shape) == 3 and math.prod(shape[2:]) > 4):
        raise ValueError(f"holds an array {shape}; expected one image (row, column)")
    return AnnouncedImage("NPY", shape[1], shape[0], math.prod(shape[2:]), array.dtype)
