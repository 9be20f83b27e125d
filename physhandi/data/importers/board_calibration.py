"""Poses of cameras from pictures of a board on the table: ChArUco, or a grid of AprilTags."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from physhandi.errors import ImportFailedError, UsageError

_cv2: Any = cv2
_aruco: Any = _cv2.aruco
_FAMILIES = ("4X4", "5X5", "6X6", "7X7")
_COUNTS = (50, 100, 250, 1000)
_LEAST_CORNERS = 4
_SMALL = 640
"""Narrower pictures are enlarged before markers are looked for [px]."""
_MOST_ERROR = 2.0
_CORNER_ERROR = 0.15
"""Standard deviation of a corner [px]."""
_DEPTH_ERROR = 0.006
"""Standard deviation of depth of the table, with what is wrong in it for good [m]."""
_THICKNESS = 0.005
"""How much the board may stand out from the table, standard deviation [m]."""
_MARKER = 0.75
"""Side of a marker in squares; corners of squares do not depend on it."""


@dataclass(frozen=True)
class CharucoTarget:
    """A ChArUco board as it was printed."""

    columns: int
    """Squares along its width."""
    rows: int
    """Squares along its height."""
    square: float
    """Side of a square [m]."""

    @classmethod
    def parse(cls, text: str) -> "CharucoTarget":
        """Read ``WxH,SQUARE``, such as ``7x5,0.04``.

        Raises:
            UsageError: If it is something else.
        """
        match = re.fullmatch(r"(\d{1,3})x(\d{1,3}),(\d*\.?\d+)", text.replace(" ", ""))
        if match is None:
            raise UsageError(
                f"--charuco {text!r} is no board; write squares across and down and the side of a "
                "square in metres, like 7x5,0.04."
            )
        columns, rows, square = int(match[1]), int(match[2]), float(match[3])
        if not (3 <= columns <= 40 and 3 <= rows <= 40 and 0.004 <= square <= 0.3):
            raise UsageError(
                f"--charuco {text!r}: boards have 3 to 40 squares each way, of 0.004 to 0.3 m. The "
                "side of a square is in metres."
            )
        return cls(columns, rows, square)

    def board(self, family: str, *, is_legacy: bool = False) -> Any:
        """Make OpenCV's board with markers of a family, such as ``5X5``."""
        count = self.columns * self.rows // 2
        size = next((size for size in _COUNTS if size >= count), _COUNTS[-1])
        dictionary = _aruco.getPredefinedDictionary(getattr(_aruco, f"DICT_{family}_{size}"))
        board = _aruco.CharucoBoard(
            (self.columns, self.rows), self.square, _MARKER * self.square, dictionary
        )
        board.setLegacyPattern(is_legacy)
        return board


@dataclass(frozen=True)
class AprilGrid:
    """A grid of AprilTags of the family 36h11, numbered row by row from 0 on."""

    columns: int
    """Tags along its width."""
    rows: int
    """Tags along its height."""
    side: float
    """Side of a tag, its black border included [m]."""
    gap: float
    """Distance between tags [m]."""

    @classmethod
    def parse(cls, text: str) -> "AprilGrid":
        """Read ``WxH,SIDE,GAP``, such as ``6x6,0.03,0.009``.

        Raises:
            UsageError: If it is something else.
        """
        number = r"(\d*\.?\d+)"
        match = re.fullmatch(rf"(\d{{1,2}})x(\d{{1,2}}),{number},{number}", text.replace(" ", ""))
        if match is None:
            raise UsageError(
                f"--april-grid {text!r} is no grid; write tags across and down, the side of a tag "
                "and the gap between tags in metres, like 6x6,0.03,0.009."
            )
        grid = cls(int(match[1]), int(match[2]), float(match[3]), float(match[4]))
        is_plausible = 0.005 <= grid.side <= 0.3 and 0 < grid.gap <= grid.side
        if not (is_plausible and grid.columns * grid.rows >= 2):
            raise UsageError(
                f"--april-grid {text!r}: a grid has 2 tags or more, of 0.005 to 0.3 m, and gaps "
                "that are smaller. Lengths are in metres."
            )
        return grid

    def corners(self, tag: int, *, is_from_below: bool) -> Float[ndarray, "4 3"]:
        """Place a tag's corners, clockwise from the top left one as the board is read [m].

        Args:
            tag: Number of the tag.
            is_from_below: Whether tag 0 is at the bottom left, as Kalibr draws, or at the top left,
                as OpenCV does.
        """
        row, column = divmod(tag, self.columns)
        row = self.rows - 1 - row if is_from_below else row
        step = self.side + self.gap
        square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
        return self.side * square + [column * step, row * step, 0.0]


