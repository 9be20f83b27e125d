"""The state of a scene written into an address and read from one."""

import math
from dataclasses import replace

import numpy as np
import pytest

from app.exports.permalink import holds_path, state_from_query, state_to_query
from app.viewer.content.layers import Layers
from app.viewer.content.session_state import Pose, SessionState
from physhandi.errors import UsageError


def state(**changes: object) -> SessionState:
    usual = SessionState(
        sequence_name="lift",
        frame=37,
        is_playing=False,
        speed=1.0,
        does_loop=True,
        part=None,
        layers=Layers(
            hands=False,
            cameras=False,
            looks_from="view1",
            force_scale=0.5,
            color="strain",
            color_range=(-0.5, 2.0),
            mass=0.125,
        ),
        theme="dark",
        prefers_dark=False,
        parameters=None,
        automatic_substeps=False,
        is_figure=False,
        pose=Pose(
            position=np.array([1.0, -2.0, 0.5]),
            look_at=np.array([0.1, 0.2, 0.3]),
            up=np.array([0.0, 0.0, 1.0]),
            fov=math.radians(40.0),
        ),
    )
    return replace(usual, **changes)


def test_a_state_is_written_as_a_short_query_that_people_can_read() -> None:
    assert state_to_query(state(parameter_changes={"drag": 4.25, "max_neighbors": 7})) == {
        "f": "37",
        "sequence": "lift",
        "cam": "1,-2,0.5,0.1,0.2,0.3",
        "fov": "40",
        "show": "nodes,controls,virtual_springs,forces,ground",
        "color": "strain",
        "range": "-0.5,2",
        "scale": "0.5",
        "mass": "0.125",
        "from": "view1",
        "theme": "dark",
        "drag": "4.25",
        "max_neighbors": "7",
    }


def test_what_was_written_is_read_again() -> None:
    before = state(
        is_playing=True,
        speed=0.3,
        part=(4, 20),
        does_loop=False,
        is_figure=True,
        automatic_substeps=True,
        pose=replace(state().pose, up=np.array([0.0, 0.6, 0.8])),
        parameter_changes={"damping": 1.0 / 3, "self_collision": True, "ground_height": None},
    )
    after = state_from_query(state_to_query(before))
    for name in ("sequence_name", "frame", "is_playing", "speed", "does_loop", "part", "theme"):
        assert getattr(after, name) == getattr(before, name), name
    assert (after.is_figure, after.automatic_substeps) == (True, True)
    assert after.parameter_changes == before.parameter_changes
    assert replace(Layers(), **after.layer_changes) == before.layers
    for name in ("position", "look_at", "up"):
        np.testing.assert_allclose(getattr(after.pose, name), getattr(before.pose, name))
    assert after.pose.fov == pytest.approx(before.pose.fov)
    assert state_to_query(after) == state_to_query(before)


KEYS = "3,1,-2,0.5,0.1,0.2,0.3,0,0,1,40;17,0,-1,0.25,0,0,0.125,0,0.6,0.8,55.5"


def test_the_path_of_a_camera_is_in_the_link() -> None:
    after = state_from_query({"path": KEYS})
    assert [key.frame for key in after.camera_keys] == [3, 17]
    later = after.camera_keys[1].pose
    np.testing.assert_allclose(later.position, [0.0, -1.0, 0.25])
    np.testing.assert_allclose(later.look_at, [0.0, 0.0, 0.125])
    np.testing.assert_allclose(later.up, [0.0, 0.6, 0.8])
    assert later.fov == pytest.approx(math.radians(55.5))
    assert state_to_query(after)["path"] == KEYS
    assert "path" not in state_to_query(replace(after, camera_keys=()))
    key = after.camera_keys[0]
    many = replace(after, camera_keys=tuple(replace(key, frame=number) for number in range(200)))
    assert (holds_path(after), holds_path(many)) == (True, False)
    assert "path" not in state_to_query(many)


def test_an_empty_query_leaves_everything_to_the_content() -> None:
    empty = state_from_query({})
    assert (empty.frame, empty.sequence_name, empty.layers, empty.pose) == (0, None, None, None)
    assert dict(empty.layer_changes) == dict(empty.parameter_changes) == {}
    assert empty.theme == "as the browser"
    assert empty.does_loop
    hidden = state_from_query({"show": ""}).layer_changes
    assert hidden["nodes"] is False
    assert not any(hidden.values())


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ({"f": "-1"}, "f"),
        ({"f": "1e3"}, "f"),
        ({"f": "9" * 300}, "f"),
        ({"f": "²"}, "f"),
        ({"cam": "1,2,3"}, "cam"),
        ({"path": "1,2,3"}, "path"),
        ({"path": KEYS.replace("17,", "3,")}, "path: keys: there are two key frames of frame 3"),
        ({"path": KEYS.replace("17,", "1.5,")}, "path: key frame"),
        ({"path": KEYS.replace("55.5", "190")}, "path: key frame"),
        ({"path": "3,1,-2,0.5,1,-2,0.5,0,0,1,40"}, "path: cam"),
        ({"path": f"{KEYS};" * 50}, "path: the value is too long"),
        ({"cam": "1,2,3,4,5,nan"}, "cam"),
        ({"cam": "1,2,3,1,2,3"}, "cam"),
        ({"cam": "0,0,1,0,0,0"}, "up"),
        ({"cam": "1e9,0,0,0,0,0"}, "cam"),
        ({"fov": "40"}, "cam"),
        ({"cam": "1,0,0,0,0,0", "fov": "0"}, "fov"),
        ({"show": "nodes,everything"}, "show"),
        ({"show": "dark"}, "show"),
        ({"scale": "inf"}, "scale"),
        ({"mass": "0"}, "mass"),
        ({"theme": "<script>"}, "theme"),
        ({"play": "yes"}, "play"),
        ({"speed": "0"}, "speed"),
        ({"part": "20,4"}, "part"),
        ({"part": "4,"}, "part"),
        ({"drag": "-1"}, "drag"),
        ({"drag": "nan"}, "drag"),
        ({"drag": "none"}, "drag"),
        ({"max_neighbors": "1001"}, "max_neighbors"),
        ({"substeps_per_frame": "1000000"}, "substeps_per_frame"),
        ({"frame_rate": "60"}, "frame_rate"),
        ({"self_collision": "True"}, "self_collision"),
        ({"color": "loud"}, "color"),
        ({"range": "2,1"}, "range"),
        ({"range": "1"}, "range"),
        ({"argv": "--host"}, "argv"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_field(query: dict[str, str], field: str) -> None:
    with pytest.raises(UsageError, match=f"^'?{field}"):
        state_from_query(query)
