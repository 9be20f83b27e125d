"""Editing in a live scene: what a shape selects, what buttons do to it, and the way back."""

import json
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from support.physics.spring_world import two_springs
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import rest_at
from support.waiting import LIMIT_S

from app.viewer.content.session_state import Pose
from app.viewer.edit import selection
from app.viewer.edit.edit_panel import attach_to_nearest, pairs_to_join
from app.viewer.edit.selection import (
    MOST_SHAPE_BYTES,
    Cover,
    DrawnShape,
    Polygon,
    ScreenView,
    Selection,
    Stroke,
    ends_of,
    select,
    springs_between,
    within,
)
from app.viewer.session import Session
from app.viewer.sessions import Sessions
from app.viewer.steer.steered import begin_motion
from physhandi.errors import UsageError
from physhandi.run import Run

AT = 4
CHOSEN = "/edit/chosen_nodes"


def eye_of(pose: Pose, aspect: float) -> ScreenView:
    view = pose.camera(100, 100).T_world_camera
    return ScreenView(position=view[:3, 3], axes=view[:3, :3].T, fov=pose.fov, aspect=aspect)


POSE = Pose(
    position=np.array([0.3, -2.0, 1.2]),
    look_at=np.array([0.1, 0.0, 0.2]),
    up=np.array([0.0, 0.0, 1.0]),
    fov=0.8,
)


def test_points_are_found_where_a_camera_of_the_same_pose_sees_them() -> None:
    point = np.random.default_rng(3).normal(0.0, 0.4, (50, 3))
    camera = POSE.camera(1600, 900)
    ahead = (
        np.concatenate([point, np.ones((50, 1))], axis=1) @ np.linalg.inv(camera.T_world_camera).T
    )
    pixel = ahead[:, :3] @ camera.K.T
    # The middle of the upper left pixel of so many is (0, 0) there.
    expected = (pixel[:, :2] / pixel[:, 2:] + 0.5) / [1600, 900]
    eye = eye_of(POSE, 1600 / 900)
    np.testing.assert_allclose(eye.project(point), expected, atol=1e-9)
    assert np.isnan(eye.project(np.array([[0.5, -4.0, 2.2]]))).all()


def test_a_polygon_holds_what_is_within_it() -> None:
    hook = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.7, 0.9], [0.7, 0.3], [0.1, 0.3]])
    place = np.array([[0.2, 0.2], [0.8, 0.8], [0.4, 0.6], [0.95, 0.5], [0.05, 0.2], [np.nan, 0.2]])
    assert within(hook, place).tolist() == [True, True, False, False, False, False]
    assert within(hook[::-1], place).tolist() == [True, True, False, False, False, False]
    crossed = np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    beside = np.array([[0.1, 0.5], [0.9, 0.5], [0.5, 0.1], [0.5, 0.9]])
    assert within(crossed, beside).tolist() == [True, True, False, False]
    box = Polygon.rectangle((0.2, 0.4), (0.3, 0.9))
    assert box.holds(np.array([[0.25, 0.5], [0.5, 0.25]]), 1.0).tolist() == [True, False]


def test_a_brush_holds_what_it_went_over_in_a_round_on_the_screen() -> None:
    stroke = Stroke(points=np.array([[0.2, 0.5], [0.6, 0.5]]), radius=0.1)
    place = np.array([[0.4, 0.59], [0.4, 0.61], [0.64, 0.5], [0.66, 0.5], [np.nan, 0.5]])
    # The screen is twice as wide as high: 0.05 of its width are 0.1 of its height.
    assert stroke.holds(place, 2.0).tolist() == [True, False, True, False, False]
    dab = Stroke(points=np.array([[0.2, 0.5]]), radius=0.1)
    assert dab.holds(np.array([[0.2, 0.58], [0.3, 0.5]]), 2.0).tolist() == [True, False]


