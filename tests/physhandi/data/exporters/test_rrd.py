"""The Rerun recording, read back by Rerun's own reader."""

import importlib.util
import io
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from support.physics.moving_scene import FRAMES, NODES, RATE, ROLLOUT, SPRINGS, pyramid, write_run

from app.cli import main
from app.settings import BUNDLED
from physhandi.data.exporters import export_scene
from physhandi.data.exporters.scene_data import SceneData, read_scene
from physhandi.data.object_mass import given_mass
from physhandi.data.sequence import Sequence
from physhandi.errors import UsageError
from physhandi.object_rollout import load_fitted
from physhandi.run import Run

# rerun-sdk and what it needs are 660 MB, so `make install` leaves them out.
needs_rerun = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None, reason="rerun-sdk (660 MB) is not installed"
)
FORCES = np.random.default_rng(7).normal(size=(FRAMES, NODES, 3))
FORCES[:, 1] = 0.0


@dataclass
class Entity:
    """What a recording says of one entity."""

    kept: dict[str, Any] = field(default_factory=dict)
    rows: dict[int, dict[str, Any]] = field(default_factory=dict)

    def values(self, name: str) -> list[np.ndarray]:
        """A component in every frame."""
        return [np.array(self.rows[frame][name]) for frame in sorted(self.rows)]


def recorded(path: Path) -> dict[str, Entity]:
    from rerun.chunk import RrdReader

    entities: dict[str, Entity] = {}
    for part in RrdReader(path).stream().to_chunks():
        entity = entities.setdefault(part.entity_path, Entity())
        batch = part.to_record_batch()
        columns = {name: batch.column(name) for name in batch.schema.names}
        if "time" in columns:
            columns["time"] = columns["time"].cast("int64")  # Nanoseconds.
        for values in zip(*(column.to_pylist() for column in columns.values()), strict=True):
            row = dict(zip(columns, values, strict=True))
            if part.is_static:
                entity.kept |= row
            else:
                entity.rows.setdefault(row["frame"], {}).update(row)
    return entities


def made_scene(folder: Path) -> SceneData:
    scene = read_scene(write_run(folder), None)
    surface = pyramid()
    return replace(
        scene,
        control=np.tile(np.arange(12, dtype=np.float32).reshape(1, 4, 3), (FRAMES, 1, 1)),
        lay_surface=lambda: surface,
        forces=lambda frame: FORCES[frame],
        mass=given_mass(0.02),
        views=tuple(Sequence.load(BUNDLED / "towel_fold").views[:1]),
    )


@needs_rerun
def test_motion_and_forces_are_those_of_the_run(tmp_path: Path) -> None:
    scene, surface = made_scene(tmp_path / "fit"), pyramid()
    entities = recorded(export_scene(scene, "rrd", tmp_path / "fit.rrd"))
    nodes = entities["/object/nodes"]
    assert sorted(nodes.rows) == list(range(FRAMES))
    seconds = [1e-9 * row["time"] for _, row in sorted(nodes.rows.items())]
    np.testing.assert_allclose(seconds, np.arange(FRAMES) / RATE, atol=1e-9)
    np.testing.assert_array_equal(nodes.values("Points3D:positions"), ROLLOUT)
    both = np.concatenate([ROLLOUT, scene.control], axis=1)
    springs = entities["/object/springs"].values("LineStrips3D:strips")
    np.testing.assert_array_equal(springs, both[:, SPRINGS[:3]])
    virtual = entities["/control/virtual_springs"].values("LineStrips3D:strips")
    np.testing.assert_array_equal(virtual, both[:, SPRINGS[3:]])
    shell = entities["/object/surface"]
    np.testing.assert_array_equal(shell.values("Mesh3D:vertex_positions"), surface.vertex)
    np.testing.assert_array_equal(shell.kept["Mesh3D:triangle_indices"], surface.face)
    red = np.array(shell.kept["Mesh3D:vertex_colors"], np.uint32) >> 24
    np.testing.assert_array_equal(red, surface.color[:, 0])
    for side, hand in scene.hands.items():
        mesh = entities[f"/hands/{side}"]
        np.testing.assert_array_equal(mesh.values("Mesh3D:vertex_positions"), hand.vertex)
        np.testing.assert_array_equal(mesh.kept["Mesh3D:triangle_indices"], hand.face)
    arrows = entities["/forces"]
    strongest = np.linalg.norm(FORCES, axis=-1).max()
    # The node that nothing pulls at has no arrow.
    expected = 0.08 / strongest * np.delete(FORCES, 1, axis=1)
    np.testing.assert_allclose(arrows.values("Arrows3D:vectors"), expected, atol=1e-6)
    origins = np.delete(ROLLOUT, 1, axis=1)
    np.testing.assert_array_equal(arrows.values("Arrows3D:origins"), origins)
    # Nodes weigh 20 g / 5, not 1 kg.
    total = 0.004 * np.linalg.norm(FORCES.sum(axis=1), axis=-1)
    drawn = np.array(entities["/plots/force_N"].values("Scalars:scalars"))[:, 0]
    np.testing.assert_allclose(drawn, total, rtol=1e-6)
    about = entities["/about"].kept["TextDocument:text"][0]
    assert f"An arrow of 1 N is {80 / (0.004 * strongest):.6g} mm long" in about
    assert "an object of 20 g" in about


