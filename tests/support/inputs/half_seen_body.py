"""A lumpy body on the ground, filmed from one side only, whose whole mesh is known."""

from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.rendering.renderer import rasterize
from physhandi.rendering.shapes import Surface
from physhandi.synthetic.bodies.solids import make_plush

UNIT = 0.037
"""Metres for one unit of the mesh's file."""
TURN = Rotation.from_rotvec([1.1, -0.7, 2.0])
"""How the body's axes are turned in that file."""
EYES = ((0.15, -0.55, 0.25), (-0.3, -0.45, 0.35))


@cache
def body() -> tuple[np.ndarray, np.ndarray]:
    """Corners [m] and triangles of a stuffed animal without any symmetry that stands upright."""
    solid, _ = make_plush(0.2, 0.012, np.random.default_rng(0))
    faces = solid.faces
    vertex = solid.node[: solid.surface_node_count].copy()
    vertex += 0.012 * np.sin(30 * vertex[:, [1, 2, 0]] + [0.3, 1.1, 2.0])
    vertex = vertex[:, [1, 2, 0]]
    vertex[:, 2] -= vertex[:, 2].min()
    return vertex, faces


def colors(vertex: np.ndarray) -> np.ndarray:
    """A color that changes slowly over the body."""
    return (127 + 120 * np.sin(8 * vertex + [0, 1, 2])).clip(0, 255)


def write_half_seen(folder: Path, *, is_on_ground: bool = True) -> Sequence:
    vertex, faces = body()
    ground = Surface(
        vertex=np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float),
        faces=np.array([[0, 1, 2], [0, 2, 3]]),
    )
    with SequenceWriter(folder) as writer:
        views = []
        for number, eye in enumerate(EYES):
            camera = _camera(np.array(eye), np.array([0, 0, 0.1]))
            raster = rasterize(camera, [Surface(vertex=vertex, faces=faces), ground])
            is_body = raster.shape == 0
            alone = rasterize(camera, [Surface(vertex=vertex, faces=faces)])
            color = alone.interpolate(faces, colors(vertex)).round().astype(np.uint8)
            views.append(ViewMeta(name=f"v{number}", camera=camera))
            place = f"views/v{number}"
            depth = np.round(1000 * raster.depth).astype(np.uint16)
            writer.save_image(f"{place}/depth/00000.png", depth)
            writer.save_image(f"{place}/mask/00000.png", is_body.astype(np.uint8))
            writer.save_image(f"{place}/color/00000.png", color)
        return writer.finish(
            SequenceMeta(
                name=folder.name,
                frame_rate=30.0,
                frame_count=1,
                ground_height=0.0 if is_on_ground else None,
                views=tuple(views),
            )
        )


def mesh_in_its_own_axes(vertex: np.ndarray) -> np.ndarray:
    """Turn, shrink and move corners as the file of the mesh has them."""
    return TURN.apply(vertex) / UNIT + [3.0, -2.0, 5.0]


def write_mesh(path: Path, vertex: np.ndarray, faces: np.ndarray) -> Path:
    mesh = trimesh.Trimesh(mesh_in_its_own_axes(vertex), faces, process=False)
    content = mesh.export(file_type=path.suffix[1:])
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def _camera(eye: np.ndarray, target: np.ndarray) -> PinholeCamera:
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    pose[:3, 3] = eye
    K = np.array([[190.0, 0, 79.5], [0, 190.0, 63.5], [0, 0, 1]])
    return PinholeCamera(K=K, T_world_camera=pose, width=160, height=128)