def test_selections_are_replaced_added_to_and_taken_from() -> None:
    first = Selection(nodes=frozenset({1, 2}), springs=frozenset({(0, 1)}))
    new = Selection(nodes=frozenset({2, 3}), virtual=frozenset({(4, 0)}))
    assert first.changed(new, "replace") is new
    added = first.changed(new, "add")
    assert (added.nodes, added.springs, added.virtual) == ({1, 2, 3}, {(0, 1)}, {(4, 0)})
    assert first.changed(new, "remove").nodes == {1}
    assert first.changed(new, "toggle").nodes == {1, 3}
    assert added.text == "3 nodes, 1 spring, 1 virtual spring"
    assert Selection().text == "nothing"
    assert ends_of(added) == {0, 1, 2, 3, 4}
    model = two_springs().model
    kept = Selection(
        nodes=frozenset({2, 3}), springs=frozenset({(0, 1), (1, 2)}), virtual=frozenset({(0, 0)})
    ).within(model)
    assert (kept.nodes, kept.springs, kept.virtual) == ({2}, {(0, 1)}, {(0, 0)})
    assert springs_between(model, frozenset({0, 1})) == {(0, 1)}
    assert springs_between(model, frozenset({0, 2})) == frozenset()


def test_a_spring_is_selected_where_its_middle_is_while_it_is_attached() -> None:
    rollout = two_springs()
    eye = eye_of(POSE, 1.0)
    for kind, middle in (("springs", [0.5, 0.0, 0.0]), ("virtual springs", [0.0, 0.0, 0.5])):
        (place,) = eye.project(np.array([middle]))
        box = Polygon.rectangle(tuple(place - 0.01), tuple(place + 0.01))
        found = select(eye, box, rollout, 0, kind)
        expected = {(0, 1)} if kind == "springs" else {(0, 0)}
        assert (found.springs or found.virtual) == expected
        assert not select(eye, box, rollout, 0, "nodes")
    # In frame 3 node 1 is 0.3 m on, and the middle of its spring 0.15 m.
    (place,) = eye.project(np.array([[0.65, 0.0, 0.0]]))
    box = Polygon.rectangle(tuple(place - 0.01), tuple(place + 0.01))
    assert select(eye, box, rollout, 3, "springs").springs == {(0, 1)}
    assert not select(eye, box, rollout, 0, "springs")


def test_what_lies_behind_a_surface_is_hidden() -> None:
    plate = np.array([[-0.5, -0.5, 1.0], [0.5, -0.5, 1.0], [0.5, 0.5, 1.0], [-0.5, 0.5, 1.0]])
    face = np.array([[0, 1, 2], [0, 3, 2]])  # They look to opposite sides.
    eye = np.array([0.0, 0.0, 3.0])
    # The shadow of a plate 2 m from the eye is 1.5 times as wide on the ground, 3 m from it.
    point = np.array(
        [[0.74, 0, 0], [0.76, 0, 0], [-0.7, 0.74, 0], [0, 0, 0.99], [0, 0, 1.5], [0, 0, 5]]
    )
    hidden = Cover(vertex=plate, face=face, depth=0.02).hides(eye, point)
    assert hidden.tolist() == [True, False, True, False, False, False]
    thin = Cover(vertex=plate, face=face, depth=0.005)
    assert thin.hides(eye, point[3:4]).tolist() == [True]
    assert thin.hides(eye, point[:0]).tolist() == []
    none = Cover(vertex=plate, face=face[:0], depth=0.0)
    assert not none.hides(eye, point).any()


def test_hidden_points_are_those_whose_ray_meets_a_triangle_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    random = np.random.default_rng(5)
    vertex, eye = random.normal(0.0, 0.5, (30, 3)), np.array([0.1, -2.5, 0.4])
    face = np.arange(30).reshape(10, 3)
    point = random.normal(0.0, 0.7, (80, 3))
    depth = 0.1

    def is_hidden(place: np.ndarray) -> bool:
        distance = np.linalg.norm(place - eye)
        for a, b, c in vertex[face]:
            sides = np.stack([b - a, c - a, eye - place], axis=1)
            u, v, part = np.linalg.solve(sides, eye - a)
            if min(u, v, 1.0 - u - v, part) > 0.0 and part * distance < distance - depth:
                return True
        return False

    expected = [is_hidden(place) for place in point]
    assert 10 < sum(expected) < 70
    cover = Cover(vertex=vertex, face=face, depth=depth)
    assert cover.hides(eye, point).tolist() == expected
    monkeypatch.setattr(selection, "_MOST_PAIRS", 25)  # Two points at a time.
    assert cover.hides(eye, point).tolist() == expected


