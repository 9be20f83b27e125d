import pytest

from app.viewer.physics.parameters import changes_in, ground_knobs, knobs, knobs_of
from physhandi.simulation.parameters import SimulationParameters


def what_changed(*arguments, **options) -> str:
    return ", ".join(change.text for change in changes_in(*arguments, **options))


START = SimulationParameters(connection_radius=0.0237, damping=20.0)


def test_every_slider_shows_the_fitted_value_and_gives_it_back() -> None:
    for unit in ("m", "squares"):
        for knob in (
            *knobs(START, length_unit=unit),
            *(k for k in knobs_of("self-collision", START, length_unit=unit) if hasattr(k, "low")),
        ):
            value = knob.to_slider(START)
            assert knob.low <= value <= knob.high
            assert knob.from_slider(value) == pytest.approx(getattr(START, knob.field))


def test_lengths_are_millimetres_only_if_the_recording_is_metric() -> None:
    metric, squares = knobs(START, length_unit="m")[0], knobs(START, length_unit="squares")[0]
    assert (metric.label, metric.to_slider(START)) == ("δ object [mm]", pytest.approx(23.7))
    assert (squares.label, squares.to_slider(START)) == (
        "δ object [squares]",
        pytest.approx(0.0237),
    )


def test_a_wider_fit_widens_its_slider() -> None:
    wide = SimulationParameters(connection_radius=0.2, max_neighbors=120)
    by_field = {knob.field: knob for knob in knobs(wide, length_unit="m")}
    assert by_field["connection_radius"].to_slider(wide) == pytest.approx(200.0)
    assert by_field["max_neighbors"].to_slider(wide) == 120


def test_no_slider_reaches_beyond_what_its_parameter_may_be() -> None:
    for fitted in (START, START.replace(drag=9e5, stiffness=9e7, connection_radius=999.0)):
        for unit in ("m", "squares"):
            for knob in knobs(fitted, length_unit=unit):
                assert START.replace(**{knob.field: knob.from_slider(knob.high)}) != START
    strong = START.replace(stiffness=9e7)
    knob = next(k for k in knobs(strong, length_unit="m") if k.field == "stiffness")
    assert knob.from_slider(knob.high) == pytest.approx(1e8, rel=1e-3)


def test_stiffness_is_moved_by_powers_of_ten() -> None:
    knob = next(k for k in knobs(START, length_unit="m") if k.field == "stiffness_scale")
    assert (knob.label, knob.from_slider(-1.0), knob.from_slider(0.5)) == ("stiffness", 0.1, 3.162)
    for factor in (0.01, 0.2, 0.3333, 7.654):
        moved = START.replace(stiffness_scale=factor)
        assert knob.from_slider(knob.to_slider(moved)) == factor


def test_what_changed_is_said_in_the_sliders_units() -> None:
    now = SimulationParameters(connection_radius=0.035, damping=20.0, stiffness_scale=0.5)
    text = what_changed(knobs(START, length_unit="m"), START, now)
    assert text == "δ object [mm] 23.7 → 35, stiffness ×1 → ×0.5"
    assert what_changed(knobs(START, length_unit="m"), START, START) == ""
    other = START.replace(use_control_velocity=False, rest_length_floor=0.0)
    changes = changes_in(knobs(START, length_unit="m"), START, other, is_automatic=True)
    assert [change.text for change in changes] == [
        "substeps 667 → automatic",
        "shortest object spring [m] 0.001 → 0",
        "dashpots see the hand move on → off",
    ]
    assert changes[1].fields == ("rest_length_floor",)


def test_self_collision_is_a_box_and_its_sliders() -> None:
    on = SimulationParameters(self_collision=True, collision_distance=0.008, self_friction=1.0)
    controls = {knob.field: knob for knob in knobs_of("self-collision", on, length_unit="m")}
    box, distance = controls["self_collision"], controls["collision_distance"]
    assert (box.to_slider(START), box.to_slider(on)) == (False, True)
    assert (box.from_slider(True), box.from_slider(False)) == (True, False)
    assert (distance.label, distance.to_slider(on)) == ("distance [mm]", pytest.approx(8.0))
    assert distance.from_slider(12.0) == pytest.approx(0.012)
    text = what_changed(tuple(controls.values()), SimulationParameters(), on)
    assert text == "nodes collide off → on, distance [mm] 5 → 8, friction of nodes 0.3 → 1"


def test_hands_that_push_are_a_box_and_their_sliders() -> None:
    box, stiffness, friction = knobs_of("hands", START, length_unit="m")
    on = START.replace(hand_pushes=True, push_stiffness=1e6, hand_friction=1.5)
    assert (box.to_slider(START), box.to_slider(on)) == (False, True)
    assert stiffness.from_slider(stiffness.to_slider(on)) == pytest.approx(1e6)
    assert friction.to_slider(on) == 1.5
    assert stiffness.to_slider(START) == 0.0
    slippery = START.replace(hand_pushes=True, hand_friction=0.0)
    text = what_changed((box, friction), START, slippery)
    assert text == "hands push off → on, friction of hands 0.5 → 0"


def test_the_ground_is_a_box_and_its_height() -> None:
    box, height, *_ = ground_knobs(START, length_unit="m", low=0.01, high=0.2)
    none = START.replace(ground_height=None)
    assert (box.to_slider(START), box.to_slider(none), box.to_slider(START)) == (True, False, True)
    assert (box.from_slider(False), box.from_slider(True)) == (None, 0.0)
    lower = START.replace(ground_height=height.from_slider(-120.0))
    assert lower.ground_height == pytest.approx(-0.12)
    assert height.to_slider(lower) == -120.0
    # No higher than the lowest node, which would be thrown out of the ground.
    assert height.from_slider(500.0) == pytest.approx(0.01)
    knobs_ = (box, height)
    assert what_changed(knobs_, START, lower) == "ground height [mm] 0 → -120"
    assert what_changed(knobs_, START, none) == "ground on → off"
    floating = ground_knobs(none, length_unit="m", low=0.3, high=0.5)
    assert floating[0].from_slider(True) == pytest.approx(0.3)


def test_stiffness_of_both_kinds_of_springs_is_moved_apart() -> None:
    by_field = {knob.field: knob for knob in knobs(START, length_unit="m")}
    for field in ("stiffness", "virtual_stiffness"):
        assert by_field[field].to_slider(START) == 0.0
        assert by_field[field].from_slider(-1.0) == pytest.approx(0.1 * getattr(START, field))
    off = START.replace(stiffness=0.0)
    assert "stiffness" not in {knob.field for knob in knobs(off, length_unit="m")}


def test_a_wider_collision_distance_widens_its_slider() -> None:
    wide = SimulationParameters(collision_distance=0.05)
    distance = knobs_of("self-collision", wide, length_unit="m")[1]
    assert distance.to_slider(wide) == pytest.approx(50.0)
