import numpy as np
import pytest
from scipy.spatial import cKDTree

from physhandi.hand.loading import load_hand_model
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import build_model
from physhandi.synthetic.bodies.sheets import (
    FINGERTIP_KEYPOINTS,
    fold_motion,
    make_sheet,
    minimum_jerk,
    uneven_material,
)


def rng() -> np.random.Generator:
    return np.random.default_rng(11)


def test_minimum_jerk_starts_and_ends_at_rest():
    time = np.linspace(0, 1, 1001)
    move = minimum_jerk(time, 0.2, 0.7)
    assert move[200] == 0
    assert move[450] == pytest.approx(0.5)
    assert move[700] == 1
    speed = np.gradient(move, time)
    assert speed[200] == pytest.approx(0, abs=1e-3)
    assert speed.max() == pytest.approx(1.875 / 0.5, rel=1e-3)


def test_a_sheet_covers_its_rectangle_and_all_triangles_face_up():
    sheet = make_sheet(0.20, 0.14, 0.008, rng())
    assert len(sheet.node) == 26 * 19
    np.testing.assert_allclose(np.ptp(sheet.node, axis=0), [0.20, 0.14, 0], atol=1e-12)
    a, b, c = (sheet.node[sheet.faces[:, corner]] for corner in range(3))
    doubled = np.cross(b - a, c - a)[:, 2]
    assert (doubled > 0).all()
    assert doubled.sum() / 2 == pytest.approx(0.20 * 0.14)
    nearest = cKDTree(sheet.node).query(sheet.node, k=2)[0][:, 1]
    assert 0.004 < nearest.min() < 0.0075


def test_stiffness_varies_in_patches_and_only_inside_the_object():
    node = make_sheet(0.20, 0.14, 0.01, rng()).node.astype(np.float32)
    parameters = SimulationParameters(connection_radius=0.025)
    hand = node[:3] + np.float32(0.004)
    even = build_model(node, hand, parameters)
    uneven = uneven_material(even, rng())
    count = even.object_spring_count
    assert even.virtual_spring_count > 0
    ratio = np.log(uneven.stiffness / even.stiffness)
    assert 0.2 < ratio[:count].std() < 0.5
    assert (ratio[count:] == 0).all()
    middle = node[even.spring_nodes[:count]].mean(axis=1)
    neighbour = cKDTree(middle).query(middle, k=2)[1][:, 1]
    assert np.corrcoef(ratio[:count], ratio[neighbour])[0, 1] > 0.8


def test_the_hand_touches_pinches_lifts_and_travels():
    hand = load_hand_model("right")
    motion = fold_motion(hand, 60, 30.0, rng())
    vertex, tip = motion.vertices(hand), motion.keypoints(hand)[:, FINGERTIP_KEYPOINTS]
    assert abs(vertex[0, :, 2].min()) < 0.0015
    middle = tip.mean(axis=1)
    rise = middle[:, 2] - middle[0, 2]
    assert rise.max() == pytest.approx(0.085, abs=0.005)
    assert 0.05 < rise[-1] < 0.08
    travel = 0.085 * (1 - np.cos(2.15))
    assert middle[-1, 0] - middle[0, 0] == pytest.approx(travel, abs=0.01)
    gap = np.linalg.norm(tip[:, 0] - tip[:, 1], axis=1)
    assert gap[0] - gap[20] > 0.005
    speed = np.linalg.norm(np.diff(vertex, axis=0), axis=-1) * 30.0
    assert speed.max() < 0.6
