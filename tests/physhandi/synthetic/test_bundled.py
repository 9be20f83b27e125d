from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial import cKDTree
from support.inputs.bundled_sequence import Recipe, Truth, generate_bundled, make_truth

from physhandi.data.observation import ObjectObservation
from physhandi.data.sequence import Sequence
from physhandi.data.truth import read_truth
from physhandi.errors import CancelledError, SequenceError
from physhandi.perception.lifting import hand_points, observe_object
from physhandi.perception.shape import shape_of_observation
from physhandi.progress import Progress
from physhandi.simulation.parameters import PARAMETERS
from physhandi.simulation.topology import virtual_springs

SMALL = Recipe(
    frame_count=5,
    size=(120, 90),
    focal_length=146.0,
    spacing=0.010,
    substeps_per_frame=667,
    track_count=60,
)
BUNDLED = Path(__file__).parents[3] / "sequences" / "towel_fold"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return generate_bundled(tmp_path_factory.mktemp("synthetic") / "small", seed=5, recipe=SMALL)


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """The same sequence, made again with its truth."""
    folder = tmp_path_factory.mktemp("told") / "small"
    return generate_bundled(folder, seed=5, recipe=SMALL, tells_truth=True)


@pytest.fixture(scope="module")
def truth() -> Truth:
    return make_truth(5, SMALL)


@pytest.fixture(scope="module")
def bundled() -> Sequence:
    return Sequence.load(BUNDLED)


@pytest.fixture(scope="module")
def seen(bundled: Sequence) -> ObjectObservation:
    """What the bundled sequence shows of the towel."""
    return observe_object(bundled)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_small_sequence_is_whole_and_says_where_it_comes_from(small):
    small.validate()
    assert small.missing("color", "depth", "mask", "keypoint", "track", "hands") == []
    assert small.label == "simulated by this project"
    assert len(small.reconstruction_frames) == 4
    for view in small.views:
        assert view.keypoint is not None
        assert view.keypoint.shape == (5, 1, 21, 3)
        labels = np.unique(view.mask(0)).tolist()
        assert labels == [0, 1, 2]
        assert 30 <= view.track.shape[1] <= 60


def test_the_same_seed_gives_the_same_bytes_and_another_one_does_not(small, told, truth):
    again = {name: c for name, c in contents(told.folder).items() if not name.startswith("truth/")}
    assert again == contents(small.folder)
    other = make_truth(6, replace(SMALL, frame_count=2))
    assert not np.array_equal(other.model.stiffness, truth.model.stiffness)


@pytest.mark.parametrize("which", ["small", "bundled"])
def test_the_folder_keeps_the_makers_numbers_to_itself(which, request):
    sequence: Sequence = request.getfixturevalue(which)
    names = set(PARAMETERS) - {
        "ground_height",
        "gravity",
        "frame_rate",
    }
    content = (sequence.folder / "sequence.yaml").read_text()
    assert not [name for name in names if name in content]
    assert "seed" not in content
    assert set(yaml.safe_load(content)["provenance"]) == {"origin", "license", "note"}
    kinds = {path.name for path in sequence.folder.rglob("*.npy")}
    assert kinds == {"keypoint.npy", "track.npy", "track_visible.npy"}
    assert sequence.object_node is None
    assert sequence.control is None


def test_the_truth_is_told_on_request(small, told, truth):
    extra = {name for name in contents(told.folder) if name not in contents(small.folder)}
    assert {name.split("/")[0] for name in extra} == {"truth"}
    known = read_truth(told.folder)
    np.testing.assert_array_equal(known.hand_vertex["right"], truth.control.astype(np.float32))
    view = told.views[0]
    pixel = view.camera.project(known.hand_keypoint["right"].astype(np.float64))
    assert np.nanmedian(np.linalg.norm(view.keypoint[:, 0, :, :2] - pixel, axis=-1)) < 3.0
    # The hand moves by more than its keypoints err.
    assert np.median(np.linalg.norm(pixel[-1] - pixel[0], axis=-1)) > 8.0
    assert known.contact is not None
    assert known.contact_point is not None
    assert known.contact.shape == (5, len(truth.sheet.node))
    distance = cKDTree(truth.control[0]).query(known.contact_point)[0]
    # The generator joins up to four nodes nearer than 9 mm to each of the hand's vertices.
    assert distance[known.contact[0]].max() < 0.009
    assert known.contact[0].sum() > 0.8 * (distance < 0.006).sum() > 5


def test_what_is_lifted_lies_on_what_was_simulated(small, truth):
    observation = observe_object(small)
    for frame in (0, 4):
        face = truth.sheet.faces
        corner = truth.position[frame][face]
        surface = np.concatenate([corner.mean(axis=1), corner.reshape(-1, 3)])
        distance = cKDTree(surface).query(observation.cloud[frame])[0]
        assert np.median(distance) < 0.003
        assert np.percentile(distance, 95) < 0.006
        hand = cKDTree(truth.control[frame]).query(hand_points(small)[0][frame])[0]
        assert np.percentile(hand, 95) < 0.008


def test_the_bundled_sequence_is_small_valid_and_complete(bundled):
    bundled.validate()
    assert (bundled.frame_count, bundled.frame_rate) == (60, 30.0)
    assert sum(path.stat().st_size for path in BUNDLED.rglob("*") if path.is_file()) <= 2.5e6


def test_the_fit_can_touch_the_bundled_towel_where_the_hand_hides_it(bundled, seen):
    truth = make_truth(recipe=Recipe(frame_count=2))
    node = shape_of_observation(seen, 0.012, bundled).node
    assert 180 <= len(node) <= 225
    held = truth.sheet.node[cKDTree(truth.control[0]).query(truth.sheet.node)[0] < 0.008]
    assert len(held) > 20
    assert cKDTree(node).query(held)[0].max() < 0.009
    beyond = np.maximum(np.abs(node[:, :2]) - [0.10, 0.07], 0).max()
    assert beyond < 0.004
    springs, _ = virtual_springs(truth.control[0], node, 0.010, 6)
    assert len(springs) > 80


@pytest.mark.slow
def test_the_bundled_sequence_is_what_the_generator_makes_today(seen):
    truth = make_truth()
    for frame in (30, 59):
        corner = truth.position[frame][truth.sheet.faces]
        surface = np.concatenate([corner.mean(axis=1), corner.reshape(-1, 3)])
        assert np.median(cKDTree(surface).query(seen.cloud[frame])[0]) < 0.0025
    lift = truth.position[:, :, 2].max()
    assert 0.07 < lift < 0.12


class StopsAt(Progress):
    def __init__(self, limit: int) -> None:
        self.count, self.limit = 0, limit

    def report(self, *_told: Any, **_more: Any) -> None:
        self.count += 1

    def check_cancelled(self) -> None:
        if self.count >= self.limit:
            raise CancelledError("stopped")


def test_stopping_leaves_nothing_behind(tmp_path):
    with pytest.raises(CancelledError):
        generate_bundled(tmp_path / "half", recipe=SMALL, progress=StopsAt(3))
    assert list(tmp_path.iterdir()) == []


def test_a_sequence_that_is_there_is_kept(small):
    with pytest.raises(SequenceError, match="exists already"):
        generate_bundled(small.folder, recipe=SMALL)
