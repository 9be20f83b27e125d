"""Cameras against OpenCV's own projection and hand-computed pixels."""

import cv2
import numpy as np
import pytest

from physhandi.data.camera import PinholeCamera

LENS = np.array([-0.28, 0.09, 0.001, -0.0007, -0.01])


def make_camera(distortion: np.ndarray | None = None) -> PinholeCamera:
    rotation = cv2.Rodrigues(np.array([0.3, -0.7, 0.2]))[0]
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = [0.1, -0.4, 0.6]
    K = np.array([[600.0, 0.5, 318.0], [0.0, 610.0, 244.0], [0.0, 0.0, 1.0]])
    return PinholeCamera(K, pose, 640, 480, np.zeros(5) if distortion is None else distortion)


def make_points(camera: PinholeCamera, count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(3)
    local = rng.uniform([-0.5, -0.4, 0.8], [0.5, 0.4, 2.0], (count, 3))
    return local @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]


def test_a_point_on_the_axis_is_seen_at_the_principal_point() -> None:
    camera = PinholeCamera(np.diag([500.0, 400.0, 1.0]), np.eye(4), 640, 480)
    assert camera.project(np.array([0.2, -0.1, 2.0])) == pytest.approx([50.0, -20.0])
    assert camera.camera_depth(np.array([0.2, -0.1, 2.0])) == pytest.approx(2.0)


def test_projection_agrees_with_opencv() -> None:
    camera = make_camera(LENS)
    camera = PinholeCamera(
        np.array([[600.0, 0, 318], [0, 610, 244], [0, 0, 1]]), camera.T_world_camera, 640, 480, LENS
    )
    point = make_points(camera)
    inverse = np.linalg.inv(camera.T_world_camera)
    expected, _ = cv2.projectPoints(
        point, cv2.Rodrigues(inverse[:3, :3])[0], inverse[:3, 3], camera.K, LENS
    )
    assert camera.project(point) == pytest.approx(expected[:, 0], abs=1e-9)


@pytest.mark.parametrize("distortion", [np.zeros(5), LENS])
def test_unproject_inverts_project(distortion: np.ndarray) -> None:
    camera = make_camera(distortion)
    point = make_points(camera).reshape(10, 20, 3)
    back = camera.unproject(camera.project(point), camera.camera_depth(point))
    assert back == pytest.approx(point, abs=1e-9)
    assert np.ptp(point) > 1.0


def test_undistort_moves_a_pixel_to_the_pinhole_image() -> None:
    camera = make_camera(LENS)
    point = make_points(camera)
    straight = make_camera().project(point)
    assert np.abs(camera.project(point) - straight).max() > 3.0
    assert camera.undistort(camera.project(point)) == pytest.approx(straight, abs=1e-7)
    assert camera.distort(straight) == pytest.approx(camera.project(point), abs=1e-9)


def test_points_behind_the_camera_have_no_pixel() -> None:
    camera = PinholeCamera(np.diag([500.0, 400.0, 1.0]), np.eye(4), 640, 480)
    pixel = camera.project(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(pixel[0]).all()
    assert pixel[1] == pytest.approx([0, 0])


def test_dict_round_trip() -> None:
    camera = make_camera(LENS)
    again = PinholeCamera.from_dict(camera.to_dict())
    assert again.to_dict() == camera.to_dict()
    assert again.distortion == pytest.approx(LENS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": [[1, 2], [3, 4]]}, r"K must have shape \(3, 3\)"),
        ({"K": "wide"}, "K must hold numbers"),
        ({"width": 640.5}, "width must be a whole number"),
        ({"focal": 3}, "unknown field 'focal'"),
        ({"T_world_camera": np.diag([2.0, 1, 1, 1]).tolist()}, "must hold a rotation"),
        ({"T_world_camera": np.diag([-1.0, 1, 1, 1]).tolist()}, "must hold a rotation"),
        ({"T_world_camera": np.diag([1e308, 1, 1, 1]).tolist()}, "must hold a rotation"),
        ({"height": 0}, "must be positive"),
    ],
)
def test_bad_calibrations_are_named(change: dict[str, object], message: str) -> None:
    fields = make_camera().to_dict() | change
    with pytest.raises(ValueError, match=message):
        PinholeCamera.from_dict(fields)


def test_a_missing_field_is_named() -> None:
    fields = make_camera().to_dict()
    del fields["height"]
    with pytest.raises(ValueError, match="field 'height' is missing"):
        PinholeCamera.from_dict(fields)
