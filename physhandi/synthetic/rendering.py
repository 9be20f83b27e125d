"""Perfect pictures of a hand and a sheet on a table: depth, labels and shaded color."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.synthetic.rasterizer import Raster, rasterize, vertex_normals

_LIGHT = np.array([0.30, -0.28, 0.91]) / np.linalg.norm([0.30, -0.28, 0.91])
_LIGHT_DISTANCE = 2.5
_SHADOW_BIAS = 0.007
_AMBIENT = 0.42
_SKIN = np.array([0.86, 0.66, 0.54])
_TOP = np.array([0.13, 0.45, 0.52])
_BACK = np.array([0.30, 0.62, 0.66])
_STRIPE = np.array([0.93, 0.90, 0.80])
_WOOD = np.array([0.70, 0.62, 0.53])


@dataclass(frozen=True)
class Scene:
    """Everything that is in front of the cameras in one frame."""

    vertex: Float[ndarray, "vertex 3"]
    """Vertices of the sheet, then of the hand [m]."""
    faces: Int[ndarray, "face 3"]
    """Triangles of the sheet, then of the hand."""
    sheet_face_count: int
    """How many of the triangles belong to the sheet."""
    pattern: Float[ndarray, "vertex 2"]
    """Where each vertex lies on the sheet's pattern [m]; unused for the hand."""

    def labels(self, raster: Raster) -> UInt8[ndarray, "row column"]:
        """Name what each pixel shows as masks do: 0 the table, 1 the sheet, 2 the hand."""
        hand = np.where(raster.face >= self.sheet_face_count, 2, 1)
        return np.where(raster.face < 0, 0, hand).astype(np.uint8)


@dataclass(frozen=True)
class Picture:
    """What a perfect camera sees."""

    depth: Float[ndarray, "row column"]
    """Depth of the nearest surface, the table included [m]; 0 above the horizon."""
    label: UInt8[ndarray, "row column"]
    """Mask values."""
    cosine: Float[ndarray, "row column"]
    """Cosine between the line of sight and the surface normal."""


def compose(
    sheet: Float[ndarray, "sheet_vertex 3"],
    sheet_faces: Int[ndarray, "sheet_face 3"],
    pattern: Float[ndarray, "sheet_vertex 2"],
    hand: Float[ndarray, "hand_vertex 3"],
    hand_faces: Int[ndarray, "hand_face 3"],
) -> Scene:
    """Put sheet and hand into one scene."""
    return Scene(
        np.concatenate([sheet, hand]),
        np.concatenate([sheet_faces, hand_faces + len(sheet)]),
        len(sheet_faces),
        np.concatenate([pattern, np.zeros((len(hand), 2))]),
    )


def photograph(camera: PinholeCamera, scene: Scene) -> Picture:
    """Render depth, labels and viewing angles of a scene."""
    raster = rasterize(camera, scene.vertex, scene.faces)
    point, sight = _points(camera, raster)
    normal = _normals(scene, raster)
    return Picture(
        depth=np.where(np.isfinite(point[..., 2]), camera.camera_depth(np.nan_to_num(point)), 0.0),
        label=scene.labels(raster),
        cosine=np.abs(np.einsum("rcd,rcd->rc", normal, sight)),
    )


def paint(camera: PinholeCamera, scene: Scene) -> UInt8[ndarray, "row column 3"]:
    """Render a shaded color image, every pixel averaged over four."""
    K = camera.K.copy()
    K[:2] *= 2.0
    K[:2, 2] += 0.5
    fine = PinholeCamera(
        K=K,
        T_world_camera=camera.T_world_camera,
        width=2 * camera.width,
        height=2 * camera.height,
    )
    raster = rasterize(fine, scene.vertex, scene.faces)
    point, sight = _points(fine, raster)
    normal = _normals(scene, raster)
    facing = np.einsum("rcd,rcd->rc", normal, sight)
    albedo = _albedo(scene, raster, point, facing)
    normal = normal * np.where(facing > 0, -1.0, 1.0)[..., None]
    diffuse = np.maximum(normal @ _LIGHT, 0.0) * _lit(scene, point)
    soft = 0.5 + 0.5 * normal[..., 2]
    bright = (_AMBIENT * (0.55 + 0.45 * soft) + (1 - _AMBIENT) * diffuse)[..., None]
    image = np.clip(albedo * 1.08 * bright, 0.0, 1.0) ** (1 / 1.25)
    image = image.reshape(camera.height, 2, camera.width, 2, 3).mean(axis=(1, 3))
    return np.round(255 * image).astype(np.uint8)


