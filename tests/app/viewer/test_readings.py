"""What is read of a thing, against numbers that were computed by hand."""

from dataclasses import replace

import numpy as np
import pytest
from support.physics.hanging_node import hanging_node
from support.physics.spring_world import content_of, two_springs
from support.viewer.viewer_world import content_of as sheet_with_hands
from support.viewer.viewer_world import controls

from app.viewer.color.coloring import Painter
from app.viewer.color.legend import ColorScale, Legend, legend_head, legend_html, number
from app.viewer.color.quantities import QUANTITIES
from app.viewer.inspect.picking import Pick
from app.viewer.inspect.readings import HISTORIES, Readings, follow, unit_of
from physhandi.simulation.restart import Restart
from physhandi.simulation.simulator import Simulator


@pytest.fixture
def world():
    rollout = two_springs()
    content = content_of(rollout)
    painter = Painter(content)
    return rollout, content, painter, Readings(content, painter)


def test_a_node_tells_its_state_and_what_holds_it(world):
    rollout, _, _, readings = world
    node = Pick(kind="node", index=0)
    assert readings.title(node, rollout) == "object node 0"
    rows = dict(readings.rows(node, rollout, 2, 2))
    assert rows["position"] == "0, 0, 0 m"
    assert rows["velocity"] == "0 m/s (0, 0, 0)"
    # 2 · 40 · (1 / 0.5 - 1) = 80 N upwards, by the control above.
    assert rows["force of the controls"] == "80 N (0, 0, 80)"
    assert rows["held by"] == "control 0 (80 N)"
    assert rows["stiffness"] == "20 N"
    assert rows["damping"] == "2 N·s/m"
    assert rows["strain"] == "20 %"
    assert rows["difference"] == "0 mm"
    assert rows["object springs"] == "1"
    lonely = dict(readings.rows(Pick(kind="node", index=2), rollout, 2, 2))
    assert lonely["held by"] == "nothing"
    assert lonely["strain"] == "not known"
    moving = dict(readings.rows(Pick(kind="node", index=1), rollout, 2, 2))
    assert moving["velocity"].startswith("3 m/s (3, 0, 0)")


def test_a_spring_tells_its_length_and_pull(world):
    rollout, _, _, readings = world
    own, virtual = (Pick(kind="spring", index=i) for i in (0, 1))
    assert readings.title(own, rollout) == "object spring 0"
    assert readings.title(virtual, rollout) == "virtual spring 1"
    rows = dict(readings.rows(own, rollout, 2, 2))
    assert rows["joins"] == "node 0 and node 1"
    assert rows["length"] == "1200 mm, at rest 1000 mm"
    assert rows["strain"] == "20 %"
    # 2 · 10 · 0.2 + 2 · 3 as node 1 runs away.
    assert rows["pull"] == "10 N"
    rows = dict(readings.rows(virtual, rollout, 2, 2))
    assert rows["joins"] == "control node 0 and node 0"
    assert rows["pull"] == "80 N"
    np.testing.assert_allclose(readings.place(virtual, rollout, 2, 2), [[0, 0, 1], [0, 0, 0]])


def test_a_spring_after_a_restart_is_read_with_its_new_rest_length():
    rollout = two_springs()
    state = rollout.position[1].copy()
    state[1, 0] += 0.11  # The spring of 1.1 m becomes 1.21 m long, 1.1 m of it at rest.
    restart = Restart(frame=1, position=state, velocity=np.zeros_like(state))
    rollout = replace(rollout, restart=restart)
    readings = Readings(content_of(rollout), Painter(content_of(rollout)))
    own = Pick(kind="spring", index=0)
    before, after = (dict(readings.rows(own, rollout, frame, frame)) for frame in (1, 2))
    assert before["length"] == "1100 mm, at rest 1000 mm"
    assert "predicted from" not in before
    assert after["length"] == "1200 mm, at rest 1100 mm"
    assert after["strain"] == "9.09 %"
    # 2 · 10 · 0.0909; it gets 0.01 m shorter in the frame, 30 times a second.
    assert after["pull"] == "1.22 N"
    assert after["predicted from"] == "the observed state at frame 1"
    assert "friction" not in after
    smoother = replace(rollout, restart=replace(restart, friction_share=0.125))
    for frame, told in ((1, None), (2, "12 % of the fitted one is left")):
        assert dict(readings.rows(own, smoother, frame, frame)).get("friction") == told
    node = dict(readings.rows(Pick(kind="node", index=1), rollout, 2, 2))
    assert node["velocity"].startswith("0.3 m/s")
    assert node["predicted from"] == "the observed state at frame 1"
    assert readings.exists(own, rollout)
    curve = follow(own, "strain", rollout, content_of(rollout), Painter(content_of(rollout)))
    np.testing.assert_allclose(curve, [0.0, 0.1, 1.2 / 1.1 - 1, 1.3 / 1.1 - 1], atol=1e-6)


