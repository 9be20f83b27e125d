"""Meshes that other programs wrote."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from physhandi.data.importers import mesh as importer
from physhandi.data.importers.mesh import read_mesh
from physhandi.errors import UsageError

CORNER = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def test_parts_of_a_scene_are_placed_and_seams_joined(tmp_path: Path) -> None:
    # Every triangle with corners of its own, as along seams of a texture.
    torn = trimesh.Trimesh(CORNER[FACES].reshape(-1, 3), np.arange(12).reshape(-1, 3))
    scene = trimesh.Scene()
    move = np.eye(4)
    move[:3, 3] = [10, 20, 30]
    scene.add_geometry(trimesh.Trimesh(torn.vertices, torn.faces, process=False), node_name="a")
    scene.add_geometry(
        trimesh.Trimesh(torn.vertices, torn.faces, process=False), node_name="b", transform=move
    )
    path = tmp_path / "two.glb"
    path.write_bytes(scene.export(file_type="glb"))
    mesh = read_mesh(path)
    assert len(mesh.vertex) == 8
    assert mesh.faces.shape == (8, 3)
    assert mesh.color is None
    expected = np.concatenate([CORNER, CORNER + np.array([10, 20, 30])])
    found = {tuple(corner) for corner in mesh.vertex.round(6).tolist()}
    assert found == {tuple(corner) for corner in expected.tolist()}
    a, b, c = (mesh.vertex[mesh.faces[:, k]] for k in range(3))
    middle = np.where(a[:, :1] < 5, [[0.25, 0.25, 0.25]], [[10.25, 20.25, 30.25]])
    assert ((np.cross(b - a, c - a) * (a - middle)).sum(axis=1) > 0).all()


def test_a_texture_becomes_colors_of_corners(tmp_path: Path) -> None:
    pixel = np.zeros((2, 2, 3), np.uint8)
    pixel[0, 0], pixel[0, 1], pixel[1, 0], pixel[1, 1] = (
        (255, 0, 0),
        (0, 255, 0),
        (0, 0, 255),
        (9, 9, 9),
    )
    # v runs upwards: the last row of the picture is at v = 0.
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    material = PBRMaterial(baseColorTexture=Image.fromarray(pixel))
    visual = TextureVisuals(uv=uv, material=material)
    mesh = trimesh.Trimesh(CORNER, FACES, process=False, visual=visual)
    path = tmp_path / "painted.glb"
    path.write_bytes(mesh.export(file_type="glb"))
    read = read_mesh(path)
    assert read.color is not None
    order = [int(np.abs(read.vertex - corner).sum(axis=1).argmin()) for corner in CORNER]
    expected = [[0, 0, 255], [9, 9, 9], [255, 0, 0], [0, 255, 0]]
    assert read.color[order].tolist() == expected


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_a_texture_that_announces_too_much_is_refused_before_it_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    picture = Image.fromarray(np.zeros((3, 5, 3), np.uint8))
    visual = TextureVisuals(uv=np.zeros((4, 2)), image=picture)
    mesh = trimesh.Trimesh(CORNER, FACES, process=False, visual=visual)
    path = tmp_path / f"painted.{kind}"
    if kind == "glb":
        path.write_bytes(mesh.export(file_type="glb"))
    else:
        mesh.export(path)
    monkeypatch.setattr(importer, "MOST_PIXELS", 14)
    monkeypatch.setattr(TextureVisuals, "to_color", lambda _: pytest.fail("was decoded"))
    with pytest.raises(UsageError, match=r"painted\..* texture has 5x3 px, and 14 are the most"):
        read_mesh(path)


def test_corners_with_colors_keep_them(tmp_path: Path) -> None:
    color = np.array([[10, 20, 30], [40, 50, 60], [70, 80, 90], [100, 110, 120]], np.uint8)
    mesh = trimesh.Trimesh(CORNER, FACES, process=False, vertex_colors=color)
    path = tmp_path / "colored.ply"
    path.write_bytes(mesh.export(file_type="ply"))
    read = read_mesh(path)
    assert read.color is not None
    order = [int(np.abs(read.vertex - corner).sum(axis=1).argmin()) for corner in CORNER]
    assert read.color[order].tolist() == color.tolist()


def test_a_mesh_that_is_too_large_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "fine.ply"
    path.write_bytes(trimesh.Trimesh(CORNER, FACES, process=False).export(file_type="ply"))
    monkeypatch.setattr(importer, "MOST_TRIANGLES", 3)
    with pytest.raises(UsageError, match=r"fine\.ply has 4 triangles, and 3 are the most"):
        read_mesh(path)
    monkeypatch.setattr(importer, "LARGEST_FILE", 100)
    with pytest.raises(UsageError, match=r"fine\.ply has more than"):
        read_mesh(path)
