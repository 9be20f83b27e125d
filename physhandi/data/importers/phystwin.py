"""Imports a case of PhysTwin (``data/different_types/{case}``): three RGB-D views and their tracks.

The case's world is a ChArUco board on the table, whose z axis points down or up, depending on the
version of OpenCV. `points_down` decides it from the data; if down, the world is rotated by
diag(1, -1, -1).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.importers.phystwin_files import (
    PHYSTWIN_FRAME_RATE,
    CaseImages,
    CaseMetadata,
    CaseMotion,
    MaskSource,
    copy_color,
    copy_depth,
    copy_tracks,
    fail,
    join_cameras,
    read_cleaned_masks,
    read_metadata,
    read_motion,
    read_phystwin_split,
    read_poses,
    read_validation,
)
from physhandi.data.sequence_meta import SequenceMeta, ViewMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.errors import ImportFailedError, SequenceError
from physhandi.progress import NullProgress, Progress

_MAJORITY = 0.6
_IMAGES = ("color", "depth", "mask", "cotracker")
_STAGE = "import"
GRAVITY = 9.8
"""PhysTwin's gravitational acceleration [m/s²]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """Everything of a case but its images, in the case's own world."""

    folder: Path
    """Folder of the case."""
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


def import_phystwin(
    case: Path | str,
    out: Path | str,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
) -> Path:
    """Convert a PhysTwin case into a sequence.

    Without ``metadata.json`` the sequence has no views, without ``final_data.pkl`` no object nodes,
    markers and controls. Object nodes keep PhysTwin's order: tracked points, surface points,
    interior points. The tracked points become markers, one a node. A case does not say which hand a
    mask shows: 2 and 3 tell the first and the other hand masks of a camera apart, and the sequence
    names no hands.

    Args:
        case: Folder of the case.
        out: Folder of the new sequence; its last part names the sequence.
        progress: Receives a report after every frame of every camera; may cancel.
        overwrite: Whether to replace a sequence that is there.

    Returns:
        Folder of the sequence.

    Raises:
        ImportFailedError: If a part is missing, malformed or contradicts another one; names file,
            field and frame. Nothing is written then.
        SequenceError: If `out` exists already.
        CancelledError: If the user asked to stop.
    """
    watched = progress or NullProgress()
    tables = read_case(Path(case))
    is_down = points_down(tables)
    up = np.diag([1.0, -1.0, -1.0]) if is_down else np.eye(3)
    views = tuple(_view(number, camera, up) for number, camera in enumerate(tables.cameras))
    with SequenceWriter(out, overwrite=overwrite) as writer:
        _save_motion(tables, up, writer)
        _save_images(tables, views, writer, watched)
        meta = SequenceMeta(
            name=Path(out).resolve().name,
            description=f"PhysTwin case '{tables.folder.name}'.",
            frame_rate=tables.metadata.frame_rate if tables.metadata else PHYSTWIN_FRAME_RATE,
            frame_count=tables.frame_count,
            ground_height=0.0,
            gravity=GRAVITY,
            views=views,
            reconstruction=tables.reconstruction,
            surface_node_count=tables.motion.surface_node_count if tables.motion else None,
            provenance={
                "importer": "phystwin",
                "case": tables.folder.name,
                "z_axis_pointed": "down" if is_down else "up",
                "frame_rate_was_given": tables.metadata is not None,
                "split_was_given": (tables.folder / "split.json").is_file(),
                "serial_numbers": list(tables.metadata.serial_numbers) if tables.metadata else [],
            },
        )
        try:
            sequence = writer.finish(meta)
        except SequenceError as error:
            raise ImportFailedError(f"{tables.folder} makes no valid sequence: {error}") from error
    watched.report(_STAGE, 1, 1, None, "Checked every frame")
    return sequence.folder


def _view(number: int, camera: PinholeCamera, up: Float[ndarray, "3 3"]) -> ViewMeta:
    T_world_board = np.eye(4)
    T_world_board[:3, :3] = up
    turned = PinholeCamera(
        camera.K, T_world_board @ camera.T_world_camera, camera.width, camera.height
    )
    return ViewMeta(name=f"view{number}", camera=turned)


def _save_motion(case: Case, up: Float[ndarray, "3 3"], writer: SequenceWriter) -> None:
    if case.validation is not None:
        writer.save_array("validation_track.npy", (case.validation @ up).astype(np.float32))
    motion = case.motion
    if motion is None:
        return
    point_count = motion.point.shape[1]
    for file, array in (
        ("control.npy", (motion.control @ up).astype(np.float32)),
        ("marker.npy", (motion.point @ up).astype(np.float32)),
        ("marker_motion_valid.npy", motion.is_motion_valid),
        ("marker_node.npy", np.arange(point_count, dtype=np.int32)),
        ("object_node.npy", (motion.node @ up).astype(np.float32)),
    ):
        writer.save_array(file, array)


def _save_images(
    case: Case, views: tuple[ViewMeta, ...], writer: SequenceWriter, progress: Progress
) -> None:
    total = case.frame_count * len(views)
    lacks_masks = any(images.mask is None for images in case.images)
    cleaned = read_cleaned_masks(case.folder) if views and lacks_masks else None
    for number, (images, view) in enumerate(zip(case.images, views, strict=True)):
        uses_cleaned = images.mask is None and cleaned is not None
        masks = MaskSource(images, cleaned if uses_cleaned else None)
        for folder, suffix in ((images.color, ".png"), (images.depth, ".npy")):
            if folder is not None and folder.is_dir():
                images.check_frame_count(folder, suffix)
        copy_tracks(images, writer, view.name)
        for frame in range(case.frame_count):
            progress.check_cancelled()
            copy_color(images, frame, writer, view.name)
            copy_depth(images, frame, writer, view.name)
            if images.mask is not None or uses_cleaned:
                writer.save_image(f"views/{view.name}/mask/{frame:05d}.png", masks.label(frame))
            progress.report(_STAGE, number * case.frame_count + frame + 1, total, None, view.name)
        # A view is its folder, also if nothing of it was recorded.
        writer.make_folder(f"views/{view.name}")


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
        reconstruction=read_phystwin_split(folder / "split.json", count),
    )


def _frame_count(folder: Path, motion: CaseMotion | None, metadata: CaseMetadata | None) -> int:
    """Determine the number of frames from the tables, or else by counting color images."""
    frame_num = None if metadata is None else metadata.frame_count
    if motion is not None:
        count = len(motion.point)
        if frame_num is not None and frame_num != count:
            fail(
                folder / "final_data.pkl",
                f"object_points has {count} frames, but frame_num in metadata.json is {frame_num}. "
                "Both must be of the same recording",
            )
        return count
    if frame_num is not None:
        return frame_num
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
    """Whether the board's z axis points down, given that object and cameras are above it.

    Raises:
        ImportFailedError: If neither object nor cameras decide it, or they contradict each other.
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
