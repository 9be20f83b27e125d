"""The glTF export, read back by pygltflib and animated by a small player of its own."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pygltflib import GLTF2
from scipy.spatial.transform import Rotation

from physhandi.data.exporters import export_run
from physhandi.data.run import Run
from physhandi.errors import UsageError
from physhandi.fitting.artefacts import save_hand_vertices, save_motions
from physhandi.hand.motion import HandMotion

FRAMES, NODES, RATE = 4, 5, 25.0
SPRINGS = np.array([[0, 1], [1, 2], [3, 4], [NODES + 3, 0]], np.int32)
KINDS = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# What the exporter must undo: glTF's y is our z, its z our -y.
TO_OURS = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def _motions() -> tuple[HandMotion, ...]:
    random = np.random.default_rng(1)
    return tuple(
        HandMotion(
            side=side,
            shape=random.normal(size=10),
            articulation=0.5 * random.normal(size=(FRAMES, 15, 3)),
            wrist_rotation=2 * random.normal(size=(FRAMES, 3)),
            wrist_translation=0.3 * random.normal(size=(FRAMES, 3)),
        )
        for side in ("right", "left")
    )


def _run(folder: Path, *, has_object: bool = True) -> Run:
    run = Run.create(folder, name="fit", kind="reconstruction", sequences=["/data/lift"], config={})
    rollout = np.random.default_rng(4).normal(size=(FRAMES, NODES, 3)).astype(np.float32)
    with run.begin_attempt() as attempt:
        base = "sequences/lift"
        attempt.save_yaml(f"{base}/meta.yaml", {"frame_rate": RATE, "length_unit": "m"})
        save_motions(attempt, "lift", _motions())
        save_hand_vertices(attempt, "lift")
        if has_object:
            attempt.save_array(f"{base}/rollout.npy", rollout)
            counts = {"object_spring_count": np.array([3], np.int32)}
            attempt.save_tensors(f"{base}/model.safetensors", {"spring_nodes": SPRINGS, **counts})
        attempt.publish()
    return Run.open(run.folder)


class Player:
    """Plays the file by the glTF specification, at the times of its keys and between them."""

    def __init__(self, path: Path) -> None:
        self.gltf = GLTF2().load(str(path))
        self.blob = self.gltf.binary_blob()

    def array(self, index: int) -> np.ndarray:
        accessor = self.gltf.accessors[index]
        view = self.gltf.bufferViews[accessor.bufferView]
        assert view.byteOffset % 4 == 0
        width = WIDTHS[accessor.type]
        flat = np.frombuffer(
            self.blob, KINDS[accessor.componentType], accessor.count * width, view.byteOffset
        )
        if accessor.min:
            bounds = flat.reshape(-1, width)
            np.testing.assert_allclose(bounds.min(0), accessor.min, atol=1e-6)
            np.testing.assert_allclose(bounds.max(0), accessor.max, atol=1e-6)
        return flat if width == 1 else flat.reshape(-1, width)

    def channels(self) -> dict[tuple[int, str], tuple[np.ndarray, np.ndarray]]:
        (animation,) = self.gltf.animations
        found = {}
        for channel in animation.channels:
            sampler = animation.samplers[channel.sampler]
            assert sampler.interpolation == "LINEAR"
            found[channel.target.node, channel.target.path] = (
                self.array(sampler.input),
                self.array(sampler.output),
            )
        return found

    def node(self, name: str) -> int:
        return [node.name for node in self.gltf.nodes].index(name)

    def transform(self, node: int, frame: int) -> np.ndarray:
        channels, fields = self.channels(), self.gltf.nodes[node]
        local = np.eye(4)
        for path in ("translation", "rotation"):
            value = getattr(fields, path)
            if (node, path) in channels:
                value = channels[node, path][1][frame]
            if value is not None and path == "translation":
                local[:3, 3] = value
            elif value is not None:
                local[:3, :3] = Rotation.from_quat(value).as_matrix()
        above = [i for i, other in enumerate(self.gltf.nodes) if node in (other.children or [])]
        return self.transform(above[0], frame) @ local if above else local

    def skinned(self, name: str, frame: int) -> np.ndarray:
        node = self.gltf.nodes[self.node(name)]
        skin, (primitive,) = self.gltf.skins[node.skin], self.gltf.meshes[node.mesh].primitives
        bind = self.array(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        bones = np.array([self.transform(joint, frame) for joint in skin.joints]) @ bind
        attributes = primitive.attributes
        vertex = self.array(attributes.POSITION)
        moved = np.einsum(
            "vkab,vb->vka",
            bones[self.array(attributes.JOINTS_0)],
            np.c_[vertex, np.ones(len(vertex))],
        )
        weight = self.array(attributes.WEIGHTS_0)
        np.testing.assert_allclose(weight.sum(1), 1, atol=1e-6)
        return (weight[..., None] * moved).sum(1)[:, :3] @ TO_OURS.T

    def morphed(self, name: str, primitive: Any, weight: np.ndarray) -> np.ndarray:
        vertex = self.array(primitive.attributes.POSITION).astype(np.float64)
        for share, target in zip(weight, primitive.targets, strict=True):
            vertex = vertex + share * self.array(target["POSITION"])
        matrix = self.transform(self.node(name), 0)
        return (vertex @ matrix[:3, :3].T + matrix[:3, 3]) @ TO_OURS.T


def test_skinned_hands_move_as_in_the_run(tmp_path: Path) -> None:
    run = _run(tmp_path / "fit")
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
    run = _run(tmp_path / "fit")
    player = Player(export_run(run, "gltf", tmp_path / "fit.glb"))
    node = player.node("object")
    nodes, springs = player.gltf.meshes[player.gltf.nodes[node].mesh].primitives
    assert (nodes.mode, springs.mode) == (0, 1)
    np.testing.assert_array_equal(player.array(springs.indices).reshape(-1, 2), SPRINGS[:3])
    time, weight = player.channels()[node, "weights"]
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
    run = _run(tmp_path / "fit", has_object=False)
    (run.out / "sequences/lift/hand_left_skin.safetensors").unlink()
    player = Player(export_run(run, "gltf", tmp_path / "fit.glb"))
    assert "object" not in [node.name for node in player.gltf.nodes]
    node = player.node("left_hand")
    (primitive,) = player.gltf.meshes[player.gltf.nodes[node].mesh].primitives
    weight = player.channels()[node, "weights"][1].reshape(FRAMES, FRAMES - 1)
    expected = run.array("sequences/lift/hand_left_vertex.npy")
    for frame in range(FRAMES):
        found = player.morphed("left_hand", primitive, weight[frame])
        np.testing.assert_allclose(found, expected[frame], atol=1e-5)
    assert player.gltf.nodes[player.node("right_hand")].skin == 0


def test_the_file_is_whole(tmp_path: Path) -> None:
    path = export_run(_run(tmp_path / "fit"), "gltf", tmp_path / "fit.glb")
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
        export_run(_run(tmp_path / "again"), "gltf", path)


def test_trimesh_reads_it(tmp_path: Path) -> None:
    import trimesh

    scene = trimesh.load(export_run(_run(tmp_path / "fit"), "gltf", tmp_path / "fit.glb"))
    assert {"right_hand", "left_hand"} <= set(scene.geometry)
