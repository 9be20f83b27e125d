"""Takes over the images and pixel tracks of a PhysTwin case, one frame at a time."""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
from jaxtyping import Float, UInt16
from numpy import ndarray

from physhandi.data.atomic import read_array
from physhandi.data.importers.phystwin_fields import fail, flags, numbers
from physhandi.data.sequence_writer import SequenceWriter

_LARGEST_ARCHIVE = 2 << 30


@dataclass(frozen=True)
class CaseImages:
    """The images of one camera; what is not there is None."""

    case: Path
    camera: int
    frame_count: int
    width: int
    height: int

    @property
    def color(self) -> Path | None:
        """Folder of color images, else a video."""
        return self._existing(f"color/{self.camera}") or self._existing(f"color/{self.camera}.mp4")

    @property
    def depth(self) -> Path | None:
        """Folder of depth images."""
        return self._existing(f"depth/{self.camera}")

    @property
    def mask(self) -> Path | None:
        """Folder of masks, one folder an object."""
        return self._existing(f"mask/{self.camera}")

    @property
    def tracks(self) -> Path | None:
        """File of pixel tracks."""
        return self._existing(f"cotracker/{self.camera}.npz")

    def frame(self, folder: Path, frame: int, suffix: str) -> Path:
        """Give the file of a frame.

        Raises:
            ImportFailedError: If it is not there.
        """
        path = folder / f"{frame}{suffix}"
        if not path.is_file():
            last = self.frame_count - 1
            fail(path, f"is missing; the case has frames 0 to {last} ('{frame}{suffix}', no zeros)")
        return path

    def check_frame_count(self, folder: Path, suffix: str) -> None:
        """Refuse a folder with frames beyond the last one: it was not cut with the others."""
        extra = sorted(
            int(path.stem)
            for path in folder.glob(f"*{suffix}")
            if path.stem.isdecimal() and int(path.stem) >= self.frame_count
        )
        if extra:
            fail(
                folder / f"{extra[0]}{suffix}",
                f"is frame {extra[0]}, but the case has {self.frame_count} frames (from 0 on). "
                "Synchronise the cameras and number their frames alike",
            )

    def check_size(self, path: Path, image: ndarray) -> None:
        """Refuse an image of another size than ``metadata.json`` says."""
        height, width = image.shape[:2]
        if (width, height) != (self.width, self.height):
            fail(
                path,
                f"is {width}x{height} px, but WH in metadata.json is {self.width}x{self.height}",
            )

    def _existing(self, rel: str) -> Path | None:
        path = self.case / rel
        return path if path.exists() else None


def read_image(path: Path, mode: int) -> ndarray:
    """Decode an image.

    Raises:
        ImportFailedError: If that is not possible.
    """
    image = cast("ndarray | None", cv2.imread(str(path), mode))
    if image is None:
        fail(path, "cannot be decoded as an image")
    return image


def copy_color(images: CaseImages, frame: int, writer: SequenceWriter, view: str) -> None:
    """Take over the color image of a frame, or with frame 0 the whole video.

    Raises:
        ImportFailedError: If it is missing, unreadable or of another size or length.
    """
    source = images.color
    if source is None:
        return
    if source.is_dir():
        path = images.frame(source, frame, ".png")
        images.check_size(path, read_image(path, cv2.IMREAD_COLOR))
        writer.copy(f"views/{view}/color/{frame:05d}.png", path)
    elif frame == 0:
        _check_video(source, images)
        writer.copy(f"views/{view}/color.mp4", source)


def copy_depth(images: CaseImages, frame: int, writer: SequenceWriter, view: str) -> None:
    """Turn the depth array of a frame into a 16-bit image; both are in millimetres.

    Raises:
        ImportFailedError: If it is missing or holds something else.
    """
    if images.depth is None:
        return
    path = images.frame(images.depth, frame, ".npy")
    try:
        depth: UInt16[ndarray, "row column"] = read_array(path)
    except (ValueError, OSError) as error:
        fail(path, f"is not a readable .npy file: {error}")
    if depth.dtype != np.uint16 or depth.ndim != 2:
        fail(path, f"holds {depth.dtype}{depth.shape}; expected uint16 millimetres (row, column)")
    images.check_size(path, depth)
    writer.save_image(f"views/{view}/depth/{frame:05d}.png", depth)


def copy_tracks(images: CaseImages, writer: SequenceWriter, view: str) -> None:
    """Take over CoTracker's tracks; PhysTwin stores them as (row, column), we as pixel x and y.

    Raises:
        ImportFailedError: If the file is broken, or a visible track is not finite.
    """
    path = images.tracks
    if path is None:
        return
    table = _archive(path)
    shape = (images.frame_count, "track", 2)
    track: Float[ndarray, "frame track 2"] = numbers(path, table, "tracks", shape)[..., ::-1]
    visible = flags(path, table, "visibility", track.shape[:2])
    lost = np.argwhere(visible & ~np.isfinite(track).all(axis=-1))
    if lost.size:
        frame, number = lost[0]
        fail(path, f"tracks: frame {frame}, track {number} is not finite, but called visible")
    # What is not visible may stand anywhere, also at infinity.
    track = np.where(np.isfinite(track), track, np.nan)
    writer.save_array(f"views/{view}/track.npy", track.astype(np.float32))
    writer.save_array(f"views/{view}/track_visible.npy", visible)


def _archive(path: Path) -> Mapping[str, Any]:
    """Read an ``.npz`` of plain arrays."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _LARGEST_ARCHIVE:
            fail(path, f"unpacks to {size} bytes; at most {_LARGEST_ARCHIVE} are read")
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        fail(path, f"is not a readable .npz of plain arrays: {error}")


def _check_video(path: Path, images: CaseImages) -> None:
    capture = cv2.VideoCapture(str(path))
    try:
        count, width, height = (
            round(capture.get(number))
            for number in (
                cv2.CAP_PROP_FRAME_COUNT,
                cv2.CAP_PROP_FRAME_WIDTH,
                cv2.CAP_PROP_FRAME_HEIGHT,
            )
        )
    finally:
        capture.release()
    if count != images.frame_count:
        fail(path, f"has {count} frames, but the case has {images.frame_count}")
    images.check_size(path, np.empty((height, width)))