Board = CharucoTarget | AprilGrid
"""Calibration board that may lie on the table."""


def parse_board(charuco: str, april_grid: str) -> Board | None:
    """Read the board that was named as one of the two kinds; None if both texts are empty.

    Raises:
        UsageError: If both are given, or one does not describe a board.
    """
    if charuco and april_grid:
        raise UsageError("--charuco and --april-grid are two boards; give the one that was used.")
    if april_grid:
        return AprilGrid.parse(april_grid)
    return CharucoTarget.parse(charuco) if charuco else None


@dataclass(frozen=True, eq=False)
class BoardSighting:
    """Corners of the board that one picture shows."""

    corner: Float[ndarray, "corner 3"]
    """Places on the board [m]."""
    pixel: Float[ndarray, "corner 2"]
    """Where they are seen, in an image without distortion [px]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardCalibration:
    """Cameras around the board, which is the table; z is up."""

    T_world_camera: tuple[Float[ndarray, "4 4"], ...]
    """Maps each camera's coordinates to the world [m]."""
    error: tuple[float, ...]
    """Root mean square reprojection error of each camera [px]."""
    corner_count: tuple[int, ...]
    """Corners that each camera has seen in all pictures."""


def find_board(image: UInt8[ndarray, "row column 3"], target: Board) -> BoardSighting | None:
    """Find the board in a picture, whichever family its markers are of; None if it is not there."""
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    # Markers of a few pixels are not read, and corners between them not refined.
    factor = 2 if image.shape[1] < _SMALL else 1
    if isinstance(target, AprilGrid):
        return _tags_in(gray, factor, target) or _tags_in(gray, 2 * factor, target)
    best = _seen_in(gray, factor, target)
    if best is None or len(best.corner) < (target.columns - 1) * (target.rows - 1) / 2:
        finer = _seen_in(gray, 2 * factor, target)
        if finer is not None and (best is None or len(finer.corner) > len(best.corner)):
            best = finer
    return best


def _seen_in(gray: ndarray, factor: int, target: CharucoTarget) -> BoardSighting | None:
    """Look for markers of all families in a picture that is enlarged."""
    gray, detection = _enlarged(gray, factor), _detection()
    best: BoardSighting | None = None
    for family in _FAMILIES:
        dictionary = target.board(family, is_legacy=False).getDictionary()
        marker, name, _ = _aruco.ArucoDetector(dictionary, detection).detectMarkers(gray)
        if name is None or len(name) == 0:
            continue
        # Before version 4.6, OpenCV printed boards with even rows the other way around.
        for is_legacy in (False, True) if target.rows % 2 == 0 else (False,):
            board = target.board(family, is_legacy=is_legacy)
            detector = _aruco.CharucoDetector(board, _aruco.CharucoParameters(), detection)
            # Both have the same markers, which take longest to find.
            pixel, number, _, _ = detector.detectBoard(gray, markerCorners=marker, markerIds=name)
            if number is None or len(number) < _LEAST_CORNERS:
                continue
            corner = np.asarray(board.getChessboardCorners(), np.float64)[np.ravel(number)]
            width = np.linalg.svd(corner - corner.mean(axis=0), compute_uv=False)[1]
            is_row = width < 0.5 * target.square  # Corners on one line leave the pose open.
            if not is_row and (best is None or len(number) > len(best.corner)):
                place = (np.asarray(pixel, np.float64).reshape(-1, 2) + 0.5) / factor - 0.5
                best = BoardSighting(corner, place)
    return best


def _enlarged(gray: ndarray, factor: int) -> ndarray:
    if factor == 1:
        return gray
    return cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)


def _detection() -> Any:
    """More thresholds, and cells of more pixels, to read markers that are small or tilted."""
    detection = _aruco.DetectorParameters()
    detection.adaptiveThreshWinSizeMax, detection.adaptiveThreshWinSizeStep = 53, 6
    detection.perspectiveRemovePixelPerCell = 8
    detection.perspectiveRemoveIgnoredMarginPerCell = 0.2
    detection.polygonalApproxAccuracyRate = 0.05
    return detection


