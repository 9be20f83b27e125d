"""A node on a spring beside one that falls, whose motion is known in closed form."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from physhandi.data.exporters.scene_data import SceneData
from physhandi.data.object_mass import given_mass
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.restart import Restart
from physhandi.simulation.simulator import Simulator


def hanging_node(
    control: np.ndarray | None = None, settings: dict[str, Any] | None = None, **changes: Any
) -> ObjectRollout:
    """A node that hangs on a control node, beside one that falls; made without a simulation."""
    values: dict[str, Any] = {
        "object_node": np.array([[0.0, 0.0, 0.4], [0.3, 0.0, 0.25]], np.float32),
        "initial_velocity": np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]], np.float32),
        "spring_nodes": np.array([[0, 2]], np.int32),
        "rest_length": np.array([0.1], np.float32),
        "stiffness": np.array([40.0], np.float32),
        "damping": np.array([0.0], np.float32),
        "object_spring_count": 0,
        "control_count": 1,
        "clearance": np.array([0.0, 0.05], np.float32),
    }
    parameters: dict[str, Any] = {
        "drag": 0.0,
        "gravity": 9.81,
        "ground_height": 0.0,
        "substeps_per_frame": 100,
        "friction": 0.3,
    }
    if control is None:
        control = np.tile(np.array([[[0.0, 0.0, 0.5]]], np.float32), (11, 1, 1))
    return ObjectRollout.empty(
        SpringMassModel(**(values | changes)),
        SimulationParameters(**(parameters | (settings or {}))),
        control,
    )


def slipping_node(strength: float = 6.0, share: float = 0.1) -> ObjectRollout:
    """The same, simulated: from frame 2 on what holds the node slips, and the ground is smoother.

    The spring would pull by up to 20 N, and the other node would all but stop on the ground.
    """
    made = hanging_node()
    free = Simulator(made.model, made.parameters).rollout(made.control)
    restart = Restart(
        frame=2,
        position=free.position[2],
        velocity=free.velocity[2],
        shifts_nodes=True,
        grip_strength=strength,
        friction_share=share,
    )
    motion = Simulator(made.model, made.parameters).rollout(made.control, restart)
    state = {"position": motion.position, "velocity": motion.velocity}
    return replace(made, restart=restart, **state)


def scene_of(rollout: ObjectRollout, kilograms: float | None = None) -> SceneData:
    rollout.ready = rollout.frame_count
    mass = None if kilograms is None else given_mass(kilograms)
    return replace(rollout.scene_data(), sequence="made", mass=mass)


def unpacked(files: Any, folder: Path) -> Path:
    """Write names and contents into a new folder."""
    folder.mkdir()
    for name, content in files:
        (folder / name).write_bytes(content)
    return folder