def test_nodes_are_joined_and_attached_to_what_is_nearest() -> None:
    rollout = two_springs()
    assert pairs_to_join(rollout, np.array([0, 1, 2])) == ((0, 2), (1, 2))
    with pytest.raises(UsageError, match="joined to each other already"):
        pairs_to_join(rollout, np.array([0, 1]))
    with pytest.raises(UsageError, match="two nodes or more"):
        pairs_to_join(rollout, np.array([0]))
    tied = attach_to_nearest(rollout, 3, np.array([1]))
    assert (tied.nodes, tied.controls, tied.frame) == ((1,), (0,), 3)
    assert tied.lengths[0] == pytest.approx(np.hypot(1.3, 1.0))


@pytest.fixture
def scene(sessions: Sessions) -> Iterator[tuple[Session, ViewerClient]]:
    """The sheet seen from above, at rest in a frame in which it is lifted, and being edited."""
    session = sessions.get(sessions.open("run", "sheet", "me"))
    with ViewerClient(f"ws://127.0.0.1:{session.port}") as client:
        client.tell_camera(**camera_above())
        wait(client, lambda: "simulated" in texts(client))
        rest_at(client, AT)
        wait(client, lambda: session._playback.frame == AT)
        client.set("Edit (B)", True)
        wait(client, lambda: "Selected: " in texts(client) and "/edit/nodes" in client.nodes)
        yield session, client


def camera_above() -> dict[str, object]:
    """A camera above the sheet: x of the world is right of the screen, y is up."""
    return {"position": (0.0, 0.0, 1.0), "look_at": (0.0, 0.0, 0.0), "wxyz": (0.0, 1.0, 0.0, 0.0)}


def texts(client: ViewerClient) -> str:
    """All that the panel says."""
    said = (p.get("content", p.get("_markdown")) for p in client.gui.values())
    return "\n".join(str(content) for content in said if content)


def wait(client: ViewerClient, condition: Callable[[], object]) -> None:
    client.until(condition, LIMIT_S)


def draw(session: Session, client: ViewerClient, low, high, modifier: str | None = None) -> None:
    """Draw a rectangle around part of the world, as a browser tells of it."""
    camera = session._server.get_clients()[next(iter(session._server.get_clients()))].camera
    eye = ScreenView.of(camera)
    corner = eye.project(np.array([[*low, 0.05], [*high, 0.05]]))
    client.send(
        "ScenePointerMessage",
        event_type="rect-select",
        ray_origin=None,
        ray_direction=None,
        screen_pos=(corner.min(axis=0).tolist(), corner.max(axis=0).tolist()),
        modifier=modifier,
    )


def is_marked(client: ViewerClient, place: np.ndarray) -> bool:
    """Whether nodes at these places, and no others, are drawn as selected."""
    shown = client.nodes.get(CHOSEN, {}).get("points", np.zeros(0)).reshape(-1, 3)
    return len(shown) == len(place) and np.allclose(shown, place, atol=1e-6)


def selected(client: ViewerClient) -> str:
    return texts(client).partition("data-selected>")[2].partition("<")[0]


def test_what_the_object_hides_can_be_left_out(scene, run: Run) -> None:
    session, client = scene
    y = run.array("sequences/lift/rollout.npy")[AT][:, 1]
    every = (-0.4, -0.4), (0.4, 0.4)
    draw(session, client, *every)
    wait(client, lambda: selected(client) == "81 nodes")
    client.set("Only what is seen", True)
    board = np.array([[-0.4, 0.0, 0.9], [0.4, 0.0, 0.9], [0.4, 0.4, 0.9], [-0.4, 0.4, 0.9]])
    session._edit._surface = SimpleNamespace(
        node_count=81, tube=None, face=np.array([[0, 1, 2], [0, 2, 3]]), place=lambda _: board
    )
    draw(session, client, *every)
    seen = np.count_nonzero(y < 0.0)
    assert 30 < seen < 50
    wait(client, lambda: selected(client) == f"{seen} nodes")
    client.set("Only what is seen", False)
    draw(session, client, *every)
    wait(client, lambda: selected(client) == "81 nodes")


