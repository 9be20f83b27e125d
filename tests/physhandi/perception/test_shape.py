"""Which kind of object a cloud shows, what of it is the object, and its nodes."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from support.inputs import made_clouds as made

from physhandi.data.observation import ObjectObservation
from physhandi.data.sequence import Sequence
from physhandi.errors import FitError, MissingInputError
from physhandi.perception.lifting import observe_object
from physhandi.perception.shape import (
    ObjectShape,
    object_shape,
    shape_of_nodes,
    shape_of_observation,
)
from physhandi.perception.shape_class import links

SPACING = 0.011
CLOUDS = {
    "flat sheet": (made.flat(0.30, 0.20), "sheet"),
    "hanging sheet": (made.hanging(0.066, size=(0.25, 0.3)), "sheet"),
    "draped arc": (made.arc(0.09, 0.20), "sheet"),
    "folded sheet": (made.folded(0.03), "sheet"),
    "sheet folded flat": (made.folded(0.004, height=0.002), "sheet"),
    "leaning sheet": (made.leaning(), "sheet"),
    "sheet that hangs to the ground": (
        made.hanging(0.066, size=(0.25, 0.2), height=0.01),
        "sheet",
    ),
    "sheet with a lifted corner": (made.lifted_corner(), "sheet"),
    "strip": (made.flat(0.30, 0.04), "sheet"),
    "bent rope": (made.rope(0.006), "rope"),
    "rope in the air": (made.rope(0.006, height=0.3), "rope"),
    "hose": (made.rope(0.015, bend=0.2), "rope"),
    "box": (made.box((0.10, 0.08, 0.06)), "solid"),
    "ball on the ground": (made.ellipsoid((0.05,) * 3, 0.05, lowest=-0.6), "solid"),
    "pouch": (made.ellipsoid((0.10, 0.07, 0.025), 0.025, lowest=-0.1), "solid"),
    "hollow sphere": (made.ellipsoid((0.05,) * 3, 0.5), "shell"),
    "pouch in the air": (made.ellipsoid((0.10, 0.07, 0.025), 0.3), "shell"),
}
# Sheets and shells: area over the square of the distance. Solids: volume over its cube. Ropes:
# a handful of nodes about each distance along them.
NODES = {
    "flat sheet": (440, 520),
    "hanging sheet": (620, 950),
    "draped arc": (430, 620),
    "folded sheet": (520, 760),
    "bent rope": (90, 260),
    "box": (500, 900),
    "pouch": (450, 1000),
    "hollow sphere": (230, 340),
}


@cache
def shape_of(name: str, spacing: float = SPACING) -> ObjectShape:
    return object_shape(made.noisy(CLOUDS[name][0]), spacing, ground_height=0.0)


AT_WIDER_SPACING = (
    *("hanging sheet", "folded sheet", "sheet that hangs to the ground", "strip"),
    *("bent rope", "hose", "box", "pouch", "hollow sphere", "pouch in the air"),
)
"""What is nearest to another class, and one of each."""


@pytest.mark.parametrize(
    ("name", "spacing"),
    [*((name, SPACING) for name in CLOUDS), *((name, 0.016) for name in AT_WIDER_SPACING)],
)
def test_a_cloud_gets_its_class_whatever_the_spacing(name, spacing):
    found = shape_of(name, spacing)
    assert found.kind == CLOUDS[name][1], found.reason
    assert not found.is_given
    assert found.removed == ()


@pytest.mark.parametrize("name", NODES)
def test_nodes_cover_what_was_seen_and_hang_together(name):
    cloud = made.noisy(CLOUDS[name][0])
    shape = shape_of(name)
    least, most = NODES[name]
    assert least <= len(shape.node) <= most
    if shape.kind != "solid":
        assert cKDTree(cloud).query(shape.node)[0].max() < SPACING
    assert cKDTree(shape.node).query(cloud)[0].max() < 1.2 * SPACING
    graph = links(shape.node.astype(np.float64), 2 * SPACING)
    assert connected_components(graph, directed=False)[0] == 1
    degree = np.bincount(graph.coords[0], minlength=len(shape.node))
    degree += np.bincount(graph.coords[1], minlength=len(shape.node))
    assert degree.min() >= 2


def test_nodes_of_a_solid_lie_in_it_and_fill_it():
    node = shape_of("box").node
    # Half a cell beside the walls, whose points deviate too.
    assert (np.abs(node) <= np.array([0.05, 0.04, 0.06]) + 0.008).all()
    assert node[:, 2].min() >= 0
    middle = node[(np.abs(node[:, :2]) < 0.02).all(axis=1)]
    assert np.ptp(middle[:, 2]) > 0.045
    empty = shape_of("hollow sphere").node
    assert np.linalg.norm(empty - [0, 0, 0.5], axis=1).min() > 0.046


def test_the_thickness_is_that_of_the_object():
    assert shape_of("box").thickness == pytest.approx(0.060, abs=0.003)
    assert shape_of("pouch in the air").thickness == pytest.approx(0.039, abs=0.006)
    assert shape_of("bent rope").thickness == pytest.approx(0.012, abs=0.002)
    assert shape_of("hanging sheet").thickness < 0.006


@pytest.mark.parametrize("name", ["folded sheet", "bent rope", "pouch", "pouch in the air"])
def test_the_same_cloud_gives_the_same_nodes_and_its_order_does_not_matter(name):
    cloud = made.noisy(CLOUDS[name][0])
    shape = shape_of(name)
    again = object_shape(cloud.copy(), SPACING, ground_height=0.0)
    assert shape.node.tobytes() == again.node.tobytes()
    shuffled = np.random.default_rng(5).permutation(cloud)
    other = object_shape(shuffled, SPACING, ground_height=0.0)
    assert (other.kind, len(other.node)) == (shape.kind, len(shape.node))
    np.testing.assert_allclose(
        other.node[np.lexsort(other.node.round(4).T)],
        shape.node[np.lexsort(shape.node.round(4).T)],
        atol=1e-5,
    )


@pytest.mark.parametrize("name", ["flat sheet", "hanging sheet", "bent rope"])
def test_specks_and_background_get_no_nodes_and_are_named(name):
    cloud = made.noisy(CLOUDS[name][0])
    speck = cloud.mean(axis=0) + np.array([[0, 0, 0.4], [0.004, 0, 0.4], [0.5, 0.1, 0.2]])
    wall = made.flat(0.3, 0.3)[:, [0, 2, 1]] + cloud.max(axis=0) + [0, 0.6, 0]
    dirty = np.concatenate([wall, cloud, speck])
    # The wall may have as many points as the object; views see past the object where it is.
    shape = object_shape(
        dirty, SPACING, ground_height=0.0, is_possible=lambda point: point[:, 1] < 0.5
    )
    clean = shape_of(name)
    assert shape.kind == clean.kind
    assert shape.node.tobytes() == clean.node.tobytes()
    assert {part.reason: part.count for part in shape.removed} == {
        "background": len(wall),
        "loose": 3,
    }
    (warning,) = shape.warnings
    assert warning["code"] == "object_points_removed"
    assert f"{len(wall) + 3} of {len(dirty)} points" in warning["message"]
    assert "in loose pieces (up to" in warning["message"]
    assert clean.warnings == []


def test_a_real_piece_beside_a_hand_is_kept_and_a_small_or_far_one_is_not():
    cloud = made.noisy(made.flat(0.30, 0.20))
    left, right = cloud[cloud[:, 0] < -0.02], cloud[cloud[:, 0] > 0.06]
    assert object_shape(np.concatenate([left, right]), SPACING).removed == ()
    far = object_shape(np.concatenate([left, right + np.array([0.2, 0, 0])]), SPACING)
    assert [(part.reason, part.count) for part in far.removed] == [("loose", len(right))]
    assert far.removed[0].distance == pytest.approx(0.36, abs=0.02)
    few = right[cKDTree(right).query([0.10, 0.0, 0.0], k=20)[1]]
    assert object_shape(np.concatenate([left, few]), SPACING).removed[0].count == 20


@pytest.mark.parametrize("name", ["box", "hose"])
def test_the_ground_beside_an_object_gets_no_nodes(name):
    cloud = made.noisy(CLOUDS[name][0])
    ground = made.noisy(made.flat(0.5, 0.5), seed=3)
    beside = cKDTree(cloud[:, :2]).query(ground[:, :2])[0]
    apron = ground[(beside > 0.004) & (beside < 0.02)]
    shape = object_shape(np.concatenate([cloud, apron]), SPACING, ground_height=0.0)
    assert shape.kind == CLOUDS[name][1]
    assert [part.reason for part in shape.removed] == ["ground"]
    assert cKDTree(cloud[:, :2]).query(shape.node[:, :2])[0].max() < 0.010


def test_a_gap_is_closed_unless_a_view_sees_through_it():
    cloud = made.noisy(made.hanging(0.066, size=(0.25, 0.3)))
    away = np.linalg.norm(cloud[:, [0, 2]] - [0.0, 0.55], axis=1)

    def in_hole(node: np.ndarray, radius: float) -> int:
        return int((np.linalg.norm(node[:, [0, 2]] - [0.0, 0.55], axis=1) < radius).sum())

    torn = object_shape(cloud[away > 0.04], SPACING, is_hidden=lambda point: point[:, 0] > 9)
    hidden = object_shape(cloud[away > 0.04], SPACING, is_hidden=lambda point: point[:, 0] < 9)
    unknown = object_shape(cloud[away > 0.04], SPACING)
    small = object_shape(cloud[away > 0.015], SPACING)
    assert in_hole(torn.node, 0.03) == in_hole(unknown.node, 0.03) == 0
    assert in_hole(hidden.node, 0.03) >= 15
    assert in_hole(small.node, 0.015) >= 3
    depth = 0.033 * np.cos(hidden.node[:, 0] * 2 * np.pi / 0.25)
    assert np.abs(hidden.node[:, 1] - depth).max() < 0.02


def test_a_folded_sheet_is_not_filled_between_its_layers():
    shape = shape_of("folded sheet")
    between = (shape.node[:, 2] > 0.309) & (shape.node[:, 2] < 0.321)
    assert not (between & (shape.node[:, 0] < 0.14)).any()


def test_a_rope_behind_a_hand_stays_in_one_piece():
    cloud = made.noisy(made.rope(0.006))
    angle = np.degrees(np.arctan2(cloud[:, 1], cloud[:, 0]))
    halves = cloud[np.abs(angle - 60) > 20]
    joined = object_shape(halves, SPACING, ground_height=0.0).node.astype(np.float64)
    assert connected_components(links(joined, 2 * SPACING), directed=False)[0] == 1
    open_ = object_shape(halves, SPACING, ground_height=0.0, is_hidden=lambda p: p[:, 0] > 9)
    graph = links(open_.node.astype(np.float64), 2 * SPACING)
    assert (open_.kind, connected_components(graph, directed=False)[0]) == ("rope", 2)


def test_a_hidden_part_of_a_rope_is_as_thick_as_the_rest():
    length, hidden = np.arange(-0.3, 0.3, 0.002)[:, None], (-0.05, 0.05)
    around = np.linspace(0, np.pi, 12)[None]
    y, z = np.broadcast_arrays(0.006 * np.cos(around), 0.006 + 0.006 * np.sin(around))
    rope = np.stack(np.broadcast_arrays(length, y, z), axis=-1).reshape(-1, 3)
    ends = made.noisy(rope[(rope[:, 0] < hidden[0]) | (rope[:, 0] > hidden[1])])
    node = object_shape(ends, SPACING, ground_height=0.0, kind="rope").node
    filled = node[(node[:, 0] > hidden[0] + 0.01) & (node[:, 0] < hidden[1] - 0.01)]
    # Three lines: the top of the half tube, and its sides at half of the rope's height.
    assert 3 * 7 <= len(filled) <= 3 * 10
    sides = np.sort(filled[:, 1])[:: len(filled) // 3][:3]
    np.testing.assert_allclose(np.diff(sides), 0.006, atol=0.002)
    top = filled[:, 2] > 0.009
    assert 2 * top.sum() == (~top).sum()
    np.testing.assert_allclose(filled[top, 2], 0.012, atol=0.002)
    np.testing.assert_allclose(filled[~top, 2], 0.006, atol=0.002)
    # Of a rope that is thin beside the distance of nodes, a line.
    coarse = object_shape(ends, 0.02, ground_height=0.0, kind="rope").node
    assert (np.abs(coarse[np.abs(coarse[:, 0]) < 0.03, 1]) < 0.008).all()


def test_ends_of_a_rope_far_apart_are_joined_where_no_view_sees_between_them():
    length = np.arange(-0.3, 0.3, 0.002)
    rope = made.noisy(np.stack([length, 0 * length, 0.3 + 0 * length], axis=1))

    def shape_with(gap: float, seen_at: float | None):
        def is_hidden(point: np.ndarray) -> np.ndarray:
            is_past = np.zeros(len(point), bool) if seen_at is None else point[:, 0] > seen_at
            is_past &= point[:, 0] < (seen_at or 0) + 0.02
            return ~is_past

        ends = rope[np.abs(rope[:, 0]) > 0.5 * gap]
        return object_shape(ends, SPACING, is_hidden=is_hidden, is_possible=is_hidden, kind="rope")

    joined = shape_with(0.2, None)
    assert joined.removed == ()
    assert connected_components(links(joined.node.astype(float), 1.6 * SPACING))[0] == 1
    for gap, seen_at in ((0.2, 0.03), (0.27, None)):
        (loose,) = shape_with(gap, seen_at).removed
        assert loose.reason == "loose"
        assert loose.distance == pytest.approx(0.5 * gap + 0.3, abs=0.01)


def test_what_views_see_below_makes_a_dome_a_sheet():
    cloud = made.noisy(made.ellipsoid((0.10, 0.07, 0.05), 0.0, lowest=0.0))
    assert object_shape(cloud, SPACING, ground_height=0.0).kind == "solid"
    held = object_shape(
        cloud, SPACING, ground_height=0.0, is_possible=lambda point: point[:, 2] > 0.02
    )
    assert held.kind == "sheet"


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    angle = np.radians(degrees)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.concatenate([points[:, :2] @ rotation.T, points[:, 2:]], axis=1)


@pytest.mark.parametrize("degrees", [0.0, 17.0, 60.0])
def test_a_flat_sheet_gets_a_grid_along_its_sides(degrees):
    cloud = turned(made.flat(0.20, 0.14, step=0.004), degrees)
    node = object_shape(cloud, 0.012).node
    assert len(node) == 16 * 11  # 0.196 / 0.012 and 0.136 / 0.012, rounded.
    np.testing.assert_allclose(node[:, 2], 0.0, atol=1e-7)
    near = cKDTree(node).query(node, k=2)[0][:, 1]
    np.testing.assert_allclose(near, 0.012, atol=1e-6)
    assert cKDTree(node).query(cloud)[0].max() < 0.012


def test_a_slightly_curved_sheet_keeps_its_height():
    cloud = made.flat(0.20, 0.14, step=0.004)
    cloud[:, 2] = 0.01 * np.cos((cloud[:, 0] + 0.1) * np.pi / 0.2)
    node = object_shape(cloud, 0.016).node
    error = node[:, 2] - 0.01 * np.cos((node[:, 0] + 0.1) * np.pi / 0.2)
    assert np.abs(error).max() < 0.001
    assert np.ptp(node[:, 2]) > 0.015


def notched(width: float) -> np.ndarray:
    """A flat sheet with a notch in its +x side."""
    cloud = made.flat(0.20, 0.14, step=0.004)
    return cloud[~((cloud[:, 0] > 0.05) & (abs(cloud[:, 1]) < width / 2))]


def test_small_notches_of_a_flat_sheet_are_closed_and_wide_ones_left_open():
    assert len(object_shape(notched(0.028), 0.012).node) == 16 * 11
    assert len(object_shape(notched(0.08), 0.012).node) < 16 * 11 - 15


def test_a_view_that_sees_past_a_flat_sheet_forbids_filling():
    seen = object_shape(notched(0.028), 0.012, is_hidden=lambda point: point[:, 0] < 0.05).node
    whole = object_shape(notched(0.028), 0.012, is_hidden=lambda point: point[:, 0] > -1).node
    assert len(whole) == 16 * 11
    assert len(whole) - 12 <= len(seen) < len(whole) - 4


def test_the_part_below_the_hand_is_filled_and_only_that(held_plate):
    node = shape_of_observation(observe_object(held_plate), 0.012, held_plate).node
    under_hand = (node[:, 0] > 0.06) & (abs(node[:, 1]) < 0.025)
    assert under_hand.sum() >= 3 * 4
    assert node[:, 0].max() < 0.101
    assert abs(len(node) - (0.2 * 0.12) / 0.012**2) < 15
    np.testing.assert_allclose(node[:, 2], 0.0, atol=1e-4)


def test_nodes_never_lie_below_the_ground():
    node = shape_of("ball on the ground").node
    assert node[:, 2].min() >= 0
    assert (
        object_shape(made.flat(0.2, 0.1) - [0, 0, 0.001], 0.01, ground_height=0.0).node[:, 2].min()
        == 0
    )


@pytest.mark.parametrize("given", ["sheet", "solid", "shell", "rope"])
def test_a_given_class_is_used(given):
    shape = object_shape(made.noisy(CLOUDS["pouch"][0]), SPACING, ground_height=0.0, kind=given)
    assert (shape.kind, shape.is_given) == (given, True)
    low = shape.node[:, 2] < 0.008
    assert (low.sum() > 30) == (given == "solid")
    assert "as sequence.yaml says" in str(shape)


def test_the_class_of_a_sequence_goes_before_what_is_found(plate):
    observation = observe_object(plate)
    assert shape_of_observation(observation, 0.012, plate).kind == "sheet"
    named = Sequence(plate.folder, replace(plate.meta, shape="shell"))
    shape = shape_of_observation(observation, 0.012, named)
    assert (shape.kind, shape.is_given) == ("shell", True)


def test_given_nodes_have_a_class_too(plate):
    along = np.linspace(0, 0.5, 49)
    line = np.stack([along, 0.1 * np.sin(9 * along), 0.3 + 0 * along], axis=1)
    assert shape_of_nodes(line.astype(np.float32), plate).kind == "rope"
    assert shape_of_nodes(made.flat(0.3, 0.2, step=0.01).astype(np.float32), plate).kind == "sheet"
    filled = Sequence(plate.folder, replace(plate.meta, surface_node_count=40))
    assert shape_of_nodes(line.astype(np.float32), filled).kind == "solid"
    for count in (1, 2, 3):
        assert len(shape_of_nodes(line[:count].astype(np.float32), plate).node) == count


def test_too_many_nodes_are_refused_with_a_spacing_that_fits(plate):
    observation = observe_object(plate)
    with pytest.raises(FitError, match="most_nodes") as told:
        shape_of_observation(observation, 0.004, plate, most_nodes=300)
    words = str(told.value)
    count = len(shape_of_observation(observation, 0.004, plate).node)
    assert f"'plate': The object would get {count} nodes as a sheet" in words
    assert "node_spacing of 0.004 m, and 300 are allowed" in words
    fits = float(words.partition("A node_spacing of ")[2].partition(" m fits")[0])
    assert 0.004 < fits <= 0.012
    assert len(shape_of_observation(observation, fits, plate, most_nodes=300).node) <= 300


@pytest.mark.parametrize("kind", [None, "sheet", "solid", "shell", "rope"])
def test_scanty_clouds_get_nodes_too(kind):
    random = np.random.default_rng(0)
    line = np.outer(np.arange(30), [0.0, 0.0, 0.01])
    few = [np.zeros((1, 3)), np.zeros((5, 3)), random.normal(size=(2, 3)), line, line[:3, ::-1]]
    for cloud in [*few, random.uniform(size=(40, 3)) * 0.2]:
        for ground in (None, 0.0):
            shape = object_shape(
                cloud, 0.02, ground_height=ground, is_hidden=lambda p: p[:, 0] > 0, kind=kind
            )
            assert len(shape.node) >= 1
            assert np.isfinite(shape.node).all()


def test_an_empty_cloud_is_refused():
    nothing = ObjectObservation(
        point=np.zeros((1, 0, 3), np.float32),
        is_visible=np.zeros((1, 0), bool),
        is_motion_valid=np.zeros((1, 0), bool),
        cloud=(np.zeros((0, 3), np.float32),),
    )
    with pytest.raises(MissingInputError, match="first frame"):
        shape_of_observation(nothing, 0.01)
    with pytest.raises(ValueError, match="spacing"):
        object_shape(np.zeros((5, 3)), 0.0)
