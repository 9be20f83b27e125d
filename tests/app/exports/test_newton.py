"""The object in Newton: moves as in our rollout and as closed forms say."""

import importlib.util
import io
import subprocess
import sys
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
from physhandi.data.exporters.newton import newton_files
from physhandi.errors import UsageError

RUN = BUNDLED / "runs" / "towel_fold_quick"
needs_newton = pytest.mark.skipif(
    importlib.util.find_spec("newton") is None, reason="newton is not installed"
)
# A process of its own, for settings of Warp that halve the time for which Newton's kernels compile.
_PLAY = """
import runpy, sys, warnings
from pathlib import Path
import numpy as np
import warp
warnings.simplefilter("error")
warp.config.enable_backward, warp.config.optimization_level = False, 1
for folder in map(Path, sys.argv[1:]):
    play = runpy.run_path(str(folder / "play.py"))["play"]
    np.save(folder / "position.npy", np.stack(list(play(folder))))
"""
RISE = 0.6
"""Speed of the control node that drags [m/s]."""


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of unpacked exports, each simulated by the script that is in it."""
    folder = tmp_path_factory.mktemp("newton")
    with pytest.raises(SystemExit) as end:
        main(["export", str(RUN), "--format", "newton", "--out", str(folder / "towel.zip")])
    assert end.value.code in {0, None}
    with zipfile.ZipFile(folder / "towel.zip") as archive:
        archive.extractall(folder / "towel")
    lifted = np.tile(np.array([[[0.0, 0.0, 0.5]]], np.float32), (11, 1, 1))
    lifted[:, 0, 2] += RISE * np.arange(11, dtype=np.float32) / 30.0
    dashpot: dict[str, Any] = {
        "control": lifted,
        "stiffness": np.zeros(1, np.float32),
        "damping": np.full(1, 4.0, np.float32),
    }
    air: dict[str, Any] = {"drag": 1.5, "ground_height": None}
    rollouts = {
        "hanging": hanging_node(),
        "attached": hanging_node(attached=np.array([[3, 6]], np.int32)),
        "dragged": hanging_node(settings=air, **dashpot),
        "braked": hanging_node(settings=air | {"use_control_velocity": False}, **dashpot),
    }
    rollouts["slipping"] = slipping_node()
    for name, rollout in rollouts.items():
        unpacked(newton_files(scene_of(rollout)), folder / name)
    unpacked(newton_files(scene_of(rollouts["hanging"], 0.03)), folder / "light")
    folders = [str(path) for path in folder.iterdir() if path.is_dir()]
    done = subprocess.run(
        [sys.executable, "-c", _PLAY, *folders], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder


@needs_newton
@pytest.mark.slow
def test_the_bundled_towel_folds_in_newton_as_in_our_rollout(played: Path) -> None:
    rollout = np.load(next(RUN.rglob("rollout.npy")))
    position = np.load(played / "towel" / "position.npy")
    moved = np.linalg.norm(rollout - rollout[0], axis=-1).mean(axis=1)
    assert moved[-1] > 0.05
    distance = np.linalg.norm(position - rollout, axis=-1).mean(axis=1)
    assert distance[0] < 1e-6
    # On other processors the towel may snap over in another frame of 20 to 40.
    assert distance.mean() < 0.003 < 0.1 * moved.mean()
    assert np.median(distance) < 3e-4
    # Prediction begins with the nodes beside their springs, where they were seen: 3.6 mm.
    with np.load(played / "towel" / "motion.npz") as motion:
        first = int(motion["restart_frame"]) + 1
        beside = np.linalg.norm(motion["restart_node_shift"], axis=1).mean()
    assert distance[first : first + 3].max() < 3e-4 < 0.1 * beside


@needs_newton
@pytest.mark.slow
def test_grips_slip_and_less_friction_is_left_as_in_our_rollout(played: Path) -> None:
    position = np.load(played / "slipping" / "position.npy")
    expected = slipping_node()
    np.testing.assert_allclose(position[:, 0], expected.position[:, 0], atol=1e-3)
    np.testing.assert_allclose(position[:, 1, 0], expected.position[:, 1, 0], atol=4e-3)
    firm = slipping_node(strength=0.0, share=1.0)
    assert np.abs(firm.position - expected.position)[-1, 0, 2] > 0.01
    assert np.abs(firm.position - expected.position)[-1, 1, 0] > 0.03


@needs_newton
@pytest.mark.slow
@pytest.mark.parametrize("name", ["hanging", "light"])
def test_springs_gravity_and_the_ground_are_those_of_closed_forms(played: Path, name: str) -> None:
    position = np.load(played / name / "position.npy")
    time = np.arange(11) / 30.0
    # One kilogram on a spring of 40 N / 0.1 m, let go at its rest length.
    rate = np.sqrt(400.0)
    height = 0.4 - 9.81 / rate**2 * (1.0 - np.cos(rate * time))
    assert height.min() < 0.36
    np.testing.assert_allclose(position[:, 0, 2], height, atol=5e-4)
    # The other one flies until it touches the ground 5 cm above it, where friction all but stops
    # it, and half of its speed is left to come back with, a little more or less in steps.
    lands = np.sqrt(2 * 0.2 / 9.81)
    flies = time < lands
    assert flies.sum() == 7
    falls = 0.25 - 0.5 * 9.81 * time**2
    np.testing.assert_allclose(position[flies, 1, 2], falls[flies], atol=5e-4)
    later = time[7:] - lands
    rises = (position[7:, 1, 2] - 0.05 + 0.5 * 9.81 * later**2) / later
    np.testing.assert_allclose(rises / (9.81 * lands), 0.5, atol=0.1)
    along = 0.3 + 0.5 * np.minimum(time, lands)
    np.testing.assert_allclose(position[:, 1, 0], along, atol=4e-3)


@needs_newton
@pytest.mark.slow
def test_a_spring_holds_only_while_it_is_attached(played: Path) -> None:
    position = np.load(played / "attached" / "position.npy")[:, 0, 2]
    time = np.arange(11) / 30.0
    np.testing.assert_allclose(position[:4], 0.4 - 0.5 * 9.81 * time[:4] ** 2, atol=5e-4)
    acceleration = 900.0 * np.diff(position, 2)
    assert (acceleration[3:5] > 0.0).all()
    np.testing.assert_allclose(acceleration[7:], -9.81, atol=0.2)


@needs_newton
@pytest.mark.slow
@pytest.mark.parametrize(("name", "speed"), [("dragged", RISE), ("braked", 0.0)])
def test_dashpots_feel_the_hand_move_if_they_did_in_our_rollout(
    played: Path, name: str, speed: float
) -> None:
    position = np.load(played / name / "position.npy")
    time = np.arange(11) / 30.0
    # v' = c (V - v) - g - drag v from rest, without a ground.
    rate = 4.0 + 1.5
    final = (4.0 * speed - 9.81) / rate
    way = final * (time - (1.0 - np.exp(-rate * time)) / rate)
    np.testing.assert_allclose(position[:, 0, 2], 0.4 + way, atol=1e-3)
    # The other one falls through where the ground would be.
    falls = 0.25 - 9.81 / 1.5 * (time - (1.0 - np.exp(-1.5 * time)) / 1.5)
    assert falls[-1] < -0.1
    np.testing.assert_allclose(position[:, 1, 2], falls, atol=1e-3)


def test_what_cannot_be_simulated_is_refused_and_the_server_offers_the_rest(
    world: World, made: list[Any]
) -> None:
    bare = replace(scene_of(hanging_node()), model={})
    with pytest.raises(UsageError, match="made' has no object that Newton could"):
        list(newton_files(bare))
    rope = scene_of(hanging_node())
    with pytest.raises(UsageError, match="made' bends as an elastic rod"):
        list(newton_files(replace(rope, model=rope.model | {"rod_node": np.arange(2)})))
    answer = world.script().get("/api/v1/runs/fitted/export?format=newton&mass=0.5")
    assert answer.headers["content-disposition"] == 'attachment; filename="fitted_newton.zip"'
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert set(archive.namelist()) == {"model.npz", "motion.npz", "play.py"}
        with np.load(io.BytesIO(archive.read("model.npz"))) as model:
            assert model["particle_mass"].sum() == pytest.approx(0.5)
            assert "the object weighs 500 g" in str(model["about"])
