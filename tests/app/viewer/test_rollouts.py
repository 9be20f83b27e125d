import numpy as np
import pytest
from support.viewer.viewer_world import FRAMES, PARAMETERS

from app.viewer.live.client import LiveRequest, LiveRollouts
from app.viewer.live.wire import Message
from physhandi.object_rollout import load_fitted
from physhandi.simulation.edits import Pin, apply_edits


class FakeLive:
    """Answers when the test says so."""

    def __init__(self) -> None:
        self.listener = None
        self.requests: list[LiveRequest] = []
        self.cancelled = 0
        self.paces: list[str] = []

    def subscribe(self, _, listener) -> None:
        self.listener = listener

    def unsubscribe(self, _) -> None:
        self.listener = None

    is_ready = True

    def prepare(self, _, request) -> None:
        self.prepared = request

    def hold(self, _, *, on: bool) -> None:
        self.paces.append("hold" if on else "go")

    def step(self, _) -> None:
        self.paces.append("step")

    def cancel(self, _) -> None:
        self.cancelled += 1

    def request(self, _, request) -> int:
        self.requests.append(request)
        return len(self.requests)

    def say(self, kind: str, number: int, arrays=None, **fields) -> None:
        self.listener(Message(kind, {"session": "s", "request": number, **fields}, arrays or {}))


@pytest.fixture
def live() -> FakeLive:
    return FakeLive()


@pytest.fixture
def changes() -> list[tuple[str, int]]:
    return []


@pytest.fixture
def rollouts(live, run, changes) -> LiveRollouts:
    fitted = load_fitted(run, "lift")
    assert fitted is not None
    return LiveRollouts(
        "s",
        live,
        fitted,
        run=run.folder,
        sequence="lift",
        on_change=lambda kind, ready: changes.append((kind, ready)),
    )


def start(rollouts: LiveRollouts, live: FakeLive, count: int) -> int:
    rollouts.request(PARAMETERS.replace(drag=7.0), automatic_substeps=False)
    number = len(live.requests)
    tensors = rollouts.fitted.model.to_tensors()
    live.say("started", number, tensors, substeps_per_frame=30)
    for frame in range(count):
        node = np.full((81, 3), float(frame), np.float32)
        arrays = {"position": node, "velocity": node}
        live.say("frame", number, arrays, frame=frame, duration=0.25)
    return number


def test_frames_that_are_not_simulated_yet_show_the_rollout_before(rollouts, live) -> None:
    start(rollouts, live, 3)
    rollout, frame = rollouts.at(2)
    assert (rollout.position[frame] == 2.0).all()
    rollout, frame = rollouts.at(3)
    assert (rollout, frame) == (rollouts.fitted, 3)
    readout = rollouts.readout
    assert (readout.simulated_count, readout.frame_count, readout.is_busy) == (3, FRAMES, True)
    assert readout.frame_duration == pytest.approx(0.25)


def test_edits_are_asked_for_until_they_are_taken_back(rollouts, live) -> None:
    edits = (Pin(nodes=(3,), places=((0.1, 0.2, 0.3),)),)
    rollouts.request(PARAMETERS, automatic_substeps=False, edits=edits)
    assert live.requests[-1].edits == edits
    model = apply_edits(rollouts.fitted.model, edits, PARAMETERS)
    live.say("started", 1, model.to_tensors(), substeps_per_frame=30)
    node = np.ones((81, 3), np.float32)
    live.say("frame", 1, {"position": node, "velocity": node}, frame=0, duration=0.1)
    rollout, _ = rollouts.at(0)
    assert rollout.edits == edits
    assert rollout.control.shape == (FRAMES, 31, 3)
    np.testing.assert_allclose(rollout.control[:, 30, :2], np.tile([[0.1, 0.2]], (FRAMES, 1)))
    # A slider leaves them in force.
    rollouts.request(PARAMETERS.replace(drag=7.0), automatic_substeps=False)
    assert live.requests[-1].edits == edits
    rollouts.request(PARAMETERS, automatic_substeps=False, edits=())
    assert live.cancelled == 1
    assert rollouts.at(0)[0] is rollouts.fitted


