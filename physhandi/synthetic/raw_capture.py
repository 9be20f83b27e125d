"""A raw capture as a recorder would have written it, made of a sequence: to try the import on."""

import json
import shutil
import tempfile
from collections.abc import Sequence as Many
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.data.files import temporary_name
from physhandi.data.importers.board_calibration import CharucoTarget
from physhandi.data.importers.capture import BOARD_FILE
from physhandi.data.importers.recorded_view import CALIBRATION
from physhandi.data.sequence import Sequence
from physhandi.data.view import View
from physhandi.errors import UsageError
from physhandi.progress import NullProgress, Progress
from physhandi.synthetic.film.cameras import SIZE
from physhandi.synthetic.film.degradations import depth_sensor, find_preset
from physhandi.synthetic.film.recording import KEPT_AROUND
from physhandi.synthetic.synthesize import synthesize

EXAMPLE_BOARD = CharucoTarget(5, 4, 0.09)
"""Board of the example's calibration pictures; large, since its pictures are small."""
BOARD_FAMILY = "4X4"
"""Family of its markers."""
_STAGE = "export"
_PRINT = 2000
_PAPER, _TABLE = 235, 150
_FARTHEST_TABLE = 4.0
_FRAMES = 60
_TILT = np.deg2rad(25)

_README = """A raw capture of three RGB-D cameras: a hand lifts a cloth (made by SynthHDI, CC0).

  camera0/ to camera2/      color, depth [mm], intrinsics and times of each image
  calibration/CAMERA/*.png  a ChArUco board of 5 x 4 squares of 90 mm, in three places

Import it:
  physhandi import capture {folder} --out data/sequences/example --charuco 5x4,0.09

(--charuco may be left out here: calibration/board.json tells it, too.)

Give the cloth by a click (camera, frame, pixel x, pixel y):
  physhandi import capture {folder} --out data/sequences/example --charuco 5x4,0.09 \\
      --overwrite --click {click}

Look at it and fit it:
  physhandi check data/sequences/example
  physhandi reconstruct data/sequences/example
  physhandi serve
"""


def write_example_capture(folder: Path | str, progress: Progress | None = None) -> Path:
    """Make the example that docs/your-data.md begins with.

    Args:
        folder: Folder to write; it must not be there yet, or be empty.
        progress: Told after every frame; may ask to stop, which leaves nothing.

    Raises:
        UsageError: If the folder holds something, or MuJoCo is not installed.
        CancelledError: If the user asked to stop.
    """
    target, progress = Path(folder).resolve(), progress or NullProgress()
    _refuse_full(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="physhandi-example-") as place:
        sequence = synthesize(
            "cloth",
            "lift",
            out=Path(place) / "example",
            seed=0,  # The hand is found in all three views.
            cameras=3,
            frames=_FRAMES,
            image_size="half",
            # The board tells where cameras are, and all take their pictures at once.
            changes={"camera_shift": 0.0, "camera_turn": 0.0, "time_skew": 0.0},
            progress=progress,
        )
        write_raw_capture(sequence, target, progress=progress)
        click = _object_click(sequence)
    (target / "README.txt").write_text(_README.format(folder=target.name, click=click))
    return target


def write_raw_capture(
    sequence: Sequence,
    folder: Path | str,
    *,
    target: CharucoTarget = EXAMPLE_BOARD,
    progress: Progress | None = None,
) -> Path:
    """Write color, depth, intrinsics, times and calibration pictures of a made-up sequence.

    Nothing else of it is written: no masks, no keypoints, no poses. Depth of made-up sequences ends
    beside body and hands; the table, z = 0, is measured here, or depth would tell the masks.

    Args:
        sequence: A sequence of `synthesize` with images.
        folder: Folder to write; it must not be there yet, or be empty.
        target: Board that is photographed in three places, at first flat on the table.
        progress: Told after every image; may ask to stop, which leaves nothing.

    Raises:
        UsageError: If the folder holds something.
        CancelledError: If the user asked to stop.
    """
    goal, progress = Path(folder).resolve(), progress or NullProgress()
    _refuse_full(goal)
    begun = goal.with_name(temporary_name(goal.name))
    places = _board_places(sequence, target)
    try:
        total, done = len(sequence.views) * sequence.frame_count, 0
        for number, view in enumerate(sequence.views):
            camera = view.camera
            for kind in ("color", "depth"):
                (begun / view.name / kind).mkdir(parents=True)
            (begun / view.name / "intrinsics.json").write_text(json.dumps(_intrinsics(camera)))
            times = [
                f"{100 + frame / sequence.frame_rate:.6f}" for frame in range(view.frame_count)
            ]
            (begun / view.name / "timestamps.txt").write_text("\n".join(times) + "\n")
            for frame in range(view.frame_count):
                progress.check_cancelled()
                _write(begun / view.name / f"color/{frame:05d}.png", view.color(frame)[..., ::-1])
                depth = _whole_depth(view, frame, np.random.default_rng([number, frame]))
                _write(begun / view.name / f"depth/{frame:05d}.png", depth)
                done += 1
                progress.report(_STAGE, done, total, None, view.name)
            view.close()
            pictures = begun / CALIBRATION / view.name
            pictures.mkdir(parents=True)
            for place, T_world_board in enumerate(places):
                random = np.random.default_rng([number, place, 1])
                picture = photograph_board(camera, target, T_world_board)
                noisy = picture + random.normal(0.0, 2.0, picture.shape)
                _write(pictures / f"{place}.png", np.clip(noisy, 0, 255).astype(np.uint8))
        board = {"charuco": f"{target.columns}x{target.rows},{target.square:g}"}
        (begun / CALIBRATION / BOARD_FILE).write_text(json.dumps(board))
        if goal.is_dir():
            goal.rmdir()
        begun.replace(goal)
    finally:
        shutil.rmtree(begun, ignore_errors=True)
    return goal


