"""Nothing is decoded that announces another size than its camera, or more than it can hold."""

import io
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.hostile.header_bombs import jpeg, mp4, png

from physhandi.data.arrays import read_array
from physhandi.data.camera import PinholeCamera
from physhandi.data.untrusted.image_header import MOST_PIXELS, announced_size, video_size
from physhandi.data.view import View
from physhandi.errors import SequenceError

WIDTH, HEIGHT = 48, 36


def view(folder: Path) -> View:
    focal = np.array([[40.0, 0, WIDTH / 2], [0, 40, HEIGHT / 2], [0, 0, 1]])
    return View(folder / "views/front", "bomb", PinholeCamera(focal, np.eye(4), WIDTH, HEIGHT), 2)


def put(folder: Path, rel: str, content: bytes) -> View:
    path = folder / "views/front" / rel
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return view(folder)


READERS: dict[str, tuple[str, bytes, Callable[[View], object]]] = {
    "mask": ("mask/00001.png", png(100_000, 100_000), lambda view: view.mask(1)),
    "depth": ("depth/00001.png", png(100_000, 100_000, bits=16), lambda view: view.depth(1)),
    "color": ("color/00001.png", png(100_000, 100_000, color=2), lambda view: view.color(1)),
    "jpeg": ("color/00001.jpg", jpeg(60_000, 60_000), lambda view: view.color(1)),
}


@pytest.mark.parametrize("case", list(READERS))
def test_a_header_bomb_is_refused_without_memory(tmp_path: Path, case: str) -> None:
    rel, content, read = READERS[case]
    bomb = put(tmp_path, rel, content)
    tracemalloc.start()
    with pytest.raises(SequenceError) as refusal:
        read(bomb)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200_000
    message = str(refusal.value)
    assert "'bomb'" in message
    assert "frame 1" in message
    assert ("60000x60000" if case == "jpeg" else "100000x100000") in message
    assert refusal.value.frame == 1
    assert refusal.value.file == f"views/front/{rel}"
    assert refusal.value.remedy


def test_a_size_that_is_not_the_cameras_is_refused_before_decoding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = cv2.imencode(".png", np.zeros((HEIGHT, WIDTH - 1), np.uint8))[1].tobytes()
    wrong = put(tmp_path, "mask/00000.png", image)
    monkeypatch.setattr(cv2, "imread", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(SequenceError, match=r"mask of frame 0 is 47x36 px, but .* 48x36"):
        wrong.mask(0)


def test_whole_images_are_read_as_before(tmp_path: Path) -> None:
    drawn = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    put(tmp_path, "color/00000.png", cv2.imencode(".png", drawn[..., ::-1])[1].tobytes())
    flat = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    put(tmp_path, "color/00001.jpg", cv2.imencode(".jpg", flat)[1].tobytes())
    whole = put(tmp_path, "mask/00000.png", png(WIDTH, HEIGHT, content=bytes((WIDTH + 1) * HEIGHT)))
    np.testing.assert_array_equal(whole.color(0), drawn)
    np.testing.assert_array_equal(whole.color(1), flat)
    np.testing.assert_array_equal(whole.mask(0), np.zeros((HEIGHT, WIDTH)))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "neither PNG"),
        (b"II*\x00" + bytes(50), "neither PNG"),
        (png(7_000, 7_000), r"7000x7000 px, which a file of \d+ bytes cannot hold"),
        (png(0, 5), "announces 0x5 px"),
        (jpeg(65_000, 65_000), rf"65000x65000 px in a file of \d+ bytes; .* {MOST_PIXELS} pixels"),
        (b"\xff\xd8\xff\xe0\x00\x10" + bytes(40), "cut off"),
        (b"\xff\xd8" + b"\xff" * 60, "cut off"),
    ],
)
def test_what_no_image_header_can_be_is_told(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=words):
        announced_size(path)


def film(path: Path) -> bytes:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30, (WIDTH, HEIGHT))
    for level in (40, 80):
        writer.write(np.full((HEIGHT, WIDTH, 3), level, np.uint8))
    writer.release()
    return path.read_bytes()


def test_a_video_tells_its_size_in_its_sample_description(tmp_path: Path) -> None:
    path = tmp_path / "views/front/color.mp4"
    content = film(path)
    assert video_size(path) == (WIDTH, HEIGHT)
    view(tmp_path).check_presence()
    assert abs(int(view(tmp_path).color(1).mean()) - 80) < 4
    assert mp4(content, WIDTH, HEIGHT) == content
    path.write_bytes(mp4(content, 60_000, 60_000))
    with pytest.raises(SequenceError, match=r"60000x60000 px.*smaller"):
        view(tmp_path).check_presence()
    path.write_bytes(mp4(content, 40, 30))
    with pytest.raises(SequenceError, match="color of frame 0 is 40x30 px"):
        view(tmp_path).color(0)


@pytest.mark.parametrize("content", [b"", b"\x00" * 64, b"\x00\x00\x00\x01moov" + b"\xff" * 40])
def test_what_is_no_mp4_is_left_to_the_decoder(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "color.mp4"
    path.write_bytes(content)
    assert video_size(path) is None


def test_an_array_that_announces_more_than_its_file_holds_is_refused(tmp_path: Path) -> None:
    stream = io.BytesIO()
    header = {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6, 3)}
    np.lib.format.write_array_header_1_0(stream, header)
    path = tmp_path / "control.npy"
    path.write_bytes(stream.getvalue() + bytes(12))
    with pytest.raises(ValueError, match=r"12000000000000 bytes, but 12 follow"):
        read_array(path)
    np.save(path, np.arange(6.0).reshape(2, 3))
    np.testing.assert_array_equal(read_array(path), [[0, 1, 2], [3, 4, 5]])


def test_what_opencv_itself_refuses_is_told_as_all_that_cannot_be_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_path: str, _flags: int) -> None:
        raise cv2.error("too large for OpenCV")

    own = put(tmp_path, "mask/00001.png", png(WIDTH, HEIGHT, content=b"\0" * (WIDTH + 1) * HEIGHT))
    assert own.mask(1).shape == (HEIGHT, WIDTH)
    monkeypatch.setattr(cv2, "imread", refuse)
    with pytest.raises(SequenceError, match=r"mask of frame 1 cannot be decoded \(mask/00001\.png"):
        own.mask(1)
