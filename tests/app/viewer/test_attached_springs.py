"""Springs that are attached for some frames only are drawn, read, clicked and saved as such."""

import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.physics.spring_world import content_of, two_springs

from app.viewer.color.coloring import Painter
from app.viewer.content.layers import Layers
from app.viewer.export.bundle import _tables
from app.viewer.export.snapshot import Snapshot, snapshot_npz
from app.viewer.inspect.picking import Pick, Ray, Target, pick
from app.viewer.inspect.readings import Readings, follow
from app.viewer.scene.framing import Framing
from app.viewer.scene.object_drawing import Budget, ObjectDrawing, contact_changes
from physhandi.data.exporters.scene_data import SceneData
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.contact_intervals import NEVER
from physhandi.simulation.restart import Restart

LATE = np.int32([[1, 2]])
"""The spring from the control node acts in frame 2 alone."""


@pytest.fixture
def rollout() -> ObjectRollout:
    world = two_springs()
    return replace(world, model=replace(world.model, attached=LATE))


class DrawnNodes:
    """Keeps what was drawn last below each path."""

    def __init__(self) -> None:
        self.drawn: dict[str, np.ndarray] = {}

    def keep(self, name: str, point: np.ndarray, *_: Any, **__: Any) -> None:
        self.drawn[name] = np.asarray(point)

    points = spheres = segments = arrows = mesh = keep

    def hide(self, *_: str) -> None:
        pass

    def show(self, *_: Any, **__: Any) -> None:
        pass

    def __contains__(self, name: str) -> bool:
        return name in self.drawn


@pytest.mark.parametrize(("frame", "held"), [(0, 0), (1, 0), (2, 1), (3, 0)])
def test_a_spring_is_drawn_while_it_is_attached(
    rollout: ObjectRollout, frame: int, held: int
) -> None:
    nodes: Any = DrawnNodes()
    drawing = ObjectDrawing(
        nodes, Framing(center=np.zeros(3), extent=5.0, low=0.0, spacing=1.0, frustum=0.1)
    )
    layers = Layers(object_springs=True, virtual_springs=True, controls=True)
    drawing.draw(rollout, frame, layers, Budget(), force_unit=0.01, longest=1.0)
    drawn = nodes.drawn
    assert len(drawn["/springs/virtual"]) == held
    assert len(drawn["/springs/object"]) == 1
    assert len(drawn["/controls/attached"]) == held
    assert len(drawn["/forces"]) == held
    if held:
        np.testing.assert_allclose(drawn["/springs/virtual"][0], [[0, 0, 1], [0, 0, 0]])
    assert len(drawing.attached(rollout)) == 1


@pytest.mark.parametrize(
    ("frame", "begun", "ended"),
    [
        (4, [], []),
        (5, [0], []),
        (7, [0], []),
        (8, [], []),
        (9, [], [0]),
        (11, [], [0]),
        (12, [], []),
    ],
)
def test_contact_is_marked_for_three_frames_when_it_begins_and_ends(frame, begun, ended) -> None:
    world = two_springs(14)
    rollout = replace(world, model=replace(world.model, attached=np.int32([[4, 8]])))
    found = contact_changes(rollout.model, frame)
    assert [part.tolist() for part in found] == [begun, ended]
    nodes: Any = DrawnNodes()
    drawing = ObjectDrawing(
        nodes, Framing(center=np.zeros(3), extent=5.0, low=0.0, spacing=1.0, frustum=0.1)
    )
    drawing.draw(rollout, frame, Layers(), Budget(), force_unit=0.01, longest=1.0)
    assert len(nodes.drawn["/contact/begins"]) == len(begun)
    assert len(nodes.drawn["/contact/ends"]) == len(ended)
    drawing.draw(rollout, frame, Layers(forces=False), Budget(), force_unit=0.01, longest=1.0)
    assert len(nodes.drawn["/contact/begins"]) == len(nodes.drawn["/contact/ends"]) == 0
    assert [len(part) for part in contact_changes(world.model, frame)] == [0, 0]


