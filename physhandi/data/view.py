"""One view of a sequence: its images, keypoints and tracks, frame by frame."""

import threading
from collections import OrderedDict
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from physhandi.data.arrays import read_array
from physhandi.data.camera import PinholeCamera
from physhandi.data.untrusted.image_header import announced_size, check_pixels, video_size
from physhandi.errors import SequenceError

_CACHED_FRAMES = 16
_MILLIMETRE = np.float32(0.001)
_SMALLER = "re-export the video, smaller"


class View:
    """One calibrated RGB-D stream; any part of it may be absent."""

    def __init__(self, folder: Path, sequence: str, camera: PinholeCamera, frame_count: int):
        self.name = folder.name
        self.folder = folder
        self.camera = camera
        self.frame_count = frame_count
        self._sequence = sequence
        self._video: _Video | None = None
        self._lock = threading.Lock()

    def __repr__(self) -> str:
        return f"View({str(self.folder)!r})"

    @property
    def place(self) -> str:
        """Folder of the view below that of the sequence."""
        parts = self.folder.parts[-3:]
        return "/".join(parts if parts[0] == "truth" else parts[1:])

    @cached_property
    def has_color(self) -> bool:
        """Whether there are color images or a video."""
        return (self.folder / "color.mp4").is_file() or (self.folder / "color").is_dir()

    @cached_property
    def has_depth(self) -> bool:
        """Whether there are depth images."""
        return (self.folder / "depth").is_dir()

    @cached_property
    def has_mask(self) -> bool:
        """Whether there are masks."""
        return (self.folder / "mask").is_dir()

    @property
    def has_keypoint(self) -> bool:
        """Whether keypoints of the hands are stored."""
        return (self.folder / "keypoint.npy").is_file()

    @cached_property
    def keypoint(self) -> Float[ndarray, "frame hand 21 3"] | None:
        """Pixel x, pixel y and confidence of each hand's keypoints; NaN where not seen."""
        return self._array("keypoint.npy")

    @cached_property
    def track(self) -> Float[ndarray, "frame track 2"] | None:
        """Pixel of each tracked point [px]."""
        return self._array("track.npy")

    @cached_property
    def track_visible(self) -> Bool[ndarray, "frame track"] | None:
        """Whether each track is visible."""
        return self._array("track_visible.npy")

    def color(self, frame: int) -> UInt8[ndarray, "row column 3"]:
        """Read the color image of a frame (RGB)."""
        self._check(frame)
        if (self.folder / "color.mp4").is_file():
            with self._lock:
                self._video = self._video or self._open_video(frame)
                image = self._video.read(frame)
            if image is None:
                self._fail("color.mp4", frame, "cannot be decoded", "re-export the video")
        else:
            image = self._image("color", frame, cv2.IMREAD_COLOR)
        self._check_size("color", frame, image)
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def depth(self, frame: int) -> Float[ndarray, "row column"]:
        """Read the depth image of a frame [m]; zero where nothing was measured."""
        image = self._image("depth", frame, cv2.IMREAD_UNCHANGED)
        if image.dtype != np.uint16 or image.ndim != 2:
            reason = f"is {image.dtype}{image.shape}"
            self._fail("depth", frame, reason, "expected 16-bit grey, mm")
        self._check_size("depth", frame, image)
        return image.astype(np.float32) * _MILLIMETRE

    def mask(self, frame: int) -> UInt8[ndarray, "row column"]:
        """Read the labels of a frame: 0 background, 1 object, 2 right hand, 3 left hand."""
        image = self._image("mask", frame, cv2.IMREAD_UNCHANGED)
        if image.dtype != np.uint8 or image.ndim != 2:
            reason = f"is {image.dtype}{image.shape}"
            self._fail("mask", frame, reason, "expected 8-bit grey, 0 to 3")
        self._check_size("mask", frame, image)
        if image.max() > 3:
            self._fail("mask", frame, f"has label {image.max()}", "only 0 to 3 are known")
        return np.asarray(image)

    def straightened(self) -> "View":
        """Give the view as a camera without lens distortion would have recorded it.

        Colors are interpolated; depth and labels are those of the nearest recorded pixel. What the
        lens did not show is black, and has neither depth nor label.

        Returns:
            The view itself if its lens has no distortion.
        """
        return _StraightView(self) if self.camera.distortion.any() else self

    def files(self, kind: str) -> list[Path]:
        """List the images of ``color``, ``depth`` or ``mask`` in frame order."""
        folder = self.folder / kind
        suffixes = {".png", ".jpg"} if kind == "color" else {".png"}
        return sorted(p for p in folder.iterdir() if p.suffix in suffixes and p.name[0] != ".")

    def check_presence(self) -> None:
        """Check that each part that is there has all frames, without decoding images."""
        for kind in ("color", "depth", "mask"):
            if (self.folder / kind).is_dir():
                self._check_files(kind)
        video = self.folder / "color.mp4"
        if video.is_file():
            if (self.folder / "color").is_dir():
                self._fail("color", None, "is there twice: color.mp4 and color/", "remove one")
            try:
                video_size(video)
            except (ValueError, OSError) as error:
                self._fail("color.mp4", None, f"cannot be decoded: it {error}", _SMALLER)
            count = _frame_count(video)
            if count != self.frame_count:
                self._fail(
                    "color.mp4",
                    None,
                    f"has {count} frames, but the sequence has {self.frame_count}",
                    "cut the video or correct frame_count in sequence.yaml",
                )

    def close(self) -> None:
        """Release the video decoder."""
        with self._lock:
            if self._video is not None:
                self._video.close()
                self._video = None

    def _check_files(self, kind: str) -> None:
        names = [path.stem for path in self.files(kind)]
        expected = [f"{frame:05d}" for frame in range(self.frame_count)]
        if names == expected:
            return
        if len(names) != len(set(names)):
            self._fail(kind, None, "has a frame twice, as .png and .jpg", "remove one of them")
        missing = sorted(set(expected) - set(names))
        if missing:
            self._fail(
                kind,
                int(missing[0]),
                f"is missing ({kind}/{missing[0]}.png); there are {len(names)} images for "
                f"{self.frame_count} frames",
                "add it or lower frame_count in sequence.yaml",
            )
        extra = sorted(set(names) - set(expected))
        self._fail(
            kind,
            None,
            f"has {kind}/{extra[0]}, but the sequence has only {self.frame_count} frames "
            f"(00000 to {expected[-1]})",
            "remove it or raise frame_count in sequence.yaml",
        )

    def _array(self, file: str) -> Any:
        path = self.folder / file
        if not path.is_file():
            return None
        try:
            return read_array(path)
        except (ValueError, OSError) as error:
            self._fail(file, None, f"is not a readable .npy file: {error}", "re-export it")

    def _image(self, kind: str, frame: int, flags: int) -> ndarray:
        self._check(frame)
        path = self.folder / kind / f"{frame:05d}.png"
        if kind == "color" and not path.is_file():
            path = path.with_suffix(".jpg")
        if not path.is_file():
            self._fail(kind, frame, f"is missing ({path.relative_to(self.folder)})", "add it")
        file = path.relative_to(self.folder)
        try:
            size = announced_size(path)
        except (ValueError, OSError) as error:
            self._fail(kind, frame, f"cannot be decoded: {file} {error}", "re-export it")
        self._check_announced(kind, frame, size)
        try:
            image: ndarray | None = cv2.imread(str(path), flags)
        except cv2.error:  # OpenCV has limits of its own.
            image = None
        if image is None:
            self._fail(kind, frame, f"cannot be decoded ({file})", "re-export it")
        return image

    def _open_video(self, frame: int) -> "_Video":
        """Open the video if it announces the size of the view's camera."""
        path = self.folder / "color.mp4"
        try:
            size = video_size(path)
            if size is not None:
                self._check_announced("color", frame, size)
            video = _Video(path)
            if all(video.size):
                check_pixels(video.size, path)
                self._check_announced("color", frame, video.size)
        except (ValueError, OSError) as error:
            self._fail("color.mp4", frame, f"cannot be decoded: it {error}", _SMALLER)
        return video

    def _check_announced(self, kind: str, frame: int, size: tuple[int, int]) -> None:
        """Refuse, before it is decoded, what has not the camera's size even if it is turned."""
        camera = self.camera
        if size not in {(camera.width, camera.height), (camera.height, camera.width)}:
            self._fail_size(kind, frame, size)

    def _check(self, frame: int) -> None:
        if not 0 <= frame < self.frame_count:
            raise IndexError(f"frame {frame} is outside 0 to {self.frame_count - 1}")

    def _check_size(self, kind: str, frame: int, image: ndarray) -> None:
        height, width = image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            self._fail_size(kind, frame, (width, height))

    def _fail_size(self, kind: str, frame: int, size: tuple[int, int]) -> NoReturn:
        self._fail(
            kind,
            frame,
            f"is {size[0]}x{size[1]} px, but the view's camera says "
            f"{self.camera.width}x{self.camera.height}",
            "re-export it or correct sequence.yaml",
        )

    def _fail(self, part: str, frame: int | None, reason: str, remedy: str) -> NoReturn:
        at = "" if frame is None else f" of frame {frame}"
        file = f"{self.place}/{part}"
        if frame is not None and (self.folder / part).is_dir():
            is_jpeg = (self.folder / part / f"{frame:05d}.jpg").is_file()
            file += f"/{frame:05d}{'.jpg' if is_jpeg else '.png'}"
        raise SequenceError(
            f"Sequence '{self._sequence}': view '{self.name}': {part}{at} {reason}; {remedy}.",
            file=file,
            frame=frame,
            remedy=remedy,
        )


