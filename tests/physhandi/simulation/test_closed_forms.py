"""Textbook motions in every way of simulating: a pendulum, a block on a slope, a hanging sheet.

Expected numbers are closed forms in float64. Nodes weigh 1 kg, and the simulator's semi-implicit
Euler is a leapfrog whose velocities are those of half a substep later.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ellipj, ellipk

from physhandi.simulation.engines.batch import BatchSimulator
from physhandi.simulation.master_topology import MasterTopology
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model

Simulate = Callable[..., list[np.ndarray]]


@pytest.fixture(params=["engine", "graph", "batch"])
def simulate(request: pytest.FixtureRequest, device: str) -> Simulate:
    """Simulate objects that differ in their parameters alone while their controls stay.

    Returns the positions of each: by the device's own engine, by a graph of launches, or in batch.
    """

    def positions(
        node: np.ndarray,
        control: np.ndarray,
        each: Sequence[SimulationParameters],
        frames: int,
        clearance: float = 0.0,
    ) -> list[np.ndarray]:
        path = np.repeat(control[None], frames, axis=0)
        touch = np.full(len(node), clearance, np.float32)
        if request.param == "batch":
            master = MasterTopology.of(node, control, each, clearance=touch)
            return list(BatchSimulator(master, each, device).rollout(path).position)
        found = []
        for parameters in each:
            model = replace(build_model(node, control, parameters), clearance=touch)
            simulator = Simulator(model, parameters, device)
            if request.param == "graph":
                simulator.engine = None
            found.append(simulator.rollout(path).position)
        return [position.astype(np.float64) for position in found]

    return positions


def test_pendulums_swing_with_the_period_of_their_length_and_stretch_as_they_swing(
    simulate: Simulate,
) -> None:
    """Masses on a spring each, let go at rest, on Earth and on the Moon.

    The angle obeys sin(θ/2) = sin(θ0/2) cd(ω t) with ω = √(g/L), whose period is
    2π √(L/g) (1 + θ0²/16 + 11 θ0⁴/3072). The spring carries g cos θ and the centripetal force:
    its length is r (1 + g (3 cos θ - 2 cos θ0) / Y), on average L = r (1 + g/Y).

    Without drag nothing damps the swing; the dashpot only stops the spring's own vibration, which
    takes 0.1 s. Substeps of 0.28 ms err by (ω dt)²/24 < 1e-7 of the period, float32 by 1e-6, the
    length's change over a swing by g/Y θ0² < 1e-4. Periods are read between frames to 3e-5.
    """
    rest, start = np.array([0.25, 0.4]), np.array([0.3, -0.15])
    pivot = np.array([[0.0, 0.0, 0.0], [1.0, 0.25, 0.5]])
    plane = np.array([[1.0, 0.0, 0.0], [0.6, 0.8, 0.0]])
    up = np.array([0.0, 0.0, 1.0])
    node = pivot + rest[:, None] * (np.sin(start)[:, None] * plane - np.cos(start)[:, None] * up)
    tension = 1e5
    each = [
        SimulationParameters(
            gravity=gravity,
            drag=0.0,
            ground_height=None,
            connection_radius=0.0,
            virtual_connection_radius=0.5,
            virtual_max_neighbors=1,
            virtual_stiffness=tension,
            damping=400.0,
            frame_rate=60.0,
            substeps_per_frame=25,
        )
        for gravity in (9.81, 20.0)
    ]
    frames = 81
    time = np.arange(frames) / 60.0
    for parameters, position in zip(each, simulate(node, pivot, each, frames), strict=True):
        gravity = parameters.gravity
        arm = position - pivot
        length = np.linalg.norm(arm, axis=2)
        mean_length = rest * (1.0 + gravity / tension)
        omega = np.sqrt(gravity / mean_length)
        angle = np.arctan2((arm * plane).sum(axis=2), -arm[..., 2])

        np.testing.assert_allclose(
            angle, swing(start, omega, time + 0.5 * parameters.dt), atol=1e-4
        )
        pull = gravity * (3.0 * np.cos(angle) - 2.0 * np.cos(start))
        stretch = length - rest
        assert (mean_length - rest).min() > 2e-5
        np.testing.assert_allclose(stretch[10:], (rest * pull / tension)[10:], atol=1e-6)
        series = 1.0 + start**2 / 16.0 + 11.0 * start**4 / 3072.0
        for bob in range(2):
            half = np.diff(zero_crossings(time, angle[:, bob]))
            assert len(half) >= 1
            np.testing.assert_allclose(
                2.0 * half, 2.0 * np.pi / omega[bob] * series[bob], rtol=1e-4
            )


def swing(start: np.ndarray, omega: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Angle of a pendulum that is let go at rest, exactly, over time x pendulum [rad]."""
    modulus = np.sin(0.5 * start)
    sine, *_ = ellipj(ellipk(modulus**2) + np.outer(time, omega), modulus**2)
    return 2.0 * np.arcsin(modulus * sine)