def test_a_control_node_tells_what_it_holds(world):
    rollout, _, _, readings = world
    rows = dict(readings.rows(Pick(kind="control", index=0), rollout, 2, 2))
    assert rows["position"] == "0, 0, 1 m"
    assert rows["force on the object"] == "80 N (0, 0, 80)"
    assert rows["holds"] == "node 0 (80 N)"
    assert len(readings.links(Pick(kind="control", index=0), rollout, 2)) == 1


def test_what_is_gone_after_a_change_of_springs_exists_no_more(world):
    rollout, _, _, readings = world
    assert readings.exists(Pick(kind="spring", index=1), rollout)
    fewer = replace(
        rollout.model,
        spring_nodes=rollout.model.spring_nodes[:1],
        rest_length=rollout.model.rest_length[:1],
        stiffness=rollout.model.stiffness[:1],
        damping=rollout.model.damping[:1],
    )
    assert not readings.exists(Pick(kind="spring", index=1), replace(rollout, model=fewer))
    assert not readings.exists(Pick(kind="node", index=0), None)


def test_histories_follow_one_thing_over_all_frames(world):
    rollout, content, painter, _ = world

    def of(kind, index, history):
        unit, factor = unit_of(history, content, painter)
        curve = follow(Pick(kind=kind, index=index), history, rollout, content, painter)
        return unit, (factor * curve).tolist()

    assert of("node", 1, "speed") == ("m/s", pytest.approx([3.0] * 4, rel=1e-5))
    assert of("node", 1, "strain") == ("%", pytest.approx([0, 10, 20, 30], abs=1e-4))
    assert of("spring", 0, "length") == ("mm", pytest.approx([1000, 1100, 1200, 1300]))
    # 20 · strain + 2 · 3.
    assert of("spring", 0, "force") == ("N", pytest.approx([6, 8, 10, 12], rel=1e-5))
    assert of("node", 0, "force") == ("N", pytest.approx([80] * 4))
    assert of("control", 0, "force") == ("N", pytest.approx([80] * 4))
    assert of("control", 0, "height") == ("mm", pytest.approx([1000] * 4))
    painter.reference = replace(rollout, position=rollout.position + np.float32([0, 0.3, 0.4]))
    assert of("node", 1, "difference") == ("mm", pytest.approx([500] * 4))
    for kind, histories in HISTORIES.items():
        for history in histories:
            if kind not in {"hand", "marker"}:
                assert len(of(kind, 0, history)[1]) == 4


def test_a_force_is_averaged_between_frames_once_all_of_them_are_ready():
    rollout = hanging_node(stiffness=np.array([6300.0], np.float32))
    simulator = Simulator(rollout.model, rollout.parameters)
    for frame, position, velocity in simulator.frames(rollout.control):
        rollout.position[frame], rollout.velocity[frame] = position, velocity
    rollout.ready = rollout.frame_count - 1
    content = content_of(rollout)
    painter = Painter(content)

    def of(kind, index):
        return follow(Pick(kind=kind, index=index), "mean force", rollout, content, painter)

    assert np.isnan(of("node", 0)).all()
    rollout.ready += 1
    own = rollout.mean_tensions()[:, 0]
    for kind in ("spring", "control", "node"):
        np.testing.assert_allclose(of(kind, 0), np.abs(own), rtol=1e-5, atol=1e-3)
    assert 7.0 < own[1:].min() < own[1:].max() < 13.0
    # Of a node on no spring.
    np.testing.assert_array_equal(of("node", 1), 0.0)
    assert unit_of("mean force", content, painter)[0] == "N"


