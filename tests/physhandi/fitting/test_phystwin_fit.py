"""The whole of profile `phystwin` on a small recording: it learns which half is the soft one."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from physhandi import pipeline
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.fitting.artefacts import load_model, load_parameters
from physhandi.fitting.config import PipelineConfig, load_profile
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

FRAMES, FITTED = 9, 7
SIDE = np.arange(7) * 0.015
NODE = np.stack([*np.meshgrid(SIDE, SIDE[:3], indexing="ij"), np.full((7, 3), 0.3)], axis=-1)
NODE = NODE.reshape(-1, 3)
MIDDLE = 0.045
PROFILE = load_profile("phystwin")
TRUTH: SimulationParameters = PROFILE.simulation.replace(stiffness=500.0, virtual_stiffness=500.0)


def write_strip(folder: Path) -> Sequence:
    """A strip that hangs between two controllers which part; one half is six times softer."""
    ends = NODE[(NODE[:, 0] == SIDE[0]) | (NODE[:, 0] == SIDE[-1])]
    control_0 = ends + np.array([0.0, 0.0, 0.01])
    away = np.where(ends[:, :1] > MIDDLE, 1.0, -1.0) * [[0.03, 0.0, 0.0]]
    control = control_0 + np.linspace(0.0, 1.0, FRAMES)[:, None, None] * away
    model = build_model(NODE, control[0], TRUTH)
    is_object = np.arange(len(model.spring_nodes)) < model.object_spring_count
    middle = NODE[np.minimum(model.spring_nodes, len(NODE) - 1)].mean(axis=1)[:, 0]
    factor = np.where(middle < MIDDLE, 2.5, 0.4) * is_object + ~is_object
    model = replace(model, stiffness=(model.stiffness * factor).astype(np.float32))
    marker = Simulator(model, TRUTH).rollout(control).position
    marker[3, 4] = np.nan
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
            "control.npy": control.astype(np.float32),
            "marker.npy": marker,
            "marker_node.npy": np.arange(len(NODE), dtype=np.int32),
            "object_node.npy": NODE.astype(np.float32),
        },
    )


def tiny() -> PipelineConfig:
    """The profile with little effort; every other switch is as it ships."""
    object_ = PROFILE.object_
    search = object_.search.replace(generations=3)
    first_order = object_.first_order.replace(iterations=12, judged_every=5, learning_rate=0.02)
    object_ = object_.replace(search=search, first_order=first_order)
    simulation = PROFILE.simulation.replace(stiffness=2000.0, virtual_stiffness=2000.0)
    return PROFILE.replace(object_=object_, simulation=simulation)


@pytest.mark.slow
def test_a_fit_as_phystwin_tells_soft_from_stiff(tmp_path: Path) -> None:
    sequence = write_strip(tmp_path / "strip")
    run = Run.create(
        tmp_path / "fit",
        name="strip",
        kind="reconstruction",
        sequences=[str(sequence.folder)],
        config={"profile": tiny().to_dict()},
    )
    pipeline.run_job(run)
    fitted = Run.open(run.folder)
    assert fitted.state == "succeeded"
    losses = fitted.json("losses.json")
    for stage, most in ((pipeline.SEARCH, 0.7), (pipeline.SPRINGS, 0.2)):
        assert losses[stage]["after"] < most * losses[stage]["before"]
    parameters, model = load_parameters(fitted.out), load_model(fitted.out, "strip")
    assert parameters.dt == pytest.approx(5e-5)
    assert parameters.gravity == 9.8
    assert parameters.damping == int(parameters.damping)
    assert parameters.drag == int(parameters.drag)
    np.testing.assert_allclose(model.damping, parameters.damping, rtol=1e-5)
    assert not model.initial_velocity.any()

    ends = NODE[model.spring_nodes[: model.object_spring_count]]
    stiffness = model.stiffness[: model.object_spring_count]
    stiff, soft = (ends[..., 0] < MIDDLE).all(axis=1), (ends[..., 0] > MIDDLE).all(axis=1)
    assert stiff.sum() > 5 < soft.sum()
    assert np.median(stiffness[stiff]) > 1.5 * np.median(stiffness[soft])
