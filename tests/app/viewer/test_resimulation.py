from dataclasses import replace

import numpy as np
import pytest
from viewer_world import FRAMES, PARAMETERS

from app.viewer.live.client import LiveRequest
from app.viewer.live.rollouts import LiveRollouts
from app.viewer.live.wire import Message
from physhandi.object_rollout import load_fitted


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
def resimulation(live, run, changes) -> LiveRollouts:
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


def start(resimulation: LiveRollouts, live: FakeLive, count: int) -> int:
    resimulation.request(replace(PARAMETERS, drag=7.0), automatic_substeps=False)
    number = len(live.requests)
    tensors = resimulation.fitted.model.to_tensors()
    live.say("started", number, tensors, substeps_per_frame=30)
    for frame in range(count):
        node = np.full((81, 3), float(frame), np.float32)
        arrays = {"position": node, "velocity": node}
        live.say("frame", number, arrays, frame=frame, duration=0.25)
    return number


def test_frames_that_are_not_simulated_yet_show_the_rollout_before(resimulation, live) -> None:
    start(resimulation, live, 3)
    take, frame = resimulation.at(2)
    assert (take.position[frame] == 2.0).all()
    take, frame = resimulation.at(3)
    assert (take, frame) == (resimulation.fitted, 3)
    readout = resimulation.readout
    assert (readout.simulated_count, readout.frame_count, readout.is_busy) == (3, FRAMES, True)
    assert readout.frame_duration == pytest.approx(0.25)


def test_answers_to_an_older_request_are_refused(resimulation, live, changes) -> None:
    old = start(resimulation, live, 2)
    new = start(resimulation, live, 1)
    heard = len(changes)
    live.say("frame", old, {"position": np.ones((81, 3)), "velocity": np.ones((81, 3))}, frame=2)
    live.say("finished", old)
    assert len(changes) == heard
    assert new == old + 1
    assert resimulation.readout.simulated_count == 1


def test_divergence_keeps_the_last_good_state(resimulation, live, changes) -> None:
    number = start(resimulation, live, 5)
    live.say("diverged", number, error="Simulation diverged at frame 5.", frame=5)
    take, frame = resimulation.at(FRAMES - 1)
    assert frame == 4
    assert (take.position[frame] == 4.0).all()
    assert resimulation.readout.error == "Simulation diverged at frame 5."
    assert not resimulation.readout.is_busy
    assert changes[-1] == ("diverged", 5)


def test_divergence_before_the_first_frame_keeps_the_rollout_before(resimulation, live) -> None:
    resimulation.request(PARAMETERS, automatic_substeps=False)
    live.say("failed", 1, error="no")
    take, frame = resimulation.at(6)
    assert (take, frame) == (resimulation.fitted, 6)
    assert resimulation.readout.error == "no"


def test_a_finished_rollout_is_measured_against_the_fitted_one(resimulation, live) -> None:
    number = start(resimulation, live, FRAMES)
    live.say("finished", number)
    fitted = np.asarray(resimulation.fitted.position, dtype=np.float64)
    expected = np.linalg.norm(fitted - np.arange(FRAMES)[:, None, None], axis=-1).mean()
    assert resimulation.readout.difference == pytest.approx(expected, rel=1e-5)
    assert resimulation.newest is resimulation.at(0)[0]
    resimulation.show_fitted()
    assert resimulation.at(0)[0] is resimulation.fitted
    assert resimulation.readout.difference == 0.0
    assert live.cancelled == 1
    live.say("finished", number)
    assert resimulation.at(0)[0] is resimulation.fitted


def test_a_crash_without_retry_ends_the_waiting(resimulation, live) -> None:
    start(resimulation, live, 2)
    live.listener(Message("crashed", {"session": "s", "code": -9, "is_retried": False}))
    assert not resimulation.readout.is_busy


def test_forces_are_those_of_the_virtual_springs(resimulation) -> None:
    take, frame = resimulation.at(10)
    force = take.forces(frame)
    model = take.model
    held = np.unique(model.spring_nodes[model.object_spring_count :, 0])
    assert np.abs(np.delete(force, held, axis=0)).max() == 0.0
    assert force[held].sum(axis=0)[2] > 10.0


def test_the_run_is_prepared_before_anybody_asks(resimulation, live, run) -> None:
    assert live.prepared == LiveRequest(run=run.folder, sequence="lift", parameters=PARAMETERS)
    assert live.requests == []


def test_that_the_process_is_starting_is_told(resimulation, live, changes) -> None:
    live.is_ready = False
    assert resimulation.readout.is_starting
    live.is_ready = True
    live.listener(Message("ready", {"session": "", "request": 0}))
    assert changes == [("ready", 0)]
    assert not resimulation.readout.is_starting
    assert resimulation.at(3) == (resimulation.fitted, 3)
