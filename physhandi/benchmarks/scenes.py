"""Scenes of the benchmarks: synthetic blocks of any size, and objects read from a file."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy import ndarray
from scipy.spatial import KDTree

from physhandi.errors import UsageError
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import build_model

SPRINGS_AT_NODE = 18
"""Springs that end at a node of a made-up block on average; each ends at two nodes."""
SUBSTEPS = 667
"""Substeps of PhysTwin and of all benchmarks that compare with it."""
_SPACING = 0.01
_JITTER = 0.1
_LIFT = 2e-3
_ARRAYS = ("position", "spring_nodes", "rest_length", "stiffness")


@dataclass(frozen=True, kw_only=True)
class BenchmarkScene:
    """An object with its springs, parameters and control trajectory."""

    name: str
    """Name of the scene."""
    model: SpringMassModel
    """Springs and nodes; one damping for all springs, which the baseline needs."""
    parameters: SimulationParameters
    """Simulation parameters; without control velocity, which the baseline lacks."""
    control: Float32[ndarray, "frame control 3"]
    """Positions of the control nodes [m]."""

    @property
    def frame_count(self) -> int:
        """Simulated frames; frame 0 is given."""
        return len(self.control) - 1


def synthetic_block(
    node_count: int,
    *,
    frame_count: int,
    springs_at_node: int = SPRINGS_AT_NODE,
    substeps_per_frame: int = SUBSTEPS,
) -> BenchmarkScene:
    """Build a block of nodes on the ground whose top is pulled up by nine control nodes.

    The nodes lie on a cubic lattice of 10 mm, moved by up to 1 mm, and the connection radius is
    chosen to give the wanted number of springs.

    Args:
        node_count: Object nodes, exactly.
        frame_count: Frames to simulate.
        springs_at_node: Springs that end at a node on average.
        substeps_per_frame: Integration steps in a frame.

    Raises:
        UsageError: If a number is not positive.
    """
    check_positive(nodes=node_count, frames=frame_count, substeps=substeps_per_frame)
    check_positive(springs_at_node=springs_at_node)
    side = math.ceil(node_count ** (1 / 3) - 1e-9)
    cell = np.stack(np.unravel_index(np.arange(node_count), (side, side, side)), axis=1)
    node = _SPACING * cell[:, ::-1].astype(np.float64)
    node += np.random.default_rng(0).uniform(-_JITTER, _JITTER, node.shape) * _SPACING
    node[:, 2] -= node[:, 2].min()
    top = node[node[:, 2] > node[:, 2].max() - _SPACING]
    control = top[np.linspace(0, len(top) - 1, min(9, len(top))).astype(int)]
    control = control + np.array([0.0, 0.0, 0.4 * _SPACING])
    parameters = _parameters(
        substeps_per_frame,
        connection_radius=radius_for(node, round(node_count * springs_at_node / 2)),
        max_neighbors=min(1000, 4 * springs_at_node),
    )
    return BenchmarkScene(
        name=f"block of {node_count} nodes",
        model=build_model(node, control, parameters),
        parameters=parameters,
        control=lifted(control, frame_count),
    )


def recorded_object(
    path: Path, *, frame_count: int, substeps_per_frame: int = SUBSTEPS
) -> BenchmarkScene:
    """Read springs from a file, floor their rest length at 1 mm, and hold the 30 highest nodes.

    Args:
        path: An `.npz` with `position`, `spring_nodes`, `rest_length` and `stiffness`.
        frame_count: Frames to simulate.
        substeps_per_frame: Integration steps in a frame.

    Raises:
        UsageError: If a number is not positive, or the file is missing or incomplete.
    """
    check_positive(frames=frame_count, substeps=substeps_per_frame)
    if not path.is_file():
        raise UsageError(f"There is no object file {path} to measure.")
    with np.load(path, allow_pickle=False) as data:
        missing = [name for name in _ARRAYS if name not in data]
        if missing:
            raise UsageError(f"{path} lacks the arrays {', '.join(missing)}.")
        node, springs, rest_length, stiffness = (np.asarray(data[name]) for name in _ARRAYS)
    node = (node - [0.0, 0.0, node[:, 2].min()]).astype(np.float32)
    highest = np.argsort(node[:, 2], kind="stable")[-30:]
    control = node[highest] + np.array([0.0, 0.0, 0.01])
    parameters = _parameters(
        substeps_per_frame,
        connection_radius=radius_for(node, len(springs)),
        max_neighbors=1000,
        damping=100.0,
        virtual_connection_radius=0.04,
        virtual_max_neighbors=50,
    )
    virtual = build_model(node, control, parameters.replace(max_neighbors=0))
    count = virtual.virtual_spring_count
    floor = np.float32(parameters.rest_length_floor)
    soft = np.full(count, np.median(stiffness), dtype=np.float32)
    model = SpringMassModel(
        object_node=node,
        initial_velocity=virtual.initial_velocity,
        spring_nodes=np.concatenate([springs.astype(np.int32), virtual.spring_nodes]),
        rest_length=np.concatenate([np.maximum(rest_length, floor), virtual.rest_length]),
        stiffness=np.concatenate([stiffness.astype(np.float32), soft]),
        damping=np.full(len(springs) + count, parameters.damping, dtype=np.float32),
        object_spring_count=len(springs),
        control_count=len(control),
    )
    path_of_control = lifted(control, frame_count)
    return BenchmarkScene(
        name=path.stem, model=model, parameters=parameters, control=path_of_control
    )


def scene_of(
    topology: str | Path | None,
    node_count: int,
    frame_count: int,
    substeps_per_frame: int = SUBSTEPS,
) -> BenchmarkScene:
    """Read the object of a file if one is given, else build a block."""
    if topology is None:
        return synthetic_block(
            node_count, frame_count=frame_count, substeps_per_frame=substeps_per_frame
        )
    return recorded_object(
        Path(topology), frame_count=frame_count, substeps_per_frame=substeps_per_frame
    )


def radius_for(node: ndarray, spring_count: int) -> float:
    """Find the connection radius that joins this many pairs of nodes [m]."""
    pair_count = len(node) * (len(node) - 1) // 2
    spring_count = min(spring_count, pair_count)
    if spring_count == 0:
        return 0.0
    tree = KDTree(node)
    radius = _SPACING
    while (count := tree.count_neighbors(tree, radius) - len(node)) < 2 * spring_count:
        radius *= 1.3 if count else 2.0
    pair = tree.query_pairs(radius, output_type="ndarray")
    length = np.linalg.norm(node[pair[:, 0]] - node[pair[:, 1]], axis=1)
    return float(np.partition(length, spring_count - 1)[spring_count - 1]) + 1e-9


def lifted(
    control: Float32[ndarray, "control 3"], frame_count: int
) -> Float32[ndarray, "frame control 3"]:
    """Let control nodes rise by 2 mm a frame."""
    rise = _LIFT * np.arange(frame_count + 1)[:, None, None] * np.array([0.0, 0.0, 1.0])
    return (control + rise).astype(np.float32)


def check_positive(**numbers: float) -> None:
    """Raise `UsageError` for a number that is not positive, by its name."""
    for name, value in numbers.items():
        if value <= 0:
            raise UsageError(f"{name} of a benchmark is {value}; expected a positive number.")


def _parameters(substeps_per_frame: int, **changes: float) -> SimulationParameters:
    values = {"stiffness": 1e3, "virtual_stiffness": 1e3, "damping": 10.0} | changes
    return SimulationParameters.from_dict(
        values | {"use_control_velocity": False, "substeps_per_frame": substeps_per_frame}
    )