class _StraightView(View):
    """A view whose images and points are moved to where a straight lens would have seen them."""

    def __init__(self, recorded: View) -> None:
        camera = recorded.camera
        straight = replace(camera, distortion=np.zeros(5))
        source = recorded._sequence  # noqa: SLF001  # of its own class
        super().__init__(recorded.folder, source, straight, recorded.frame_count)
        self._recorded = camera
        size = (camera.width, camera.height)
        self._maps = cv2.initUndistortRectifyMap(
            camera.K, camera.distortion, np.eye(3), camera.K, size, cv2.CV_32FC1
        )

    @cached_property
    def keypoint(self) -> Float[ndarray, "frame hand 21 3"] | None:
        """Pixel x, pixel y and confidence of each hand's keypoints; NaN where not seen."""
        keypoint = super().keypoint
        if keypoint is None:
            return None
        pixel = self._recorded.undistort(keypoint[..., :2].astype(np.float64))
        return np.concatenate([pixel.astype(keypoint.dtype), keypoint[..., 2:]], axis=-1)

    @cached_property
    def track(self) -> Float[ndarray, "frame track 2"] | None:
        """Pixel of each tracked point [px]."""
        track = super().track
        if track is None:
            return None
        return self._recorded.undistort(track.astype(np.float64)).astype(track.dtype)

    def color(self, frame: int) -> UInt8[ndarray, "row column 3"]:
        """Read the color image of a frame (RGB)."""
        return cv2.remap(super().color(frame), *self._maps, cv2.INTER_LINEAR)

    def depth(self, frame: int) -> Float[ndarray, "row column"]:
        """Read the depth image of a frame [m]; zero where nothing was measured."""
        return cv2.remap(super().depth(frame), *self._maps, cv2.INTER_NEAREST)

    def mask(self, frame: int) -> UInt8[ndarray, "row column"]:
        """Read the labels of a frame: 0 background, 1 object, 2 right hand, 3 left hand."""
        return cv2.remap(super().mask(frame), *self._maps, cv2.INTER_NEAREST)