def test_what_is_read_of_a_spring_is_of_the_frame(rollout: ObjectRollout) -> None:
    content = content_of(rollout)
    painter = Painter(content)
    readings = Readings(content, painter)
    node, control, spring = (
        Pick(kind=kind, index=index) for kind, index in (("node", 0), ("control", 0), ("spring", 1))
    )
    early, held = (dict(readings.rows(node, rollout, frame, frame)) for frame in (1, 2))
    assert (early["held by"], held["held by"]) == ("nothing", "control 0 (80 N)")
    assert early["force of the controls"].startswith("0 N")
    assert held["force of the controls"] == "80 N (0, 0, 80)"
    assert dict(readings.rows(control, rollout, 1, 1))["holds"] == "nothing"
    assert dict(readings.rows(control, rollout, 2, 2))["holds"] == "node 0 (80 N)"
    assert [len(readings.links(node, rollout, frame)) for frame in (1, 2, 3)] == [0, 1, 0]
    row = dict(readings.rows(spring, rollout, 2, 2))
    assert row["attached"] == "from frame 1 to 2"
    assert row["stiffness"] == "80 N"
    assert dict(readings.rows(spring, rollout, 3, 3))["stiffness"] == "0 N"
    for_ever = replace(rollout, model=replace(rollout.model, attached=np.int32([[1, NEVER]])))
    assert dict(readings.rows(spring, for_ever, 2, 2))["attached"] == "from frame 1"
    assert "attached" not in dict(readings.rows(spring, two_springs(), 2, 2))
    curve = follow(node, "force", rollout, content, painter)
    np.testing.assert_allclose(curve, [0.0, 0.0, 80.0, 0.0], atol=1e-5)


def test_only_an_attached_spring_can_be_clicked(rollout: ObjectRollout) -> None:
    def click(frame: int) -> Pick | None:
        eye = np.array([0.0, -3.0, 0.5])
        target = Target(
            content=content_of(rollout),
            rollout=rollout,
            frame=frame,
            rollout_frame=frame,
            layers=Layers(nodes=False, controls=False, hands=False),
            spacing=0.1,
        )
        return pick(Ray(origin=eye, direction=np.array([0.0, 1.0, 0.0]), pixel=1e-3), target)

    assert click(1) is None
    assert click(2) == Pick(kind="spring", index=1)


def test_saved_frames_tell_what_is_attached(rollout: ObjectRollout) -> None:
    counts = [_tables({"shown": (rollout, frame)})["controls.csv"].decode() for frame in (1, 2)]
    assert [line.splitlines()[1].split(",")[-1] for line in counts] == ["0", "1"]
    fields = {"frame": 2, "rollout_frame": 2, "layers": Layers(), "link": ""}
    for saved, expected in ((rollout, LATE.tolist()), (two_springs(), None)):
        shown = Snapshot(content=content_of(saved), rollout=saved, **fields)
        with np.load(io.BytesIO(snapshot_npz(shown))) as arrays:
            found = arrays["attached"].tolist() if "attached" in arrays else None
        assert found == expected


def test_exported_frames_have_the_springs_that_are_attached(rollout: ObjectRollout) -> None:
    scene: SceneData = rollout.scene_data()
    assert [len(scene.virtual_springs_in(frame)) for frame in range(4)] == [0, 0, 1, 0]
    older = replace(scene, model={k: v for k, v in scene.model.items() if k != "attached"})
    assert [len(older.virtual_springs_in(frame)) for frame in range(4)] == [1, 1, 1, 1]


def test_springs_end_beside_hands_that_a_restart_moves() -> None:
    world = two_springs()
    state = world.position[1].copy()
    state[0] += [0.0, 0.0, -0.25]
    fields = {"frame": 1, "position": state, "velocity": np.zeros_like(state)}
    moved = replace(world, restart=Restart(**fields, moves_hands=True))
    np.testing.assert_allclose(moved.held_control(1), [[0, 0, 1]])
    np.testing.assert_allclose(moved.held_control(2), [[0, 0, 0.75]])
    # 0.75 m long in frame 2, where node 0 is where it ever was, and 0.5 m at rest.
    assert moved.strains(2)[1] == pytest.approx(0.5)
    np.testing.assert_allclose(moved.forces(2)[0], [0.0, 0.0, 40.0], rtol=1e-6)
    assert moved.model_in(2).rest_length[1] == pytest.approx(0.5)
    np.testing.assert_allclose(moved.restart_arrays()["restart_hand_shift"], [[0, 0, -0.25]])
    scaled = replace(world, restart=Restart(**fields))
    np.testing.assert_allclose(scaled.held_control(2), [[0, 0, 1]])
    assert scaled.model_in(2).rest_length[1] == pytest.approx(0.625)
    assert "restart_hand_shift" not in scaled.restart_arrays()
    # A history is read with the springs of one thing only, and with the same shift.
    content = content_of(moved)
    curve = follow(Pick(kind="node", index=0), "force", moved, content, Painter(content))
    np.testing.assert_allclose(curve, [80.0, 80.0, 40.0, 40.0], atol=1e-4)
