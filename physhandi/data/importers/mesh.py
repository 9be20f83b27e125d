"""Reads triangle meshes that other programs wrote: glTF, PLY, OBJ and STL, by trimesh."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from physhandi.data.untrusted.image_header import MOST_PIXELS
from physhandi.errors import UsageError

KINDS = (".glb", ".gltf", ".ply", ".obj", ".stl")
"""Endings of files that are read."""
LARGEST_FILE = 2**29
"""Most bytes of a file."""
MOST_TRIANGLES = 1_000_000
"""Most triangles of all parts together."""
_LEAST_FACES = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """Triangles in the unit and the axes of the file that they come from."""

    vertex: Float[ndarray, "vertex 3"]
    """Corners; equal ones are one."""
    faces: Int[ndarray, "face 3"]
    """Corners of each triangle, seen from outside."""
    color: UInt8[ndarray, "vertex 3"] | None
    """Color of each corner, also where the file has a texture; None if it has neither."""


def read_mesh(path: Path | str) -> Mesh:
    """Read a mesh; several in one file become one, each where the file's scene places it.

    Raises:
        UsageError: If the file cannot be read, or holds no surface; names file and remedy.
    """
    path = Path(path)
    if path.suffix.lower() not in KINDS:
        raise UsageError(f"Mesh {path}: only {', '.join(KINDS)} are read; export it as one.")
    if not path.is_file():
        raise UsageError(f"Mesh {path} is not there.")
    if path.stat().st_size > LARGEST_FILE:
        raise UsageError(f"Mesh {path} has more than {LARGEST_FILE >> 20} MiB; simplify it.")
    import trimesh

    try:
        # The whole scene, because transforms of nodes say where its parts are.
        scene: Any = trimesh.load_scene(path)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
        colors = [_colors(part) for part in parts]
    except Exception as error:
        raise UsageError(f"Mesh {path} cannot be read: {error}. Export it again.") from error
    counts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    place = [np.asarray(part.vertices, np.float64) for part in parts]
    faces = [np.asarray(part.faces) + start for part, start in zip(parts, counts, strict=False)]
    vertex = np.concatenate([np.zeros((0, 3)), *place])
    face = np.concatenate([np.zeros((0, 3), np.int64), *faces])
    if len(face) < _LEAST_FACES or not np.isfinite(vertex).all():
        raise UsageError(
            f"Mesh {path} has {len(face)} triangles"
            f"{'' if np.isfinite(vertex).all() else ', and corners that are not finite'}; export "
            "the object's surface as triangles."
        )
    if len(face) > MOST_TRIANGLES:
        raise UsageError(
            f"Mesh {path} has {len(face)} triangles, and {MOST_TRIANGLES} are the most; simplify "
            "it, for example by Blender's Decimate."
        )
    # A surface without any color is white in every viewer; that says nothing about the object.
    given = [color for color in colors if color is not None]
    color = np.concatenate(given) if len(given) == len(colors) else None
    return _welded(vertex, face, color)


def _colors(part: Any) -> ndarray | None:
    """Find the color of every corner of a mesh, or None if it was given none."""
    visual = part.visual
    if not visual.defined:
        return None
    if visual.kind == "texture":
        _check_texture(visual.material)
        visual = visual.to_color()
    color = np.asarray(visual.vertex_colors)
    return color[:, :3].astype(np.uint8) if color.shape == (len(part.vertices), 4) else None


def _check_texture(material: Any) -> None:
    """Refuse a picture that is too large, of which only the header was read so far."""
    for name in ("image", "baseColorTexture"):
        picture = getattr(material, name, None)
        if picture is None:
            continue
        width, height = picture.size
        if width * height > MOST_PIXELS:
            raise ValueError(f"its texture has {width}x{height} px, and {MOST_PIXELS} are the most")


def _welded(vertex: ndarray, faces: ndarray, color: ndarray | None) -> Mesh:
    """Join corners in one place, which files with textures repeat along seams."""
    _, first, owner = np.unique(vertex, axis=0, return_index=True, return_inverse=True)
    faces = owner.reshape(-1)[faces]
    is_there = (faces[:, [0, 1, 2]] != faces[:, [1, 2, 0]]).all(axis=1)
    faces = faces[is_there]
    used, corner = np.unique(faces, return_inverse=True)
    return Mesh(
        vertex=vertex[first[used]],
        faces=corner.reshape(-1, 3).astype(np.int32),
        color=None if color is None else color[first[used]],
    )
