"""What colors tell, against values that were computed by hand or by the metrics."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.physics.spring_world import content_of, two_springs
from support.viewer.viewer_world import FolderCatalog

from app.viewer.color.coloring import Painter
from app.viewer.color.colormaps import UNKNOWN, levels, paint_values, table
from app.viewer.color.quantities import QUANTITIES, measure
from app.viewer.content.content import open_run_content
from app.viewer.content.layers import COLORINGS, Layers
from app.viewer.content.observed import PointSet, Tracks

BUNDLED = Path(__file__).parents[3] / "sequences"


def test_values_of_two_springs():
    rollout = two_springs()

    def at(coloring, frame=2, **options):
        values = measure(coloring, rollout, frame, **options)
        return values.node.tolist(), values.spring.tolist()

    nan = np.nan
    node, spring = at("strain")
    assert node[:2] == pytest.approx([0.2, 0.2])
    assert np.isnan(node[2])
    assert spring == [pytest.approx([0.2, 0.2]), pytest.approx([1.0, 1.0])]
    node, spring = at("stiffness")
    assert node == pytest.approx([20.0, 20.0, nan], nan_ok=True)
    assert spring == [pytest.approx([20.0] * 2), pytest.approx([80.0] * 2)]
    node, spring = at("damping")
    assert node == pytest.approx([2.0, 2.0, nan], nan_ok=True)
    node, spring = at("speed")
    assert node == pytest.approx([0.0, 3.0, 0.0], abs=1e-5)
    assert spring[0] == pytest.approx([0.0, 3.0], abs=1e-5)
    # 20·0.2 + 2·3 = 10 N pull at both ends; the hand holds node 0 with 80·1 N.
    node, spring = at("force")
    assert node == pytest.approx([80.0, 0.0, 0.0])
    assert spring == [pytest.approx([10.0, 10.0], rel=1e-5), pytest.approx([80.0, 80.0])]
    other = replace(rollout, position=rollout.position + np.float32([0, 0.3, 0.4]))
    node, spring = at("difference", reference=other)
    assert node == pytest.approx([0.5] * 3)
    # A control node has no difference of its own: its spring shows the held node's.
    assert spring == [pytest.approx([0.5, 0.5]), pytest.approx([0.5, 0.5])]
    assert np.isnan(at("difference")[0]).all()
    assert np.isnan(at("error")[0]).all()


def test_every_coloring_is_described_and_measured():
    assert set(QUANTITIES) == set(COLORINGS) - {"plain"}
    rollout = two_springs()
    for coloring in QUANTITIES:
        values = measure(coloring, rollout, 1, error_of=lambda *_: np.zeros(3), reference=rollout)
        assert values.node.shape == (3,)
        assert values.spring.shape == (2, 2)


def test_the_error_of_a_track_is_the_metric_s():
    content = open_run_content(FolderCatalog(BUNDLED), "towel_fold_quick")
    name = content.sequence_name
    out = BUNDLED / "runs" / "towel_fold_quick" / "attempts" / "1" / "out" / "sequences" / name
    measured = json.loads((out / "frame_errors.json").read_text())
    errors = Painter(content).errors
    assert errors.source == "the tracks"
    assert content.fitted is not None
    for frame in (3, 30, 59):
        error, is_seen = errors.tracks(content.fitted, frame)
        wanted = measured["rollout"]["track_error"][measured["frames"].index(frame)]
        assert error[is_seen].mean() == pytest.approx(wanted, rel=1e-3)
        node = errors.nodes(content.fitted, frame)
        assert 0.5 * wanted < np.nanmean(node) < 2 * wanted


def test_an_error_is_told_only_where_something_was_seen():
    rollout = two_springs()
    seen = np.array([[1, 1, 1], [1, 0, 1], [0, 0, 0], [1, 1, 1]], bool)
    tracks = Tracks(
        point=rollout.position + np.float32([0, 0, 0.25]), is_visible=seen, node=np.array([0, 1, 2])
    )
    errors = Painter(content_of(rollout, tracks=tracks)).errors
    assert errors.nodes(rollout, 0) == pytest.approx([0.25] * 3)
    assert np.isnan(errors.nodes(rollout, 2)).all()
    # Node 1 lies beside track 0, so that this one speaks for it when its own is hidden.
    assert errors.nodes(rollout, 1) == pytest.approx([0.25] * 3)
    assert errors.tracks(rollout, 1)[1].tolist() == [True, False, True]


def test_without_tracks_the_nearest_observed_point_counts():
    rollout = two_springs()
    point = np.repeat(np.float32([[[0, 0, 0.5], [1, 0, 0.0]]]), 4, axis=0)
    observed = PointSet(point, np.ones(point.shape[:2], bool))
    errors = Painter(content_of(rollout, observed=observed)).errors
    assert errors.source == "the nearest observed point"
    assert errors.nodes(rollout, 1)[:2] == pytest.approx([0.5, 0.1], abs=1e-6)


def test_the_range_is_that_of_the_sequence_until_it_is_fixed():
    rollout = two_springs(20)
    painter = Painter(content_of(rollout))
    first = painter.paint(rollout, 1, Layers(color="strain"))
    last = painter.paint(rollout, 19, Layers(color="strain"))
    assert first.scale.limits == last.scale.limits
    low, high = last.scale.limits
    assert low == -high
    assert 1.7 < high <= 2.0
    assert painter.legend.highest == pytest.approx(1.9, rel=1e-5)
    fixed = painter.paint(rollout, 1, Layers(color="strain", color_range=(0.0, 0.1)))
    assert fixed.scale.limits == (0.0, 0.1)
    assert painter.legend.scale.limits == (0.0, 0.1)
    # At 0.1 the scale ends; the third node has no spring.
    np.testing.assert_array_equal(fixed.node[0], table("diverging")[-1])
    np.testing.assert_array_equal(fixed.node[2], UNKNOWN)
    np.testing.assert_array_equal(fixed.springs(slice(0, 1))[0], table("diverging")[[-1, -1]])
    assert painter.paint(rollout, 1, Layers()) is None
    assert painter.legend is None


def test_the_range_is_that_of_what_is_shown():
    rollout = two_springs()
    painter = Painter(content_of(rollout))
    shown = {"nodes": Layers(virtual_springs=False), "virtual": Layers(nodes=False)}
    shown["own"] = Layers(nodes=False, virtual_springs=False, object_springs=True)
    shown["nothing"] = Layers(nodes=False, virtual_springs=False)
    for name, layers in shown.items():
        layers.color = "stiffness"
        painter.paint(rollout, 2, layers)
        low, high = painter.limits("stiffness", rollout, layers)
        # Springs of 20 and 80 N; nodes 0 and 1 are joined by the first alone.
        value = {"virtual": 80.0}.get(name, 20.0)
        assert (low, high) == pytest.approx((value, 2 * value)), name
        assert set(painter.legend.shown.round(3)) == {value}, name


def test_the_range_grows_with_a_rollout_that_is_being_computed():
    fitted = two_springs(20)
    painter = Painter(content_of(fitted))
    rollout = replace(fitted, ready=2)
    assert painter.limits("difference", rollout)[1] == pytest.approx(1e-3)
    before = painter.limits("speed", rollout)
    rollout.position[2:, 1, 0] += np.arange(18, dtype=np.float32)
    rollout.ready = 3
    assert painter.limits("speed", rollout) == before
    rollout.ready = 4
    assert painter.limits("speed", rollout)[1] > 8 * before[1]


def test_colors_are_viridis_and_the_ends_are_reached():
    ramp = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)
    painted = paint_values(np.array([-5.0, 0.0, 0.5, 1.0, 9.0, np.nan]), (0.0, 1.0))
    np.testing.assert_array_equal(painted[0], painted[1])
    np.testing.assert_array_equal(painted[3], painted[4])
    np.testing.assert_array_equal(painted[5], UNKNOWN)
    assert np.abs(ramp[130, 0, ::-1].astype(int) - painted[2]).max() < 5
    blue, middle, red = paint_values(np.array([-2.0, 0.0, 2.0]), (-2.0, 2.0), "diverging").astype(
        int
    )
    assert blue[2] > blue[0] + 80
    assert red[0] > red[2] + 80
    assert np.ptp(middle) < 4


def test_equal_ratios_are_equal_steps_on_a_logarithmic_scale():
    value = np.array([10.0, 100.0, 1000.0, 0.0])
    np.testing.assert_allclose(
        levels(value, (10.0, 1000.0), is_logarithmic=True), [0, 0.5, 1, 0], atol=1e-12
    )
    np.testing.assert_allclose(levels(value, (0.0, 1000.0)), [0.01, 0.1, 1, 0])
    # A range without extent splits what lies above it from the rest.
    assert levels(np.array([1.0, 2.0, 3.0]), (2.0, 2.0)).tolist() == [0.0, 0.0, 1.0]


def test_units_follow_the_content():
    rollout = two_springs()
    painter = Painter(replace(content_of(rollout), length_unit="squares"))
    assert (painter.quantity("error").unit, painter.quantity("error").factor) == ("squares", 1.0)
    assert painter.quantity("speed").unit == "squares/s"
    assert painter.quantity("strain").unit == "%"
    assert Painter(content_of(rollout)).quantity("error").unit == "mm"
