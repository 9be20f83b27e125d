import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.viewer.viewer_world import FRAMES, PARAMETERS, controls, sheet
from support.waiting import LIMIT_S, until

from app.viewer.live.client import LiveRequest, SimulationClient, _message
from app.viewer.live.drive import HandLimits, HandOrder
from app.viewer.live.wire import Message, receive
from app.viewer.live.worker import SimulationWorker
from physhandi.fitted_object import FittedObject
from physhandi.run import Run
from physhandi.simulation.edits import Cut, Pin, Release
from physhandi.simulation.steering import POSE, SteeredHand, SteeredMotion

LIMITS = HandLimits(top_speed=0.5, reach=1.0)
TESTS = Path(__file__).parents[2]


class Mailbox:
    """Collects what the process says to one session."""

    def __init__(self) -> None:
        self.messages: queue.Queue[Message] = queue.Queue()

    def __call__(self, message: Message) -> None:
        self.messages.put(message)

    def until(self, *kinds: str) -> list[Message]:
        seen = []
        while not seen or seen[-1].kind not in kinds:
            seen.append(self.messages.get(timeout=LIMIT_S))
        return seen


@pytest.fixture(scope="module")
def live() -> Iterator[SimulationClient]:
    live = SimulationClient()
    yield live
    live.close()


@pytest.fixture
def mailbox(live: SimulationClient) -> Iterator[Mailbox]:
    mailbox = Mailbox()
    live.subscribe("a", mailbox)
    yield mailbox
    live.unsubscribe("a")


def ask(run: Run, **changes: float) -> LiveRequest:
    return LiveRequest(run=run.folder, sequence="lift", parameters=PARAMETERS.replace(**changes))


def frames(messages: list[Message]) -> np.ndarray:
    return np.stack([m.arrays["position"] for m in messages if m.kind == "frame"])


def the_start(messages: list[Message]) -> Message:
    """The message that tells what is simulated; that the process is ready may come before it."""
    return next(message for message in messages if message.kind == "started")


def recount(radius: float, most: int) -> int:
    """Count the object springs by looking at every node alone."""
    node = sheet()
    tree = cKDTree(node)
    pairs = set()
    for index, point in enumerate(node):
        distance, near = tree.query(point, k=most + 1)
        for length, other in zip(distance, near, strict=True):
            if other != index and length < radius:
                pairs.add((min(index, int(other)), max(index, int(other))))
    return len(pairs)


def test_the_fitted_parameters_give_the_fitted_rollout(live, mailbox, run) -> None:
    live.request("a", ask(run))
    messages = mailbox.until("finished")
    kinds = [m.kind for m in messages if m.kind not in {"ready", "stability"}]
    assert kinds == ["started", *["frame"] * FRAMES, "finished"]
    np.testing.assert_array_equal(frames(messages), run.array("sequences/lift/rollout.npy"))


def test_a_larger_radius_gives_the_springs_that_an_independent_count_gives(
    live, mailbox, run
) -> None:
    live.request("a", ask(run, connection_radius=0.06, max_neighbors=20))
    messages = mailbox.until("finished")
    started = the_start(messages)
    assert int(started.arrays["object_spring_count"][0]) == recount(0.06, 20) > recount(0.035, 12)
    moved = frames(messages) - run.array("sequences/lift/rollout.npy")
    assert np.abs(moved[0]).max() == 0
    assert np.abs(moved[-1]).max() > 1e-4


def test_an_edited_object_is_simulated_and_goes_back_when_it_is_not_edited(
    live, mailbox, run
) -> None:
    model = FittedObject.of(run, "lift").model
    place = tuple(float(x) for x in model.object_node[80])
    edits = (
        Cut(springs=tuple((int(a), int(b)) for a, b in model.spring_nodes[:40])),
        Pin(nodes=(80,), places=(place,)),
    )
    live.request("a", replace(ask(run), edits=edits))
    messages = mailbox.until("finished")
    expected = FittedObject.of(run, "lift").simulate(edits=edits)
    np.testing.assert_array_equal(frames(messages), expected.position)
    started = the_start(messages).arrays
    np.testing.assert_array_equal(started["pin_place"], expected.control[0, -1:])
    assert int(started["object_spring_count"][0]) == model.object_spring_count - 40
    live.request("a", ask(run))
    messages = mailbox.until("finished")
    np.testing.assert_array_equal(frames(messages), run.array("sequences/lift/rollout.npy"))
    live.request("a", replace(ask(run), edits=(Release(nodes=(81,)),)))
    (failed,) = (m for m in mailbox.until("failed") if m.kind == "failed")
    assert "there is no object node 81" in failed["error"]


