"""Pictures of a body and hands: cut-outs, labels, and colors against what is known of them."""

import numpy as np
import pytest
from support.physics.synthetic_world import bare_hands, lifted_sheet

from physhandi.synthetic.film.cameras import make_viewpoints, window_around
from physhandi.synthetic.film.degradations import Degradations
from physhandi.synthetic.film.filmed_scene import make_filmed_scene
from physhandi.synthetic.film.rendering import (
    Dye,
    compose,
    look_at,
    paint,
    photograph,
    resized,
    shadow_points,
)

SQUARE = np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.fixture(scope="module")
def stage():
    truth = lifted_sheet(2, ("right", "left"))
    return make_filmed_scene(truth, bare_hands(truth), Degradations(), 0)


def raised(height: float):
    return SQUARE + np.array([0.0, 0.0, height])


def above(size: int = 120):
    return look_at(np.array([0.0, 0.001, 1.0]), np.zeros(3), focal_length=200.0, size=(size, size))


def test_painting_a_part_gives_that_part_of_the_whole(stage):
    camera = resized(make_viewpoints(stage.extent(), 1, Degradations(), 0)[0].camera, 0.25)
    scene = stage.scene_at(1)
    whole = paint(camera, scene)
    window = window_around(camera, scene.vertex, 2)
    part = paint(window.camera, scene)
    cut = whole[window.rows, window.columns]
    assert part.shape == cut.shape != whole.shape
    assert (np.abs(part.astype(int) - cut) <= 1).mean() > 0.999
    empty = compose(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), np.zeros((0, 2)), [])
    background = paint(camera, empty)
    touched = np.concatenate([scene.vertex, shadow_points(scene.vertex)])
    around = window_around(camera, touched, 6)
    background[around.rows, around.columns] = whole[around.rows, around.columns]
    np.testing.assert_array_equal(background, whole)


def test_labels_depth_and_angles_of_a_square_seen_from_above():
    hand = SQUARE * 0.2 + [0.0, 0.0, 0.3]
    scene = compose(raised(0.1), FACES, SQUARE[:, :2], [(3, hand, FACES)])
    picture = photograph(above(), scene)
    assert (picture.label[60, 60], picture.label[60, 80], picture.label[5, 5]) == (3, 1, 0)
    for place, depth in (((60, 60), 0.7), ((60, 80), 0.9), ((5, 5), 1.0)):
        assert picture.depth[place] == pytest.approx(depth, abs=0.001)
    assert picture.cosine[60, 60] == pytest.approx(1.0, abs=1e-3)
    corner = np.arctan(np.hypot(54.5, 54.5) / 200)
    assert picture.cosine[5, 5] == pytest.approx(np.cos(corner), abs=0.002)
    # The square of 20 cm at 0.9 m has sides of 44 px.
    assert (picture.label > 0).sum() == pytest.approx((200 * 0.2 / 0.9) ** 2, rel=0.05)


def test_a_body_has_its_dye_and_a_shadow_beside_it():
    dye = Dye(top=(0.1, 0.9, 0.1), stripe=(0.1, 0.9, 0.1))
    plain = compose(raised(0.25), FACES, SQUARE[:, :2], [], dye=dye)
    image = paint(above(200), plain).astype(float)
    middle = image[90:110, 90:110].mean(axis=(0, 1))
    assert middle[1] > 3 * middle[0]
    pixel = above(200).project(shadow_points(np.array([[0.0, 0.0, 0.25]])))[0]
    x, y = np.round(pixel + 0.9 * (pixel - 99.5)).astype(int)
    lit = image[20:40, 20:40].mean()
    assert image[y - 2 : y + 3, x - 2 : x + 3].mean() < 0.8 * lit


def test_shadows_fall_where_the_line_from_the_lamp_meets_the_table():
    point = np.array([[0.1, -0.2, 0.3], [0.0, 0.0, 0.0]])
    shadow = shadow_points(point)
    np.testing.assert_allclose(shadow[:, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(shadow[1], 0.0, atol=1e-12)
    lamp = 2.5 * np.array([0.30, -0.28, 0.91]) / np.linalg.norm([0.30, -0.28, 0.91])
    away, beyond = point[0] - lamp, shadow[0] - lamp
    assert np.linalg.norm(np.cross(away, beyond)) < 1e-12
    assert np.linalg.norm(beyond) > np.linalg.norm(away)


def test_a_camera_may_see_the_table_up_to_the_horizon():
    camera = look_at(
        np.array([-0.8, 0.0, 0.3]), np.array([0.0, 0.0, 0.2]), focal_length=60.0, size=(80, 60)
    )
    scene = compose(raised(0.1), FACES, SQUARE[:, :2], [])
    image, picture = paint(camera, scene), photograph(camera, scene)
    above_horizon = picture.depth == 0
    assert above_horizon[0].all()
    assert not above_horizon[30:].any()
    assert image.min() > 0
    far = image[~above_horizon & (picture.depth > 3)]
    # Unshadowed wood, as bright as at the feet of the camera.
    assert far.mean() == pytest.approx(image[-1].mean(), rel=0.05)
