"""Sizes are known before an image is decoded, whatever the file announces."""

import struct

import cv2
import numpy as np
import pytest
from support.hostile.header_bombs import exr, png

from physhandi.data.untrusted.image_header import announced_size, is_whole_video


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_the_size_of_what_opencv_writes_is_read(tmp_path, suffix):
    path = tmp_path / f"image{suffix}"
    cv2.imwrite(str(path), np.full((37, 53, 3), 90, np.uint8))
    assert announced_size(path) == (53, 37)


def test_the_sizes_of_exr_and_npy_are_read(tmp_path):
    (tmp_path / "a.exr").write_bytes(exr(640, 360))
    np.save(tmp_path / "b.npy", np.zeros((12, 20), np.float32))
    assert announced_size(tmp_path / "a.exr") == (640, 360)
    assert announced_size(tmp_path / "b.npy") == (20, 12)


@pytest.mark.parametrize("write", [png, exr])
def test_a_small_file_that_announces_a_huge_image_is_refused(tmp_path, write):
    path = tmp_path / "bomb"
    path.write_bytes(write(100_000, 100_000))
    assert path.stat().st_size < 400
    with pytest.raises(ValueError, match="100000x100000 px in a file of"):
        announced_size(path)


def test_what_ends_in_its_header_or_is_no_image_is_refused(tmp_path):
    path = tmp_path / "x.png"
    path.write_bytes(png(20, 10)[:20])
    with pytest.raises(ValueError, match="cut off"):
        announced_size(path)
    cv2.imwrite(str(tmp_path / "x.jpg"), np.zeros((20, 10, 3), np.uint8))
    path.write_bytes((tmp_path / "x.jpg").read_bytes()[:30])
    with pytest.raises(ValueError, match="cut off"):
        announced_size(path)
    path.write_bytes(b"no image")
    with pytest.raises(ValueError, match="neither PNG"):
        announced_size(path)
    np.save(tmp_path / "x.npy", np.zeros((2, 3, 4, 5)))
    with pytest.raises(ValueError, match="one image"):
        announced_size(tmp_path / "x.npy")


def box(kind: bytes, size: int, content: bytes = b"") -> bytes:
    return struct.pack(">I", size) + kind + content


@pytest.mark.parametrize(
    ("content", "is_whole"),
    [
        (b"RIFF" + struct.pack("<I", 20) + b"AVI " + bytes(16), True),
        (b"RIFF" + struct.pack("<I", 20) + b"AVI " + bytes(15), False),
        (box(b"ftyp", 16, bytes(8)) + box(b"mdat", 24, bytes(16)), True),
        (box(b"ftyp", 16, bytes(8)) + box(b"mdat", 24, bytes(15)), False),
        (box(b"mdat", 1, struct.pack(">Q", 32) + bytes(16)), True),
        (box(b"mdat", 1, struct.pack(">Q", 1 << 40) + bytes(16)), False),
        (box(b"ftyp", 16, bytes(8)) + box(b"mdat", 0, bytes(5)), True),  # As long as the file.
        (b"\x1a\x45\xdf\xa3" + bytes(20), True),  # Matroska need not say it.
        (b"", True),
    ],
)
def test_a_video_that_is_shorter_than_it_says_is_told(tmp_path, content, is_whole):
    (tmp_path / "video").write_bytes(content)
    assert is_whole_video(tmp_path / "video") == is_whole