def photograph_board(
    camera: PinholeCamera,
    target: CharucoTarget,
    T_world_board: Float[ndarray, "4 4"],
    family: str = BOARD_FAMILY,
) -> UInt8[ndarray, "row column 3"]:
    """Draw what a camera without distortion sees of a printed board on an empty table.

    Args:
        camera: The camera.
        target: The board.
        T_world_board: Maps OpenCV's coordinates of the board (x along its width, y down, z into it)
            to the world [m].
        family: Family of its markers.
    """
    width, height = target.columns * target.square, target.rows * target.square
    size = (round(width * _PRINT), round(height * _PRINT))
    sheet = target.board(family).generateImage(size, marginSize=0)
    margin = round(target.square * _PRINT / 2)
    sheet = np.pad(sheet, margin, constant_values=255)
    # Pixel (0, 0) of the print has its centre half a pixel from the corner of the board.
    to_board = np.diag([1 / _PRINT, 1 / _PRINT, 1.0])
    to_board[:2, 2] = (0.5 - margin) / _PRINT
    T_camera_board = camera.T_camera_world @ T_world_board
    homography = camera.K @ T_camera_board[:3][:, [0, 1, 3]] @ to_board
    # Drawn four times as fine and thinned, so that edges are not jagged.
    finer = np.array([[4.0, 0, 1.5], [0, 4.0, 1.5], [0, 0, 1]])
    fine = cv2.warpPerspective(
        np.minimum(sheet, _PAPER),
        finer @ homography,
        (4 * camera.width, 4 * camera.height),
        dst=np.full((4 * camera.height, 4 * camera.width), _TABLE, np.uint8),
        borderMode=cv2.BORDER_TRANSPARENT,
    )
    picture = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.repeat(picture[..., None], 3, axis=2)


def _refuse_full(folder: Path) -> None:
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise UsageError(f"{folder} holds something already. Choose another folder.")


def _write(path: Path, image: ndarray) -> None:
    path.write_bytes(cv2.imencode(path.suffix, np.ascontiguousarray(image))[1].tobytes())


def _intrinsics(camera: PinholeCamera) -> dict[str, float]:
    return {
        "fx": float(camera.K[0, 0]),
        "fy": float(camera.K[1, 1]),
        "cx": float(camera.K[0, 2]),
        "cy": float(camera.K[1, 2]),
        "width": camera.width,
        "height": camera.height,
        "depth_scale": 0.001,
    }


def _whole_depth(
    view: View, frame: int, random: np.random.Generator
) -> UInt16[ndarray, "row column"]:
    """Measure the table too, around what the sequence keeps of depth [mm]."""
    camera = view.camera
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixel = np.stack([x, y], axis=-1).astype(np.float64)
    eye = camera.T_world_camera[:3, 3]
    way = camera.unproject(pixel, np.ones(pixel.shape[:2])) - eye
    down = -way[..., 2]
    depth = np.where(down > 0, eye[2] / np.maximum(down, 1e-6), np.inf)
    table = np.where(depth < _FARTHEST_TABLE, depth, 0.0).astype(np.float32)
    cosine = (down / np.linalg.norm(way, axis=-1)).astype(np.float32)
    sensor = depth_sensor(find_preset("default"))
    measured = sensor.measure(table, cosine, random, scale=camera.width / SIZE[0])
    around = np.ones((2 * KEPT_AROUND + 1,) * 2, dtype=np.uint8)
    is_kept = cv2.dilate((view.mask(frame) > 0).astype(np.uint8), around) > 0
    own = np.round(1000 * view.depth(frame)).astype(np.uint16)
    return np.where(is_kept, own, measured)


def _board_places(sequence: Sequence, target: CharucoTarget) -> Many[Float[ndarray, "4 4"]]:
    """Lay the board where the cameras look: flat, flat and turned, tilted."""
    middle = np.zeros(3)
    for view in sequence.views:
        pose = view.camera.T_world_camera
        middle += pose[:3, 3] - pose[:3, 2] * pose[2, 3] / pose[2, 2]
    middle /= len(sequence.views)
    to_middle = np.eye(4)
    to_middle[:2, 3] = -0.5 * target.square * np.array([target.columns, target.rows])
    face_up = np.diag([1.0, -1.0, -1.0, 1.0])
    places: list[ndarray] = []
    for heading, tilt, lift in ((0.3, 0.0, 0.0), (1.7, 0.0, 0.0), (0.9, _TILT, 0.06)):
        turn = np.eye(4)
        about_z, about_x = (cv2.Rodrigues(np.array(v))[0] for v in ([0, 0, heading], [tilt, 0, 0]))
        turn[:3, :3] = about_z @ about_x
        turn[:3, 3] = [middle[0], middle[1], lift]
        places.append(turn @ face_up @ to_middle)
    return places


def _object_click(sequence: Sequence) -> str:
    """Where to click on the object in frame 0 of the first view."""
    mask = sequence.views[0].mask(0) == 1
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    row, column = np.unravel_index(int(inside.argmax()), inside.shape)
    return f"{sequence.views[0].name},0,{column},{row}"
