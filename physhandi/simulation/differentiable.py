"""Differentiable rollouts for PyTorch, by a hand-written adjoint over any number of frames.

The forward pass stores the state at each frame, and the substeps of as many frames as memory
allows (`engines.tape.Trajectory`); the backward pass simulates the other frames again. No atomics:
gradients are the same bits run after run, however many frames are stored.
"""

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int32
from numpy import ndarray
from torch import Tensor

from physhandi.errors import SimulationError
from physhandi.simulation.engines.cpu import CpuAdjoint
from physhandi.simulation.engines.cuda import CudaAdjoint
from physhandi.simulation.engines.frame_sums import SCALARS
from physhandi.simulation.engines.graph_adjoint import GraphAdjoint
from physhandi.simulation.engines.tape import TapeLayout, Trajectory
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import NO_DIVERGENCE, Simulator

CACHED_SIMULATORS = 16
"""Models whose captured graphs and tapes are reused between calls of `rollout`."""


def rollout(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control: Float[Tensor, "frame control 3"],
    *,
    log_stiffness: Float[Tensor, " spring"] | None = None,
    damping: Float[Tensor, " spring"] | None = None,
    drag: Float[Tensor, ""] | None = None,
    restitution: Float[Tensor, ""] | None = None,
    friction: Float[Tensor, ""] | None = None,
    self_restitution: Float[Tensor, ""] | None = None,
    self_friction: Float[Tensor, ""] | None = None,
    initial_position: Float[Tensor, "node 3"] | None = None,
    initial_velocity: Float[Tensor, "node 3"] | None = None,
    device: str = "cpu",
    first_frame: int = 0,
    window: int | None = None,
    memory: int | None = None,
) -> tuple[Float[Tensor, "frame node 3"], Float[Tensor, "frame node 3"]]:
    """Simulate all frames so that a loss of the result can be differentiated.

    Arguments that are left out take their value from the model or the parameters. The first
    call with a model captures graphs, which later calls with the same model object reuse.

    Args:
        model: Nodes and springs; not modified.
        parameters: Global parameters.
        control: Positions of the control nodes in every frame [m]. Their gradient includes
            that of their velocity, if `use_control_velocity` is set.
        log_stiffness: Natural logarithm of each spring's stiffness [log N], without
            `stiffness_scale`.
        damping: Dashpot of each spring [N·s/m].
        drag: Velocity decay rate [1/s].
        restitution: Of the ground; no gradient outside [0, 1].
        friction: Of the ground; no gradient outside [0, 2].
        self_restitution: Of two object nodes; no gradient outside [0, 1].
        self_friction: Of two object nodes; no gradient outside [0, 2]. Neither has one without
            `parameters.self_collision`. Which nodes collide, and which triangle of a hand pushes
            which node, is not differentiated.
        initial_position: Object nodes at frame 0 [m].
        initial_velocity: Their velocities at frame 0 [m/s].
        device: Warp device to simulate on. Tensors may be elsewhere; results are where
            `control` is.
        first_frame: Number of the first frame of `control`, which decides what is attached when.
        window: Frames after which gradients are cut: 1 is PhysTwin's one-frame gradient,
            none the gradient over the whole horizon.
        memory: Memory that substeps may use until the backward pass [B], at least one frame's;
            None for `engines.tape.memory_budget`. Changes the time, but no bit of the result.

    Returns:
        Positions [m] and velocities [m/s] of the object nodes in every frame; frame 0 is the
        initial state.

    Raises:
        SimulationDivergedError: If a node is not finite or too fast.
        SimulationError: If there are too many candidates for self-collision, or a gradient is asked
            for through a rope that bends.
        ValueError: If a tensor does not fit the model, or the window is not positive.
    """
    if window is not None and window < 1:
        raise ValueError(f"window is {window}; expected at least one frame, or none.")
    bridge = _bridge(model, parameters, device)
    log_default = np.log(np.maximum(model.stiffness, np.finfo(np.float32).tiny))
    arguments = (
        (control, None),
        (log_stiffness, log_default),
        (damping, model.damping),
        (drag, parameters.drag),
        (restitution, parameters.restitution),
        (friction, parameters.friction),
        (self_restitution, parameters.self_restitution),
        (self_friction, parameters.self_friction),
        (initial_position, model.object_node),
        (initial_velocity, model.initial_velocity),
    )
    where = {"dtype": torch.float32, "device": bridge.torch_device}
    tensors = [
        torch.as_tensor(default if value is None else value, **where).contiguous()
        for value, default in arguments
    ]
    bridge.check(tensors)
    trajectory = bridge.trajectory(tensors, memory)
    position, velocity = _Rollout.apply(bridge, trajectory, (first_frame, window), *tensors)
    return position.to(control.device), velocity.to(control.device)


def tape_layout(
    model: SpringMassModel, parameters: SimulationParameters, device: str
) -> TapeLayout:
    """Return the layout of the tapes of such a rollout; see `engines.tape.frame_bytes`."""
    return _bridge(model, parameters, device).adjoint.layout


