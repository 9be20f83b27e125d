from app.viewer.physics.history import MOST_STEPS, History
from app.viewer.physics.parameters import edits_text
from physhandi.simulation.edits import Cut, Release
from physhandi.simulation.parameters import SimulationParameters

START = SimulationParameters(connection_radius=0.0237, damping=20.0)


def test_undo_redo_and_reset() -> None:
    history = History(START)
    history.set("drag", 5.0)
    history.set("max_neighbors", 40)
    assert history.undo().parameters.max_neighbors == START.max_neighbors
    assert history.current.drag == 5.0
    assert history.redo() == history.setting
    assert history.current.max_neighbors == 40
    assert history.reset() == (START, False, ())
    assert history.undo().parameters.max_neighbors == 40
    history.undo()
    changed = history.set("drag", 9.0)
    assert history.redo() == changed


def test_one_parameter_is_put_back_and_automatic_substeps_are_undone() -> None:
    history = History(START)
    history.set("drag", 5.0)
    history.replace(history.current, is_automatic=True)
    history.set("gravity", 1.0)
    assert history.is_automatic
    history.put_back("drag")
    assert (history.current.drag, history.current.gravity) == (START.drag, 1.0)
    assert history.is_automatic
    history.put_back("substeps_per_frame")
    assert not history.is_automatic
    assert history.undo().parameters.drag == START.drag
    assert history.is_automatic
    assert history.reset() == (START, False, ())


def drags(history: History) -> list[float]:
    return [step.parameters.drag for step in history.steps]


def test_one_gesture_is_one_step_however_many_values_it_has() -> None:
    history = History(START)
    for step in range(24):
        history.set("drag", 4.0 + 0.1 * step, gesture=1)
    assert drags(history) == [START.drag, 4.0 + 0.1 * 23]
    history.set("drag", 7.0, gesture=2)
    history.set("drag", 8.0, gesture=2)
    history.set("gravity", 1.0, gesture=2)
    history.set("drag", 9.0, gesture=2)
    assert drags(history) == [START.drag, 4.0 + 0.1 * 23, 8.0, 8.0, 9.0]


def test_a_gesture_that_was_taken_back_begins_another_step() -> None:
    history = History(START)
    history.set("drag", 4.0, gesture=1)
    assert history.undo() == (START, False, ())
    history.set("drag", 5.0, gesture=1)
    assert drags(history) == [START.drag, 5.0]


def test_a_gesture_that_ends_where_it_began_is_no_step() -> None:
    history = History(START)
    history.set("drag", 4.0, gesture=1)
    history.set("drag", START.drag, gesture=1)
    assert (drags(history), history.index) == ([START.drag], 0)
    history.set("drag", 5.0, gesture=1)
    assert drags(history) == [START.drag, 5.0]
    assert history.undo() == (START, False, ())


def test_every_step_can_be_gone_to_until_another_change_is_made() -> None:
    history = History(START)
    for number, drag in enumerate((4.0, 5.0, 6.0)):
        history.set("drag", drag, gesture=number)
    assert history.go(1).parameters.drag == 4.0
    assert history.go(3).parameters.drag == 6.0
    assert history.go(99).parameters.drag == 6.0
    history.go(2)
    history.set("drag", 7.0, gesture=9)
    assert drags(history) == [START.drag, 4.0, 5.0, 7.0]


def test_the_oldest_steps_go_and_a_gesture_stays_whole() -> None:
    history = History(START)
    for number in range(MOST_STEPS + 5):
        history.set("drag", 100.0 + number, gesture=number)
        history.set("drag", 200.0 + number, gesture=number)
    assert drags(history) == [200.0 + number for number in range(5, MOST_STEPS + 5)]
    assert history.reset() == (START, False, ())


def test_typed_substeps_are_no_longer_automatic() -> None:
    history = History(START)
    history.choose_substeps(is_automatic=True)
    for number in (1, 12, 120):
        history.set("substeps_per_frame", number, gesture=4)
    assert history.setting == (START.replace(substeps_per_frame=120), False, ())
    assert history.undo() == (START, True, ())


def test_a_value_that_is_there_already_is_no_step() -> None:
    history = History(START)
    history.set("drag", START.drag)
    history.replace(START)
    history.choose_substeps(is_automatic=False)
    history.set("drag", 5.0)
    assert history.undo() == (START, False, ())
    assert history.redo().parameters.drag == 5.0


def test_an_edit_is_a_step_that_parameters_leave_alone() -> None:
    own = (Cut(springs=((0, 1),)),)
    history = History(START, own)
    more = (*own, Release(nodes=(3,), frame=4))
    history.edit(more)
    history.set("drag", 5.0, gesture=1)
    history.replace(START.replace(drag=6.0))
    assert history.setting.edits == more
    assert [step.edits for step in history.steps] == [own, more, more, more]
    history.go(1)
    assert history.undo() == (START, False, own)
    assert history.redo().edits == more
    history.edit(more)  # Changes nothing.
    assert len(history.steps) == 4
    assert history.reset() == history.begin == (START, False, own)


def test_steps_say_what_was_edited() -> None:
    cut, let_go = Cut(springs=((0, 1), (1, 2))), Release(nodes=(3,), frame=4)
    assert edits_text((), (cut, let_go)) == ["Cut 2 springs", "Release 1 node from frame 4 on"]
    assert edits_text((cut, let_go), (cut,)) == ["1 edit taken back"]
    assert edits_text((let_go, cut), (cut,)) == ["2 edits taken back", "Cut 2 springs"]
    assert edits_text((cut,), (cut,)) == []
