"""Scenes of the viewer's benchmark: a heavy scene, and a folder with many runs."""

import shutil
from pathlib import Path
from typing import Literal

import numpy as np
from numpy import ndarray

from physhandi.data.layout import MATERIAL_FILE, METRICS_FILE, PARAMETERS_FILE, SequenceFiles
from physhandi.hand.loading import load_hand_model
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import build_model

HEAVY = "heavy_scene"
"""Id of the heavy run and name of its sequence."""
HEAVY_NODES = 3000
"""Object nodes of the heavy run."""
HEAVY_ARROWS = 300
"""Object nodes of the heavy run that a hand pulls."""
HEAVY_FRAMES = 60
_SHAPE = (30, 10, 10)
_SPACING = 0.006
_SWING = 0.05
_HANDS: tuple[tuple[Literal["right", "left"], float], ...] = (
    ("right", -0.05),
    ("left", 0.05 + _SPACING * _SHAPE[0]),
)


def make_heavy_run(folder: Path) -> Run:
    """Write a run with two hands and a block of 3,000 nodes, of which 300 are pulled.

    One control node stands above each node of the block's top. They swing, the block follows
    half as far, so that from frame 1 on each of its top nodes feels a force.

    Args:
        folder: Where runs are; the run's own folder is made in it.

    Returns:
        The run, finished.
    """
    rest = np.stack(np.meshgrid(*(np.arange(n) for n in _SHAPE), indexing="ij"), axis=-1)
    node = (_SPACING * rest.reshape(-1, 3)).astype(np.float32)
    above = np.array([0.0, 0.0, 0.3 * _SPACING], dtype=np.float32)
    top = node[node[:, 2] == node[:, 2].max()] + above
    parameters = SimulationParameters(
        connection_radius=1.8 * _SPACING,
        max_neighbors=9,
        virtual_connection_radius=0.5 * _SPACING,
        virtual_max_neighbors=1,
        stiffness=100.0,
        virtual_stiffness=100.0,
        substeps_per_frame=200,
    )
    model = build_model(node, top, parameters)
    swing = _SWING * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, HEAVY_FRAMES)))
    way = swing[:, None, None] * np.array([1.0, 0.0, 0.5])
    run = Run.create(
        folder / HEAVY, name="Heavy scene", kind="reconstruction", sequences=[HEAVY], config={}
    )
    with run.begin_attempt() as attempt:
        files = SequenceFiles(HEAVY)
        attempt.save_yaml(PARAMETERS_FILE, parameters.to_dict())
        attempt.save_tensors(MATERIAL_FILE, {"rest_node": node})
        attempt.save_array(files.rollout, (node + 0.5 * way).astype(np.float32))
        attempt.save_array(files.control, (top + way).astype(np.float32))
        attempt.save_tensors(files.model, model.to_tensors())
        for side, offset in _HANDS:
            vertex, face = _hand(side, offset)
            attempt.save_array(files.hand_vertex(side), vertex + way)
            attempt.save_array(files.hand_face(side), face)
        about = {"frame_rate": 30.0, "frame_count": HEAVY_FRAMES, "ground_height": 0.0}
        attempt.save_yaml(files.meta, about)
        attempt.publish()
    return Run.open(run.folder)


def make_many_runs(folder: Path, count: int) -> None:
    """Write a number of small finished runs.

    Args:
        folder: Where runs are.
        count: How many.
    """
    first = Run.create(
        folder / "many_0000", name="Run 0", kind="reconstruction", sequences=["cloth"], config={}
    )
    with first.begin_attempt() as attempt:
        attempt.save_yaml(PARAMETERS_FILE, SimulationParameters().to_dict())
        attempt.save_json(METRICS_FILE, {"cloth": {"track_error": 0.004}})
        attempt.finish_stage("first_order", {"before": 2.0, "after": 0.5, "curve": [[0, 2.0]]})
        attempt.publish()
    about = (first.folder / "run.yaml").read_text()
    for number in range(1, count):
        copied = folder / f"many_{number:04d}"
        shutil.copytree(first.folder, copied)
        (copied / "run.yaml").write_text(about.replace("Run 0", f"Run {number}"))


def _hand(side: Literal["right", "left"], offset: float) -> tuple[ndarray, ndarray]:
    """Place a hand beside the block; gives its vertices and triangles."""
    hand = load_hand_model(side)
    place = np.array([offset, 0.03, 0.1]) - hand.template.mean(axis=0)
    return (hand.template + place).astype(np.float32)[None], np.asarray(hand.faces, np.int32)
