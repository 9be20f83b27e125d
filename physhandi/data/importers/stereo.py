"""Imports hands filmed by two calibrated cameras, in the layout of TemugeB/handpose3d.

The folder holds a video per camera (``cam0*.mp4``, ``cam1*.mp4``), intrinsics and lens distortion
(``c0.dat``, ``c1.dat``) and the pose of the checkerboard in each camera (``rot_trans_c0.dat``,
``rot_trans_c1.dat``). One length unit is one square of the board.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.importers.phystwin_files import probe_video
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta, Side
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.errors import ImportFailedError, UsageError
from physhandi.progress import NullProgress, Progress

_STAGE = "import"
_CAMERAS = (0, 1)
_FRAME_RATE_RANGE = (1.0, 1000.0)


@dataclass(frozen=True)
class _Video:
    path: Path
    frame_count: int
    frame_rate: float
    width: int
    height: int


def import_stereo(
    source_folder: Path | str,
    out_folder: Path | str,
    progress: Progress | None = None,
    *,
    hands: tuple[Side, ...] = ("right",),
    origin: str = "",
    licence: str = "",
    overwrite: bool = False,
) -> Sequence:
    """Convert a two-camera recording of a hand into a sequence.

    The board's frame becomes the world; if the cameras are below it, it is turned upside down
    about its x axis, so that the world is z-up. The last block of ``rot_trans_c1.dat`` (camera 0
    to camera 1) repeats what the others say and is not used.

    Args:
        source_folder: The recording.
        out_folder: Folder of the new sequence; its last part names the sequence.
        progress: Receives a report after every step.
        hands: Hands that the recording shows.
        origin: Who recorded it, and where it was published; kept with the sequence if given.
        licence: Under which licence; kept with the sequence if given.
        overwrite: Whether to replace a sequence that is there.

    Returns:
        The sequence.

    Raises:
        ImportFailedError: If a file is missing or malformed; names file and line.
        UsageError: If no hand is named, or one twice.
    """
    if not hands or len(set(hands)) != len(hands):
        raise UsageError(f"Name each hand that the recording shows once, not {list(hands)}.")
    source, progress = Path(source_folder), progress or NullProgress()
    if not source.is_dir():
        raise ImportFailedError(f"{source} is not a folder. Give the folder with cam0*.mp4.")
    videos = [_find_video(source, camera) for camera in _CAMERAS]
    _check_agreement(videos)
    intrinsics = [_read_intrinsics(source / f"c{camera}.dat") for camera in _CAMERAS]
    poses = [_read_pose(source / f"rot_trans_c{camera}.dat") for camera in _CAMERAS]
    T_world_board = _upright(poses)
    views = tuple(
        ViewMeta(
            name=f"view{camera}",
            camera=PinholeCamera(
                K=intrinsics[camera][0],
                T_world_camera=T_world_board @ np.linalg.inv(poses[camera]),
                width=videos[camera].width,
                height=videos[camera].height,
                distortion=intrinsics[camera][1],
            ),
        )
        for camera in _CAMERAS
    )
    meta = SequenceMeta(
        name=Path(out_folder).resolve().name,
        description=f"{' and '.join(hands).capitalize()} hand before two calibrated cameras.",
        frame_rate=videos[0].frame_rate,
        frame_count=videos[0].frame_count,
        metric=False,
        length_unit="board square",
        hands=hands,
        views=views,
        provenance={"importer": "stereo", "folder": source.resolve().name}
        | ({"origin": origin} if origin else {})
        | ({"licence": licence} if licence else {}),
    )
    with SequenceWriter(out_folder, overwrite=overwrite) as writer:
        for step, (view, video) in enumerate(zip(views, videos, strict=True)):
            progress.check_cancelled()
            writer.copy(f"views/{view.name}/color.mp4", video.path)
            progress.report(_STAGE, step + 1, len(views) + 1, None, video.path.name)
        sequence = writer.finish(meta)
    progress.report(_STAGE, len(views) + 1, len(views) + 1, None, "Checked every frame")
    return sequence


def _find_video(source: Path, camera: int) -> _Video:
    paths = sorted(source.glob(f"cam{camera}*.mp4"))
    if len(paths) != 1:
        names = ", ".join(path.name for path in paths) or "none"
        raise ImportFailedError(
            f"{source}: expected one video cam{camera}*.mp4, found {names}. "
            "Keep one video for each camera."
        )
    count, width, height, rate = probe_video(paths[0])
    video = _Video(path=paths[0], frame_count=count, frame_rate=rate, width=width, height=height)
    low, high = _FRAME_RATE_RANGE
    if video.frame_count < 1 or not low <= video.frame_rate <= high:
        raise ImportFailedError(
            f"{paths[0]} cannot be decoded as a video ({video.frame_count} frames at "
            f"{video.frame_rate:g} Hz). Re-export it as H.264 in MP4."
        )
    return video


def _check_agreement(videos: list[_Video]) -> None:
    first, second = videos
    if first.frame_count != second.frame_count or first.frame_rate != second.frame_rate:
        raise ImportFailedError(
            f"{second.path} has {second.frame_count} frames at {second.frame_rate:g} Hz, but "
            f"{first.path.name} has {first.frame_count} at {first.frame_rate:g} Hz. "
            "Both cameras must be synchronised; cut them to the same frames."
        )


def _read_intrinsics(path: Path) -> tuple[Float[ndarray, "3 3"], Float[ndarray, " 5"]]:
    lines = _Lines(path)
    lines.expect("intrinsic:")
    K = np.stack([lines.numbers(3) for _ in range(3)])
    lines.expect("distortion:")
    if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.array_equal(K[2], [0, 0, 1]):
        raise ImportFailedError(
            f"{path}, lines 2-4: the intrinsic matrix must be [[fx, s, cx], [0, fy, cy], "
            f"[0, 0, 1]] with positive focal lengths, not {K.tolist()}."
        )
    return K, lines.numbers(5)


def _read_pose(path: Path) -> Float[ndarray, "4 4"]:
    """Read the transform from the board's to the camera's frame."""
    lines = _Lines(path)
    lines.expect("R:")
    rotation = np.stack([lines.numbers(3) for _ in range(3)])
    lines.expect("T:")
    pose = np.eye(4)
    pose[:3, 3] = [lines.numbers(1)[0] for _ in range(3)]
    left, _, right = np.linalg.svd(rotation)
    pose[:3, :3] = left @ right
    if np.abs(pose[:3, :3] - rotation).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise ImportFailedError(
            f"{path}, lines 2-4: R is not a rotation (rows must be orthonormal, determinant +1)."
        )
    return pose


def _upright(poses: list[Float[ndarray, "4 4"]]) -> Float[ndarray, "4 4"]:
    """Choose the world so that the cameras, which watch the board from above, have positive z."""
    height = np.mean([np.linalg.inv(pose)[2, 3] for pose in poses])
    return np.diag([1.0, -1.0, -1.0, 1.0]) if height < 0 else np.eye(4)


class _Lines:
    """The lines of a calibration file, read one after the other."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._next = 0
        try:
            self._lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            reason = (
                "is missing" if isinstance(error, FileNotFoundError) else f"is unreadable: {error}"
            )
            raise ImportFailedError(
                f"{path} {reason}. The recording needs c0.dat, c1.dat, rot_trans_c0.dat and "
                "rot_trans_c1.dat."
            ) from error

    def expect(self, heading: str) -> None:
        """Read a line that must be a heading."""
        line = self._take(f"the heading {heading!r}")
        if line.strip() != heading:
            self._fail(f"is {line!r}; expected the heading {heading!r}")

    def numbers(self, count: int) -> Float[ndarray, " number"]:
        """Read a line of so many finite numbers."""
        line = self._take(f"{count} numbers")
        try:
            values = np.array([float(word) for word in line.split()])
        except ValueError:
            self._fail(f"is {line!r}; expected {count} numbers")
        if len(values) != count or not np.isfinite(values).all():
            self._fail(f"is {line!r}; expected {count} finite numbers")
        return values

    def _take(self, expected: str) -> str:
        self._next += 1
        if self._next > len(self._lines):
            self._fail(f"is missing; expected {expected}")
        return self._lines[self._next - 1]

    def _fail(self, reason: str) -> NoReturn:
        raise ImportFailedError(f"{self._path}, line {self._next} {reason}.")