def _tags_in(gray: ndarray, factor: int, target: AprilGrid) -> BoardSighting | None:
    """Look for AprilTags; which way they are numbered and turned is found by what fits."""
    gray, detection = _enlarged(gray, factor), _detection()
    detection.cornerRefinementMethod = _aruco.CORNER_REFINE_SUBPIX
    dictionary = _aruco.getPredefinedDictionary(_aruco.DICT_APRILTAG_36H11)
    quads, numbers, _ = _aruco.ArucoDetector(dictionary, detection).detectMarkers(gray)
    count = target.columns * target.rows
    labels: list[int] = [] if numbers is None else np.asarray(numbers).ravel().tolist()
    seen = {
        number: np.asarray(quad, np.float64).reshape(4, 2)
        for quad, number in zip(quads, labels, strict=True)
        if number < count
    }
    if not seen:
        return None
    pixel = (np.concatenate(list(seen.values())) + 0.5) / factor - 0.5
    best: BoardSighting | None = None
    least = np.inf
    for is_from_below in (False, True):
        for turn in range(4):
            corner = np.concatenate(
                [np.roll(target.corners(n, is_from_below=is_from_below), turn, 0) for n in seen]
            )
            homography, _ = _cv2.findHomography(corner[:, :2], pixel)
            if homography is None:
                continue
            mapped = np.column_stack([corner[:, :2], np.ones(len(corner))]) @ homography.T
            error = float(np.abs(mapped[:, :2] / mapped[:, 2:] - pixel).mean())
            if error < least:
                best, least = BoardSighting(corner, pixel), error
    return best


def calibrate_by_board(
    names: Sequence[str],
    intrinsics: Sequence[Float[ndarray, "3 3"]],
    sizes: Sequence[tuple[int, int]],
    sightings: Sequence[Sequence[BoardSighting | None]],
    tables: Sequence[Float[ndarray, "point 3"]] = (),
) -> BoardCalibration:
    """Find the pose of every camera; all pictures are adjusted together.

    The world is the board of the first pictures: z = 0 is its plane, and z points to the cameras.
    With depth of the table, that is z = 0: the board may have some thickness.

    Args:
        names: Names of the views, for messages.
        intrinsics: Intrinsic matrix of each view [px].
        sizes: Width and height of each view's images [px].
        sightings: For each view what its pictures show; those of all views with the same number
            were taken while the board lay in the same place.
        tables: For each view what it measured on the table, in its camera's coordinates [m]. A
            board that is small in the picture tells less about tilt than the whole table.

    Raises:
        ImportFailedError: If a view is not tied to the others by the board, or its reprojection
            error is large.
    """
    count = max(len(row) for row in sightings)
    seen = {
        (view, place): sighting
        for view, row in enumerate(sightings)
        for place, sighting in enumerate(row)
        if sighting is not None
    }
    single = {key: _single_pose(intrinsics[key[0]], sighting) for key, sighting in seen.items()}
    cameras, boards = _chained(names, count, single)
    cameras, boards, height = _adjusted(intrinsics, seen, cameras, boards, tables)
    error: list[float] = []
    corner_count: list[int] = []
    for view, name in enumerate(names):
        residual = np.concatenate(
            [
                _residual(intrinsics[view], cameras[view] @ boards[place], sighting)
                for (other, place), sighting in seen.items()
                if other == view
            ]
        )
        rms = float(np.sqrt((residual**2).sum(axis=1).mean()))
        most = _MOST_ERROR * max(1.0, sizes[view][0] / 848)
        if rms > most:
            raise ImportFailedError(
                f"View '{name}': the board's corners are {rms:.1f} px (rms) from where the "
                f"calibration puts them; at most {most:.1f} px are accepted. Check this camera's "
                "intrinsics, that the board is flat and was not moved between the cameras' "
                "pictures, and its number of squares."
            )
        error.append(rms)
        corner_count.append(len(residual))
    to_table = np.eye(4)
    to_table[2, 3] = -height
    poses = [to_table @ np.linalg.inv(cameras[view]) for view in range(len(names))]
    return BoardCalibration(
        T_world_camera=_upright(names, poses),
        error=tuple(error),
        corner_count=tuple(corner_count),
    )


