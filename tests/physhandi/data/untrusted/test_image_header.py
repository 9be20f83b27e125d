"""Sizes are known before an image is decoded, whatever the file announces."""

import struct
import tracemalloc

import cv2
import numpy as np
import pytest
from support.hostile.header_bombs import exr, png

from physhandi.data.untrusted.image_header import announced_size, is_whole, is_whole_video


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


PICTURE = cv2.GaussianBlur(
    np.random.default_rng(3).integers(0, 255, (72, 96, 3), np.uint8), (0, 0), 1.5
)
SMALL = cv2.imencode(".jpg", PICTURE[:24, :24])[1].tobytes()
EXIF = b"\xff\xe1" + struct.pack(">H", 8 + len(SMALL)) + b"Exif\0\0" + SMALL


def encoded(suffix: str, *options: int) -> bytes:
    return cv2.imencode(suffix, PICTURE, options)[1].tobytes()


PNG = encoded(".png")
JPEG = encoded(".jpg", cv2.IMWRITE_JPEG_QUALITY, 100)
PHOTO = JPEG[:2] + EXIF + JPEG[2:]  # As cameras write it: with a small picture in its header.
SCANS = encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
RESTARTS = encoded(".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 1)
LAST_SCAN = SCANS.rindex(b"\xff\xda")
PIXELS = JPEG.index(b"\xff\xda") + 14
"""Where the coded picture begins, behind what tells of three channels."""
BLOCK = 1 << 14
"""Bytes that are looked at at once."""
FAR = 5 * BLOCK
WHOLE = {
    "PNG": PNG,
    "PNG and text": PNG + b"tEXt" * FAR,
    "JPEG": JPEG,
    "JPEG and text": JPEG + b"text" * FAR,
    "two pictures": PHOTO + PHOTO,
    "a picture and half of one": PHOTO + PHOTO[:-900],
    "a small picture in a header": PHOTO,
    "scans": SCANS + bytes(3000),
    "restarts": RESTARTS + bytes(3000),
    "filled before its end": JPEG[:-2] + b"\xff" * FAR + JPEG[-2:],
    "an end across blocks": JPEG[:-2] + bytes(PIXELS + 5 * BLOCK - len(JPEG) + 1) + JPEG[-2:],
}
CUT = {
    "PNG": PNG[:-1],
    "PNG without its end": PNG[:-12],
    "PNG of which half is empty": PNG[: len(PNG) // 2] + bytes(FAR),
    "PNG that writes of its end": PNG[:-12] + b"\0\0\0\x08tEXtan IEND!\0\0\0\0",
    "PNG whose chunk leads out of it": PNG[:33] + b"\xff\xff\xff\xff" + PNG[37:],
    "JPEG": JPEG[:-1],
    "JPEG without its end": JPEG[:-2],
    "JPEG of which half is empty": JPEG[: len(JPEG) // 2] + bytes(FAR),
    "a small picture in a header": PHOTO[:-900],
    "in a header behind a small picture": PHOTO[: 2 + len(EXIF) + 30],
    "a cut picture and whole ones": PHOTO[:-900] + 20 * PHOTO,
    "scans, in the last": SCANS[: LAST_SCAN + 30],
    "scans, before the last": SCANS[:LAST_SCAN],
    "restarts": RESTARTS[: len(RESTARTS) // 2],
    "JPEG that is filled": JPEG[:-2] + b"\xff" * FAR,
    "JPEG whose segment leads backwards": JPEG[:-2] + b"\xff\xfe\0\0" + JPEG[-2:],
    "JPEG whose segment leads out of it": JPEG[:-2] + b"\xff\xfe\xff\xff" + JPEG[-2:],
}


@pytest.mark.parametrize("kind", WHOLE)
def test_what_follows_a_whole_image_does_no_harm(tmp_path, kind):
    path = tmp_path / "image"
    path.write_bytes(WHOLE[kind])
    assert is_whole(path, "PNG" if kind.startswith("PNG") else "JPEG")
    assert announced_size(path) == (96, 72)
    # What is decoded is all of it, not what was filled in: compression alone changes it.
    assert np.abs(cv2.imread(str(path)).astype(int) - PICTURE).mean() < 4


@pytest.mark.parametrize("kind", CUT)
def test_an_image_without_its_end_is_told(tmp_path, kind):
    path = tmp_path / "image"
    path.write_bytes(CUT[kind])
    assert not is_whole(path, "PNG" if kind.startswith("PNG") else "JPEG")


@pytest.mark.parametrize(
    ("form", "content"),
    [
        ("JPEG", b"\xff\xd8" + b"\xff" * 2_000_000),
        ("JPEG", b"\xff\xd8" + b"\xff\xfe\0\x02" * 500_000),
        ("PNG", PNG[:33] + bytes(200_000)),
    ],
    ids=["filling", "empty segments", "empty chunks"],
)
def test_an_endless_image_takes_no_memory(tmp_path, form, content):
    path = tmp_path / "image"
    path.write_bytes(content)
    tracemalloc.start()
    assert not is_whole(path, form)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100_000


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