@needs_rerun
def test_cameras_stand_where_they_stood_with_what_they_saw(tmp_path: Path) -> None:
    scene = made_scene(tmp_path / "fit")
    (view,) = scene.views
    entities = recorded(export_scene(scene, "rrd", tmp_path / "fit.rrd"))
    kept = entities[f"/cameras/{view.name}"].kept
    matrix = view.camera.T_world_camera
    np.testing.assert_allclose(kept["Transform3D:translation"][0], matrix[:3, 3], atol=1e-6)
    # Columns after one another, as Rerun stores matrices.
    turn = np.array(kept["Transform3D:mat3x3"][0]).reshape(3, 3).T
    np.testing.assert_allclose(turn, matrix[:3, :3], atol=1e-6)
    lens = np.array(kept["Pinhole:image_from_camera"][0]).reshape(3, 3).T
    np.testing.assert_allclose(lens, view.camera.K, rtol=1e-6)
    assert kept["Pinhole:resolution"][0] == [view.camera.width, view.camera.height]
    images = entities[f"/cameras/{view.name}/image"]
    assert sorted(images.rows) == list(range(FRAMES))
    for frame, row in images.rows.items():
        jpeg = np.array(row["EncodedImage:blob"][0], np.uint8).tobytes()
        found = np.asarray(PIL.Image.open(io.BytesIO(jpeg)), float)
        assert np.abs(found - view.color(frame)).mean() < 3.0


@needs_rerun
def test_the_bundled_run_brings_its_forces_and_cameras(tmp_path: Path) -> None:
    folder = BUNDLED / "runs" / "towel_fold_quick"
    with pytest.raises(SystemExit) as end:
        main(["export", str(folder), "--format", "rrd", "--out", str(tmp_path / "towel.rrd")])
    assert end.value.code in {0, None}
    entities = recorded(tmp_path / "towel.rrd")
    rollout = load_fitted(Run.open(folder), "towel_fold")
    assert rollout is not None
    cameras = [path for path in entities if path.startswith("/cameras/") and path.count("/") == 2]
    assert len(cameras) == 3
    frames = (5, 30, 50)
    arrows = entities["/forces"].rows
    ratios = []
    for frame in frames:
        force = rollout.forces(frame)
        force = force[np.linalg.norm(force, axis=1) > 0.0]
        vectors = np.array(arrows[frame]["Arrows3D:vectors"])
        ratios.append((vectors * force).sum() / (force**2).sum())
        np.testing.assert_allclose(vectors, ratios[-1] * force, atol=1e-6)
    np.testing.assert_allclose(ratios, ratios[0], rtol=1e-4)
    assert ratios[0] > 0.0


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("physhandi.data.exporters.rrd.find_spec", lambda _: None)
    scene = read_scene(write_run(tmp_path / "fit"), None)
    with pytest.raises(UsageError, match=r"pip install 'physhandi\[rerun\]'"):
        export_scene(scene, "rrd", tmp_path / "fit.rrd")
    assert not (tmp_path / "fit.rrd").exists()
