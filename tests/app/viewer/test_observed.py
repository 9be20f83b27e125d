"""Markers of a rope: neighbors, lengths, and what a recording of it offers."""

import numpy as np
import pytest
from support.viewer.viewer_world import FolderCatalog

from app.previews.links import marker_links
from app.settings import BUNDLED
from app.viewer.color.coloring import Painter
from app.viewer.content.content import Content, open_run_content
from app.viewer.content.layers import Layers
from app.viewer.content.observed import BONES, CloudSet, DepthCloud, Markers, lift_keypoints
from app.viewer.inspect.inspector import clickable
from app.viewer.inspect.picking import Pick, Ray, Target, pick
from app.viewer.inspect.readings import Readings

_ROPE = np.array([0.0, 0.02, 0.1, 0.18, 0.26])


@pytest.fixture
def content() -> Content:
    point = np.zeros((4, 5, 3), np.float32)
    point[..., 0] = _ROPE
    point[..., 2] = 0.3 + 0.1 * np.arange(4)[:, None]
    point[3, 3] = np.nan
    markers = Markers(point=point, held=(0, 1), links=marker_links(point[0]))
    return Content(
        title="t",
        sequence_name="s",
        frame_count=4,
        frame_rate=30.0,
        reconstruction_count=4,
        length_unit="m",
        ground_height=None,
        control=point[:, :2],
        markers=markers,
    )


def test_neighbors_along_a_rope_are_joined_while_both_are_seen(content):
    assert content.markers.links.tolist() == [[0, 1], [1, 2], [2, 3], [3, 4]]
    assert len(content.markers.segments(0)) == 4
    assert len(content.markers.segments(3)) == 2


def test_a_click_tells_a_marker_and_how_far_its_neighbors_are(content):
    ray = Ray(origin=np.array([0.1, -2.0, 0.3]), direction=np.array([0.0, 1.0, 0.0]), pixel=1e-3)
    target = Target(
        content=content,
        rollout=None,
        frame=0,
        rollout_frame=0,
        layers=Layers(observed=True),
        spacing=0.02,
    )
    found = pick(ray, target)
    assert found == Pick(kind="marker", index=2)
    readings = Readings(content, Painter(content))
    rows = dict(readings.rows(found, None, 1, 1))
    assert rows["speed"] == "3 m/s"
    assert rows["to marker 1"] == "80 mm"
    assert rows["to marker 3"] == "80 mm"
    held = Pick(kind="control", index=1)
    assert readings.title(held, None) == "gripper, marker 1"
    assert dict(readings.rows(held, None, 1, 1))["to marker 0"] == "20 mm"


def test_only_what_is_there_can_be_clicked_and_is_named(content):
    assert clickable(content) == "a gripper or a marker"


def test_keypoints_seen_by_two_views_come_back_where_they_were(recording) -> None:
    (lifted,) = lift_keypoints(recording.sequence.views)
    is_lost = np.isnan(lifted).any(axis=-1)
    assert np.argwhere(is_lost).tolist() == [[3, 5]]
    np.testing.assert_allclose(lifted[~is_lost], recording.keypoint[~is_lost], atol=2e-5)


def test_one_view_alone_cannot_lift(recording) -> None:
    assert lift_keypoints(recording.sequence.views[:1]) == ()


def test_the_bones_form_one_hand() -> None:
    assert set(BONES.ravel()) == set(range(21))
    assert len(BONES) == 21


def test_depth_becomes_points_in_front_of_the_camera(recording) -> None:
    views = recording.sequence.views
    cloud = DepthCloud(views)
    point = cloud.points(2)
    assert len(point) == 2 * 8 * 4
    depth = views[0].camera.camera_depth(point[:32].astype(float))
    np.testing.assert_allclose(depth, 0.42, atol=1e-6)
    assert (cloud.colors() == 80).all()


def test_observed_points_have_the_colors_of_the_video_in_their_own_frame():
    observed = open_run_content(FolderCatalog(BUNDLED), "towel_fold_quick").observed
    assert observed.is_colored
    for frame in (0, 40):
        point = observed.points(frame)
        color = observed.colors().astype(float)
        assert color.shape == point.shape
        # A teal towel in light and shadow, of which a part is white.
        is_teal = (color[:, 2] > 1.5 * color[:, 0]) & (color[:, 1] > 1.3 * color[:, 0])
        is_white = (color > 150).all(axis=1)
        assert 0.5 < is_teal.mean() < 0.95
        assert is_white.mean() > 0.03
    # Without views all are green.
    plain = CloudSet(observed._point, observed._end)
    assert len(plain.points(0)) > 100
    assert plain.colors().tolist() == [46, 160, 67]