def _points(camera: PinholeCamera, raster: Raster) -> tuple[ndarray, ndarray]:
    """Find the surface point of every pixel, on the table where no triangle is, and its ray."""
    rows, columns = np.indices(raster.depth.shape)
    pixel = np.stack([columns, rows], axis=-1).astype(np.float64)
    far = camera.unproject(pixel, np.ones(raster.depth.shape))
    eye = camera.T_world_camera[:3, 3]
    ray = far - eye
    with np.errstate(divide="ignore"):
        table = np.where(ray[..., 2] < -1e-6, -eye[2] / ray[..., 2], np.nan)
    depth = np.where(raster.face >= 0, raster.depth, table)
    return eye + ray * depth[..., None], ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def _normals(scene: Scene, raster: Raster) -> Float[ndarray, "row column 3"]:
    normal = raster.interpolate(scene.faces, vertex_normals(scene.vertex, scene.faces))
    normal[raster.face < 0] = [0.0, 0.0, 1.0]
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)


def _albedo(scene: Scene, raster: Raster, point: ndarray, facing: ndarray) -> ndarray:
    """Color every pixel as if it were fully lit."""
    x, y = np.nan_to_num(point[..., 0]), np.nan_to_num(point[..., 1])
    grain = np.sin(90 * y + 6 * np.sin(9 * x + 2.0)) + 0.5 * np.sin(230 * y + 3 * np.sin(14 * x))
    seam = np.abs((y / 0.09) % 1.0 - 0.5) > 0.488
    color = _WOOD * (1.0 + 0.018 * grain - 0.16 * seam)[..., None]
    u, v = np.moveaxis(raster.interpolate(scene.faces, scene.pattern), -1, 0)
    is_back = facing > 0
    cloth = np.where(is_back[..., None], _BACK, _TOP)
    weave = np.sin(u * 900) * np.sin(v * 900)
    cloth = cloth * (1.0 + 0.10 * weave)[..., None]
    stripe = (np.abs(np.abs(u) - 0.066) < 0.007) | (np.abs(np.abs(u) - 0.083) < 0.003)
    cloth = np.where((stripe & ~is_back)[..., None], _STRIPE, cloth)
    is_sheet = (raster.face >= 0) & (raster.face < scene.sheet_face_count)
    color = np.where(is_sheet[..., None], cloth, color)
    return np.where((raster.face >= scene.sheet_face_count)[..., None], _SKIN, color)


def _lit(scene: Scene, point: Float[ndarray, "row column 3"]) -> Float[ndarray, "row column"]:
    """Tell how much of the light reaches each point past sheet and hand."""
    light = look_at(_LIGHT * _LIGHT_DISTANCE, np.zeros(3), focal_length=2200.0, size=(400, 400))
    reach = rasterize(light, scene.vertex, scene.faces).depth
    reach = np.where(reach > 0, reach, np.inf)
    where = np.nan_to_num(point)
    depth, pixel = light.camera_depth(where), light.project(where)
    amount = np.zeros(depth.shape)
    offsets = [(a, b) for a in (-1.2, 0.0, 1.2) for b in (-1.2, 0.0, 1.2)]
    for offset in offsets:
        place = np.clip(np.round(pixel + offset), 0, 399).astype(np.int64)
        amount += depth < reach[place[..., 1], place[..., 0]] + _SHADOW_BIAS
    return amount / len(offsets)


def look_at(
    eye: Float[ndarray, " 3"],
    target: Float[ndarray, " 3"],
    *,
    focal_length: float,
    size: tuple[int, int],
) -> PinholeCamera:
    """Build a camera that looks from one point at another with the world's up in the image.

    Args:
        eye: Where the camera stands [m].
        target: What appears in the middle of the image [m].
        focal_length: Focal length [px].
        size: Width and height of the image [px].
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    width, height = size
    K = np.array(
        [
            [focal_length, 0.0, (width - 1) / 2],
            [0.0, focal_length, (height - 1) / 2],
            [0.0, 0.0, 1.0],
        ]
    )
    return PinholeCamera(K=K, T_world_camera=pose, width=width, height=height)