def test_a_rectangle_selects_and_each_button_is_one_step(scene, run: Run) -> None:
    session, client = scene
    position = run.array("sequences/lift/rollout.npy")
    # The camera is 1 m above the ground, the corners of the rectangle are 0.95 m below it.
    x, y, z = position[AT].T
    right = np.flatnonzero(x / (1.0 - z) > 0.03 / 0.95)
    assert 9 < len(right) < 40
    draw(session, client, (0.03, -0.3), (0.3, 0.3))
    wait(client, lambda: selected(client) == f"{len(right)} nodes")
    wait(client, lambda: is_marked(client, position[AT][right]))
    draw(session, client, (0.03, -0.3), (0.3, 0.01), "cmd/ctrl")
    fewer = [node for node in right if y[node] / (1.0 - z[node]) > 0.01 / 0.95]
    assert 0 < len(fewer) < len(right)
    wait(client, lambda: selected(client) == f"{len(fewer)} nodes")
    draw(session, client, (0.03, -0.3), (0.3, 0.3), "shift")
    wait(client, lambda: selected(client) == f"{len(right)} nodes")

    history = session._object.panel.history
    client.set("Nodes", "Pin")
    wait(client, lambda: f"Pin {len(right)} nodes from frame {AT} on" in texts(client))
    # The panel may still tell of the rollout before, which was simulated to its end, too.
    newest = lambda: session._object.newest  # noqa: E731
    wait(client, lambda: newest().edits and newest().ready == len(position))
    rollout = newest()
    assert rollout.model.pin_count == len(right)
    np.testing.assert_allclose(rollout.position[:AT], position[:AT], atol=1e-6)
    held, free = (
        np.abs(p[-1][right] - position[AT][right]).max() for p in (rollout.position, position)
    )
    assert held < 0.025 < 0.6 * free

    client.set("Multiply", "Stiffness")
    wait(client, lambda: "Stiffness ×0.5 of" in texts(client))
    client.set("Springs", "Cut")
    wait(client, lambda: len(history.setting.edits) == 3)
    cut = history.setting.edits[2]
    own = rollout.model.spring_nodes[: rollout.model.object_spring_count]
    expected = own[np.isin(own, right).all(axis=1)]
    assert cut.springs == tuple(sorted(map(tuple, np.sort(expected, axis=1).tolist())))
    assert cut.title == f"Cut {len(expected)} springs"
    wait(client, lambda: client.value("History") == f"3 · {cut.title}")
    client.set("Steps", "Undo")
    wait(client, lambda: len(history.setting.edits) == 2)
    client.set("Steps", "Reset")
    fitted = session._content.fitted
    wait(client, lambda: "No edits." in texts(client) and session._object.newest is fitted)
    assert len(history.steps) == 4


