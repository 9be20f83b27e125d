"""The glTF export, read back by pygltflib and animated by a small player of its own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pygltflib import GLTF2
from support.physics.moving_scene import FRAMES, RATE, SPRINGS, pyramid, write_run
from support.viewer.gltf_player import Player

from physhandi.data.exporters import export_run
from physhandi.errors import UsageError


def test_the_object_has_triangles_that_move_in_its_own_colors(tmp_path: Path) -> None:
    surface = pyramid()
    run = write_run(tmp_path / "fit")
    path = export_run(run, "gltf", tmp_path / "fit.glb", surface=lambda: surface)
    player = Player(path)
    node = player.gltf.nodes[player.node("object_surface")]
    (primitive,) = player.gltf.meshes[node.mesh].primitives
    np.testing.assert_array_equal(player.array(primitive.indices).reshape(-1, 3), surface.face)
    light = player.array(primitive.attributes.COLOR_0)[:, 0]
    # By the table of IEC 61966-2-1: the levels 0, 10, 128 and 255.
    np.testing.assert_allclose(light[:4], [0.0, 0.003035, 0.215861, 1.0], atol=1e-6)
    for frame in range(FRAMES):
        moved = player.vertices("object_surface", frame)
        np.testing.assert_allclose(moved, surface.vertex[frame], atol=1e-6)
    start = player.array(primitive.attributes.NORMAL)
    for frame in range(1, FRAMES):
        normal = start + player.array(primitive.targets[frame - 1]["NORMAL"])
        # By area: sides along the axes have normals h, the base 1.
        height = 1.0 + frame
        expected = -np.array([height, height, 1.0]) / np.sqrt(2 * height**2 + 1)
        np.testing.assert_allclose(normal[0], expected, atol=1e-5)
        np.testing.assert_array_equal(normal[4], [0, 0, 1])
    scene = trimesh_scene(path)
    assert len(scene.geometry["object_surface"].faces) == 4


def trimesh_scene(path: Path) -> Any:
    import trimesh

    return trimesh.load(path)


def test_skinned_hands_move_as_in_the_run(tmp_path: Path) -> None:
    run = write_run(tmp_path / "fit")
    player = Player(export_run(run, "gltf", tmp_path / "fit.glb"))
    for side in ("right", "left"):
        expected = run.array(f"sequences/lift/hand_{side}_vertex.npy")
        for frame in range(FRAMES):
            found = player.skinned(f"{side}_hand", frame)
            np.testing.assert_allclose(found, expected[frame], atol=1e-5)
        assert np.abs(expected[1] - expected[0]).max() > 0.1
        (primitive,) = player.gltf.meshes[
            player.gltf.nodes[player.node(f"{side}_hand")].mesh
        ].primitives
        faces = player.array(primitive.indices).reshape(-1, 3)
        np.testing.assert_array_equal(faces, run.array(f"sequences/lift/hand_{side}_face.npy"))
        normal = player.array(primitive.attributes.NORMAL)
        rest = player.array(primitive.attributes.POSITION)
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
        assert (
            np.cross(*(rest[faces[:, i]] - rest[faces[:, 0]] for i in (1, 2))) * normal[faces[:, 0]]
        ).sum(1).mean() > 0
    assert (player.gltf.accessors[primitive.indices].componentType, primitive.mode) == (5125, 4)


def test_the_object_moves_as_in_the_run(tmp_path: Path) -> None:
    run = write_run(tmp_path / "fit")
    player = Player(export_run(run, "gltf", tmp_path / "fit.glb"))
    node = player.node("object")
    nodes, springs = player.gltf.meshes[player.gltf.nodes[node].mesh].primitives
    assert (nodes.mode, springs.mode) == (0, 1)
    np.testing.assert_array_equal(player.array(springs.indices).reshape(-1, 2), SPRINGS[:3])
    time, weight = player.channels[node, "weights"]
    np.testing.assert_allclose(time, np.arange(FRAMES) / RATE)
    weight = weight.reshape(FRAMES, FRAMES - 1)
    rollout = run.array("sequences/lift/rollout.npy")
    for primitive in (nodes, springs):
        for frame in range(FRAMES):
            found = player.morphed("object", primitive, weight[frame])
            np.testing.assert_allclose(found, rollout[frame], atol=1e-6)
    between = player.morphed("object", nodes, 0.25 * weight[1] + 0.75 * weight[2])
    np.testing.assert_allclose(between, 0.25 * rollout[1] + 0.75 * rollout[2], atol=1e-6)


def test_a_hand_without_a_skin_becomes_a_moving_surface(tmp_path: Path) -> None:
    run = write_run(tmp_path / "fit", has_object=False)
    (run.out / "sequences/lift/hand_left_skin.safetensors").unlink()
    player = Player(export_run(run, "gltf", tmp_path / "fit.glb"))
    assert "object" not in [node.name for node in player.gltf.nodes]
    node = player.node("left_hand")
    (primitive,) = player.gltf.meshes[player.gltf.nodes[node].mesh].primitives
    weight = player.channels[node, "weights"][1].reshape(FRAMES, FRAMES - 1)
    expected = run.array("sequences/lift/hand_left_vertex.npy")
    for frame in range(FRAMES):
        found = player.morphed("left_hand", primitive, weight[frame])
        np.testing.assert_allclose(found, expected[frame], atol=1e-5)
    assert player.gltf.nodes[player.node("right_hand")].skin == 0


def test_the_file_is_whole(tmp_path: Path) -> None:
    path = export_run(write_run(tmp_path / "fit"), "gltf", tmp_path / "fit.glb")
    content = path.read_bytes()
    assert int.from_bytes(content[8:12], "little") == len(content)
    gltf = GLTF2().load(str(path))
    assert gltf.buffers[0].byteLength == len(gltf.binary_blob())
    assert gltf.asset.extras["sequence"] == "lift"
    # Every node hangs in the scene exactly once, skinned meshes at its top.
    children = [child for node in gltf.nodes for child in node.children or []]
    assert sorted(children + gltf.scenes[0].nodes) == list(range(len(gltf.nodes)))
    assert {gltf.nodes[node].name for node in gltf.scenes[0].nodes} == {
        "world",
        "right_hand",
        "left_hand",
    }
    with pytest.raises(UsageError, match="exists already"):
        export_run(write_run(tmp_path / "again"), "gltf", path)


def test_trimesh_reads_it(tmp_path: Path) -> None:
    import trimesh

    scene = trimesh.load(export_run(write_run(tmp_path / "fit"), "gltf", tmp_path / "fit.glb"))
    assert {"right_hand", "left_hand"} <= set(scene.geometry)
