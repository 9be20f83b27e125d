"""A balance of moments along the observed rope, which tells how it bends without a simulation."""

from collections.abc import Sequence as Many

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import make_interp_spline

from physhandi.fitting.object_problem import ObjectProblem
from physhandi.fitting.rope.bending import Bending, rope_model
from physhandi.rotations import parallel_transport, unit_across
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters

CURVATURE_COST = 1e-4
"""Cost of curvature at rest in a balance of moments, as a part of what it explains: of a rope that
is hardly turned, some of it is the same as a moment of the gripper."""
LEAST_STIFFNESS, LEAST_DAMPING, LEAST_DRAG = 1e-4, 1e-3, 0.05
"""Least that a balance of moments may give, in the units of `Bending`."""
EDGE_FRAMES = 3
"""First and last frames in which accelerations are not known well."""


def balance_moments(
    problems: Many[ObjectProblem], parameters: SimulationParameters
) -> Bending | None:
    """Find how a rope bends from its observed motion alone, by linear least squares.

    The force n in the rope grows along it by the mass of each node times (a - g + c v), the moment
    m by n x e; both are known up to their values at the gripper, six unknowns a frame that a QR
    decomposition takes out. What is left is linear: m·d = (EI/h) (κ - h κ⁰ + τ dκ/dt) about each
    axis d of a vertex, in EI, EI τ, the drag c and EI κ⁰.

    Args:
        problems: One for each sequence; all show the same rope.
        parameters: Of its springs, for the model.

    Returns:
        What was found; None if a node is not seen in every frame, if there are too few frames, or
        if the rope seems to have no stiffness.
    """
    rows, values = [], []
    spacing = 1.0
    for problem in problems:
        node = seen_nodes(problem)
        if node is None:
            return None
        model = rope_model(problem, parameters, Bending.straight(node.shape[1]))
        spacing = float(model.rest_length[: model.object_spring_count].mean())
        for row, value in _moment_equations(problem, model, node):
            rows.append(row)
            values.append(value)
    matrix = np.concatenate(rows)
    normal, side = matrix.T @ matrix, matrix.T @ np.concatenate(values)
    dear = np.diagonal(normal).copy()
    dear[:3] = 0.0
    solution = np.linalg.solve(normal + CURVATURE_COST * np.diag(dear), side)
    stiffness, viscous, drag = (float(value) for value in solution[:3])
    if stiffness * spacing < LEAST_STIFFNESS:
        return None
    return Bending(
        stiffness=stiffness * spacing,
        damping=max(viscous / stiffness, LEAST_DAMPING),
        drag=max(drag, LEAST_DRAG),
        # About that of a round bar, of which a balance of bending moments says nothing.
        twist_stiffness=stiffness * spacing,
        curvature=solution[3:].reshape(-1, 2) / stiffness,
    )


def seen_nodes(problem: ObjectProblem) -> Float[ndarray, "frame node 3"] | None:
    """Give every node's observed position in every frame [m]; None if one is not seen in one."""
    count = len(problem.object_node)
    carrier = problem.carrier.numpy()
    is_alone = carrier.shape[1] == 1 and np.array_equal(np.sort(carrier[:, 0]), np.arange(count))
    if not is_alone or problem.frame_count <= 2 * EDGE_FRAMES:
        return None
    node = problem.track.numpy().astype(np.float64)[:, np.argsort(carrier[:, 0])]
    return node if np.all(np.isfinite(node)) else None