def test_a_lasso_and_a_brush_select_when_the_pointer_goes_up(scene, run: Run) -> None:
    session, client = scene
    position = run.array("sequences/lift/rollout.npy")[AT]
    (camera,) = (c.camera for c in session._server.get_clients().values())
    place = ScreenView.of(camera).project(position)

    def tell(tool: str, points, way: str = "replace", radius: float = 0.0) -> None:
        shape = {"tool": tool, "points": points, "way": way, "radius": radius}
        session.select(DrawnShape.parse(json.dumps(shape).encode()))

    assert "data-draws" not in texts(client)
    client.set("Tool", "lasso")
    wait(client, lambda: 'data-draws="lasso"' in texts(client))
    triangle = [[0.5, 0.5], [1.0, 0.0], [1.0, 1.0]]
    inside = (place[:, 0] > 0.5) & (np.abs(place[:, 1] - 0.5) < place[:, 0] - 0.5)
    tell("lasso", triangle)
    assert session._edit.selection.nodes == set(np.flatnonzero(inside).tolist())
    assert 5 < inside.sum() < 40
    client.set("Tool", "brush")
    client.set("Brush [%]", 5.0)
    wait(client, lambda: 'data-draws="brush" data-radius="0.05"' in texts(client))
    tell("brush", [place[0].tolist()], "add", 0.001)
    assert session._edit.selection.nodes == {0, *np.flatnonzero(inside).tolist()}
    tell("brush", [[0.0, 0.5], [1.0, 0.5]], "remove", 1.0)
    assert not session._edit.selection
    client.set("Back to playback (B)", True)
    wait(client, lambda: "data-draws" not in texts(client))
    tell("lasso", triangle)
    assert not session._edit.selection


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "Expected `object`"),
        ('{"tool": "lasso", "way": "replace", "points": []}', "points"),
        ('{"tool": "knife", "way": "replace", "points": [[0, 0]]}', "knife"),
        ('{"tool": "lasso", "way": "add", "points": [[0, 99]]}', r"\$.points\[0\]\[1\]"),
        ('{"tool": "lasso", "way": "add", "points": [[0, 0]], "more": 1}', "more"),
        (" " * (MOST_SHAPE_BYTES + 1), "at most"),
    ],
)
def test_a_page_that_tells_of_no_shape_is_refused(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        DrawnShape.parse(text.encode())


def test_what_cannot_be_edited_changes_nothing(scene, run: Run) -> None:
    session, client = scene
    history = session._object.panel.history
    client.set("Nodes", "Pin")
    wait(client, lambda: client.is_told("Nothing is selected."))
    client.set("Selection", "All")
    wait(client, lambda: selected(client) == "81 nodes")
    client.set("Selection", "Invert")
    wait(client, lambda: selected(client) == "nothing")
    x, y, z = run.array("sequences/lift/rollout.npy")[AT][0]
    place = 0.95 * np.array([x, y]) / (1.0 - z)
    draw(session, client, place - 0.002, place + 0.002)
    wait(client, lambda: selected(client) == "1 node")
    client.set("Springs", "Join")
    wait(client, lambda: client.is_told("two nodes or more"))
    client.set("Nodes", "Release")
    wait(client, lambda: client.is_told("nothing to release"))
    client.set("Factor", 1.0)
    client.set("Multiply", "Damping")
    wait(client, lambda: client.is_told("No spring joins two"))
    assert history.steps == (history.begin,)


def test_clicks_select_while_editing_and_read_otherwise(scene, run: Run) -> None:
    session, client = scene
    node = run.array("sequences/lift/rollout.npy")[AT]

    def click(number: int, modifier: str | None = None) -> None:
        client.send(
            "ScenePointerMessage",
            event_type="click",
            ray_origin=(float(node[number, 0]), float(node[number, 1]), 3.0),
            ray_direction=(0.0, 0.0, -1.0),
            screen_pos=((0.5, 0.5),),
            modifier=modifier,
        )

    client.set("Surface", False)
    client.set("Object nodes", True)
    layers = session._view.scene.layers
    wait(client, lambda: layers.nodes and not layers.surface)
    click(0)
    wait(client, lambda: session._edit.selection.nodes == {0})
    click(8, "shift")
    wait(client, lambda: session._edit.selection.nodes == {0, 8})
    click(0, "shift")
    wait(client, lambda: session._edit.selection.nodes == {8})
    client.set("Select", "springs")
    wait(client, lambda: not session._edit.selection)
    click(8)
    wait(client, lambda: len(session._edit.selection.springs) == 2)
    assert all(8 in pair for pair in session._edit.selection.springs)
    assert session._inspector.pick is None
    client.set("Back to playback (B)", True)
    wait(client, lambda: client.find("Edit (B)"))
    assert not session._edit.selection
    click(8)
    wait(client, lambda: session._inspector.pick is not None)


def test_edits_are_saved_as_a_run_and_go_into_a_copy_but_not_into_a_link(
    scene, sessions: Sessions, begun: list[Run]
) -> None:
    session, client = scene
    assert session.state.edits is None
    draw(session, client, (-0.3, -0.3), (-0.02, 0.3))
    wait(client, lambda: selected(client).endswith("nodes"))
    client.set("Springs", "Cut")
    wait(client, lambda: session.state.edits)
    edits = session.state.edits
    newest = lambda: session._object.newest  # noqa: E731
    wait(client, lambda: newest().edits and newest().ready > 0)
    rollout, frame = session._object.at(0)
    assert begin_motion(rollout, frame, {}, {}).is_edited
    assert not begin_motion(session._content.fitted, 0, {}, {}).is_edited
    client.set("name", "Cut sheet")
    client.set("Save as", "Run")
    wait(client, lambda: begun)
    (saved,) = begun
    assert list(saved.config) == ["source", "edits", "parameters"]
    assert saved.config["edits"]["steps"] == [edits[0].title]
    stored = json.loads((saved.folder / "edits.json").read_text())
    assert len(stored[0]["springs"]) == len(edits[0].springs) > 0
    copied = sessions.get(sessions.copy(session))
    assert copied.state.edits == edits
    assert session.snapshot().link == ""
