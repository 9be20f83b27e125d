"""Splats as PLY, read by a program that knows nothing of the exporter, as viewers of splats do."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from physhandi.data.exporters import export_run
from physhandi.data.layout import SPLATS_FILE
from physhandi.errors import RunError, UsageError
from physhandi.run import Run

NODE = np.array([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]], np.float32)
ROLLOUT = np.stack([NODE, NODE + np.float32(0.25)])


def splats() -> dict[str, np.ndarray]:
    random = np.random.default_rng(5)
    return {
        "center": random.normal(size=(7, 3)).astype(np.float32),
        "scale": random.uniform(0.001, 0.02, 7).astype(np.float32),
        "color": random.uniform(0, 1, (7, 3)).astype(np.float32),
        "opacity": np.array([0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0], np.float32),
        "rest_node": NODE,
    }


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Run.create(
        tmp_path / "fit", name="fit", kind="reconstruction", sequences=["/data/lift"], config={}
    )
    with run.begin_attempt() as attempt:
        attempt.save_yaml("sequences/lift/meta.yaml", {"frame_rate": 30.0, "frame_count": 2})
        attempt.save_array("sequences/lift/rollout.npy", ROLLOUT)
        attempt.save_tensors(SPLATS_FILE, splats())
        attempt.publish()
    return run


def read(path: Path) -> dict[str, np.ndarray]:
    """Read the properties of the vertices, by trimesh, as what they stand for."""
    cloud = trimesh.load(path, process=False)
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    field = {name: np.asarray(raw[name], np.float64).ravel() for name in raw.dtype.names}
    # Kerbl et al. 2023: colors are 1/2 + Y00 f_dc, opacities a sigmoid, extents an exponential.
    harmonic = 0.5 / np.sqrt(np.pi)
    dc, scale = (np.stack([field[f"{n}_{k}"] for k in range(3)], 1) for n in ("f_dc", "scale"))
    return field | {
        "center": np.stack([field[axis] for axis in "xyz"], 1),
        "color": 0.5 + harmonic * dc,
        "opacity": 1 / (1 + np.exp(-field["opacity"])),
        "scale": np.exp(scale),
        "rotation": np.stack([field[f"rot_{k}"] for k in range(4)], 1),
    }


def test_other_programs_read_back_what_the_run_holds(run: Run, tmp_path: Path) -> None:
    path = export_run(run, "splat-ply", tmp_path / "towel.ply")
    found, stored = read(path), splats()
    np.testing.assert_array_equal(found["center"].astype(np.float32), stored["center"])
    np.testing.assert_allclose(found["color"], stored["color"], atol=1e-6)
    np.testing.assert_allclose(found["opacity"], stored["opacity"], atol=1.1e-4)
    np.testing.assert_allclose(found["opacity"][1:-1], stored["opacity"][1:-1], atol=1e-6)
    expected = np.repeat(stored["scale"][:, None], 3, axis=1)
    np.testing.assert_allclose(found["scale"], expected, rtol=1e-5)
    np.testing.assert_array_equal(found["rotation"], np.tile([1.0, 0, 0, 0], (7, 1)))
    # The order in which programs read the properties that do not look at their names.
    names = [
        line.split()[-1]
        for line in path.read_bytes().split(b"end_header")[0].decode().splitlines()
        if line.startswith("property")
    ]
    places = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity")
    shapes = ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
    assert names == [*places, *shapes]
    with pytest.raises(UsageError, match="exists already"):
        export_run(run, "splat-ply", path)


def test_a_frame_has_the_splats_where_its_nodes_carry_them(run: Run, tmp_path: Path) -> None:
    def carry(stored: dict[str, np.ndarray], node: np.ndarray) -> np.ndarray:
        return stored["center"] + (node - stored["rest_node"])[0]

    path = export_run(run, "splat-ply", tmp_path / "one.ply", frame=1, carry=carry)
    np.testing.assert_allclose(read(path)["center"], splats()["center"] + 0.25, atol=1e-6)
    with pytest.raises(UsageError, match="has frames 0 to 1, not 2"):
        export_run(run, "splat-ply", tmp_path / "two.ply", frame=2, carry=carry)
    assert not (tmp_path / "two.ply").exists()


def test_a_run_without_splats_says_how_to_get_some(tmp_path: Path) -> None:
    run = Run.create(
        tmp_path / "bare", name="bare", kind="reconstruction", sequences=["/data/lift"], config={}
    )
    with run.begin_attempt() as attempt:
        attempt.save_array("sequences/lift/rollout.npy", ROLLOUT)
        attempt.publish()
    with pytest.raises(RunError, match=r"'bare' holds no splats.*appearance\.enabled=true"):
        export_run(run, "splat-ply", tmp_path / "x.ply")