def test_answers_to_an_older_request_are_refused(rollouts, live, changes) -> None:
    old = start(rollouts, live, 2)
    new = start(rollouts, live, 1)
    heard = len(changes)
    live.say("frame", old, {"position": np.ones((81, 3)), "velocity": np.ones((81, 3))}, frame=2)
    live.say("finished", old)
    assert len(changes) == heard
    assert new == old + 1
    assert rollouts.readout.simulated_count == 1


def test_divergence_keeps_the_last_good_state(rollouts, live, changes) -> None:
    number = start(rollouts, live, 5)
    live.say("diverged", number, error="Simulation diverged at frame 5.", frame=5)
    rollout, frame = rollouts.at(FRAMES - 1)
    assert frame == 4
    assert (rollout.position[frame] == 4.0).all()
    assert rollouts.readout.error == "Simulation diverged at frame 5."
    assert not rollouts.readout.is_busy
    assert changes[-1] == ("diverged", 5)


def test_divergence_before_the_first_frame_keeps_the_rollout_before(rollouts, live) -> None:
    rollouts.request(PARAMETERS.replace(drag=7.0), automatic_substeps=False)
    live.say("failed", 1, error="no")
    rollout, frame = rollouts.at(6)
    assert (rollout, frame) == (rollouts.fitted, 6)
    assert rollouts.readout.error == "no"


def test_a_finished_rollout_is_measured_against_the_fitted_one(rollouts, live) -> None:
    number = start(rollouts, live, FRAMES)
    live.say("finished", number)
    fitted = np.asarray(rollouts.fitted.position, dtype=np.float64)
    expected = np.linalg.norm(fitted - np.arange(FRAMES)[:, None, None], axis=-1).mean()
    assert rollouts.readout.difference == pytest.approx(expected, rel=1e-5)
    assert rollouts.newest is rollouts.at(0)[0]
    rollouts.request(PARAMETERS, automatic_substeps=False)
    assert rollouts.at(0)[0] is rollouts.fitted
    assert rollouts.readout.difference == 0.0
    assert live.cancelled == 1
    live.say("finished", number)
    assert rollouts.at(0)[0] is rollouts.fitted


def test_a_crash_without_retry_ends_the_waiting(rollouts, live) -> None:
    start(rollouts, live, 2)
    live.listener(Message("crashed", {"session": "s", "code": -9, "is_retried": False}))
    assert not rollouts.readout.is_busy


def test_forces_are_those_of_the_virtual_springs(rollouts) -> None:
    rollout, frame = rollouts.at(10)
    force = rollout.forces(frame)
    model = rollout.model
    held = np.unique(model.spring_nodes[model.object_spring_count :, 0])
    assert np.abs(np.delete(force, held, axis=0)).max() == 0.0
    assert force[held].sum(axis=0)[2] > 10.0


def test_the_run_is_prepared_before_anybody_asks(rollouts, live, run) -> None:
    assert live.prepared == LiveRequest(run=run.folder, sequence="lift", parameters=PARAMETERS)
    assert live.requests == []


def test_that_the_process_is_starting_is_told(rollouts, live, changes) -> None:
    live.is_ready = False
    assert rollouts.readout.is_starting
    live.is_ready = True
    live.listener(Message("ready", {"session": "", "request": 0}))
    assert changes == [("ready", 0)]
    assert not rollouts.readout.is_starting
    assert rollouts.at(3) == (rollouts.fitted, 3)


def test_stepping_simulates_what_is_wanted_even_the_fitted_parameters(rollouts, live) -> None:
    rollouts.step()
    assert [request.parameters for request in live.requests] == [PARAMETERS]
    rollouts.step()
    rollouts.hold(on=False)
    assert len(live.requests) == 1
    assert live.paces == ["hold", "step", "step", "go"]


def test_fitted_parameters_held_by_other_controls_are_simulated(live, run, changes) -> None:
    fitted = load_fitted(run, "lift")
    other = LiveRollouts(
        "s",
        live,
        fitted,
        run=run.folder,
        sequence="lift",
        controls=(1, 2),
        on_change=lambda kind, ready: changes.append((kind, ready)),
    )
    other.request(PARAMETERS, automatic_substeps=False)
    assert [request.controls for request in live.requests] == [(1, 2)]
    assert changes == [("requested", 0)]