def test_the_latest_request_wins(live, mailbox, run) -> None:
    # All but the last take so long that none ends before the next is asked for.
    numbers = [
        live.request("a", ask(run, drag=float(drag), substeps_per_frame=substeps))
        for drag, substeps in enumerate([*[20_000] * 9, 600])
    ]
    seen = []
    while not seen or seen[-1]["request"] != numbers[-1] or seen[-1].kind != "finished":
        seen.append(mailbox.messages.get(timeout=LIMIT_S))
    finished = [m["request"] for m in seen if m.kind == "finished"]
    assert finished[-1] == numbers[-1]
    assert len(finished) < 5
    assert mailbox.messages.empty()


def test_sessions_take_turns(run) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        worker = SimulationWorker(theirs, "cpu")
        for number, session in enumerate("ab"):  # Both before the process computes a frame.
            about = {"session": session, "request": number, "is_held": False, "arrived": 0.0}
            worker._handle(_message("simulate", about, ask(run)))
        thread = threading.Thread(target=worker.run)
        thread.start()
        order = ""
        while len(order) < 2 * FRAMES:
            message = receive(ours)
            assert message is not None
            order += message["session"] if message.kind == "frame" else ""
        ours.shutdown(socket.SHUT_RDWR)
        thread.join(LIMIT_S)
    assert order == "ab" * FRAMES


def steered(run: Run) -> SteeredMotion:
    """The sheet in its first frame, whose controls are one hand."""
    rollout = FittedObject.of(run.folder, "lift").fitted
    control = np.array(rollout.control[0])
    hand = SteeredHand(name="controls", control=np.arange(30), wrist=control.mean(axis=0))
    model, start = rollout.going_on(0)
    return SteeredMotion(
        model=model, start=start, parameters=PARAMETERS, control=control, hands=(hand,)
    )


def test_steering_as_was_recorded_gives_the_recorded_rollout(live, mailbox, run) -> None:
    control = run.array("sequences/lift/control.npy").astype(np.float64)
    pose = np.zeros((FRAMES, 1, POSE))
    pose[:, 0, :3] = (control - control[0]).mean(axis=1)
    live.steer("a", replace(steered(run), pose=pose), LIMITS, replays=True, is_paced=False)
    messages = mailbox.until("finished")
    recorded = run.array("sequences/lift/rollout.npy")
    assert np.abs(recorded[-1] - recorded[0]).max() > 0.05
    np.testing.assert_allclose(frames(messages), recorded, atol=2e-6)
    told = np.stack([m.arrays["pose"] for m in messages if m.kind == "frame"])
    np.testing.assert_array_equal(told, pose)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_driven_wrist_takes_what_it_holds_along(live, mailbox, run, axis: int) -> None:
    motion, goal = steered(run), np.zeros(6)
    goal[axis] = 0.03
    number = live.steer("a", motion, LIMITS, is_paced=False)
    live.drive("a", [HandOrder(goal=tuple(goal))])
    seen, there = [], 0
    while there < 60:  # So many frames after it has arrived the sheet hangs still.
        message = mailbox.until("frame")[-1]
        if message["request"] == number:
            seen.append(message)
            there += np.allclose(message.arrays["pose"][:, :6], [goal], atol=1e-6)
    live.cancel("a")
    assert [m["frame"] for m in seen] == list(range(len(seen)))
    held = np.unique(motion.model.spring_nodes[motion.model.object_spring_count :, 0])
    moved = (seen[-1].arrays["position"] - motion.start[0])[held].mean(axis=0)
    # The sheet hangs a little lower than it lay.
    np.testing.assert_allclose(moved, goal[:3], atol=0.004)
    assert moved[axis] > 0.025


