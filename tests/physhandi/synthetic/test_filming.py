"""Videos as they are stored, and disks that do not take them."""

import errno
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from physhandi.data.sequence_writer import SequenceWriter
from physhandi.errors import SequenceError, describe
from physhandi.synthetic.film import filming
from physhandi.synthetic.film.filming import save_video

COUNT = 12
Damage = Callable[[Path], None]


def images() -> Iterator[np.ndarray]:
    """Noise about a red that grows from frame to frame."""
    random = np.random.default_rng(3)
    for frame in range(COUNT):
        image = random.integers(0, 40, (48, 64, 3), dtype=np.uint8)
        image[..., 0] += np.uint8(15 * frame)
        yield image


def damaged_by(damage: Damage, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Let every video be damaged once it is released; return where they were written."""
    written: list[Path] = []

    class Writer:
        fourcc = cv2.VideoWriter.fourcc

        def __init__(self, path: str, *rest: object) -> None:
            self.path, self.video = Path(path), real(path, *rest)
            written.append(self.path)

        def isOpened(self) -> bool:  # noqa: N802  # OpenCV's name
            return self.video.isOpened()

        def write(self, image: np.ndarray) -> None:
            self.video.write(image)

        def release(self) -> None:
            self.video.release()
            damage(self.path)

    real = cv2.VideoWriter
    monkeypatch.setattr(filming.cv2, "VideoWriter", Writer)
    return written


def test_every_frame_is_stored_in_its_order(tmp_path, monkeypatch):
    written = damaged_by(lambda _: None, monkeypatch)
    with SequenceWriter(tmp_path / "cloth") as writer:
        save_video(writer, "views/a/color.mp4", images(), 30.0)
        (stored,) = tmp_path.glob(".cloth.*.tmp/views/a/color.mp4")
        video = cv2.VideoCapture(str(stored))
        frames = []
        while (read := video.read())[0]:
            frames.append(read[1][..., ::-1])
        assert (len(frames), video.get(cv2.CAP_PROP_FPS)) == (COUNT, 30.0)
        for frame, expected in zip(frames, images(), strict=True):
            mean = expected.reshape(-1, 3).mean(axis=0)
            assert frame.reshape(-1, 3).mean(axis=0) == pytest.approx(mean, abs=4)
        # On the disk of the sequence, and gone.
        assert written[0].parent.parent == tmp_path
        assert not written[0].parent.exists()


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def with_a_gap(path: Path) -> None:
    """Lose what lies in the middle, while the header tells of all frames."""
    content = bytearray(path.read_bytes())
    end = content.rfind(b"moov") - 4
    content[end // 2 : end] = bytes(end - end // 2)
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [Path.unlink, cut, with_a_gap])
def test_a_disk_that_takes_only_a_part_is_told(tmp_path, monkeypatch, damage):
    written = damaged_by(damage, monkeypatch)
    with (
        pytest.raises(OSError, match=rf"holds \d+ of {COUNT} frames; the disk may be full") as told,
        SequenceWriter(tmp_path / "cloth") as writer,
    ):
        save_video(writer, "views/a/color.mp4", images(), 30.0)
    assert told.value.filename == str(tmp_path / "cloth/views/a/color.mp4")
    assert describe(told.value).startswith(f"{tmp_path}/cloth/views/a/color.mp4: The video holds ")
    assert len(written) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_not_taken_for_a_missing_encoder(tmp_path, monkeypatch):
    damaged_by(lambda _: None, monkeypatch)
    monkeypatch.setattr(filming.cv2.VideoWriter, "isOpened", lambda _: False)
    with (
        pytest.raises(SequenceError, match="has no MPEG-4 encoder"),
        SequenceWriter(tmp_path / "cloth") as writer,
    ):
        save_video(writer, "views/a/color.mp4", images(), 30.0)

    def full(path: Path, _: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_bytes", full)
    with (
        pytest.raises(OSError, match=r"No space left on device: .*color\.mp4"),
        SequenceWriter(tmp_path / "cloth") as writer,
    ):
        save_video(writer, "views/a/color.mp4", images(), 30.0)
    assert list(tmp_path.iterdir()) == []


def test_stopping_between_frames_leaves_no_file(tmp_path):
    def stopped() -> Iterator[np.ndarray]:
        yield from list(images())[:2]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), SequenceWriter(tmp_path / "cloth") as writer:
        save_video(writer, "views/a/color.mp4", stopped(), 30.0)
    assert list(tmp_path.iterdir()) == []


def test_no_images_give_no_video(tmp_path):
    with SequenceWriter(tmp_path / "cloth") as writer:
        save_video(writer, "views/a/color.mp4", iter(()), 30.0)
        assert list(tmp_path.rglob("*.mp4")) == []
