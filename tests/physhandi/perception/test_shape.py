import numpy as np
import pytest
from scipy.spatial import cKDTree

from physhandi.data.observation import ObjectObservation
from physhandi.errors import MissingInputError
from physhandi.perception.lifting import observe_object
from physhandi.perception.shape import object_nodes, object_nodes_from_observation


def sheet(length: float, width: float, step: float = 0.004) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0, length, step), np.arange(0, width, step))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.concatenate([points[:, :2] @ rotation.T, points[:, 2:]], axis=1)


@pytest.mark.parametrize("degrees", [0.0, 17.0, 60.0])
def test_a_sheet_gets_one_layer_of_nodes_along_its_sides(degrees):
    cloud = turned(sheet(0.20, 0.14), degrees)
    node = object_nodes(cloud, 0.012)
    assert len(node) == 16 * 11  # 0.196 / 0.012 and 0.136 / 0.012, rounded.
    np.testing.assert_allclose(node[:, 2], 0.0, atol=1e-7)
    near = cKDTree(node).query(node, k=2)[0][:, 1]
    np.testing.assert_allclose(near, 0.012, atol=1e-6)
    reach = cKDTree(node).query(cloud)[0]
    assert reach.max() < 0.012


def test_the_same_cloud_gives_the_same_nodes_in_any_order():
    cloud = turned(sheet(0.20, 0.14), 5.0)
    shuffled = np.random.default_rng(0).permutation(cloud)
    np.testing.assert_allclose(object_nodes(cloud, 0.01), object_nodes(shuffled, 0.01), atol=1e-6)


def test_a_curved_sheet_keeps_its_height():
    cloud = sheet(0.20, 0.14)
    cloud[:, 2] = 0.01 * np.cos(cloud[:, 0] * np.pi / 0.2)
    node = object_nodes(cloud, 0.016)
    error = node[:, 2] - 0.01 * np.cos(node[:, 0] * np.pi / 0.2)
    assert np.abs(error).max() < 0.001
    assert np.ptp(node[:, 2]) > 0.015


def test_small_notches_are_closed_and_wide_ones_left_open():
    cloud = sheet(0.20, 0.14)
    notch = (cloud[:, 0] > 0.15) & (abs(cloud[:, 1] - 0.07) < 0.014)
    assert len(object_nodes(cloud[~notch], 0.012)) == 16 * 11
    wide = (cloud[:, 0] > 0.15) & (abs(cloud[:, 1] - 0.07) < 0.04)
    assert len(object_nodes(cloud[~wide], 0.012)) < 16 * 11 - 15


def test_the_part_below_the_hand_is_filled_and_only_that(held_plate):
    node = object_nodes_from_observation(observe_object(held_plate), 0.012, held_plate)
    under_hand = (node[:, 0] > 0.06) & (abs(node[:, 1]) < 0.025)
    assert under_hand.sum() >= 3 * 4
    assert node[:, 0].max() < 0.101
    assert abs(len(node) - (0.2 * 0.12) / 0.012**2) < 15
    np.testing.assert_allclose(node[:, 2], 0.0, atol=1e-4)


def test_a_view_that_sees_past_the_object_forbids_filling():
    cloud = sheet(0.20, 0.14)
    notch = (cloud[:, 0] > 0.15) & (abs(cloud[:, 1] - 0.07) < 0.014)
    seen = object_nodes(cloud[~notch], 0.012, is_hidden=lambda point: point[:, 0] < 0.15)
    whole = object_nodes(cloud[~notch], 0.012, is_hidden=lambda point: point[:, 0] > 0)
    assert len(whole) == 16 * 11
    assert len(whole) - 12 <= len(seen) < len(whole) - 4


def test_a_box_is_filled_down_to_the_ground_and_nodes_never_lie_below_it():
    top = sheet(0.10, 0.08, 0.003) + np.array([0, 0, 0.06])
    side = np.stack(
        [
            a.ravel()
            for a in np.meshgrid(np.arange(0, 0.1, 0.003), [0.0], np.arange(-0.002, 0.06, 0.003))
        ],
        1,
    )
    node = object_nodes(np.concatenate([top, side]), 0.01, ground_height=0.0)
    assert node[:, 2].min() >= 0
    middle = node[(abs(node[:, 0] - 0.05) < 0.006) & (abs(node[:, 1] - 0.04) < 0.006)]
    assert len(np.unique(np.round(middle[:, 2], 3))) >= 6
    assert 10 * 8 * 6 <= len(node) <= 11 * 9 * 8


def test_a_body_in_the_air_is_not_filled_to_the_ground():
    random = np.random.default_rng(1)
    direction = random.normal(size=(4000, 3))
    ball = 0.05 * direction / np.linalg.norm(direction, axis=1, keepdims=True) + [0, 0, 0.5]
    node = object_nodes(ball, 0.01, ground_height=0.0)
    assert node[:, 2].min() > 0.44
    assert (np.linalg.norm(node - [0, 0, 0.5], axis=1) < 0.02).sum() > 20


def test_an_empty_cloud_is_refused():
    nothing = ObjectObservation(
        point=np.zeros((1, 0, 3), np.float32),
        is_visible=np.zeros((1, 0), bool),
        is_motion_valid=np.zeros((1, 0), bool),
        cloud=(np.zeros((0, 3), np.float32),),
    )
    with pytest.raises(MissingInputError, match="first frame"):
        object_nodes_from_observation(nothing, 0.01)
    with pytest.raises(ValueError, match="spacing"):
        object_nodes(np.zeros((5, 3)), 0.0)