def test_a_hand_that_is_pressed_into_the_table_stays_on_it(live, mailbox, run) -> None:
    motion = steered(run)
    ground = motion.parameters.ground_height
    number = live.steer("a", motion, LIMITS, is_paced=False)
    live.drive("a", [HandOrder(goal=(0.0, 0.0, -0.5, 0.0, 0.0, 0.0))])
    lowest, rested = min(ground, motion.control[:, 2].min()), 0
    while rested < 60:
        message = mailbox.until("frame", "diverged")[-1]
        assert message.kind == "frame", message["error"]
        if message["request"] == number:
            pose, position = message.arrays["pose"][0], message.arrays["position"]
            rested += abs(motion.control_at([pose])[:, 2].min() - lowest) < 1e-6
    live.cancel("a")
    assert position[:, 2].min() > ground - 1e-6
    assert np.ptp(position, axis=0)[:2] == pytest.approx(
        np.ptp(motion.start[0], axis=0)[:2], rel=0.2
    )


@pytest.mark.parametrize("most", [None, 1500.0])
def test_a_hand_pulls_no_harder_than_it_may(live, mailbox, run, most: float | None) -> None:
    motion = steered(run)
    far = motion.hold_point(0, motion.start, motion.pose[0], "point 1")
    number = live.steer("a", replace(far, pose=np.zeros((1, 2, POSE))), LIMITS, is_paced=False)
    goal = (0.0, 0.0, 0.3, 0.0, 0.0, 0.0)
    live.drive("a", [HandOrder(goal=goal), HandOrder()], most)
    height, driven = 0.0, 0
    while driven < 240:  # So many frames after it has heard of its goal the pull is steady.
        message = mailbox.until("frame", "diverged")[-1]
        assert message.kind == "frame", message["error"]
        if message["request"] == number:
            pull, height = message.arrays["pull"][0], message.arrays["pose"][0, 2]
            driven += height > 0.0
    live.cancel("a")
    # A corner is held on the table, so that going up stretches the sheet.
    force = float(np.linalg.norm(pull))
    if most is None:
        assert height == pytest.approx(0.3)
        assert force > 2500.0
    else:
        assert force == pytest.approx(most, rel=0.03)
        assert 0.1 < height < 0.25


def test_what_cannot_be_steered_is_told_and_the_process_lives_on(live, mailbox, run) -> None:
    process, motion = live.process_id, steered(run)
    live.steer("a", motion, LIMITS, is_paced=False)
    live.drive("a", [HandOrder(), HandOrder()])
    assert mailbox.until("failed")[-1]["request"] > 0
    wild = replace(motion, parameters=PARAMETERS.replace(stiffness_scale=1e6))
    live.steer("a", wild, LIMITS, is_paced=False)
    assert "Simulation diverged at frame 1" in mailbox.until("diverged")[-1]["error"]
    assert live.process_id == process


def test_divergence_is_told_with_the_frame_and_the_process_lives_on(live, mailbox, run) -> None:
    process = live.process_id
    live.request("a", ask(run, stiffness_scale=1e5))
    message = mailbox.until("diverged", "finished")[-1]
    assert message.kind == "diverged"
    assert message["error"].startswith("Simulation diverged at frame ")
    assert message["frame"] >= 1
    live.request("a", ask(run))
    mailbox.until("finished")
    assert live.process_id == process


def test_automatic_substeps_survive_what_the_fitted_number_does_not(live, mailbox, run) -> None:
    request = ask(run, stiffness_scale=200.0, damping=0.0)
    live.request("a", request)
    assert mailbox.until("diverged", "finished")[-1].kind == "diverged"
    live.request("a", replace(request, automatic_substeps=True))
    messages = mailbox.until("diverged", "finished")
    assert messages[-1].kind == "finished"
    assert the_start(messages)["substeps_per_frame"] > PARAMETERS.substeps_per_frame


def finish_another(live: SimulationClient, run: Run) -> None:
    """Simulate for another session; meanwhile every session gets a turn for each of its frames."""
    other = Mailbox()
    live.subscribe("b", other)
    live.request("b", ask(run))
    other.until("finished")
    live.unsubscribe("b")


def test_a_held_simulation_goes_on_frame_by_frame_and_gives_the_same_motion(
    live, mailbox, run
) -> None:
    live.hold("a", on=True)
    live.request("a", ask(run))
    seen = mailbox.until("frame")
    finish_another(live, run)
    assert mailbox.messages.empty()
    for frame in (1, 2):
        live.step("a")
        seen += mailbox.until("frame")
        assert seen[-1]["frame"] == frame
    live.hold("a", on=False)
    seen += mailbox.until("finished")
    np.testing.assert_array_equal(frames(seen), run.array("sequences/lift/rollout.npy"))