def zero_crossings(time: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Times at which a value changes its sign, on straight lines between samples."""
    at = np.flatnonzero(np.sign(value[:-1]) != np.sign(value[1:]))
    return time[at] - value[at] * (time[at + 1] - time[at]) / (value[at + 1] - value[at])


SLOPES = [
    (0.0, 0.5, 0.49, 0.0),
    (0.0, 0.5, 0.51, 0.0),
    (0.0, 0.5, 1.0, 0.0),
    (0.036, 0.5, 1.0, 0.0),
    (0.036, 0.2, 0.4, 0.5),
    (0.036, 0.0, 0.1, 0.9),
]
"""Connection radius, friction μ, slope tan φ, restitution e; without springs nodes are pebbles."""


def test_pebbles_and_a_block_rest_or_slide_on_a_slope_as_coulomb_says(simulate: Simulate) -> None:
    """The ground is level, so the frame is the slope's: g cos φ presses, g sin φ pulls along x.

    The pull comes from a control far behind, whose springs are half as long as at rest: they push
    nodes by Y/2 = g sin φ, less 1/450 of it for a metre of way.

    Each impact takes μ (1 + e) |v_n| of a node's sliding speed and gives it (1 + e) |v_n| upwards.
    Over all nodes and substeps these have the ratio μ, whatever e is, as long as all slide. So
    x + μ (z - z0) = (sin φ - μ cos φ) g t²/2 for the middle, also while a block settles; a substep
    adds g dt t/2, half of its length. Where a pebble sticks, each impact takes all of its speed.
    Some nodes of a block stick for moments, so that it slides up to 0.3 % farther.
    """
    place = np.stack([axis.ravel() for axis in np.mgrid[:3, :3, :2]], axis=1)
    # Heights that float32 holds exactly: the lower layer begins in touch.
    node = np.array([0.02, 0.02, 0.015625]) * place + np.array([0.0, 0.0, 0.1875])
    away = 450.0
    each = [
        SimulationParameters(
            gravity=9.81 * np.cos(np.arctan(slope)),
            friction=friction,
            restitution=restitution,
            virtual_stiffness=2.0 * 9.81 * np.sin(np.arctan(slope)),
            virtual_connection_radius=2.0 * away,
            virtual_max_neighbors=len(node),
            virtual_rest_length_floor=2.0 * away,
            connection_radius=radius,
            stiffness=2000.0,
            damping=0.0,
            drag=0.0,
            ground_height=0.125,
            substeps_per_frame=250,
        )
        for radius, friction, slope, restitution in SLOPES
    ]
    control = np.array([[-away, 0.02, 0.1875]])
    time = np.arange(16) / 30.0
    found = simulate(node, control, each, len(time), clearance=0.0625)
    for (radius, friction, slope, _), position in zip(SLOPES, found, strict=True):
        angle = np.arctan(slope)
        net = 9.81 * max(np.sin(angle) - friction * np.cos(angle), 0.0)
        way = 0.5 * net * time * (time + each[0].dt)
        assert (way[-1] > 0.01) == (slope > friction)
        moved = position - node
        if radius:
            middle = moved.mean(axis=1)
            found_way = middle[:, 0] + friction * middle[:, 2]
            np.testing.assert_allclose(found_way, way, rtol=3e-3, atol=1e-4)
        else:
            low = moved[:, place[:, 2] == 0]
            # Pebbles farther away are pushed less, which matters where friction nearly holds them.
            less = 9.81 * np.sin(angle) * node[place[:, 2] == 0, 0] / away * (net > 0.0)
            each_way = way[:, None] - 0.5 * less * (time**2)[:, None]
            np.testing.assert_allclose(low[..., 0], each_way, rtol=5e-4, atol=2e-6)
            np.testing.assert_allclose(low[..., 2], 0.0, atol=1e-6)
        assert np.abs(moved[..., 1].mean(axis=1)).max() < 1e-5


def test_a_hanging_sheet_stretches_by_the_weight_below_each_spring(simulate: Simulate) -> None:
    """Columns of a sheet hang on the controls above them; springs join neighbors of the lattice.

    A spring with n nodes below it is longer by r n g / Y. The horizontal ones carry nothing, since
    all columns hang alike.
    """
    step = 0.02
    column, row = (axis.ravel() for axis in np.mgrid[:4, :5])
    node = step * np.column_stack([column, 0.0 * column, -1.0 - row])
    control = step * np.column_stack([np.arange(4), np.zeros((4, 2))])
    each = [
        SimulationParameters(
            gravity=gravity,
            connection_radius=0.025,
            stiffness=1500.0,
            virtual_stiffness=3000.0,
            virtual_connection_radius=0.025,
            virtual_max_neighbors=1,
            damping=50.0,
            drag=8.0,
            ground_height=None,
            substeps_per_frame=60,
        )
        for gravity in (9.81, 4.0)
    ]
    for parameters, position in zip(each, simulate(node, control, each, 46), strict=True):
        unit = step * parameters.gravity / 1500.0
        below = np.array([2.5, 4.0, 3.0, 2.0, 1.0])  # The grip above is twice as stiff.
        expected = node.copy()
        expected[:, 2] -= unit * np.cumsum(below)[row]
        assert np.abs(expected - node).max() > 6e-4
        np.testing.assert_allclose(position[-1], expected, atol=2e-6)