@lru_cache(maxsize=CACHED_SIMULATORS)
def _bridge(
    model: SpringMassModel, parameters: SimulationParameters, device: str
) -> "_DifferentiableSimulator":
    return _DifferentiableSimulator(model, parameters, device)


class _Rollout(torch.autograd.Function):
    """Connects the simulator and its adjoint to PyTorch."""

    @staticmethod
    def forward(
        ctx: Any,
        bridge: "_DifferentiableSimulator",
        trajectory: Trajectory | None,
        frames: tuple[int, int | None],
        *tensors: Tensor,
    ) -> tuple[Tensor, Tensor]:
        with bridge.stream():
            position, velocity = bridge.forward(tensors, trajectory, frames[0])
        ctx.bridge, ctx.trajectory, ctx.frames = bridge, trajectory, frames
        ctx.save_for_backward(*tensors, position, velocity)
        return position, velocity

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Any, ...]:
        *tensors, position, velocity = ctx.saved_tensors
        states = position, velocity
        first_frame, window = ctx.frames
        with ctx.bridge.stream():
            gradients = ctx.bridge.backward(
                tensors,
                states,
                grad_outputs,
                ctx.trajectory,
                window or len(position),
                first_frame=first_frame,
            )
        return None, None, None, *gradients


class _DifferentiableSimulator:
    """A simulator and the adjoint of one frame, with tensors going in and out."""

    def __init__(
        self, model: SpringMassModel, parameters: SimulationParameters, device: str
    ) -> None:
        self.simulator = Simulator(model, parameters, device)
        self.torch_device = torch.device(wp.device_to_torch(self.simulator.device))
        self._acts: Tensor | None = None
        self._acting: dict[bytes, Tensor] = {}
        self._acting_at: dict[int, Tensor] = {}

    @cached_property
    def adjoint(self) -> GraphAdjoint | CudaAdjoint | CpuAdjoint:
        """The adjoint of one frame; built on first use, since many rollouts have no backward."""
        simulator = self.simulator
        if simulator.rod is not None:
            raise SimulationError(
                "The rollout of a rope that bends has no gradient. Call it under torch.no_grad(), "
                "or leave out the model's rod."
            )
        if simulator.has_contacts:
            return GraphAdjoint(simulator)
        engine = simulator.engine
        fast = CudaAdjoint.of(simulator, engine) or CpuAdjoint.of(simulator, engine)
        return fast or GraphAdjoint(simulator)

    def trajectory(self, tensors: list[Tensor], memory: int | None) -> Trajectory | None:
        """Decide which frames to store; None if no gradient can be requested."""
        if not torch.is_grad_enabled() or not any(tensor.requires_grad for tensor in tensors):
            return None
        return Trajectory(self.adjoint, self.simulator.device, len(tensors[0]) - 1, memory)

    @contextmanager
    def stream(self) -> Generator[None]:
        """Run PyTorch on Warp's stream, synchronised with its own before and after."""
        if not self.simulator.device.is_cuda:
            yield
            return
        own = torch.cuda.current_stream(self.torch_device)
        stream = wp.stream_to_torch(self.simulator.device)
        stream.wait_stream(own)
        with torch.cuda.stream(stream):
            yield
        own.wait_stream(stream)

    def check(self, tensors: list[Tensor]) -> None:
        """Raise `ValueError` for a tensor that does not fit the model."""
        control, log_stiffness, damping, *scalars, position, velocity = tensors
        self.simulator.checked_control(control.detach().cpu().numpy())
        model = self.simulator.model
        for name, value, shape in (
            ("log_stiffness", log_stiffness, model.rest_length.shape),
            ("damping", damping, model.rest_length.shape),
            ("initial_position", position, model.object_node.shape),
            ("initial_velocity", velocity, model.object_node.shape),
            *((name, value, ()) for name, value in zip(SCALARS, scalars, strict=True)),
        ):
            if tuple(value.shape) != tuple(shape):
                raise ValueError(f"{name} has shape {tuple(value.shape)}; expected {tuple(shape)}.")

    def forward(
        self, tensors: Sequence[Tensor], trajectory: Trajectory | None, first_frame: int
    ) -> tuple[Tensor, Tensor]:
        """Simulate all frames, store the substeps of some; return positions and velocities."""
        control, *material, position, velocity = tensors
        self._place_material(material)
        simulator = self.simulator
        _copy_in(simulator.position, position)
        _copy_in(simulator.velocity, velocity)
        if simulator.rod is not None:
            simulator.rod.reset()
        simulator.first_divergence.fill_(NO_DIVERGENCE)
        positions, velocities = [position], [velocity]
        # A GPU is asked once, at the end: a question after every frame would leave it idle.
        asks_later = simulator.device.is_cuda and simulator.collision is None
        diverged = []
        for frame in range(1, len(control)):
            self._place_control(control, frame)
            self._hold(material, first_frame + frame)
            if trajectory is not None and trajectory.keeps(frame):
                trajectory.record(frame)
            else:
                simulator.replay_frame()
            if asks_later:
                diverged.append(_copy_out(simulator.first_divergence))
            else:
                simulator.check_divergence(frame)
            positions.append(_copy_out(simulator.position))
            velocities.append(_copy_out(simulator.velocity))
        if diverged:
            self._check_divergences(torch.cat(diverged).cpu().numpy())
        return torch.stack(positions), torch.stack(velocities)

    def _check_divergences(self, first: Int32[ndarray, " frame"]) -> None:
        """Raise `SimulationDivergedError` for the first frame that recorded a divergence.

        Args:
            first: What `Simulator.first_divergence` held after each frame.
        """
        frames = np.flatnonzero(first != NO_DIVERGENCE)
        if len(frames):
            self.simulator.first_divergence.fill_(int(first[frames[0]]))
            self.simulator.check_divergence(int(frames[0]) + 1)

    def backward(
        self,
        tensors: list[Tensor],
        states: tuple[Tensor, Tensor],
        outputs: tuple[Tensor, ...],
        trajectory: Trajectory,
        window: int,
        *,
        first_frame: int,
    ) -> list[Tensor]:
        """Return the gradients of all tensors, in their order, and release the trajectory."""
        control, *material, _, _ = tensors
        self._place_material(material)
        simulator, adjoint = self.simulator, self.adjoint
        begin = simulator.position, simulator.velocity
        bars = adjoint.position_bar, adjoint.velocity_bar
        # Sums over many substeps and frames keep their digits in float64.
        sums = [torch.zeros_like(value, dtype=torch.float64) for value in tensors[:-2]]
        for bar, output in zip(bars, outputs, strict=True):
            _copy_in(bar, output[-1])
        for frame in range(len(control) - 1, 0, -1):
            self._place_control(control, frame)
            self._hold(material, first_frame + frame)
            if not trajectory.holds(frame):
                for place, state in zip(begin, states, strict=True):
                    _copy_in(place, state[frame - 1])
                trajectory.record(frame)
            adjoint.backward(trajectory.tape(frame))
            start, end, *rest = (_copy_out(value) for value in adjoint.sums)
            if self._acts is not None:
                rest[:2] = (value * self._acts for value in rest[:2])
            sums[0][frame - 1] += start
            sums[0][frame] += end
            for total, value in zip(sums[1:], rest, strict=True):
                total.add_(value.double().sum() if total.ndim == 0 else value)
            is_cut = (frame - 1) % window == 0 and frame > 1
            # The loss's own gradient of this frame's state; later frames count unless cut.
            for bar, output in zip(bars, outputs, strict=True):
                earlier = output[frame - 1]
                _copy_in(bar, earlier if is_cut else _copy_out(bar) + earlier)
        trajectory.release()
        return [value.float() for value in sums] + [_copy_out(bar) for bar in bars]

    def _place_material(self, material: list[Tensor]) -> None:
        log_stiffness, damping, drag, *coefficients = material
        self._acts = None
        _copy_in(self.simulator.stiffness, log_stiffness.exp())
        _copy_in(self.simulator.damping, damping)
        self.simulator.override_world(
            velocity_loss=self.simulator.parameters.velocity_loss(float(drag)),
            **{n: float(v) for n, v in zip(SCALARS[1:], coefficients, strict=True)},
        )

    def _hold(self, material: list[Tensor], frame: int) -> None:
        """Let the springs act that are attached on the way to a frame, and no others."""
        model = self.simulator.model
        if model.is_always_attached:
            return
        acts = self._acting_in(frame)
        if acts is not self._acts:
            self._acts = acts
            log_stiffness, damping = material[:2]
            _copy_in(self.simulator.stiffness, log_stiffness.exp() * acts)
            _copy_in(self.simulator.damping, damping * acts)

    def _acting_in(self, frame: int) -> Tensor:
        """Mark the springs that act on the way to a frame; the same tensor for the same springs."""
        if frame not in self._acting_at:
            acts = self.simulator.model.acts_in(frame)
            key = acts.tobytes()
            if key not in self._acting:
                self._acting[key] = torch.from_numpy(acts).to(self.torch_device)
            self._acting_at[frame] = self._acting[key]
        return self._acting_at[frame]

    def _place_control(self, control: Tensor, frame: int) -> None:
        _copy_in(self.simulator.control_start, control[frame - 1])
        _copy_in(self.simulator.control_end, control[frame])


def _copy_in(target: wp.array, value: Tensor) -> None:
    """Copy a tensor of the same device into an array."""
    if target.size:
        wp.to_torch(target).copy_(value.detach())


def _copy_out(value: wp.array) -> Tensor:
    """Copy an array into a new tensor of the same device."""
    return wp.to_torch(value).clone()
