"""A small recording for tests: markers on a simulated sheet that two point controllers lift."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.fitting.config import PipelineConfig, SearchVariable, load_profile
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

FRAMES = 10
FITTED = 7
AXIS = np.arange(5) * 0.05
NODE = np.stack([*np.meshgrid(AXIS, AXIS, indexing="ij"), np.full((5, 5), 0.2)], -1).reshape(-1, 3)
_CORNER = (np.arange(4)[:, None] * 5 + np.arange(4)).reshape(-1, 1)
FACES = np.concatenate([_CORNER + np.array(offset) for offset in ((0, 1, 5), (1, 6, 5))])
"""Triangles of the sheet's nodes."""
TRUTH = SimulationParameters(
    connection_radius=0.08,
    max_neighbors=8,
    virtual_connection_radius=0.02,
    virtual_max_neighbors=1,
    stiffness=400.0,
    virtual_stiffness=2000.0,
    damping=4.0,
    drag=1.0,
    ground_height=0.0,
    substeps_per_frame=60,
)


def write_sheet(folder: Path, *, lift: float = 0.15) -> Sequence:
    """Simulate the sheet and write its markers as a sequence."""
    corner = NODE[[0, 4]] + [0.0, 0.0, 0.005]
    rise = np.linspace(0, 1, FRAMES)[:, None, None] * np.array([0.05, 0.0, lift])
    control = (corner[None] + rise).astype(np.float32)
    model = build_model(NODE, control[0], TRUTH)
    softer = np.where(NODE[model.spring_nodes[:, 0], 0] < 0.1, 2.0, 0.7) * model.stiffness
    model = replace(model, stiffness=softer.astype(np.float32))
    marker = Simulator(model, TRUTH).rollout(control).position
    return write_sequence(
        folder,
        SequenceMeta(
            name=folder.name,
            frame_rate=30.0,
            frame_count=FRAMES,
            ground_height=0.0,
            reconstruction=FITTED,
        ),
        {
            "control.npy": control,
            "marker.npy": marker,
            "marker_node.npy": np.arange(len(NODE), dtype=np.int32),
            "object_node.npy": NODE.astype(np.float32),
            "rest_node.npy": NODE.astype(np.float32),
        },
    )


def sheet_config(*, generations: int, population: int, iterations: int) -> PipelineConfig:
    """The quick profile, searched where the sheet has springs and with the given effort."""
    config = load_profile("quick")
    soft = SearchVariable(low=50.0, high=3e4, scale="log")
    # Two corners hold it in the air: few candidates are better spent on springs than on friction.
    variables = config.object_.search.variables | {
        "connection_radius": SearchVariable(low=0.06, high=0.12),
        "virtual_connection_radius": SearchVariable(low=0.01, high=0.04),
        "stiffness": soft,
        "virtual_stiffness": soft,
    }
    del variables["friction"]
    search = config.object_.search.replace(
        generations=generations,
        population=population,
        variables=variables,
        reference_spacing=None,
        reference_length=None,
        widening_generations=0,
    )
    first_order = config.object_.first_order.replace(iterations=iterations)
    simulation = config.simulation.replace(connection_radius=0.08, virtual_connection_radius=0.02)
    object_ = config.object_.replace(search=search, first_order=first_order)
    # It begins to be lifted half a second before: what it bore until then says nothing of now.
    prediction = config.prediction.replace(strain_time=0.0)
    return config.replace(object_=object_, simulation=simulation, prediction=prediction)
