"""Hands that are wrong by a known amount, and small objects that they hold."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from physhandi.data.observation import ObjectObservation
from physhandi.fitting.hand_refinement import RefinementProblem
from physhandi.fitting.object_problem import build_problem
from physhandi.hand.loading import load_hand_model
from physhandi.hand.model import HandModel
from physhandi.hand.motion import HandMotion, control_trajectory
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

SOFT = SimulationParameters(
    connection_radius=0.03,
    max_neighbors=8,
    virtual_connection_radius=0.012,
    virtual_max_neighbors=3,
    stiffness=15.0,
    virtual_stiffness=15.0,
    damping=4.0,
    drag=8.0,
    ground_height=None,
    gravity=0.0,
    substeps_per_frame=40,
    rest_length_floor=4e-3,
    virtual_rest_length_floor=4e-3,
)
"""A rig without any spring of a period near a frame: motion follows the hand and dies out."""
TIPS = (4, 8, 12)


def mpjpe(motion: HandMotion, truth: HandMotion, frames: slice = slice(None)) -> float:
    """Mean distance of the 21 joints from where they are, over some frames [m]."""
    hand = load_hand_model(motion.side)
    gap = motion.keypoints(hand)[frames] - truth.keypoints(hand)[frames]
    return float(np.linalg.norm(gap, axis=2).mean())


def mpvpe(motion: HandMotion, truth: HandMotion, frames: slice = slice(None)) -> float:
    """Mean distance of the surface's vertices from where they are, over some frames [m]."""
    hand = load_hand_model(motion.side)
    gap = motion.vertices(hand)[frames] - truth.vertices(hand)[frames]
    return float(np.linalg.norm(gap, axis=2).mean())


def with_error(
    motion: HandMotion, error: float, seed: int, *, width: float, frames: slice = slice(None)
) -> HandMotion:
    """Disturb pose and place of a hand at random, by exactly so much in the mean.

    Each wrist coordinate gets normal noise of 10 mm, the wrist's rotation 0.1 rad about each axis
    of the hand and each joint 0.1 rad about each axis of its bone; everything is then scaled by
    one factor so that the mean joint error over the frames is `error`.

    Args:
        motion: The true hand.
        error: Mean joint error to be reached [m].
        seed: Of the noise.
        width: Standard deviation of the Gaussian that smooths the noise in time (its variance is
            restored) [frames].
        frames: Frames that the mean is taken over.
    """
    random = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        noise = random.standard_normal((motion.frame_count, *shape))
        noise = gaussian_filter1d(noise, width, axis=0, mode="reflect")
        return noise / noise.std()

    place, turn, pose = 0.01 * draw(3), 0.1 * draw(3), 0.1 * draw(15, 3)

    def disturbed(share: float) -> HandMotion:
        rotation = Rotation.from_rotvec(motion.wrist_rotation) * Rotation.from_rotvec(share * turn)
        return replace(
            motion,
            articulation=(motion.articulation + share * pose).astype(np.float32),
            wrist_rotation=rotation.as_rotvec().astype(np.float32),
            wrist_translation=(motion.wrist_translation + share * place).astype(np.float32),
        )

    low, high = 0.0, 5.0
    for _ in range(30):
        middle = (low + high) / 2
        is_less = mpjpe(disturbed(middle), motion, frames) < error
        low, high = (middle, high) if is_less else (low, middle)
    return disturbed(high)


def held_patch(
    truth: tuple[HandMotion, ...],
    seen: tuple[HandMotion, ...],
    *,
    fitted: int,
    every: int = 1,
    parameters: SimulationParameters = SOFT,
) -> RefinementProblem:
    """Simulate a few nodes at the fingertips of true hands; pose the problem with other hands.

    Args:
        truth: Hands that moved the object which was seen.
        seen: Hands to refine.
        fitted: Frames that are compared.
        every: Only every so many vertices are control nodes.
        parameters: Of the object.
    """
    models: tuple[HandModel, ...] = tuple(load_hand_model(motion.side) for motion in truth)
    tip = np.concatenate(
        [m.keypoints(h)[0][list(TIPS)] for m, h in zip(truth, models, strict=True)]
    )
    node = np.concatenate([tip, tip + np.array([0.0, 0.008, -0.006])]).astype(np.float32)
    vertex = control_trajectory(truth, models)
    chosen = None if every == 1 else np.arange(0, vertex.shape[1], every)
    control = vertex if chosen is None else vertex[:, chosen]
    model = build_model(node, control[0], parameters)
    assert model.virtual_spring_count >= len(tip)
    point = Simulator(model, parameters).rollout(control).position
    visible = np.ones(point.shape[:2], bool)
    other = control_trajectory(seen, models)
    object_ = build_problem(
        name="patch",
        observation=ObjectObservation(
            point=point,
            is_visible=visible,
            is_motion_valid=visible,
            cloud=tuple(point),
            node_of_track=np.arange(len(node), dtype=np.int32),
        ),
        object_node=node,
        rest_node=node,
        control=other if chosen is None else other[:, chosen],
        hand_face=np.zeros((0, 3), np.int32),
        frame_count=fitted,
        frame_rate=parameters.frame_rate,
        ground_height=parameters.ground_height,
        gravity=parameters.gravity,
        starts_at_rest=True,
    )
    return RefinementProblem(
        object_=object_,
        model=model,
        parameters=parameters,
        motions=seen,
        hand_models=models,
        chosen=chosen,
    )


def moved(motion: HandMotion, by: tuple[float, float, float]) -> HandMotion:
    """Shift a hand in all frames [m]."""
    return replace(
        motion, wrist_translation=(motion.wrist_translation + np.array(by)).astype(np.float32)
    )