def _moment_equations(
    problem: ObjectProblem, model: SpringMassModel, node: Float[ndarray, "frame node 3"]
) -> list[tuple[ndarray, ndarray]]:
    """Give the equations of each frame: their rows, and their right sides [N·m]."""
    rod = model.rod
    if rod is None:
        raise ValueError("The model has no rod.")
    time = np.arange(len(node)) / problem.frame_rate
    motion = make_interp_spline(time, node, k=5)
    velocity, acceleration = motion(time, 1), motion(time, 2)
    acceleration[..., 2] += problem.gravity
    held = problem.control[: len(node), rod.held_by].astype(np.float64)
    edge, curvature, axes = _curved(node, held)
    change = make_interp_spline(time, curvature, k=3)(time, 1)
    length = rod.length[1:-1].astype(np.float64)[:, None]

    def about_axes(force: ndarray) -> Float[ndarray, "frame row"]:
        """Project the moments of a force in each edge on the vertices' axes."""
        moment = -np.cumsum(np.cross(edge, force), axis=1)[:, :-1]
        return np.einsum("fvc,fvac->fva", moment, axes).reshape(len(node), -1)

    def along(load: ndarray) -> ndarray:
        """Add up what acts on the nodes that are not held, from the first one on."""
        return np.cumsum(np.concatenate([0.0 * load[:, :1], load[:, 1:-1]], axis=1), axis=1)

    unit = np.eye(3)
    free = [about_axes(np.broadcast_to(each, edge.shape)) for each in unit]
    free += [axes[..., coordinate].reshape(len(node), -1) for coordinate in range(3)]
    columns = [
        (curvature / length).reshape(len(node), -1),
        (change / length).reshape(len(node), -1),
    ]
    columns.append(-about_axes(along(velocity)))
    rest = -np.eye(columns[0].shape[1])
    loads = about_axes(along(acceleration))
    equations = []
    for frame in range(EDGE_FRAMES, len(node) - EDGE_FRAMES):
        gripper = np.stack([each[frame] for each in free], axis=1)
        across = np.linalg.qr(gripper, mode="complete")[0][:, gripper.shape[1] :].T
        row = np.concatenate([np.stack([each[frame] for each in columns], axis=1), rest], axis=1)
        equations.append((across @ row, across @ loads[frame]))
    return equations


def _curved(
    node: Float[ndarray, "frame node 3"], held: Float[ndarray, "frame 3"]
) -> tuple[ndarray, ndarray, ndarray]:
    """Give the edges, and at the vertices between them curvatures and what they are moved by.

    Without twist, for that is how axes are carried; see `kernels.rod`.

    Returns:
        Edges [m] (frame edge 3), curvatures (frame vertex 2), and the vectors (frame vertex 2 3)
        whose products with the moment in the rope are the derivatives of the energy by these.
    """
    edge = np.diff(node, axis=1)
    tangent = edge / np.linalg.norm(edge, axis=2, keepdims=True)
    axis = parallel_transport(unit_across(held - node[:, 0], tangent[:, 0]), tangent)
    other = np.cross(tangent, axis)
    before, behind = tangent[:, :-1], tangent[:, 1:]
    chi = 1.0 + _dot(before, behind)
    binormal = 2.0 * np.cross(before, behind) / chi
    behind_axes = np.stack([other[:, 1:], -axis[:, 1:]], axis=2)
    axes = 0.5 * (np.stack([other[:, :-1], -axis[:, :-1]], axis=2) + behind_axes)
    # How the curvature changes as all behind a vertex is turned about it. A moment does work with
    # that; what it does with twist, about the mean tangent, drops out across it.
    slope = np.empty_like(axes)
    for coordinate, unit in enumerate(np.eye(3)):
        turned = np.cross(unit, behind)
        bent = (2.0 * np.cross(before, turned) - binormal * _dot(before, turned)) / chi
        own = np.einsum("fvc,fvac->fva", bent, axes)
        slope[..., coordinate] = (
            own + 0.5 * _dot(binormal[:, :, None], np.cross(unit, behind_axes))[..., 0]
        )
    work = np.einsum("fvbc,fvac->fvba", axes, slope)
    return edge, np.einsum("fvc,fvac->fva", binormal, axes), np.linalg.solve(work, axes)


def _dot(first: ndarray, second: ndarray) -> ndarray:
    return (first * second).sum(axis=-1, keepdims=True)
