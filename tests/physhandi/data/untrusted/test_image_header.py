"""Sizes are known before an image is decoded, whatever the file announces."""

import cv2
import numpy as np
import pytest
from header_bombs import exr, png

from physhandi.data.untrusted.image_header import announced_size


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
