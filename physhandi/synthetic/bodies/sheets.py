"""A synthetic folded sheet: its nodes and springs, and the motion of the hand."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.random import Generator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from physhandi.hand.model import HandModel
from physhandi.hand.motion import HandMotion
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model
from physhandi.synthetic.hands.script import minimum_jerk

FINGERTIP_KEYPOINTS = (4, 8, 12, 16, 20)
"""Keypoints at the ends of the fingers."""

# Curl of the thumb's three joints, its base also spread and twisted [rad].
_OPEN_THUMB = (-0.34, 0.21, -0.05, -0.34, -0.30)
_CLOSED_THUMB = (-0.55, 0.16, -0.03, -0.24, -0.18)
# Each finger's curl and spread at the knuckle, and its curl at the middle joint [rad].
_OPEN_FINGERS = (
    (-0.47, 0.19, -0.76),
    (-0.41, 0.11, -0.90),
    (-0.39, 0.03, -0.81),
    (-0.50, -0.06, -0.52),
)
_CLOSED_FINGERS = (
    (-0.54, 0.06, -0.93),
    (-0.48, 0.10, -1.07),
    (-0.48, 0.11, -0.95),
    (-0.62, 0.11, -0.56),
)
_LAST_JOINT = 0.6
_SQUEEZE = 0.4
_FOLD_RADIUS = 0.085
_FOLD_ANGLE = 2.15
_WRIST_ROTATION = (1.4074, -1.0680, 1.1160)
_WRIST = (-0.1779, -0.0204, 0.0982)


@dataclass(frozen=True)
class Sheet:
    """A soft sheet that lies flat on the ground."""

    node: Float[ndarray, "node 3"]
    """Nodes in the world frame [m]."""
    faces: Int[ndarray, "face 3"]
    """Triangles between the nodes, counter-clockwise from above."""


def make_sheet(
    length: float, width: float, spacing: float, random: Generator, *, height: float = 0.001
) -> Sheet:
    """Scatter the nodes of a rectangular sheet around the origin.

    Args:
        length: Size along x [m].
        width: Size along y [m].
        spacing: Distance between neighbouring nodes before they are shifted [m].
        random: Decides by how much inner nodes are shifted (up to a fifth of the spacing).
        height: Height above the ground [m].
    """
    counts = [round(size / spacing) + 1 for size in (length, width)]
    x, y = np.meshgrid(
        np.linspace(-length / 2, length / 2, counts[0]),
        np.linspace(-width / 2, width / 2, counts[1]),
        indexing="ij",
    )
    shift = random.uniform(-0.2, 0.2, (2, *x.shape)) * spacing
    x[1:-1] += shift[0, 1:-1]
    y[:, 1:-1] += shift[1, :, 1:-1]
    flat = np.stack([x.ravel(), y.ravel()], axis=1)
    corner = flat[Delaunay(flat).simplices]
    faces = Delaunay(flat).simplices.astype(np.int64)
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    clockwise = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] < 0
    faces[clockwise] = faces[clockwise][:, ::-1]
    area = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    faces = faces[area > 1e-3 * spacing * spacing]
    return Sheet(np.column_stack([flat, np.full(len(flat), height)]), faces)


def uneven_material(
    model: SpringMassModel, random: Generator, *, spread: float = 0.35, patch: float = 0.05
) -> SpringMassModel:
    """Vary the stiffness of a model's object springs smoothly over patches.

    Args:
        model: Model whose object springs are equally stiff.
        random: Decides which patches are stiff.
        spread: Standard deviation of the logarithm of the stiffness.
        patch: Distance over which stiffness changes [m].
    """
    object_springs = model.spring_nodes[: model.object_spring_count]
    middle = model.object_node[object_springs].mean(axis=1)
    field = np.zeros(len(middle))
    waves = 12
    for _ in range(waves):
        direction = random.standard_normal(3) / patch
        field += np.cos(middle @ direction + random.uniform(0, 2 * np.pi))
    factor = np.exp(spread * field * np.sqrt(2 / waves))
    stiffness = model.stiffness.copy()
    stiffness[: model.object_spring_count] *= factor.astype(np.float32)
    return replace(model, stiffness=stiffness)


def fold_motion(
    model: HandModel, frame_count: int, frame_rate: float, random: Generator
) -> HandMotion:
    """Script a right hand that pinches the sheet's -x edge, lifts it and lays it over towards +x.

    The fingertips close by about 1 cm, then move up and over on an arc of 8.5 cm radius about a
    fold line on the ground, while the wrist turns along. Both are minimum-jerk moves; a tremor of
    half a millimetre lies over everything. On the arc the sheet is neither dragged nor compressed,
    so its shape follows from its weight and does not hang on how it happens to buckle.

    Args:
        model: The right hand.
        frame_count: Frames over which the script is stretched.
        frame_rate: Frames per second [Hz].
        random: Decides the tremor.
    """
    time = np.linspace(0.0, 1.0, frame_count)
    squeeze = _SQUEEZE * minimum_jerk(time, 0.03, 0.24)[:, None, None]
    opened = _articulation(_OPEN_THUMB, _OPEN_FINGERS)
    closed = _articulation(_CLOSED_THUMB, _CLOSED_FINGERS)
    articulation = opened + squeeze * (closed - opened)
    articulation += 0.006 * _tremor((frame_count, 15, 1), frame_rate, random) * [1.0, 0.0, 0.0]

    angle = _FOLD_ANGLE * minimum_jerk(time, 0.12, 0.96)
    arc = np.stack([1 - np.cos(angle), 0.10 * angle, np.sin(angle)], axis=1)
    travel = _FOLD_RADIUS * arc + 0.0004 * _tremor((frame_count, 3), frame_rate, random)
    turn = angle[:, None] * [0.10, 0.42, -0.10]
    turn += 0.004 * _tremor((frame_count, 3), frame_rate, random)
    held = minimum_jerk(time, 0.02, 0.10)[:, None]
    rotation = Rotation.from_rotvec(held * turn)
    start = Rotation.from_rotvec(_WRIST_ROTATION)
    grasp = _grasp_point(model, opened, start.as_rotvec())
    return HandMotion(
        side="right",
        shape=np.zeros(10, dtype=np.float32),
        articulation=articulation.astype(np.float32),
        wrist_rotation=(rotation * start).as_rotvec().astype(np.float32),
        wrist_translation=(grasp + held * travel + rotation.apply(np.array(_WRIST) - grasp)).astype(
            np.float32
        ),
    )


def simulate_sheet(
    sheet: Sheet,
    control: Float[ndarray, "frame control 3"],
    parameters: SimulationParameters,
    random: Generator,
) -> tuple[SpringMassModel, Float[ndarray, "frame node 3"]]:
    """Simulate a sheet of uneven stiffness moved by the hand's vertices.

    Returns:
        The model, and the positions of its nodes in every frame [m].
    """
    model = build_model(sheet.node.astype(np.float32), control[0], parameters)
    model = uneven_material(model, random)
    rollout = Simulator(model, parameters).rollout(control)
    return model, rollout.position.astype(np.float64)


def _tremor(shape: tuple[int, ...], frame_rate: float, random: Generator) -> ndarray:
    """Draw noise of unit variance, mostly below 6 Hz, along the first axis."""
    noise = random.standard_normal(shape)
    smooth = gaussian_filter1d(noise, frame_rate / (2 * np.pi * 6.0) + 0.8, axis=0)
    return smooth / smooth.std()


def _articulation(
    thumb: tuple[float, ...], fingers: tuple[tuple[float, float, float], ...]
) -> Float[ndarray, "15 3"]:
    articulation = np.zeros((15, 3))
    articulation[0] = thumb[:3]
    articulation[1:3, 0] = thumb[3:]
    for number, (knuckle, spread, middle) in enumerate(fingers, start=1):
        articulation[3 * number, :2] = knuckle, spread
        articulation[3 * number + 1 : 3 * number + 3, 0] = middle, _LAST_JOINT * middle
    return articulation


def _grasp_point(
    model: HandModel, articulation: Float[ndarray, "15 3"], rotation: Float[ndarray, " 3"]
) -> Float[ndarray, " 3"]:
    """Find the middle of the fingertips, about which the hand turns."""
    with torch.no_grad():
        keypoint = model.keypoints(
            torch.zeros(10, dtype=torch.float64),
            torch.from_numpy(articulation)[None],
            torch.from_numpy(rotation)[None],
            torch.tensor([_WRIST], dtype=torch.float64),
        )
    return keypoint[0, list(FINGERTIP_KEYPOINTS)].mean(dim=0).numpy()