def _single_pose(K: ndarray, sighting: BoardSighting) -> Float[ndarray, "4 4"]:
    """Find where the board is before one camera; of the two mirrored poses, the better one."""
    _, turns, shifts, _ = _cv2.solvePnPGeneric(
        sighting.corner, sighting.pixel.reshape(-1, 1, 2), K, None, flags=cv2.SOLVEPNP_IPPE
    )
    poses: list[ndarray] = []
    for turn, shift in zip(turns, shifts, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = _cv2.Rodrigues(turn)[0]
        pose[:3, 3] = np.ravel(shift)
        poses.append(pose)
    return min(poses, key=lambda pose: float((_residual(K, pose, sighting) ** 2).sum()))


def _residual(K: ndarray, T_camera_board: ndarray, sighting: BoardSighting) -> ndarray:
    point = sighting.corner @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    depth = np.maximum(point[:, 2:], 1e-6)
    return (point[:, :2] / depth) @ K[:2, :2].T + K[:2, 2] - sighting.pixel


_Poses = dict[int, Float[ndarray, "4 4"]]


def _chained(
    names: Sequence[str], count: int, single: dict[tuple[int, int], ndarray]
) -> tuple[_Poses, _Poses]:
    """Carry poses from the first board over to all cameras and all other places of the board."""
    cameras: _Poses = {}
    boards: _Poses = {0: np.eye(4)}
    for _ in range(len(names) + count):
        for (view, place), T_camera_board in single.items():
            if place in boards and view not in cameras:
                cameras[view] = T_camera_board @ np.linalg.inv(boards[place])
            elif view in cameras and place not in boards:
                boards[place] = np.linalg.inv(cameras[view]) @ T_camera_board
    for view, name in enumerate(names):
        if view not in cameras:
            is_blind = not any(key[0] == view for key in single)
            reason = (
                "no calibration picture shows the board (4 corners, not all in a row, are needed)"
                if is_blind
                else "it never shows the board at a place that another camera shows too"
            )
            raise ImportFailedError(
                f"View '{name}' cannot be calibrated: {reason}. Take sharp pictures in which the "
                "board is large and whole, and check --charuco."
            )
    return cameras, boards


def _adjusted(
    intrinsics: Sequence[ndarray],
    seen: dict[tuple[int, int], BoardSighting],
    cameras: _Poses,
    boards: _Poses,
    tables: Sequence[ndarray],
) -> tuple[_Poses, _Poses, float]:
    """Minimise all reprojection errors, and distances of the table's points from one height.

    The first board stays where it is. Returns cameras, boards and the height of the table above
    the first board [m], in its own coordinates.
    """
    optimize: Any = import_module("scipy.optimize")
    views, places = sorted(cameras), sorted(set(boards) - {0})

    def unpacked(value: ndarray) -> tuple[_Poses, _Poses]:
        steps = value[:-1].reshape(-1, 6)
        moved = {view: _moved(cameras[view], steps[i]) for i, view in enumerate(views)}
        laid = {p: _moved(boards[p], steps[len(views) + i]) for i, p in enumerate(places)}
        return moved, {0: boards[0], **laid}

    def residuals(value: ndarray) -> ndarray:
        moved, laid = unpacked(value)
        parts = [
            _residual(intrinsics[view], moved[view] @ laid[place], sighting).ravel() / _CORNER_ERROR
            for (view, place), sighting in seen.items()
        ]
        for view, point in enumerate(tables):
            up = np.linalg.inv(moved[view])[2]
            parts.append((point @ up[:3] + up[3] - value[-1]) / _DEPTH_ERROR)
        return np.concatenate([*parts, value[-1:] / _THICKNESS])

    start = np.zeros(6 * (len(views) + len(places)) + 1)
    solution: Any = optimize.least_squares(residuals, start, loss="soft_l1", x_scale="jac")
    return *unpacked(solution.x), float(solution.x[-1])


def _moved(pose: ndarray, step: ndarray) -> ndarray:
    moved = pose.copy()
    moved[:3, :3] = _cv2.Rodrigues(step[:3])[0] @ pose[:3, :3]
    moved[:3, 3] = pose[:3, 3] + step[3:]
    return moved


def _upright(names: Sequence[str], T_board_camera: list[ndarray]) -> tuple[ndarray, ...]:
    """Turn the world so that the cameras are above the board."""
    height = np.array([pose[2, 3] for pose in T_board_camera])
    if (height > 0).any() and (height < 0).any():
        below = names[int(np.argmin(np.abs(height)))]
        raise ImportFailedError(
            f"The cameras are on both sides of the board; view '{below}' is nearest to its plane. "
            "All must look down on the table that it lies on."
        )
    T_world_board = np.diag([1.0, -1.0, -1.0, 1.0]) if (height < 0).all() else np.eye(4)
    return tuple(T_world_board @ pose for pose in T_board_camera)
