"""The object in MuJoCo: moves as in our rollout, weighs what it weighs, and is held when it was."""

import io
import runpy
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.physics.hanging_node import hanging_node, scene_of, slipping_node, unpacked
from support.server.server_world import World

from app.cli import main
from app.settings import BUNDLED
from physhandi.data.exporters.mjcf import mjcf_files
from physhandi.errors import UsageError

mujoco: Any = pytest.importorskip("mujoco")


def played(folder: Path) -> np.ndarray:
    """Simulate an unpacked export with the script that is in it."""
    play = runpy.run_path(str(folder / "play.py"))["play"]
    return np.stack([position.copy() for position in play(folder)])


@pytest.mark.slow
def test_the_bundled_towel_folds_in_mujoco_as_in_our_rollout(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = BUNDLED / "runs" / "towel_fold_quick"
    with pytest.raises(SystemExit) as end:
        main(["export", str(run), "--format", "mjcf", "--out", str(tmp_path / "towel.zip")])
    assert end.value.code in {0, None}, capsys.readouterr().err
    with zipfile.ZipFile(tmp_path / "towel.zip") as archive:
        archive.extractall(tmp_path / "towel")
    rollout = np.load(next(run.rglob("rollout.npy")))
    position = played(tmp_path / "towel")
    moved = np.linalg.norm(rollout - rollout[0], axis=-1).mean(axis=1)
    assert moved[-1] > 0.05
    distance = np.linalg.norm(position - rollout, axis=-1).mean(axis=1)
    assert distance[0] < 1e-6
    assert distance.mean() < 0.003 < 0.1 * moved.mean()
    # Prediction begins with the nodes beside their springs, where they were seen: 3.6 mm.
    with np.load(tmp_path / "towel" / "motion.npz") as motion:
        first = int(motion["restart_frame"]) + 1
        beside = np.linalg.norm(motion["restart_node_shift"], axis=1).mean()
    assert distance[first] < 5e-4 < 0.2 * beside
    text = (tmp_path / "towel" / "scene.xml").read_text()
    assert "the object weighs 8.2" in text
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "towel" / "scene.xml"))
    assert model.body_mass.sum() == pytest.approx(0.0082, rel=0.02)


@pytest.mark.parametrize("kilograms", [None, 0.03])
def test_springs_gravity_and_the_ground_are_those_of_closed_forms(
    tmp_path: Path, kilograms: float | None
) -> None:
    position = played(unpacked(mjcf_files(scene_of(hanging_node(), kilograms)), tmp_path / "twin"))
    time = np.arange(11) / 30.0
    # One kilogram on a spring of 40 N / 0.1 m, let go at its rest length.
    rate = np.sqrt(400.0)
    height = 0.4 - 9.81 / rate**2 * (1.0 - np.cos(rate * time))
    assert height.min() < 0.36
    np.testing.assert_allclose(position[:, 0, 2], height, atol=2e-3)
    # The other one flies until it touches the ground 5 cm above it.
    flies = time < np.sqrt(2 * 0.2 / 9.81)
    expected = np.stack([0.3 + 0.5 * time, 0.25 - 0.5 * 9.81 * time**2], axis=1)
    assert 3 < flies.sum() < 10
    np.testing.assert_allclose(position[flies, 1][:, [0, 2]], expected[flies], atol=2e-3)
    assert position[-1, 1, 2] == pytest.approx(0.05, abs=4e-3)


def test_grips_slip_and_less_friction_is_left_as_in_our_rollout(tmp_path: Path) -> None:
    rollout = slipping_node()
    position = played(unpacked(mjcf_files(scene_of(rollout, 0.03)), tmp_path / "twin"))
    np.testing.assert_allclose(position[:, 0], rollout.position[:, 0], atol=1e-3)
    np.testing.assert_allclose(position[:, 1, 0], rollout.position[:, 1, 0], atol=0.01)
    firm = slipping_node(strength=0.0, share=1.0)
    assert np.abs(firm.position - rollout.position)[-1, 0, 2] > 0.01
    assert np.abs(firm.position - rollout.position)[-1, 1, 0] > 0.03


def test_a_spring_holds_only_while_it_is_attached(tmp_path: Path) -> None:
    rollout = hanging_node(attached=np.array([[3, 6]], np.int32))
    position = played(unpacked(mjcf_files(scene_of(rollout)), tmp_path / "twin"))[:, 0, 2]
    time = np.arange(11) / 30.0
    np.testing.assert_allclose(position[:4], 0.4 - 0.5 * 9.81 * time[:4] ** 2, atol=1e-3)
    acceleration = 900.0 * np.diff(position, 2)
    assert (acceleration[3:5] > 0.0).all()
    np.testing.assert_allclose(acceleration[7:], -9.81, atol=0.2)


def test_what_cannot_be_simulated_is_refused_and_the_server_offers_the_rest(
    world: World, made: list[Any]
) -> None:
    bare = replace(scene_of(hanging_node()), model={})
    with pytest.raises(UsageError, match="made' has no object"):
        list(mjcf_files(bare))
    rope = scene_of(hanging_node())
    with pytest.raises(UsageError, match="made' bends as an elastic rod"):
        list(mjcf_files(replace(rope, model=rope.model | {"rod_node": np.arange(2)})))
    answer = world.script().get("/api/v1/runs/fitted/export?format=mjcf&mass=0.5")
    assert answer.headers["content-disposition"] == 'attachment; filename="fitted_mjcf.zip"'
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert set(archive.namelist()) == {"scene.xml", "motion.npz", "play.py"}
        model = mujoco.MjModel.from_xml_string(archive.read("scene.xml").decode())
    assert model.body_mass.sum() == pytest.approx(0.5)