class _Video:
    """Frames of a video by number; neighbours are decoded once."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._capture = cv2.VideoCapture(str(path))
        self._next = 0
        self._cache: OrderedDict[int, ndarray] = OrderedDict()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height that the decoder announces [px]; zero if it could not open the video."""
        wanted = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        width, height = (round(self._capture.get(side)) for side in wanted)
        return width, height

    def read(self, frame: int) -> ndarray | None:
        """Decode a frame (BGR); None if the video does not have it."""
        if frame in self._cache:
            self._cache.move_to_end(frame)
            return self._cache[frame]
        if frame < self._next:
            # Seeking by number is inexact for many encoders, so decode from the start.
            self._capture.release()
            self._capture = cv2.VideoCapture(str(self._path))
            self._next = 0
        while self._next < frame:
            if not self._capture.grab():
                return None
            self._next += 1
        is_read, image = self._capture.read()
        if not is_read:
            return None
        self._next = frame + 1
        self._cache[frame] = image
        if len(self._cache) > _CACHED_FRAMES:
            self._cache.popitem(last=False)
        return image

    def close(self) -> None:
        self._capture.release()


def _frame_count(path: Path) -> int:
    capture = cv2.VideoCapture(str(path))
    try:
        return round(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
    finally:
        capture.release()
