"""Intrinsics and poses of cameras as other programs write them: JSON, YAML or plain numbers."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.arrays import read_array
from physhandi.data.files import parse_yaml
from physhandi.data.importers.phystwin_files import fail
from physhandi.data.length_unit import FARTHEST_POSITION

_LARGEST_TABLE = 16_000_000
_K = ("K", "k", "camera_matrix", "intrinsic_matrix", "cameraMatrix", "cam_K", "matrix")
_FX, _FY = ("fx", "f_x"), ("fy", "f_y")
_CX, _CY = ("cx", "ppx", "px", "c_x"), ("cy", "ppy", "py", "c_y")
_WIDTH = ("width", "image_width", "w", "cols")
_HEIGHT = ("height", "image_height", "h", "rows")
_SIZE = ("resolution", "image_size", "size", "WH", "wh")
_DISTORTION = (
    "distortion",
    "distortion_coefficients",
    "distortion_coeffs",
    "dist_coeffs",
    "distCoeffs",
    "dist",
    "coeffs",
    "D",
)
_MODEL = ("distortion_model", "camera_model", "model")
_SCALE = ("depth_scale", "depth_unit", "depth_units")
_RATE = ("fps", "frame_rate", "framerate", "rate")
_TO_WORLD = ("T_world_camera", "camera_to_world", "cam2world", "c2w", "pose", "T_wc")
_FROM_WORLD = (
    *("T_camera_world", "world_to_camera", "world2cam", "w2c", "T_cw"),
    *("extrinsics", "extrinsic"),
)
_DEPTH_TO_COLOR = ("depth_to_color", "T_color_depth", "extrinsics_depth_to_color")
_PARTS = ("rgb", "colour", "intrinsics", "intrinsic", "camera")
FISHEYE = frozenset({"fisheye", "equidistant", "kannala_brandt4", "kannala_brandt"})
"""Names of the lens model of OpenCV's fisheye module."""
INVERSE = frozenset({"inverse_brown_conrady"})
"""Names of the model whose polynomial leads from the picture to the ray, not back."""
_PLAIN = frozenset(
    {"", "none", "pinhole", "brown_conrady", "modified_brown_conrady", "plumb_bob", "radtan"}
    | {"rational_polynomial", "opencv", "perspective", "distortion.brown_conrady"}
)
_COEFFICIENT_COUNTS = (0, 4, 5, 8, 12, 14)


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordedCamera:
    """Properties of one camera as a recording stores them."""

    path: Path
    """File that says it."""
    K: Float[ndarray, "3 3"]
    """Intrinsic matrix [px]."""
    size: tuple[int, int] | None = None
    """Width and height of its images [px]; None if the file does not say."""
    distortion: Float[ndarray, " coefficient"] = field(default_factory=lambda: np.zeros(0))
    """Lens coefficients in OpenCV's order; none without distortion."""
    model: str = ""
    """Name of the lens model, lower case."""
    depth_scale: float | None = None
    """Metres per unit of depth images."""
    frame_rate: float | None = None
    """Frames per second [Hz]."""
    T_world_camera: Float[ndarray, "4 4"] | None = None
    """Maps camera coordinates to world coordinates [m]."""
    T_color_depth: Float[ndarray, "4 4"] | None = None
    """Maps coordinates of the depth camera to those of the color camera [m]."""
    depth: "RecordedCamera | None" = None
    """The depth camera, where the file describes it apart."""


def read_table(path: Path) -> Any:
    """Read a JSON or YAML file, also one that OpenCV wrote.

    Raises:
        ImportFailedError: If it is missing, too large or neither.
    """
    try:
        if path.stat().st_size > _LARGEST_TABLE:
            fail(path, f"is larger than {_LARGEST_TABLE} bytes")
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        fail(path, "is missing")
    except (OSError, ValueError) as error:
        fail(path, f"is no text: {error}")
    if text.startswith("%YAML:"):
        text = text.partition("\n")[2]
    # YAML has JSON in it but for tabs.
    text = text.replace("!!opencv-matrix", "").replace("\t", "  ")
    try:
        return parse_yaml(text)
    except ValueError as error:
        fail(path, f"is neither JSON nor YAML: {error}")


