from app.viewer.physics.history import History
from physhandi.simulation.parameters import SimulationParameters

START = SimulationParameters(connection_radius=0.0237, damping=20.0)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_undo_redo_and_reset() -> None:
    history = History(START, Clock())
    history.set("drag", 5.0)
    history.set("max_neighbors", 40)
    assert history.undo().parameters.max_neighbors == START.max_neighbors
    assert history.current.drag == 5.0
    assert history.redo() == history.setting
    assert history.current.max_neighbors == 40
    assert history.reset() == (START, False)
    assert history.undo().parameters.max_neighbors == 40
    history.undo()
    changed = history.set("drag", 9.0)
    assert history.redo() == changed


def test_one_parameter_is_put_back_and_automatic_substeps_are_undone() -> None:
    history = History(START, Clock())
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
    assert history.reset() == (START, False)


def test_one_drag_of_a_slider_is_one_step_however_slow_it_is() -> None:
    clock = Clock()
    history = History(START, clock)
    for step in range(24):
        history.set("drag", 4.0 + 0.1 * step)
        clock.now += 2.0
    assert history.current.drag == 4.0 + 0.1 * 23
    assert history.undo() == (START, False)
    assert history.undo() == (START, False)


def test_a_slider_that_rested_or_was_left_for_another_control_begins_a_step() -> None:
    clock = Clock()
    history = History(START, clock)
    history.set("drag", 4.0)
    clock.now += 10.0
    history.set("drag", 5.0)
    history.set("gravity", 1.0)
    history.set("drag", 6.0)
    history.undo()
    history.set("drag", 7.0)  # Another gesture than the one that was taken back.
    drags = [history.current.drag]
    while history.undo().parameters != START:
        drags.append(history.current.drag)
    assert drags == [7.0, 5.0, 5.0, 4.0]


def test_a_value_that_is_there_already_is_no_step() -> None:
    history = History(START, Clock())
    history.set("drag", START.drag)
    history.replace(START)
    history.set_substeps(START.substeps_per_frame)
    history.set("drag", 5.0)
    assert history.undo() == (START, False)
    assert history.redo().parameters.drag == 5.0