def test_a_killed_process_comes_back_held_and_finishes_the_work(live, mailbox, run) -> None:
    live.hold("a", on=True)  # So that it is not done before it is killed.
    live.request("a", ask(run))
    mailbox.until("frame")
    process = live.process_id
    assert process is not None
    os.kill(process, signal.SIGKILL)
    messages = mailbox.until("frame")
    crashed = next(m for m in messages if m.kind == "crashed")
    assert (crashed["code"], crashed["is_retried"]) == (-signal.SIGKILL, True)
    assert live.process_id not in {None, process}
    assert messages[-1]["frame"] == 0
    finish_another(live, run)
    assert mailbox.messages.empty()
    live.hold("a", on=False)
    mailbox.until("finished")


def test_the_fewest_stable_substeps_are_told(live, mailbox, run) -> None:
    live.request("a", ask(run))
    (soft,) = (m["needed"] for m in mailbox.until("finished") if m.kind == "stability")
    # Without dashpots the limit goes with the square root of the stiffness.
    live.request("a", ask(run, damping=0.0))
    (bare,) = (m["needed"] for m in mailbox.until("finished") if m.kind == "stability")
    live.request("a", ask(run, damping=0.0, stiffness_scale=4.0, substeps_per_frame=4 * bare))
    (stiff,) = (m["needed"] for m in mailbox.until("finished") if m.kind == "stability")
    assert soft < PARAMETERS.substeps_per_frame
    assert stiff == pytest.approx(2 * bare, abs=1)
    live.request("a", ask(run, damping=0.0, stiffness_scale=4.0, substeps_per_frame=bare // 2))
    assert mailbox.until("finished", "diverged")[-1].kind == "diverged"


def test_a_request_that_makes_no_sense_is_answered(live, mailbox, run) -> None:
    live.request("a", replace(ask(run), sequence="nowhere"))
    assert "nowhere" in mailbox.until("failed")[-1]["error"]


def test_the_process_dies_with_its_parent() -> None:
    script = (
        "import os\n"
        "from app.viewer.live.client import SimulationClient\n"
        "from support.waiting import until\n"
        "live = SimulationClient()\n"
        "live.subscribe('a', lambda message: None)\n"
        "until(lambda: live.process_id)\n"
        "os.write(1, str(live.process_id).encode())\n"
        "os._exit(0)\n"
    )
    out = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        check=True,
        timeout=LIMIT_S,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parent)])},
    )
    until(lambda: not _is_running(int(out.stdout)))


def test_close_leaves_no_process() -> None:
    live = SimulationClient()
    live.subscribe("a", lambda _: None)
    process = until(lambda: live.process_id)
    live.close()
    assert not _is_running(process)


def test_the_controls_move_at_all() -> None:
    assert np.abs(np.diff(controls((0.0, 0.0, 1.0)), axis=0)).max() > 1e-3


def _is_running(process: int) -> bool:
    try:
        with open(f"/proc/{process}/stat") as stat:  # noqa: PTH123
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_the_process_warms_up_by_itself(run) -> None:
    live = SimulationClient()
    try:
        live.start()
        live.start()
        first = Mailbox()
        live.subscribe("a", first)
        live.prepare("a", ask(run))  # Before the process is there, perhaps.
        until(lambda: live.is_ready)
        process = live.process_id
        live.request("a", ask(run, drag=9.0))
        messages = first.until("finished")
        # What was prepared says nothing and leaves no trace in what is asked for.
        kinds = [m.kind for m in messages if m.kind not in {"ready", "stability"}]
        assert kinds == ["started", *["frame"] * FRAMES, "finished"]
        other = Mailbox()
        live.subscribe("b", other)
        live.request("b", ask(run, drag=9.0))
        np.testing.assert_array_equal(frames(messages), frames(other.until("finished")))
        assert live.process_id == process
    finally:
        live.close()
    assert live.process_id is None


def test_a_frame_tells_how_long_ago_it_was_asked_for(live, mailbox, run) -> None:
    start = time.perf_counter()
    live.request("a", ask(run, drag=8.0))
    messages = [m for m in mailbox.until("finished") if m.kind == "frame"]
    passed = time.perf_counter() - start
    elapsed = [m["elapsed"] for m in messages]
    assert elapsed == sorted(elapsed)
    assert sum(m["duration"] for m in messages) < elapsed[-1] < passed
