"""Rollouts that PyTorch can differentiate, by a hand-written adjoint over any number of frames.

Memory is one frame's substeps: the forward pass keeps the state at each frame, the backward
pass simulates a frame again and walks back through it. No atomics: gradients are the same
bits run after run.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from physhandi.simulation.kernels.adjoint import gather_nodes, retract_nodes, retract_springs
from physhandi.simulation.model import SimulationParameters, SpringMassModel
from physhandi.simulation.simulator import Simulator

CACHED_SIMULATORS = 16
"""How many models keep their captured graphs and tape between calls of `rollout`."""


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
    initial_position: Float[Tensor, "node 3"] | None = None,
    initial_velocity: Float[Tensor, "node 3"] | None = None,
    device: str = "cpu",
    window: int | None = None,
) -> tuple[Float[Tensor, "frame node 3"], Float[Tensor, "frame node 3"]]:
    """Simulate and remember how, so that a loss of the result can be differentiated.

    Arguments that are left out take their value from the model or the parameters. The first
    call with a model captures graphs, later ones with the same model object use them again.

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
        initial_position: Object nodes at frame 0 [m].
        initial_velocity: Their velocities at frame 0 [m/s].
        device: Warp device to simulate on. Tensors may be elsewhere; results are where
            `control` is.
        window: Frames after which gradients are cut: 1 is PhysTwin's one-frame gradient,
            none the gradient over the whole horizon.

    Returns:
        Positions [m] and velocities [m/s] of the object nodes in every frame; frame 0 is the
        initial state.

    Raises:
        SimulationDivergedError: If a node is not finite or too fast.
        ValueError: If a tensor does not fit the model, or the window is not positive.
    """
    if window is not None and window < 1:
        raise ValueError(f"window is {window}; expected at least one frame, or none.")
    bridge = _bridge(model, parameters, device)
    log_default = np.log(np.maximum(model.stiffness, np.finfo(np.float32).tiny))
    given = (
        (control, None),
        (log_stiffness, log_default),
        (damping, model.damping),
        (drag, parameters.drag),
        (restitution, parameters.restitution),
        (friction, parameters.friction),
        (initial_position, model.object_node),
        (initial_velocity, model.initial_velocity),
    )
    where = {"dtype": torch.float32, "device": bridge.torch_device}
    tensors = [
        torch.as_tensor(default if value is None else value, **where).contiguous()
        for value, default in given
    ]
    bridge.check(tensors)
    position, velocity = _Rollout.apply(bridge, window, *tensors)
    return position.to(control.device), velocity.to(control.device)


@lru_cache(maxsize=CACHED_SIMULATORS)
def _bridge(
    model: SpringMassModel, parameters: SimulationParameters, device: str
) -> "_DifferentiableSimulator":
    return _DifferentiableSimulator(model, parameters, device)


class _Rollout(torch.autograd.Function):
    """Connects the simulator and its adjoint to PyTorch."""

    @staticmethod
    def forward(ctx: Any, bridge: "_DifferentiableSimulator", window: int | None, *tensors: Tensor):
        with bridge.stream():
            position, velocity = bridge.forward(*tensors)
        ctx.bridge = bridge
        ctx.window = window
        ctx.save_for_backward(*tensors, position, velocity)
        return position, velocity

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor):
        *tensors, position, velocity = ctx.saved_tensors
        window = ctx.window or len(position)
        with ctx.bridge.stream():
            gradients = ctx.bridge.backward(tensors, (position, velocity), grad_outputs, window)
        return None, None, *gradients


class _DifferentiableSimulator:
    """A simulator with the tape of one frame and the graphs that fill it and walk it back."""

    def __init__(
        self, model: SpringMassModel, parameters: SimulationParameters, device: str
    ) -> None:
        self.simulator = Simulator(model, parameters, device)
        self.torch_device = torch.device(wp.device_to_torch(self.simulator.device))
        self._is_captured = False

    @contextmanager
    def stream(self) -> Iterator[None]:
        """Let PyTorch work on Warp's stream, ordered before and after with its own."""
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
            *zip(("drag", "restitution", "friction"), scalars, ((), (), ()), strict=True),
        ):
            if tuple(value.shape) != tuple(shape):
                raise ValueError(f"{name} has shape {tuple(value.shape)}; expected {tuple(shape)}.")

    def forward(self, control: Tensor, *rest: Tensor) -> tuple[Tensor, Tensor]:
        """Simulate all frames; return positions and velocities."""
        *material, position, velocity = rest
        self._place_material(material)
        simulator = self.simulator
        _copy_in(simulator.position, position)
        _copy_in(simulator.velocity, velocity)
        simulator.first_divergence.fill_(np.iinfo(np.int32).max)
        positions, velocities = [position], [velocity]
        for frame in range(1, len(control)):
            self._place_control(control, frame)
            simulator.replay_frame()
            simulator.check_divergence(frame)
            positions.append(_copy_out(simulator.position))
            velocities.append(_copy_out(simulator.velocity))
        return torch.stack(positions), torch.stack(velocities)

    def backward(
        self,
        tensors: list[Tensor],
        states: tuple[Tensor, Tensor],
        outputs: tuple[Tensor, ...],
        window: int,
    ) -> list[Tensor]:
        """Return the gradients of all tensors, in their order."""
        control, *material, _, _ = tensors
        self._place_material(material)
        self._capture()
        # Sums over many substeps and frames keep their digits in float64.
        sums = [torch.zeros_like(value, dtype=torch.float64) for value in tensors[:6]]
        _copy_in(self._position_bar, outputs[0][-1])
        _copy_in(self._velocity_bar, outputs[1][-1])
        for frame in range(len(control) - 1, 0, -1):
            self._place_control(control, frame)
            _copy_in(self._position[0], states[0][frame - 1])
            _copy_in(self._velocity[0], states[1][frame - 1])
            for sum_bar in self._sums:
                sum_bar.zero_()
            wp.capture_launch(self._fill_graph)
            wp.capture_launch(self._walk_back_graph)
            start, end, *rest = (_copy_out(value) for value in self._sums)
            sums[0][frame - 1] += start
            sums[0][frame] += end
            for total, value in zip(sums[1:], rest, strict=True):
                total.add_(value.double().sum() if total.ndim == 0 else value)
            self._enter_frame(frame - 1, outputs, is_cut=(frame - 1) % window == 0 and frame > 1)
        initial = [_copy_out(self._position_bar), _copy_out(self._velocity_bar)]
        return [value.float() for value in sums] + initial

    def _enter_frame(self, frame: int, outputs: tuple[Tensor, ...], *, is_cut: bool) -> None:
        """Add what the loss says of a frame's state, after forgetting later frames if cut."""
        for bar, output in zip((self._position_bar, self._velocity_bar), outputs, strict=True):
            later = torch.zeros_like(output[frame]) if is_cut else _copy_out(bar)
            _copy_in(bar, later + output[frame])

    def _place_material(self, material: list[Tensor]) -> None:
        log_stiffness, damping, drag, restitution, friction = material
        _copy_in(self.simulator.stiffness, log_stiffness.exp())
        _copy_in(self.simulator.damping, damping)
        self.simulator.override_world(
            velocity_loss=-np.expm1(-self.simulator.parameters.dt * float(drag)),
            restitution=float(restitution),
            friction=float(friction),
        )

    def _place_control(self, control: Tensor, frame: int) -> None:
        _copy_in(self.simulator.control_start, control[frame - 1])
        _copy_in(self.simulator.control_end, control[frame])

    def _capture(self) -> None:
        """Make the tape and the two graphs of the backward pass, once."""
        if self._is_captured:
            return
        model, device = self.simulator.model, self.simulator.device
        substeps = self.simulator.parameters.substeps_per_frame
        nodes, springs = model.node_count, len(model.spring_nodes)

        def zeros(count: int, dtype: Any) -> wp.array:
            return wp.zeros(count, dtype=dtype, device=device)

        def tape(length: int) -> list[Any]:
            whole = wp.zeros((length, nodes), dtype=wp.vec3, device=device)
            return [whole[index] for index in range(length)]

        self._position, self._velocity = tape(substeps + 1), tape(substeps + 1)
        self._free_velocity = tape(substeps)
        self._position_bar, self._velocity_bar = zeros(nodes, wp.vec3), zeros(nodes, wp.vec3)
        self._force_bar = zeros(nodes, wp.vec3)
        self._offset_bar, self._stretch_bar = zeros(springs, wp.vec3), zeros(springs, wp.vec3)
        self._row_offset_bar = self.simulator.sums.scratch()
        self._row_stretch_bar = self.simulator.sums.scratch()
        controls = [zeros(model.control_count, wp.vec3) for _ in range(2)]
        materials = [zeros(springs, wp.float32) for _ in range(2)]
        scalars = [zeros(nodes, wp.float32) for _ in range(3)]
        self._sums = [*controls, *materials, *scalars]
        self._fill_graph = self.simulator.capture(self._fill)
        self._walk_back_graph = self.simulator.capture(self._walk_back)
        self._is_captured = True

    def _fill(self) -> None:
        for substep, free_velocity in enumerate(self._free_velocity):
            self.simulator.launch_substep(
                substep,
                (self._position[substep], self._velocity[substep]),
                (self._position[substep + 1], self._velocity[substep + 1]),
                free_velocity,
            )

    def _walk_back(self) -> None:
        simulator, model = self.simulator, self.simulator.model
        control_bars, material_bars, scalar_bars = self._sums[:2], self._sums[2:4], self._sums[4:]
        state_bars = [self._position_bar, self._velocity_bar]
        for substep in reversed(range(len(self._free_velocity))):
            state = self._position[substep], self._velocity[substep]
            fraction = (substep + 1) / len(self._free_velocity)
            wp.launch(
                retract_nodes,
                dim=model.node_count,
                inputs=[simulator.world, state[0], self._free_velocity[substep]],
                outputs=[*state_bars, *scalar_bars, self._force_bar],
                device=simulator.device,
            )
            wp.launch(
                retract_springs,
                dim=len(model.spring_nodes),
                inputs=[*simulator.spring_inputs(fraction, state), self._force_bar],
                outputs=[*material_bars, self._offset_bar, self._stretch_bar],
                device=simulator.device,
            )
            start, entry, offset_bar = simulator.sums.of(self._offset_bar, self._row_offset_bar)
            *_, stretch_bar = simulator.sums.of(self._stretch_bar, self._row_stretch_bar)
            wp.launch(
                gather_nodes,
                dim=model.node_count + model.control_count,
                inputs=[fraction, simulator.world, start, entry, offset_bar, stretch_bar],
                outputs=[*state_bars, *control_bars],
                device=simulator.device,
            )


def _copy_in(target: wp.array, value: Tensor) -> None:
    """Copy a tensor of the same device into an array."""
    if target.size:
        wp.to_torch(target).copy_(value.detach())


def _copy_out(value: wp.array) -> Tensor:
    """Copy an array into a new tensor of the same device."""
    return wp.to_torch(value).clone()
