"""Perfect pictures of hands and a soft body on a table: depth, labels and shaded color."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from physhandi.data.camera import PinholeCamera
from physhandi.rendering.renderer import Raster, rasterize
from physhandi.rendering.shapes import Surface
from physhandi.triangles import vertex_normals

_LIGHT = np.array([0.30, -0.28, 0.91]) / np.linalg.norm([0.30, -0.28, 0.91])
_LIGHT_DISTANCE = 2.5
_SHADOW_BIAS = 0.007
_SOFTENING = (-1.2, 0.0, 1.2)
"""Where the edge of a shadow is sampled, in rows and in columns [px of the light]."""
_AMBIENT = 0.42
_SKIN = np.array([0.86, 0.66, 0.54])
_WOOD = np.array([0.70, 0.62, 0.53])
_BODY = 1

Color = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Dye:
    """Colors of a body: red, green and blue from 0 to 1."""

    top: Color = (0.13, 0.45, 0.52)
    """The outside, or the side that lies up in frame 0."""
    back: Color = (0.30, 0.62, 0.66)
    """The other side of a sheet."""
    stripe: Color = (0.93, 0.90, 0.80)
    """Stripes on the outside."""


def light_camera(size: int = 400, focal_length: float = 2200.0) -> PinholeCamera:
    """Look at the world's origin from where the light is; shadows are cast within this picture.

    Args:
        size: Width and height [px].
        focal_length: Focal length [px].
    """
    return look_at(
        _LIGHT * _LIGHT_DISTANCE, np.zeros(3), focal_length=focal_length, size=(size, size)
    )


@dataclass(frozen=True)
class Scene:
    """Everything that is in front of the cameras in one frame."""

    vertex: Float[ndarray, "vertex 3"]
    """Vertices of the body, then of the hands [m]."""
    faces: Int[ndarray, "face 3"]
    """Triangles of the body, then of the hands."""
    face_label: UInt8[ndarray, " face"]
    """Mask label of each triangle: 1 the body, 2 and 3 the hands."""
    pattern: Float[ndarray, "vertex 2"]
    """Where each vertex lies on the body's pattern [m]; unused for hands."""
    dye: Dye = field(default_factory=Dye)
    """Colors of the body."""
    light: PinholeCamera = field(default_factory=light_camera)
    """Camera of the light; see `light_camera`."""
    device: str = "cpu"
    """Warp device that draws it."""

    @property
    def surface(self) -> Surface:
        """Everything, to be drawn."""
        return Surface(vertex=self.vertex, faces=self.faces)

    def labels(self, raster: Raster) -> UInt8[ndarray, "row column"]:
        """Name what each pixel shows as masks do: 0 the table, 1 the body, 2 and 3 the hands."""
        if not len(self.faces):
            return np.zeros(raster.element.shape, dtype=np.uint8)
        label = self.face_label[np.maximum(raster.element, 0)]
        return np.where(raster.element < 0, 0, label).astype(np.uint8)


@dataclass(frozen=True)
class Picture:
    """Image of a perfect camera."""

    depth: Float[ndarray, "row column"]
    """Depth of the nearest surface, the table included [m]; 0 above the horizon."""
    label: UInt8[ndarray, "row column"]
    """Mask values."""
    cosine: Float[ndarray, "row column"]
    """Cosine between the line of sight and the surface normal."""


def compose(
    body: Float[ndarray, "body_vertex 3"],
    faces: Int[ndarray, "body_face 3"],
    pattern: Float[ndarray, "body_vertex 2"],
    hands: Sequence[tuple[int, Float[ndarray, "_ 3"], Int[ndarray, "_ 3"]]],
    *,
    dye: Dye | None = None,
    light: PinholeCamera | None = None,
    device: str = "cpu",
) -> Scene:
    """Put a body and hands into one scene.

    Args:
        body: Vertices of the body [m].
        faces: Its triangles.
        pattern: Where its vertices lie on its pattern [m].
        hands: Mask value, vertices [m] and triangles of each hand.
        dye: Colors of the body.
        light: What the light sees.
        device: Warp device that draws it.
    """
    vertex, triangles = [body], [faces]
    label = [np.full(len(faces), _BODY, dtype=np.uint8)]
    for value, hand, hand_faces in hands:
        triangles.append(hand_faces + sum(len(part) for part in vertex))
        vertex.append(hand)
        label.append(np.full(len(hand_faces), value, dtype=np.uint8))
    unused = np.zeros((sum(len(part) for part in vertex[1:]), 2))
    return Scene(
        np.concatenate(vertex),
        np.concatenate(triangles),
        np.concatenate(label),
        np.concatenate([pattern, unused]),
        dye or Dye(),
        light or light_camera(),
        device,
    )


def photograph(camera: PinholeCamera, scene: Scene) -> Picture:
    """Render depth, labels and viewing angles of a scene."""
    raster = rasterize(camera, [scene.surface], device=scene.device)
    point, sight = _points(camera, raster)
    normal = _normals(scene, raster)
    return Picture(
        depth=np.where(np.isfinite(point[..., 2]), camera.camera_depth(np.nan_to_num(point)), 0.0),
        label=scene.labels(raster),
        cosine=np.abs(np.einsum("rcd,rcd->rc", normal, sight)),
    )


