"""Which frames a rollout keeps, in how much memory, and that the bits do not depend on it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from reference.blocks import PARAMETERS, block_gradients, thrown_block
from reference.gradients import gradients, loss_weights
from reference.scenes import as_model, crossing_scene, cube_scene

from physhandi.simulation import differentiable
from physhandi.simulation.engines import cpu, cuda, graph_adjoint, tape
from physhandi.simulation.engines.tape import Trajectory, frame_bytes, memory_budget, stored_frames

FRAMES = 7


def longer(scene, frames=FRAMES, substeps=20):
    """Let a scene go on, with controls that swing."""
    swing = 0.004 * np.sin(np.arange(frames + 1))[:, None, None] * np.array([1.0, -0.5, 0.3])
    return replace(scene, control=np.float32(scene.control[:1] + swing), substeps=substeps)


SCENES = {"engine": cube_scene, "recorded": cube_scene, "collisions": crossing_scene}


@pytest.fixture(autouse=True)
def nothing_spare(monkeypatch):
    monkeypatch.setattr(tape, "_spare", {})


class Counter:
    """Writes its calls down as a frame's substeps."""

    def __init__(self, size=5):
        self.layout = (((3, size), wp.vec4), ((2, size), wp.vec3))
        self.calls = 0

    def record(self, tape):
        self.calls += 1
        for array in tape:
            array.fill_(self.calls)


def test_bytes_of_two_hundred_frames_of_five_thousand_nodes():
    # Three vectors of four floats; states of eight floats and vectors of four; vectors of three.
    fast = cuda.cuda_tape_layout(5000, 667)
    on_cpu = cpu.cpu_tape_layout(5000, 5000, 667)
    plain = graph_adjoint.graph_tape_layout(5000, 667, collides=False)
    colliding = graph_adjoint.graph_tape_layout(5000, 667, collides=True)
    assert 200 * frame_bytes(fast) == 32_016_000_000
    assert 200 * frame_bytes(on_cpu) == 32_048_000_000
    assert 200 * frame_bytes(plain) == 24_036_000_000
    assert 200 * frame_bytes(colliding) == 32_040_000_000


def test_the_room_taken_is_what_was_counted(device):
    model, parameters = as_model(cube_scene())
    layout = differentiable.tape_layout(model, parameters, device)
    tapes = tape._take(wp.get_device(device), layout, 2)
    assert sum(array.capacity for tape in tapes for array in tape) == 2 * frame_bytes(layout)
    assert all(array.shape[0] >= parameters.substeps_per_frame for array in tapes[0])


@pytest.mark.parametrize(
    ("frames", "memory", "stored"),
    [(9, 0, 1), (9, 359, 1), (9, 719, 1), (9, 720, 2), (9, 9 * 360, 9), (9, 10**9, 9), (0, 0, 0)],
)
def test_as_many_frames_are_stored_as_fit_but_one(frames, memory, stored):
    layout = Counter().layout
    assert frame_bytes(layout) == 4 * (3 * 5 * 4 + 2 * 5 * 3)
    assert stored_frames(layout, frames, memory) == stored


@pytest.mark.parametrize("stored", [1, 2, 3, 6, 7])
def test_the_last_frames_are_kept_and_make_room_for_the_others(device, stored):
    recorder = Counter()
    kept = Trajectory(
        recorder, wp.get_device(device), FRAMES, stored * frame_bytes(recorder.layout)
    )
    written = {}
    for frame in range(1, FRAMES + 1):
        assert kept.keeps(frame) == (frame > FRAMES - stored)
        if kept.keeps(frame):
            kept.record(frame)
            written[frame] = recorder.calls
    assert recorder.calls == stored
    for frame in range(FRAMES, 0, -1):
        assert kept.holds(frame) == (frame in written)
        if not kept.holds(frame):
            with pytest.raises(KeyError, match=f"frame {frame} is not held"):
                kept.tape(frame)
            kept.record(frame)
            written[frame] = recorder.calls
        for array in kept.tape(frame):
            assert np.all(array.numpy() == written[frame])
    assert recorder.calls == FRAMES


def test_memory_is_handed_on_and_only_once(device, monkeypatch):
    made, real = [], tape._room
    monkeypatch.setattr(tape, "_room", lambda *args: made.append(real(*args)) or made[-1])

    def walked(frames, size=5):
        kept = Trajectory(Counter(size), wp.get_device(device), frames, 10**9)
        for frame in range(1, frames + 1):
            kept.record(frame)
        return kept, {id(array) for frame in range(1, frames + 1) for array in kept.tape(frame)}

    def spare():
        ((layout, tapes),) = tape._spare.values()
        return layout, len(tapes)

    first, mine = walked(3)
    second, others = walked(3)
    assert (len(made), len(mine | others)) == (12, 12)
    first.release()
    assert not first.holds(3)
    again, reused = walked(2)
    more, mixed = walked(2)
    assert reused < mine
    assert len(mixed & (mine - reused)) == 2
    assert len(made) == 14
    for kept in (second, again, more):
        kept.release()
    assert spare() == (Counter().layout, 7)
    # Room of another shape is of no use, and is not kept beside.
    others = walked(1, size=6)[0], walked(2, size=7)[0]
    assert not tape._spare
    for kept, size, count in zip(others, (6, 7), (1, 2), strict=True):
        kept.release()
        assert spare() == (Counter(size).layout, count)