def read_camera(path: Path, table: Any, where: str = "") -> RecordedCamera:
    """Read a camera from the content of a file.

    Args:
        path: The file.
        table: What it says about this camera: named fields, or a bare matrix.
        where: Which part of the file this is, for messages.

    Raises:
        ImportFailedError: If a field is missing or makes no sense; names it.
    """
    at = f"{where}: " if where else ""
    if not isinstance(table, dict):
        return RecordedCamera(path=path, K=_matrix(path, f"{at}K", table))
    whole = cast("dict[str, Any]", table)
    fields = whole
    nested = [whole[name] for name in ("color", *_PARTS) if isinstance(whole.get(name), dict)]
    if nested and not _has_intrinsics(whole):
        fields = {**whole, **cast("dict[str, Any]", nested[0])}
    depth = whole.get("depth")
    if not _has_intrinsics(fields):
        names = ", ".join(map(str, list(whole)[:12])) or "none"
        fail(
            path,
            f"{at}has no intrinsics; expected fx, fy, cx, cy or a matrix K in pixels. Its fields "
            f"are {names}",
        )
    return RecordedCamera(
        path=path,
        K=_intrinsics(path, at, fields),
        size=_size(path, at, fields),
        distortion=_distortion(path, at, fields),
        model=_model(path, at, fields),
        depth_scale=_depth_scale(path, at, fields, depth),
        frame_rate=_optional(path, at, fields, _RATE, (1.0, 1000.0)),
        T_world_camera=_pose(path, at, whole),
        T_color_depth=_rigid_field(path, at, whole, _DEPTH_TO_COLOR),
        depth=read_camera(path, depth, f"{at}depth")
        if isinstance(depth, dict) and _has_intrinsics(cast("dict[str, Any]", depth))
        else None,
    )


def check_camera(camera: RecordedCamera, width: int, height: int, images: Path) -> None:
    """Refuse intrinsics that cannot belong to images of this size.

    Raises:
        ImportFailedError: With both sizes, or the field that makes no sense.
    """
    if camera.size is not None and camera.size != (width, height):
        fail(
            camera.path,
            f"is for images of {camera.size[0]}x{camera.size[1]} px, but those in {images} are "
            f"{width}x{height}. Give the intrinsics of this camera and mode, not of another one",
        )
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    if not (0.2 * width < fx < 10 * width and 0.5 < fx / fy < 2.0):
        fail(
            camera.path,
            f"says fx = {fx:g}, fy = {fy:g} for images {width} px wide, which no such lens has. "
            "Focal lengths are in pixels of these images",
        )
    if not (0.2 * width < cx < 0.8 * width and 0.2 * height < cy < 0.8 * height):
        fail(
            camera.path,
            f"says that the lens looks through pixel ({cx:g}, {cy:g}) of images of "
            f"{width}x{height} px. It must be near their middle; check the order fx, fy, cx, cy",
        )