def paint(
    camera: PinholeCamera, scene: Scene, *, samples: int = 2
) -> UInt8[ndarray, "row column 3"]:
    """Render a shaded color image.

    Args:
        camera: Where the picture is taken from; without distortion.
        scene: What is there.
        samples: Each pixel is averaged over this many rows and columns.
    """
    fine = resized(camera, samples)
    raster = rasterize(fine, [scene.surface], device=scene.device)
    point, sight = _points(fine, raster)
    normal = _normals(scene, raster)
    facing = np.einsum("rcd,rcd->rc", normal, sight)
    albedo = _albedo(scene, raster, point, facing)
    normal = normal * np.where(facing > 0, -1.0, 1.0)[..., None]
    diffuse = np.maximum(normal @ _LIGHT, 0.0) * _lit(scene, point)
    soft = 0.5 + 0.5 * normal[..., 2]
    bright = (_AMBIENT * (0.55 + 0.45 * soft) + (1 - _AMBIENT) * diffuse)[..., None]
    image = np.clip(albedo * 1.08 * bright, 0.0, 1.0) ** (1 / 1.25)
    image = image.reshape(camera.height, samples, camera.width, samples, 3).mean(axis=(1, 3))
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
    depth = np.where(raster.element >= 0, raster.depth, table)
    return eye + ray * depth[..., None], ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def _normals(scene: Scene, raster: Raster) -> Float[ndarray, "row column 3"]:
    if not len(scene.faces):
        return np.broadcast_to([0.0, 0.0, 1.0], (*raster.element.shape, 3))
    normal = raster.interpolate(scene.faces, vertex_normals(scene.vertex, scene.faces))
    normal[raster.element < 0] = [0.0, 0.0, 1.0]
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)


def _albedo(scene: Scene, raster: Raster, point: ndarray, facing: ndarray) -> ndarray:
    """Color every pixel as if it were fully lit."""
    x, y = np.nan_to_num(point[..., 0]), np.nan_to_num(point[..., 1])
    grain = np.sin(90 * y + 6 * np.sin(9 * x + 2.0)) + 0.5 * np.sin(230 * y + 3 * np.sin(14 * x))
    seam = np.abs((y / 0.09) % 1.0 - 0.5) > 0.488
    color = _WOOD * (1.0 + 0.018 * grain - 0.16 * seam)[..., None]
    if not len(scene.faces):
        return color
    u, v = np.moveaxis(raster.interpolate(scene.faces, scene.pattern), -1, 0)
    is_back = facing > 0
    cloth = np.where(is_back[..., None], scene.dye.back, scene.dye.top)
    weave = np.sin(u * 900) * np.sin(v * 900)
    cloth = cloth * (1.0 + 0.10 * weave)[..., None]
    stripe = (np.abs(np.abs(u) - 0.066) < 0.007) | (np.abs(np.abs(u) - 0.083) < 0.003)
    cloth = np.where((stripe & ~is_back)[..., None], scene.dye.stripe, cloth)
    label = scene.labels(raster)[..., None]
    return np.where(label == 0, color, np.where(label == _BODY, cloth, _SKIN))


def _lit(scene: Scene, point: Float[ndarray, "row column 3"]) -> Float[ndarray, "row column"]:
    """Tell how much of the light reaches each point past body and hands."""
    light = scene.light
    reach = rasterize(light, [scene.surface], device=scene.device).depth
    reach = np.where(reach > 0, reach, np.inf) + _SHADOW_BIAS
    where = np.nan_to_num(point)
    # Far away the table is behind the light; nothing casts a shadow there.
    depth, pixel = light.camera_depth(where), np.nan_to_num(light.project(where))
    columns, rows = (
        [np.clip(np.round(along + offset), 0, size - 1).astype(np.int64) for offset in _SOFTENING]
        for along, size in zip(np.moveaxis(pixel, -1, 0), (light.width, light.height), strict=True)
    )
    amount = np.zeros(depth.shape)
    for column, row in itertools.product(columns, rows):
        amount += depth < reach.take(row * light.width + column)
    return amount / len(_SOFTENING) ** 2


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


def resized(camera: PinholeCamera, factor: float) -> PinholeCamera:
    """Give a camera that sees the same with so many times the rows and columns.

    Args:
        camera: A camera without distortion.
        factor: How many times as many.
    """
    K = camera.K.copy()
    K[:2] *= factor
    K[:2, 2] += (factor - 1) / 2
    return PinholeCamera(
        K=K,
        T_world_camera=camera.T_world_camera,
        width=round(factor * camera.width),
        height=round(factor * camera.height),
    )


def shadow_points(point: Float[ndarray, "point 3"]) -> Float[ndarray, "point 3"]:
    """Find where the shadows of points fall on the table [m]."""
    lamp = _LIGHT * _LIGHT_DISTANCE
    return lamp + (point - lamp) * (lamp[2] / (lamp[2] - point[:, 2:]))
