"""A fitted object in another recording: it lies as it is seen there, and rests if it rested."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.server.run_world import make_run

import physhandi as ph
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import RunError
from physhandi.fitted_object import FittedObject
from physhandi.fitting.config import load_profile
from physhandi.fitting.placement import settings_of_fit
from physhandi.progress import NullProgress
from physhandi.run import Run
from physhandi.simulation.simulator import Simulator

FRAMES = 4
STILL = 60
"""Frames that an object must lie still: two seconds."""


def waves(flat, shift):
    """Lay points of a plane on waves, 4 to 8 mm above the ground: a cloth, seen from above."""
    height = 0.006 + 0.002 * np.sin(70.0 * flat[:, 0] + shift) * np.cos(50.0 * flat[:, 1])
    return np.column_stack([flat[:, :2], height])


def write_cloth(
    folder: Path, *, shift: float, turn: float, ground: float, is_held: bool = True
) -> ph.Sequence:
    """Record a cloth of 16 by 12 cm that lies still; a point that rests holds its corner."""
    random = np.random.default_rng(3)
    flat = random.uniform([0.0, 0.0], [0.16, 0.12], (900, 2))
    cloth = waves(flat, shift) + random.normal(0.0, 2e-4, (900, 3))
    held = waves(np.array([[0.002, 0.002]]), shift) + np.array([0.0, 0.0, 0.004])
    turned = Rotation.from_euler("z", turn)
    point, hold = (turned.apply(part) + np.array([0.4, -0.1, ground]) for part in (cloth, held))
    hold[:, 2] += 0.0 if is_held else 1.0
    return write_sequence(
        folder,
        SequenceMeta(
            name=folder.name,
            frame_rate=30.0,
            frame_count=FRAMES,
            ground_height=ground,
            shape="sheet",
        ),
        {
            "control.npy": np.repeat(hold[None], FRAMES, axis=0).astype(np.float32),
            "marker.npy": np.repeat(point[None], FRAMES, axis=0).astype(np.float32),
            "marker_motion_valid.npy": np.repeat(
                (np.arange(FRAMES) > 0)[:, None], len(point), axis=1
            ),
        },
    )


def fit_cloth(folder: Path, recording: ph.Sequence, *, bends: bool) -> ph.Run:
    """Take the springs of the quick profile as they are; nothing is searched or optimised."""
    changes = {
        "node_spacing": 0.01,
        "object_.search.generations": 0,
        "object_.first_order.iterations": 0,
        "object_.bends_into_place": bends,
    }
    profile = load_profile("quick")
    return ph.reconstruct(recording, profile=profile, overrides=changes, out=folder)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, ph.Run]:
    folder = tmp_path_factory.mktemp("runs")
    cloth = write_cloth(folder / "cloth", shift=0.0, turn=0.0, ground=0.0)
    return {
        bends: fit_cloth(folder / f"bends_{bends}", cloth, bends=bends) for bends in (False, True)
    }


def moved(fitted: FittedObject) -> float:
    """Farthest that a node comes from where it begins while nothing touches the object [m]."""
    count = len(fitted.fitted.control[0])
    control = np.repeat(fitted.fitted.control[:1], STILL, axis=0).reshape(STILL, count, 3)
    rollout = Simulator(fitted.model, fitted.parameters).rollout(control)
    offset = rollout.position - fitted.model.object_node
    return float(np.linalg.norm(offset, axis=2).max())


def test_what_rests_in_one_recording_rests_in_another(runs, tmp_path) -> None:
    # Other waves: rigidly laid, nodes would be up to 4 mm below where they rest, and jump.
    recording = write_cloth(tmp_path / "other", shift=2.5, turn=3.3, ground=-0.25, is_held=False)
    placed = runs[True].object.placed_in(recording, NullProgress())
    assert placed.model.virtual_spring_count == 0
    assert moved(placed) < 5e-4


def test_a_bent_object_lies_where_it_is_seen_and_keeps_its_springs(runs, tmp_path) -> None:
    recording = write_cloth(tmp_path / "other", shift=2.5, turn=0.9, ground=0.3)
    fitted = runs[True].object
    placed = fitted.placed_in(recording, NullProgress())
    node = Rotation.from_euler("z", -0.9).apply(placed.model.object_node - [0.4, -0.1, 0.3])
    inner = (np.abs(node[:, :2] - [0.08, 0.06]) < [0.07, 0.05]).all(axis=1)
    assert inner.sum() > 60
    height = waves(node, 2.5)[:, 2]
    assert np.abs(node[:, 2] - waves(node, 0.0)[:, 2])[inner].mean() > 0.0009
    assert np.abs(node[:, 2] - height)[inner].mean() < 0.0005
    own = fitted.model.object_spring_count
    np.testing.assert_array_equal(placed.model.spring_nodes[:own], fitted.model.spring_nodes[:own])
    ends = placed.model.object_node[placed.model.spring_nodes[:own]].astype(np.float64)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    strain = length / placed.model.rest_length[:own] - 1.0
    assert np.abs(strain).max() < 0.01
    assert np.abs(length / fitted.model.rest_length[:own] - 1.0).mean() > 0.003
    assert placed.model.virtual_spring_count > 0


def test_without_bending_it_keeps_its_shape_and_rests_on_the_other_ground(runs, tmp_path) -> None:
    recording = write_cloth(tmp_path / "other", shift=0.0, turn=0.9, ground=0.3, is_held=False)
    fitted = runs[False].object
    placed = fitted.placed_in(recording, NullProgress())
    own = fitted.model.object_spring_count
    np.testing.assert_allclose(
        placed.model.rest_length[:own], fitted.model.rest_length[:own], rtol=1e-5
    )
    assert moved(placed) < 5e-4


def test_parameters_changed_afterwards_keep_the_lengths_of_the_bent_shape(runs, tmp_path) -> None:
    recording = write_cloth(tmp_path / "other", shift=2.5, turn=0.9, ground=0.3)
    placed = runs[True].object.placed_in(recording, NullProgress())
    changed = placed.changed({"virtual_connection_radius": 0.03}).model
    own = placed.model.object_spring_count
    assert changed.virtual_spring_count > placed.model.virtual_spring_count
    np.testing.assert_allclose(changed.rest_length[:own], placed.model.rest_length[:own], rtol=2e-5)


def test_the_settings_of_a_fit_are_found_through_its_simulations(tmp_path: Path) -> None:
    config = load_profile("quick")
    fit = make_run(tmp_path / "fit", config={"profile": config.to_dict()})
    again = make_run(tmp_path / "again", kind="simulation", config={"source": str(fit.folder)})
    third = make_run(tmp_path / "third", kind="simulation", config={"source": str(again.folder)})
    assert settings_of_fit(third) == config
    # A damaged description must not lead round and round.
    circle = {"source": str(third.folder)}
    job = yaml.safe_load((again.folder / "job.yaml").read_text()) | {"config": circle}
    (again.folder / "job.yaml").write_text(yaml.safe_dump(job))
    with pytest.raises(RunError, match="'third' simulates itself"):
        settings_of_fit(Run.open(third.folder))
    with pytest.raises(RunError, match=r"field 'config\.source' is missing"):
        settings_of_fit(make_run(tmp_path / "lost", kind="simulation", config={}))
