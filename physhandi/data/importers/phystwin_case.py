"""Puts the tables of a PhysTwin case together and checks that they belong to each other."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.importers.phystwin_fields import fail
from physhandi.data.importers.phystwin_images import CaseImages
from physhandi.data.importers.phystwin_tables import (
    CaseMetadata,
    CaseMotion,
    join_cameras,
    read_metadata,
    read_motion,
    read_poses,
    read_split,
    read_validation,
)
from physhandi.errors import ImportFailedError

_MAJORITY = 0.6
_IMAGES = ("color", "depth", "mask", "cotracker")


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """Everything of a case but its images, in the case's own world."""

    folder: Path
    """Where the case lies."""
    frame_count: int
    """Number of frames."""
    metadata: CaseMetadata | None
    """Content of ``metadata.json``."""
    pose: Float[ndarray, "camera 4 4"]
    """Maps camera coordinates to the case's world [m]; empty without ``calibrate.pkl``."""
    cameras: tuple[PinholeCamera, ...]
    """The same with intrinsics; empty without ``metadata.json``."""
    motion: CaseMotion | None
    """Content of ``final_data.pkl``."""
    validation: Float[ndarray, "frame validation 3"] | None
    """Content of ``gt_track_3d.pkl`` [m]."""
    reconstruction: int
    """Number of leading frames that are fitted."""

    @property
    def images(self) -> list[CaseImages]:
        """The images of each camera."""
        return [
            CaseImages(self.folder, number, self.frame_count, camera.width, camera.height)
            for number, camera in enumerate(self.cameras)
        ]


def read_case(folder: Path) -> Case:
    """Read and check all tables of a case.

    Raises:
        ImportFailedError: If a part is missing, malformed or contradicts another one.
    """
    if not folder.is_dir():
        raise ImportFailedError(
            f"{folder} is not a folder. Give the folder of one case, with final_data.pkl in it."
        )
    folder = folder.resolve()
    files = {n: folder / n for n in ("final_data.pkl", "metadata.json", "gt_track_3d.pkl")}
    motion = read_motion(files["final_data.pkl"]) if files["final_data.pkl"].is_file() else None
    metadata = read_metadata(files["metadata.json"]) if files["metadata.json"].is_file() else None
    if metadata is None and motion is None:
        raise ImportFailedError(
            f"{folder} is no PhysTwin case: it has neither final_data.pkl nor metadata.json. Give "
            "one folder of data/different_types/."
        )
    if metadata is None and any((folder / name).exists() for name in _IMAGES):
        fail(files["metadata.json"], "is missing; images cannot be placed without its intrinsics")
    needs_poses = metadata is not None or (folder / "calibrate.pkl").is_file()
    poses = read_poses(folder / "calibrate.pkl") if needs_poses else np.zeros((0, 4, 4))
    cameras = join_cameras(folder / "calibrate.pkl", poses, metadata) if metadata else ()
    _check_images(folder, len(cameras))
    count = _frame_count(folder, motion, metadata)
    has_validation = files["gt_track_3d.pkl"].is_file()
    return Case(
        folder=folder,
        frame_count=count,
        metadata=metadata,
        pose=poses,
        cameras=cameras,
        motion=motion,
        validation=read_validation(files["gt_track_3d.pkl"], count) if has_validation else None,
        reconstruction=read_split(folder / "split.json", count),
    )


def _frame_count(folder: Path, motion: CaseMotion | None, metadata: CaseMetadata | None) -> int:
    """Agree on the number of frames, or count the color images of a case that nobody numbered."""
    given = None if metadata is None else metadata.frame_count
    if motion is not None:
        count = len(motion.point)
        if given is not None and given != count:
            fail(
                folder / "final_data.pkl",
                f"object_points has {count} frames, but frame_num in metadata.json is {given}. "
                "Both must be of the same recording",
            )
        return count
    if given is not None:
        return given
    path = folder / "metadata.json"
    if metadata is not None and metadata.is_raw:
        fail(
            path,
            "has no 'frame_num': this is the recorder's own folder, whose cameras count steps "
            "each for itself (field 'recording'). Match the steps by their timestamps, number "
            "color/ and depth/ of every camera 0 to T-1 and write frame_num = T",
        )
    counts = {
        item.name: sum(1 for image in item.glob("*.png") if image.stem.isdecimal())
        for item in sorted((folder / "color").glob("*"))
        if item.is_dir()
    }
    if not counts or len(set(counts.values())) != 1 or 0 in counts.values():
        fail(path, f"has no 'frame_num', and color/ has {counts or 'no'} images. Write frame_num")
    return next(iter(counts.values()))


def points_down(case: Case) -> bool:
    """Tell whether the board's z axis points down, as the object and the cameras are above it.

    Raises:
        ImportFailedError: If neither object nor cameras tell, or they contradict each other.
    """
    height = case.pose[:, 2, 3]
    point = np.zeros((0, 3)) if case.motion is None else case.motion.point.reshape(-1, 3)
    below, above = int((point[:, 2] < 0).sum()), int((point[:, 2] > 0).sum())
    if max(below, above) > _MAJORITY * (below + above):
        is_down = below > above
        if len(height) and (height > 0 if is_down else height < 0).all():
            fail(
                case.folder / "calibrate.pkl",
                "puts every camera on the other side of the table than final_data.pkl puts the "
                "object. The two are of different recordings",
            )
        return is_down
    if len(height) == 0 or (height == 0).any() or np.ptp(np.sign(height)) != 0:
        fail(
            case.folder / "final_data.pkl",
            f"does not tell which side of the table is up: {below} object points have z < 0 and "
            f"{above} have z > 0, and the cameras do not agree either. Check the calibration",
        )
    return bool(height[0] < 0)


def _check_images(folder: Path, camera_count: int) -> None:
    """Refuse images of cameras that are not calibrated."""
    for name in _IMAGES[:3]:
        for path in sorted((folder / name).glob("*")):
            if path.is_dir() and path.name.isdecimal() and int(path.name) >= camera_count:
                fail(
                    path,
                    f"is of camera {path.name}, but calibrate.pkl and metadata.json have only "
                    f"{camera_count} cameras (from 0 on)",
                )