def test_a_hand_s_vertex_is_the_control_node_that_it_is():
    control = controls((0, 0, 1))
    face = np.array([[0, 1, 2]], np.int32)
    content = sheet_with_hands({"right": (control[0], face)}, control)
    painter = Painter(content)
    readings = Readings(content, painter)
    vertex = Pick(kind="hand", index=7, side="right")
    assert readings.settle(vertex) == Pick(kind="control", index=7)
    title = readings.title(readings.settle(vertex), content.fitted)
    assert title == "control node 7 (right hand, vertex 7)"
    # Other points than the hand's vertices hold this one.
    apart = sheet_with_hands({"right": (control[0] + 0.01, face)}, control)
    readings = Readings(apart, Painter(apart))
    assert readings.settle(vertex) == vertex
    assert readings.title(vertex, apart.fitted) == "right hand, vertex 7"
    assert dict(readings.rows(vertex, apart.fitted, 0, 0))["position"].endswith(" m")
    speed = follow(vertex, "speed", apart.fitted, apart, painter)
    np.testing.assert_array_equal(speed, np.zeros(len(control)))


def scale(coloring, limits, **fields):
    return ColorScale(quantity=QUANTITIES[coloring], limits=limits, **fields)


def legend(coloring, limits, **fields):
    return Legend(scale=scale(coloring, limits), **fields)


def test_the_scale_has_even_ticks_in_the_quantity_s_unit():
    assert scale("error", (0.0, 0.02)).ticks == pytest.approx([0, 5, 10, 15, 20])
    assert scale("strain", (-0.1, 0.1)).ticks == pytest.approx([-10, -5, 0, 5, 10])
    logarithmic = scale("stiffness", (10.0, 1e5)).ticks
    assert logarithmic == pytest.approx([10, 100, 1000, 1e4, 1e5])
    assert scale("error", (0.0, 0.02), is_open=True).tick_labels[-2:] == ["15", "≥20"]


def test_the_legend_says_what_is_not_known_and_what_is_highest():
    said = legend_html(legend("error", (0.0, 0.02), unknown=3, highest=0.0123), highest=True)
    assert "<b>Error</b><span>mm</span>" in said
    assert "<span>15</span>" in said
    assert "highest node now 12.3&nbsp;mm" in said
    assert "3 nodes not known" in said
    assert "rgb(72,23,105)" in said
    nothing = legend_html(legend("error", (0.0, 0.02), is_known=False), highest=True)
    assert "not known in this frame" in nothing
    assert "highest" not in legend_html(legend("speed", (0.0, 1.0), highest=0.5), highest=False)
    assert "color:black" not in said  # It takes the panel's own color of text.


def test_bars_say_how_often_each_color_is_there_and_are_no_part_of_the_head():
    shown = np.array([0.001, 0.001, 0.0199, 0.5])
    few = legend("error", (0.0, 0.02), highest=0.5, shown=shown)
    shares = few.shares
    assert (len(shares), shares[1], shares[-1], sum(shares)) == (32, 1.0, 1.0, 2.0)
    assert few.frame_limits == (0.0, pytest.approx(0.48))  # 98 % lie below 0.471, rounded up.
    said = legend_html(few)
    assert said.count("<i style") == 32
    assert "height:100%;background:rgb(" in said
    quiet = legend_html(few, highest=False)
    assert "<i style" not in quiet
    later = legend_html(legend("error", (0.0, 0.02), highest=0.1, shown=0.5 * shown))
    assert later != said
    assert legend_head(later) == legend_head(said)
    other = legend_html(legend("error", (0.0, 0.03), highest=0.5, shown=shown))
    assert legend_head(other) != legend_head(said)
    none = legend("error", (0.0, 0.02))
    assert (none.shares, none.frame_limits) == ([], None)
    same = legend("stiffness", (1.0, 2.0), shown=np.array([3.0, 3.0]))
    assert same.frame_limits == (3.0, 6.0)


def test_numbers_are_short():
    shown = [number(v) for v in (0.0, -1e-15, 1234.5, 12.345, 0.001234, 1.5e7, -2.5, 3e-9)]
    assert shown == ["0", "0", "1230", "12.3", "0.00123", "1.5e7", "-2.5", "3e-9"]
