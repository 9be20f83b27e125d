"""Who gets how many threads, and what happens when a thread is late or fails."""

from threading import Thread

import numpy as np
import pytest
import warp as wp
from reference.blocks import PARAMETERS, thrown_block
from support.waiting import LIMIT_S

from physhandi.simulation.engines import cpu
from physhandi.simulation.engines.cpu import FIRST_PAUSE, TRIAL, Pace
from physhandi.simulation.kernels.barrier import ABORT, NO_STOP, meet
from physhandi.simulation.simulator import Simulator

needs_processor = pytest.mark.skipif(
    not wp.is_cpu_available(), reason="this Warp has no CPU device"
)


@wp.func
def dawdle(long: int):
    total = float(0.0)  # noqa: UP018  (Warp's way to say that it changes)
    for i in range(long):
        total += wp.sin(float(i))
    return total


@wp.kernel(enable_backward=False)
def meet_often(
    thread: int, late: int, first_waited: int, meeting_out: wp.array[int], met_out: wp.array[int]
):
    """Meet a hundred times; one thread may be late, which makes the other wait."""
    waited = first_waited + 0
    for number in range(100):
        if waited >= 0:
            # Never true, but so that dawdling is not left out.
            if dawdle(late) > 1.0e9:
                met_out[thread] = 0
            waited = meet(meeting_out, number, 2, waited, wp.uint64(0))
            met_out[thread] = met_out[thread] + 1


def meet_two(waited=(0, 0), stop=NO_STOP, late=(0, 0)):
    """Let two threads meet, and return how often each met."""
    meeting = wp.array([0, stop], dtype=int, device="cpu")
    met = wp.zeros(2, dtype=int, device="cpu")
    wp.load_module(meet_often.module, device="cpu")
    threads = [
        Thread(
            target=lambda t: wp.launch(
                meet_often, dim=1, inputs=[t, late[t], waited[t], meeting, met], device="cpu"
            ),
            args=(thread,),
        )
        for thread in (0, 1)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=LIMIT_S)
        assert not thread.is_alive()
    return met.numpy().tolist()


@needs_processor
def test_threads_meet_and_leave_together():
    assert meet_two() == [100, 100]
    assert meet_two(late=(0, 2000)) == [100, 100]
    assert meet_two(stop=41) == [42, 42]


@needs_processor
def test_a_thread_that_waited_too_long_takes_the_other_along():
    assert meet_two(waited=(0, 2000)) == [1, 1]
    assert meet_two(waited=(2000, 0)) == [1, 1]


@needs_processor
def test_an_abort_frees_a_thread_whose_partner_never_comes():
    meeting = wp.array([0, ABORT], dtype=int, device="cpu")
    met = wp.zeros(2, dtype=int, device="cpu")
    wp.launch(meet_often, dim=1, inputs=[0, 0, 0, meeting, met], device="cpu")
    assert met.numpy()[0] == 1


@pytest.fixture
def block():
    model, control = thrown_block(9, frames=2)
    simulator = Simulator(model, PARAMETERS, device="cpu")
    simulator.engine.threads = 1
    wanted = simulator.rollout(control).position
    simulator.engine.threads = 2
    simulator.rollout(control)
    return simulator, control, wanted, simulator.engine._loops[True]


@needs_processor
def test_a_walk_that_stopped_early_goes_on(block, monkeypatch):
    simulator, control, wanted, frame = block
    launch, reached = frame._launch, []

    class StopsOnce:
        def __init__(self, recorded):
            self.recorded = recorded

        def launch(self):
            if not reached:
                frame._meeting.numpy()[1] = 5
            self.recorded.launch()

    def watched(*arguments):
        reached.append(launch(*arguments))
        return reached[-1]

    monkeypatch.setattr(frame, "_together", (StopsOnce(frame._together[0]), frame._together[1]))
    monkeypatch.setattr(frame, "_launch", watched)
    assert np.array_equal(simulator.rollout(control).position, wanted)
    # On a busy machine, a thread may want to stop even earlier.
    assert reached[0][0] <= 5
    assert reached[-1] == (PARAMETERS.substeps_per_frame, 2)


@needs_processor
def test_a_busy_companion_leaves_one_thread(block, monkeypatch):
    simulator, control, wanted, frame = block
    monkeypatch.setattr(frame, "_together", ())
    companion = cpu._companion(cpu.os.getpid())
    with companion.lock:
        assert np.array_equal(simulator.rollout(control).position, wanted)


@needs_processor
def test_a_failing_thread_does_not_hang_the_other(block, monkeypatch):
    simulator, control, wanted, frame = block

    class Fails:
        def launch(self):
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(frame, "_together", (Fails(), frame._together[1]))
        with pytest.raises(KeyboardInterrupt):
            simulator.rollout(control)
    assert np.array_equal(simulator.rollout(control).position, wanted)


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def run_frames(pace, clock, cost, frames=1, substeps=667):
    """Simulate frames on a clock; return how many substeps one and two threads took."""
    taken = {1: 0, 2: 0}
    for _ in range(frames):
        left = substeps
        while left:
            threads, count = pace.choose(left)
            clock.now += count * cost[threads]
            pace.learn(threads, cost[threads])
            taken[threads] += count
            left -= count
    return taken


def test_the_faster_number_of_threads_is_kept():
    clock = Clock()
    pace = Pace(2, clock)
    assert run_frames(pace, clock, {1: 20e-6, 2: 11e-6}) == {1: TRIAL, 2: 667 - TRIAL}
    later = run_frames(pace, clock, {1: 20e-6, 2: 11e-6}, frames=300)
    assert 0 < later[1] <= 5 * TRIAL
    clock = Clock()
    pace = Pace(2, clock)
    taken = run_frames(pace, clock, {1: 20e-6, 2: 60e-6}, frames=300)
    assert taken[2] <= 6 * TRIAL


def test_a_machine_that_becomes_busy_and_free_again_is_noticed():
    clock = Clock()
    pace = Pace(2, clock)
    run_frames(pace, clock, {1: 20e-6, 2: 11e-6}, frames=50)
    busy = {1: 40e-6, 2: 400e-6}
    assert run_frames(pace, clock, busy)[2] > 0
    assert run_frames(pace, clock, busy, frames=20)[2] <= 3 * TRIAL
    free = {1: 20e-6, 2: 11e-6}
    while clock.now < 120.0:
        last = run_frames(pace, clock, free)
    assert last == {1: 0, 2: 667}


def test_a_pause_between_trials_grows():
    clock = Clock()
    pace = Pace(2, clock)
    cost = {1: 20e-6, 2: 60e-6}
    trials = []
    while clock.now < 150.0:
        if run_frames(pace, clock, cost)[2]:
            trials.append(clock.now)
    gaps = np.diff(trials)
    assert gaps[0] == pytest.approx(FIRST_PAUSE, abs=0.05)
    assert gaps[-1] == pytest.approx(cpu.LONGEST_PAUSE, abs=0.05)


def test_one_processor_means_one_thread():
    assert run_frames(Pace(1, Clock()), Clock(), {1: 1e-5}, frames=3) == {1: 3 * 667, 2: 0}


def test_a_frame_of_few_substeps_is_tried_as_a_whole():
    clock = Clock()
    pace = Pace(2, clock)
    taken = run_frames(pace, clock, {1: 20e-6, 2: 11e-6}, frames=4, substeps=40)
    assert taken == {1: 40, 2: 120}
