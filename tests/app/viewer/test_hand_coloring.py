"""Colors of hands, against distances that were chosen beforehand."""

from pathlib import Path

import numpy as np
import pytest

from app.exports.permalink import state_from_query
from app.viewer.color.coloring import Painter
from app.viewer.color.hand_coloring import HandPainter, joint_weights
from app.viewer.color.legend import legend_html
from app.viewer.content.content import Content, ShownHand
from app.viewer.content.layers import Layers
from app.viewer.inspect.picking import Pick
from app.viewer.inspect.readings import Readings
from app.viewer.scene.framing import frame_content
from app.viewer.session import complete_state
from physhandi.data.camera import PinholeCamera
from physhandi.data.view import View

_K = np.array([[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]])
_FRAMES = 3
_OFF = (3.0, 5.0)
"""How many pixels the keypoints of the two views are beside the joints."""


def a_view(name: str, x: float) -> View:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = (x, 0.0, 10.0)
    camera = PinholeCamera(K=_K, T_world_camera=pose, width=100, height=100)
    return View(Path(name), "s", camera, _FRAMES)


@pytest.fixture
def content() -> Content:
    """A hand of 21 joints in a row, each with one vertex on it, that moves 0.1 a frame."""
    joint = np.zeros((_FRAMES, 21, 3), np.float32)
    joint[..., 0] = np.linspace(-2, 2, 21) + 0.1 * np.arange(_FRAMES)[:, None]
    views = [a_view("left", -1.0), a_view("right", 1.0)]
    pixel = np.stack([view.camera.project(joint.astype(np.float64)) for view in views])
    pixel[..., 1] += np.array(_OFF)[:, None, None]
    keypoint = np.concatenate([pixel, np.ones((2, _FRAMES, 21, 1))], axis=-1)
    keypoint[1, 2] = np.nan  # In frame 2 the second view sees nothing,
    keypoint[:, 1] = np.nan  # and in frame 1 none does.
    face = np.array([[0, 1, 2], [18, 19, 20]], np.int32)
    hand = ShownHand(side="right", vertex=joint, face=face, joint=joint, keypoint=keypoint)
    return Content(
        title="t",
        sequence_name="s",
        frame_count=_FRAMES,
        frame_rate=30.0,
        reconstruction_count=_FRAMES,
        length_unit="board square",
        ground_height=None,
        hands=(hand,),
        views=views,
    )


def test_reprojection_is_the_mean_of_the_views_that_see_a_joint(content):
    painter, hand = HandPainter(content), content.hands[0]
    assert painter.offered == ("error", "speed")
    assert painter.measure("error", hand, 0) == pytest.approx(np.full(21, 4.0), abs=1e-3)
    assert painter.measure("error", hand, 2) == pytest.approx(np.full(21, 3.0), abs=1e-3)
    assert np.isnan(painter.measure("error", hand, 1)).all()
    painted = painter.paint(0, Layers(color="error"))
    assert painted["right"].scale.limits == (0.0, 4.0)
    assert painter.legend is not None
    said = legend_html(painter.legend, highest=True)
    assert "<b>Reprojection error</b><span>px</span>" in said
    assert "highest vertex now 4&nbsp;px" in said
    painter.paint(1, Layers(color="error"))
    assert "not known in this frame" in legend_html(painter.legend, highest=True)
    assert painter.paint(0, Layers()) == {}
    assert painter.legend is None


def test_speed_is_told_in_the_unit_of_the_recording(content):
    painter, hand = HandPainter(content), content.hands[0]
    assert painter.quantity("speed").unit == "board square/s"
    assert painter.measure("speed", hand, 2) == pytest.approx(np.full(21, 3.0), abs=1e-4)
    readings = Readings(content, Painter(content))
    rows = dict(readings.rows(Pick(kind="hand", index=10, side="right"), None, 2, 2))
    assert rows["position"] == "0.2, 0, 0 board squares"
    assert rows["speed"] == "3 board square/s"
    assert rows["reprojection error"] == "3 px"


def test_a_vertex_listens_to_its_nearest_joints():
    joint = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
    weight = joint_weights(np.array([[0.5, 0.0, 0.0]]), joint)
    # Inverse squares 4, 4 and 4 / 9; the fourth joint is too far.
    assert weight[0] == pytest.approx(np.array([9.0, 9.0, 1.0, 0.0]) / 19.0)


def test_the_first_camera_is_near_enough_to_see_the_hand(content):
    framing = frame_content(content)
    away = np.linalg.norm(framing.camera - framing.center)
    assert 2 * away * np.tan(framing.fov / 2) < 1.6 * framing.extent


def test_a_link_that_looks_from_a_view_begins_there(content):
    asked = state_from_query({"from": "right"})
    pose = complete_state(asked, content).pose
    assert pose is not None
    assert pose.position == pytest.approx([1.0, 0.0, 10.0])
    assert pose.look_at == pytest.approx([1.0, 0.0, 0.0], abs=0.2)
    assert pose.up == pytest.approx([0.0, 1.0, 0.0])
    assert pose.fov == pytest.approx(2 * np.arctan(0.5))