def read_pose(path: Path, value: Any, name: str) -> Float[ndarray, "4 4"]:
    """Read a rigid transform: 4x4, 3x4, 16 or 12 numbers row by row, or rotation and translation.

    Raises:
        ImportFailedError: If it is something else, or so far away that it cannot be in metres.
    """
    if isinstance(value, dict):
        fields = cast("dict[str, Any]", value)
        if "data" in fields:
            return read_pose(path, fields["data"], name)
        rotation = next((fields[key] for key in ("rotation", "R") if key in fields), None)
        shift = next((fields[key] for key in ("translation", "t", "T") if key in fields), None)
        if rotation is None or shift is None:
            listed = ", ".join(map(str, list(fields)[:12])) or "none"
            fail(
                path,
                f"{name} needs rotation and translation, or 4x4 numbers. Its fields are {listed}",
            )
        matrix = np.eye(4)
        matrix[:3, :3] = _numbers(path, f"{name}.rotation", rotation, 9).reshape(3, 3)
        matrix[:3, 3] = _numbers(path, f"{name}.translation", shift, 3)
    else:
        flat = _numbers(path, name, value, 12, 16)
        matrix = np.eye(4)
        matrix[: len(flat) // 4] = flat.reshape(-1, 4)
    rotation = matrix[:3, :3]
    is_rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
    if not is_rigid or np.linalg.det(rotation) < 0 or not np.allclose(matrix[3], [0, 0, 0, 1]):
        fail(
            path,
            f"{name} is no rigid transform: its rotation must be orthonormal with determinant +1, "
            "its last row 0, 0, 0, 1",
        )
    if np.abs(matrix[:3, 3]).max() > FARTHEST_POSITION:
        fail(
            path,
            f"{name} moves by {np.linalg.norm(matrix[:3, 3]):.4g} m, which looks like millimetres. "
            "Give metres",
        )
    left, _, right = np.linalg.svd(rotation)
    matrix[:3, :3] = left @ right
    return matrix


def read_pose_file(path: Path) -> Float[ndarray, "4 4"]:
    """Read a file that holds one camera's pose, camera to world, and nothing else.

    Raises:
        ImportFailedError: If it does not.
    """
    if path.suffix == ".npy":
        try:
            return read_pose(path, read_array(path).tolist(), "the matrix")
        except (ValueError, OSError) as error:
            fail(path, f"is not a readable .npy file: {error}")
    if path.suffix == ".txt":
        return read_pose(path, read_numbers(path), "the matrix")
    table = read_table(path)
    pose = _pose(path, "", cast("dict[str, Any]", table)) if isinstance(table, dict) else None
    return read_pose(path, table, "the matrix") if pose is None else pose


def read_numbers(path: Path) -> list[float]:
    """Read a text file of numbers, as ``numpy.savetxt`` writes them.

    Raises:
        ImportFailedError: If it holds something else.
    """
    try:
        if path.stat().st_size > _LARGEST_TABLE:
            fail(path, f"is larger than {_LARGEST_TABLE} bytes")
        return [float(part) for part in path.read_text("utf-8").replace(",", " ").split()]
    except (OSError, ValueError) as error:
        fail(path, f"is no file of numbers: {error}")


def _has_intrinsics(fields: Mapping[str, Any]) -> bool:
    if any(name in fields for name in (*_K, *_FX, "focal_length")):
        return True
    bare = fields.get("intrinsics", fields.get("intrinsic"))
    return isinstance(bare, list)


def _first(fields: Mapping[str, Any], names: tuple[str, ...]) -> tuple[str, Any] | None:
    return next(((name, fields[name]) for name in names if fields.get(name) is not None), None)


def _intrinsics(path: Path, at: str, fields: Mapping[str, Any]) -> Float[ndarray, "3 3"]:
    entry = _first(fields, (*_K, "intrinsics", "intrinsic"))
    if entry is not None and not isinstance(entry[1], int | float):
        return _matrix(path, f"{at}{entry[0]}", entry[1])
    K = np.eye(3)
    focal, center = fields.get("focal_length"), fields.get("principal_point")
    if focal is not None:
        K[0, 0], K[1, 1] = _numbers(path, f"{at}focal_length", focal, 1, 2)[[0, -1]]
    else:
        K[0, 0] = _field(path, at, fields, _FX)
        K[1, 1] = _field(path, at, fields, _FY)
    if center is not None:
        K[:2, 2] = _numbers(path, f"{at}principal_point", center, 2)
    else:
        K[0, 2] = _field(path, at, fields, _CX)
        K[1, 2] = _field(path, at, fields, _CY)
    return K


def _matrix(path: Path, name: str, value: Any) -> Float[ndarray, "3 3"]:
    if isinstance(value, dict):
        inner = cast("dict[str, Any]", value)
        if "data" not in inner:
            return _intrinsics(path, f"{name}: ", inner)
        value = inner["data"]
    flat = _numbers(path, name, value, 4, 9)
    if len(flat) == 4:
        return np.array([[flat[0], 0, flat[2]], [0, flat[1], flat[3]], [0, 0, 1.0]])
    is_transposed = flat[2] == 0 and flat[6] != 0  # Open3D lists the matrix column by column.
    K = flat.reshape(3, 3).T if is_transposed else flat.reshape(3, 3)
    if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.allclose(K[2], [0, 0, 1]):
        fail(path, f"{name} is {K.tolist()}; expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]]")
    return K


def _numbers(path: Path, name: str, value: Any, *counts: int) -> ndarray:
    try:
        flat = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        fail(path, f"{name} holds {str(value)[:60]!r}; expected numbers")
    if len(flat) not in counts or not np.isfinite(flat).all():
        expected = " or ".join(map(str, counts))
        fail(path, f"{name} holds {len(flat)} numbers; expected {expected} finite ones")
    return flat


def _field(path: Path, at: str, fields: Mapping[str, Any], names: tuple[str, ...]) -> float:
    entry = _first(fields, names)
    if entry is None:
        fail(path, f"{at}field '{names[0]}' is missing; add it, in pixels")
    return float(_numbers(path, f"{at}{entry[0]}", entry[1], 1)[0])


def _optional(
    path: Path,
    at: str,
    fields: Mapping[str, Any],
    names: tuple[str, ...],
    limits: tuple[float, float],
) -> float | None:
    entry, (low, high) = _first(fields, names), limits
    if entry is None:
        return None
    value = float(_numbers(path, f"{at}{entry[0]}", entry[1], 1)[0])
    if not low <= value <= high:
        fail(path, f"{at}{entry[0]} is {value:g}; expected {low:g} to {high:g}")
    return value


def _size(path: Path, at: str, fields: Mapping[str, Any]) -> tuple[int, int] | None:
    both = _first(fields, _SIZE)
    if both is not None:
        width, height = _numbers(path, f"{at}{both[0]}", both[1], 2)
    else:
        pair = [_optional(path, at, fields, names, (1.0, 65_536.0)) for names in (_WIDTH, _HEIGHT)]
        if pair[0] is None or pair[1] is None:
            return None
        width, height = pair[0], pair[1]
    return round(width), round(height)


def _distortion(path: Path, at: str, fields: Mapping[str, Any]) -> Float[ndarray, " coefficient"]:
    entry = _first(fields, _DISTORTION)
    if entry is None:
        named = [fields.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")]
        value: Any = named if any(named) else []
    else:
        value = entry[1]
        if isinstance(value, dict):
            inner = cast("dict[str, Any]", value)
            value = inner.get("data", [inner.get(n, 0.0) for n in ("k1", "k2", "p1", "p2", "k3")])
    coefficient = _numbers(path, f"{at}distortion", value, *range(15))
    if not coefficient.any():
        return np.zeros(0)
    most = next(count for count in _COEFFICIENT_COUNTS if count >= len(coefficient))
    return np.concatenate([coefficient, np.zeros(most - len(coefficient))])


def _model(path: Path, at: str, fields: Mapping[str, Any]) -> str:
    entry = _first(fields, _MODEL)
    model = "" if entry is None else str(entry[1]).lower().replace(" ", "_").replace("-", "_")
    model = model.removeprefix("distortion.")
    if model not in _PLAIN | FISHEYE | INVERSE and len(_distortion(path, at, fields)):
        models = ", ".join(sorted(_PLAIN - {""} | FISHEYE | INVERSE))
        fail(path, f"{at}the lens model {model!r} is not known. Give one of {models}")
    return model


def _depth_scale(path: Path, at: str, fields: Mapping[str, Any], depth: Any) -> float | None:
    """Read metres per unit; values above 1 are units per metre, as Open3D and TUM give them."""
    entry = _first(fields, _SCALE)
    if entry is None and isinstance(depth, dict):
        entry = _first(cast("dict[str, Any]", depth), (*_SCALE, "scale"))
    if entry is None:
        return None
    value = float(_numbers(path, f"{at}{entry[0]}", entry[1], 1)[0])
    if not (value > 0 and math.isfinite(value)):
        fail(path, f"{at}{entry[0]} is {value:g}; expected metres per unit, such as 0.001")
    return value if value <= 1.0 else 1.0 / value


def _pose(path: Path, at: str, fields: Mapping[str, Any]) -> Float[ndarray, "4 4"] | None:
    T_world_camera = _rigid_field(path, at, fields, _TO_WORLD)
    if T_world_camera is not None:
        return T_world_camera
    T_camera_world = _rigid_field(path, at, fields, _FROM_WORLD)
    return None if T_camera_world is None else np.linalg.inv(T_camera_world)


def _rigid_field(
    path: Path, at: str, fields: Mapping[str, Any], names: tuple[str, ...]
) -> Float[ndarray, "4 4"] | None:
    entry = _first(fields, names)
    return None if entry is None else read_pose(path, entry[1], f"{at}{entry[0]}")
