import numpy as np

from app.viewer.content.observed import DepthCloud
from app.viewer.content.skeleton import BONES, lift_keypoints


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
