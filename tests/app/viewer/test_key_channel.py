"""Held keys: what they mean as somebody looks at the scene, and what a page may say."""

import json

import numpy as np
import pytest

from app.viewer.content.session_state import Pose
from app.viewer.steer.key_channel import KeyChannel, velocity_of, view_axes
from physhandi.errors import UsageError


def pose(position, look_at, up=(0.0, 0.0, 1.0)) -> Pose:
    return Pose(
        position=np.array(position, float),
        look_at=np.array(look_at, float),
        up=np.array(up, float),
        fov=0.8,
    )


def test_ahead_is_where_one_looks_on_level_ground() -> None:
    axes = view_axes(pose((3.0, 0.0, 4.0), (0.0, 0.0, 0.0)))
    np.testing.assert_allclose(axes, [[-1, 0, 0], [0, 1, 0], [0, 0, 1]], atol=1e-12)
    # Who looks straight down walks where the top of the picture is.
    axes = view_axes(pose((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0)))
    np.testing.assert_allclose(axes, [[0, 1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("KeyW", (0, 2, 0, 0, 0, 0)),
        ("KeyS", (0, -2, 0, 0, 0, 0)),
        ("KeyD", (2, 0, 0, 0, 0, 0)),
        ("KeyA", (-2, 0, 0, 0, 0, 0)),
        ("KeyE", (0, 0, 2, 0, 0, 0)),
        ("KeyQ", (0, 0, -2, 0, 0, 0)),
        ("KeyI", (0, 0, 0, -3, 0, 0)),  # Its top goes ahead.
        ("KeyK", (0, 0, 0, 3, 0, 0)),
        ("KeyJ", (0, 0, 0, 0, 0, 3)),  # Counter-clockwise from above.
        ("KeyL", (0, 0, 0, 0, 0, -3)),
        ("KeyU", (0, 0, 0, 0, -3, 0)),  # Counter-clockwise as it is seen.
        ("KeyO", (0, 0, 0, 0, 3, 0)),
    ],
)
def test_each_key_moves_or_turns_one_way(key: str, expected) -> None:
    axes = view_axes(pose((0.0, -5.0, 1.0), (0.0, 0.0, 0.0)))
    found = velocity_of(frozenset({key}), axes, 2.0, 3.0)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_two_keys_are_no_faster_than_one_and_opposite_ones_stand_still() -> None:
    axes = view_axes(pose((0.0, -5.0, 1.0), (0.0, 0.0, 0.0)))
    diagonal = velocity_of(frozenset({"KeyW", "KeyE", "KeyJ"}), axes, 2.0, 3.0)
    np.testing.assert_allclose(diagonal, [0, 2**0.5, 2**0.5, 0, 0, 3], atol=1e-12)
    still = velocity_of(frozenset({"KeyW", "KeyS", "KeyU", "KeyO"}), axes, 2.0, 3.0)
    assert still == (0.0,) * 6


def channel() -> tuple[KeyChannel, list]:
    heard: list = []
    channel = KeyChannel()
    channel.attach(lambda held: heard.append(sorted(held)), heard.append)
    return channel, heard


def test_a_page_tells_what_is_held_and_is_told_what_goes_on() -> None:
    keys, heard = channel()
    said: list = []
    keys.listen(said.append)
    keys.hear('{"held": ["KeyW", "KeyL"]}')
    keys.hear('{"press": "undo"}')
    assert heard == [[], ["KeyL", "KeyW"], "undo"]
    keys.tell({"steering": True})
    keys.tell({"steering": True})
    keys.detach()
    assert [json.loads(text)["steering"] for text in said] == [False, True, False]
    assert len(heard) == 3
    keys.hear('{"held": ["KeyW"]}')
    assert len(heard) == 3


def test_keys_of_a_page_that_goes_or_is_replaced_are_let_go() -> None:
    keys, heard = channel()
    first: list = []
    second: list = []
    keys.listen(first.append)
    keys.hear('{"held": ["KeyW"]}')
    keys.listen(second.append)
    assert first[-1] is None
    assert heard[-1] == []
    keys.hear('{"held": ["KeyA"]}')
    keys.leave(first.append)  # It is somebody else's channel by now.
    assert heard[-1] == ["KeyA"]
    listener = second.append
    keys.listen(listener)
    keys.hear('{"held": ["KeyA"]}')
    keys.leave(listener)
    assert heard[-1] == []


@pytest.mark.parametrize(
    "text",
    [
        "",
        "held",
        "[]",
        "NaN",
        '{"held": "KeyW"}',
        '{"held": ["KeyX"]}',
        '{"held": ["KeyW", 1e999]}',
        '{"press": "format"}',
        '{"hold": ["KeyW"]}',
        '{"held": ' + 200 * '["KeyW"' + "]}",
        '{"held": ["KeyW\ud800"]}',
    ],
)
def test_what_is_no_message_is_refused_and_changes_nothing(text: str) -> None:
    keys, heard = channel()
    with pytest.raises(UsageError):
        keys.hear(text)
    assert heard == []
    with pytest.raises(UsageError, match="KeyW, KeyS, KeyA"):
        keys.hear('{"held": ["Enter"]}')
