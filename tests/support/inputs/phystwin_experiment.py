"""What PhysTwin's optimisation would leave for the case of `phystwin_case`, made independently.

Springs are found by loops over sorted distances, as its specification tells, and the rollout is the
float64 oracle's.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from reference.spring_mass import Scene, simulate

from support.inputs.phystwin_case import Case, save_pickle

OPTIMUM: dict[str, Any] = {
    "global_spring_Y": np.float32(9000.0),
    "object_radius": np.float32(0.021),
    "object_max_neighbours": 7,
    "controller_radius": np.float32(0.019),
    "controller_max_neighbours": 5,
    "collide_elas": np.float32(0.4),
    "collide_fric": np.float32(0.25),
    "collide_object_elas": np.float32(0.6),
    "collide_object_fric": np.float32(0.35),
    "collision_dist": np.float32(0.011),
    "drag_damping": np.float32(2.99),
    "dashpot_damping": np.float32(83.97),
}
CONTACT = {
    "collide_elas": -0.0047,
    "collide_fric": 2.0026,
    "collide_object_elas": 0.7,
    "collide_object_fric": 0.3,
}
UP = np.array([1.0, -1.0, -1.0])


@dataclass
class Experiment:
    """Files of an experiment, and what they mean."""

    optimum: Path
    checkpoint: Path
    inference: Path
    springs: list[tuple[int, int]]
    object_count: int
    stiffness: np.ndarray
    position: np.ndarray  # (frame, node, 3), z up


def find_springs(
    node: np.ndarray, control: np.ndarray, optimum: dict[str, Any]
) -> tuple[list[tuple[int, int]], int]:
    """Find springs as PhysTwin does, by plain loops; also tell how many join object nodes."""
    springs: list[tuple[int, int]] = []
    known: set[frozenset[int]] = set()
    for i in range(len(node)):
        for j in _hits(node, node[i], optimum["object_max_neighbours"], optimum["object_radius"])[
            1:
        ]:
            pair = frozenset((i, j))
            if pair not in known and np.linalg.norm(node[i] - node[j]) > 1e-4:
                known.add(pair)
                springs.append((i, j))
    object_count = len(springs)
    for c, point in enumerate(control):
        most, radius = optimum["controller_max_neighbours"], optimum["controller_radius"]
        springs.extend((len(node) + c, j) for j in _hits(node, point, most, radius))
    return springs, object_count


def _hits(node: np.ndarray, point: np.ndarray, most: int, radius: float) -> list[int]:
    distance = np.sqrt(((node - point) ** 2).sum(axis=1))
    nearest = sorted(range(len(node)), key=lambda j: distance[j])[:most]
    return [j for j in nearest if distance[j] < float(radius)]


def write_experiment(case: Case, folder: Path) -> Experiment:
    """Write search result, checkpoint and rollout of a case whose z axis points down."""
    folder.mkdir(parents=True)
    node = (case.node * UP).astype(np.float32).astype(float)
    control = (case.control * UP).astype(np.float32).astype(float)
    springs, object_count = find_springs(node, control[0], OPTIMUM)
    rng = np.random.default_rng(11)
    stiffness = np.exp(rng.uniform(np.log(2e3), np.log(6e4), len(springs))).astype(np.float32)
    stiffness[3], stiffness[object_count + 1] = 1.4e5, 0.0
    ends = np.vstack([node, control[0]])
    pair = np.array(springs)
    dashpot = float(int(OPTIMUM["dashpot_damping"]))
    scene = Scene(
        node=node,
        velocity=np.zeros_like(node),
        springs=pair,
        rest=np.linalg.norm(ends[pair[:, 1]] - ends[pair[:, 0]], axis=1),
        stiffness=np.minimum(stiffness, 1e5).astype(float),
        damping=np.where(stiffness > 0, dashpot, 0.0),
        control=control,
        drag=float(int(OPTIMUM["drag_damping"])),
        restitution=0.0,
        friction=2.0,
        gravity=9.8,
        frame_rate=1 / (667 * 5e-5),
        moves=False,
    )
    position = simulate(scene)[0]
    experiment = Experiment(
        optimum=folder / "optimal_params.pkl",
        checkpoint=folder / "best_120.pth",
        inference=folder / "inference.pkl",
        springs=springs,
        object_count=object_count,
        stiffness=stiffness,
        position=position,
    )
    save_pickle(experiment.optimum, OPTIMUM)
    save_checkpoint(experiment, stiffness)
    save_pickle(experiment.inference, (position * UP).astype(np.float32))
    return experiment


def save_checkpoint(experiment: Experiment, stiffness: np.ndarray, **fields: Any) -> None:
    """Write a checkpoint with other stiffnesses, or other fields."""
    table: dict[str, Any] = {
        "epoch": 120,
        "num_object_springs": experiment.object_count,
        "spring_Y": torch.from_numpy(np.asarray(stiffness)),
        **{field: torch.tensor([value]) for field, value in CONTACT.items()},
        "optimizer_state_dict": {"state": {0: {"step": torch.tensor(3.0)}}, "param_groups": [{}]},
    }
    torch.save(table | fields, experiment.checkpoint)