def test_the_budget_is_a_part_of_what_is_free_or_spare(device, monkeypatch):
    monkeypatch.setattr(tape, "free_memory", lambda _: 10_000)
    share = 0.25 if device == "cpu" else 0.5
    assert memory_budget(device) == share * 10_000
    kept = Trajectory(Counter(), wp.get_device(device), 4, 10**9)
    for frame in range(1, 5):
        kept.record(frame)
    kept.release()
    assert memory_budget(device) == share * (10_000 + 4 * 360)


def test_the_budget_of_this_machine_is_a_part_of_its_memory(device):
    assert 0 < memory_budget(device) < 0.51 * wp.get_device(device).total_memory


def adjoint_of(kind, scene, device, monkeypatch):
    """Make the adjoint that a scene's rollouts use, and count what it records and carries."""
    bridge = differentiable._DifferentiableSimulator(*as_model(scene), device)
    if kind == "recorded":
        bridge.simulator.engine = None
    monkeypatch.setattr(differentiable, "_bridge", lambda *_: bridge)
    calls = {"record": 0, "backward": 0}

    def counted(name, real):
        def call(tape):
            calls[name] += 1
            real(tape)

        return call

    for name in calls:
        monkeypatch.setattr(bridge.adjoint, name, counted(name, getattr(bridge.adjoint, name)))
    is_recorded = isinstance(bridge.adjoint, graph_adjoint.GraphAdjoint)
    assert is_recorded == (kind != "engine")
    return bridge.adjoint, calls


@pytest.mark.parametrize("kind", SCENES)
def test_stored_and_simulated_again_give_the_same_bits(device, kind, monkeypatch):
    scene = longer(SCENES[kind]())
    adjoint, calls = adjoint_of(kind, scene, device, monkeypatch)
    weights, size = loss_weights(scene), frame_bytes(adjoint.layout)
    found = {}
    for stored in (FRAMES, 1, 2, 3, FRAMES):
        for window in (None, 3):
            calls.update(record=0, backward=0)
            result = gradients(scene, device, weights, window, memory=stored * size)
            assert calls == {"record": FRAMES, "backward": FRAMES}
            bits = {name: value.tobytes() for name, value in result.items()}
            assert found.setdefault(window, bits) == bits, stored
    assert found[None]["log_stiffness"] != found[3]["log_stiffness"]
    assert any(np.frombuffer(found[None]["control"]))
    if kind == "collisions":
        assert any(np.frombuffer(found[None]["self_restitution"]))


def test_a_block_in_many_parts_has_the_same_gradients_stored_and_simulated_again(device):
    model, control = thrown_block(9, frames=4)
    found = [block_gradients(model, control, PARAMETERS, device, memory) for memory in (0, None)]
    for name, value in found[0].items():
        assert np.abs(value).max() > 0
        assert np.array_equal(value, found[1][name]), name


@pytest.mark.parametrize("stored", [1, 3, FRAMES])
def test_only_frames_that_do_not_fit_are_simulated_again(device, stored, monkeypatch):
    scene = longer(cube_scene())
    adjoint, calls = adjoint_of("engine", scene, device, monkeypatch)
    # The budget is that of a device on which so many frames and a half fit.
    share = 0.25 if device == "cpu" else 0.5
    free = int((stored + 0.5) * frame_bytes(adjoint.layout) / share)
    monkeypatch.setattr(tape, "free_memory", lambda _: free)
    log = torch.tensor(np.log(scene.stiffness), requires_grad=True)
    position, _ = differentiable.rollout(
        *as_model(scene), torch.tensor(scene.control), log_stiffness=log, device=device
    )
    assert calls == {"record": stored, "backward": 0}
    position[-1].sum().backward()
    assert calls == {"record": FRAMES, "backward": FRAMES}
    assert float(log.grad.abs().max()) > 1e-4


def test_nothing_is_kept_where_nobody_asks_for_a_gradient(device, monkeypatch):
    scene = longer(cube_scene())
    _, calls = adjoint_of("engine", scene, device, monkeypatch)
    control = torch.tensor(scene.control)
    differentiable.rollout(*as_model(scene), control, device=device)
    with torch.no_grad():
        differentiable.rollout(*as_model(scene), control.requires_grad_(), device=device)
    assert calls["record"] == 0
    position, _ = differentiable.rollout(*as_model(scene), control, device=device)
    assert calls["record"] == FRAMES
    assert position.requires_grad


def test_walking_back_twice_simulates_again(device, monkeypatch):
    scene = longer(cube_scene())
    _, calls = adjoint_of("engine", scene, device, monkeypatch)
    control = torch.tensor(scene.control).requires_grad_()
    position, _ = differentiable.rollout(*as_model(scene), control, device=device)
    loss = position[1:].square().sum()
    (first,) = torch.autograd.grad(loss, control, retain_graph=True)
    assert calls["record"] == FRAMES
    (second,) = torch.autograd.grad(loss, control)
    assert calls["record"] == 2 * FRAMES
    assert torch.equal(first, second)
    assert float(first.abs().max()) > 1e-3
