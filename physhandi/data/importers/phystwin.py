"""Imports a case of PhysTwin (``data/different_types/{case}``): three RGB-D views and their tracks.

The case's world is a ChArUco board on the table, whose z axis usually points down into it, and
upwards with other OpenCV versions. Which it is, is read off the data; if down, the world is turned
about its x axis by diag(1, -1, -1), a rotation, so that handedness and distances stay.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.importers.phystwin_case import Case, points_down, read_case
from physhandi.data.importers.phystwin_images import copy_color, copy_depth, copy_tracks
from physhandi.data.importers.phystwin_masks import MaskSource, read_cleaned_masks
from physhandi.data.importers.phystwin_tables import FRAME_RATE
from physhandi.data.sequence_schema import SequenceMeta, ViewMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.errors import ImportFailedError, SequenceError
from physhandi.progress import NullProgress, Progress

STAGE = "import"
GRAVITY = 9.8
"""PhysTwin's gravitational acceleration [m/s²]."""


def import_phystwin(
    case: Path | str,
    out: Path | str,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
) -> Path:
    """Convert a PhysTwin case into a sequence.

    What the case lacks, the sequence lacks: without ``metadata.json`` there are no views, without
    ``final_data.pkl`` there are no object nodes, markers and controls. Object nodes keep PhysTwin's
    order: tracked points, surface points, interior points. The tracked points become markers, one a
    node. Which hand a mask shows is not known: 2 and 3 tell the first and the other hand masks of a
    camera apart, and the sequence names no hands.

    Args:
        case: Folder of the case.
        out: Where the sequence shall appear; its last part names the sequence.
        progress: Told after every frame of every camera; may ask to stop.
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
    found = read_case(Path(case))
    is_down = points_down(found)
    up = np.diag([1.0, -1.0, -1.0]) if is_down else np.eye(3)
    views = tuple(_view(number, camera, up) for number, camera in enumerate(found.cameras))
    with SequenceWriter(out, overwrite=overwrite) as writer:
        _save_motion(found, up, writer)
        _save_images(found, views, writer, watched)
        meta = SequenceMeta(
            name=Path(out).resolve().name,
            description=f"PhysTwin case '{found.folder.name}'.",
            frame_rate=found.metadata.frame_rate if found.metadata else FRAME_RATE,
            frame_count=found.frame_count,
            ground_height=0.0,
            gravity=GRAVITY,
            views=views,
            reconstruction=found.reconstruction,
            surface_node_count=found.motion.surface_node_count if found.motion else None,
            provenance={
                "importer": "phystwin",
                "case": found.folder.name,
                "z_axis_pointed": "down" if is_down else "up",
                "frame_rate_was_given": found.metadata is not None,
                "split_was_given": (found.folder / "split.json").is_file(),
                "serial_numbers": list(found.metadata.serial_numbers) if found.metadata else [],
            },
        )
        try:
            sequence = writer.finish(meta)
        except SequenceError as error:
            raise ImportFailedError(f"{found.folder} makes no valid sequence: {error}") from error
    watched.report(STAGE, 1, 1, None, "Checked every frame")
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
            progress.report(STAGE, number * case.frame_count + frame + 1, total, None, view.name)
        # A view is its folder, also if nothing of it was recorded.
        writer.make_folder(f"views/{view.name}")
