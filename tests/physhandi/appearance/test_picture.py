import numpy as np
import pytest

from physhandi.appearance.picture import Appearance
from physhandi.appearance.splats import Splats
from physhandi.data.camera import PinholeCamera
from physhandi.rendering.shapes import Surface

CAMERA = PinholeCamera(
    K=np.array([[100.0, 0, 30], [0, 100.0, 20], [0, 0, 1]]),
    T_world_camera=np.eye(4),
    width=61,
    height=41,
)
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
SKIN = [200.0, 150.0, 100.0]


def wall_of_splats() -> Appearance:
    """A dense wall half a metre away, 0.2 m wide, that its nodes carry."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.1, 0.1, 41), np.linspace(-0.1, 0.1, 41)))
    center = np.stack([x, y, np.full(x.size, 0.5)], axis=1).astype(np.float32)
    splats = Splats(
        center=center,
        scale=np.full(x.size, 0.004, np.float32),
        color=np.tile(np.float32([0.1, 0.2, 0.9]), (x.size, 1)),
        opacity=np.full(x.size, 0.99, np.float32),
        rest_node=center[::20],
    )
    return Appearance.of(splats)


def hand_at(depth: float) -> Surface:
    """A flat hand in the right half of the picture."""
    corner = np.concatenate([0.1 * SQUARE + [0.1, 0.0], np.full((4, 1), depth)], axis=1)
    return Surface(vertex=corner, faces=FACES, color=np.array([SKIN]))


def test_hands_hide_the_object_and_are_hidden_by_it() -> None:
    appearance = wall_of_splats()
    node = appearance.splats.rest_node
    background = np.full((41, 61, 3), 0.5)
    before = appearance.render_frame(CAMERA, node, [hand_at(0.4)], background=background)
    behind = appearance.render_frame(CAMERA, node, [hand_at(0.6)], background=background)

    np.testing.assert_allclose(before.image.color[20, 40], np.array(SKIN) / 255, atol=0.003)
    np.testing.assert_allclose(before.image.color[20, 20], [0.1, 0.2, 0.9], atol=0.01)
    np.testing.assert_allclose(behind.image.color[20, 40], [0.1, 0.2, 0.9], atol=0.01)
    assert (before.image.alpha[20, 40], before.image.depth[20, 40]) == (0.0, 0.0)
    assert behind.image.depth[20, 40] == pytest.approx(0.5, abs=1e-3)
    # The wall ends 20 px from the middle, the hand goes on.
    assert before.is_hand[20, 31:55].all()
    assert not before.is_hand[20, :30].any()
    assert not behind.is_hand[20, :46].any()
    assert behind.is_hand[20, 57] == (0.1 * 2 / 0.6 * 100 + 30 > 57)
    np.testing.assert_allclose(before.image.color[20, 2], 0.5, atol=0.01)


def test_a_hand_within_a_cloud_of_splats_hides_what_is_behind_it_alone() -> None:
    color = np.float32([[0.9, 0.0, 0.0], [0.0, 0.9, 0.0]])
    splats = Splats(
        center=np.float32([[0.05, 0, 0.4], [0.05, 0, 0.6]]),
        scale=np.float32([0.05, 0.05]),
        color=color,
        opacity=np.float32([0.5, 0.99]),
        rest_node=np.zeros((1, 3), np.float32),
    )
    picture = Appearance.of(splats).render_frame(CAMERA, np.zeros((1, 3)), [hand_at(0.5)])
    at = 20, 40
    alpha = float(picture.image.alpha[at])
    assert 0.4 < alpha < 0.5
    np.testing.assert_allclose(
        picture.image.color[at], alpha * color[0] + (1 - alpha) * np.array(SKIN) / 255, atol=0.003
    )
    assert picture.is_hand[at]


def test_nodes_carry_what_is_drawn() -> None:
    appearance = wall_of_splats()
    moved = appearance.splats.rest_node + np.array([0.1, 0.0, 0.0], np.float32)
    picture = appearance.render_frame(CAMERA, moved)
    assert picture.image.alpha[20, 55] > 0.9
    assert picture.image.alpha[20, 20] < 0.05
    assert not picture.is_hand.any()
