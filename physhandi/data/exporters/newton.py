"""An object as a Newton model: nodes and control nodes as particles, springs, and the ground.

Newton's springs have stiffness Y/r, a rest length r and a dashpot c, and its semi-implicit solver
takes the same steps as ours. Particles without mass are moved by nothing but their velocity: these
are the control nodes. The ground is Newton's, which pushes a node that is below it.
"""

import io
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy import ndarray

from physhandi.data.exporters.scene_data import SceneData
from physhandi.data.exporters.twin import SLIPPED, Twin

_STEPS_PER_SUBSTEP = 4
"""Steps that Newton takes for one of ours: the ground is stiff, and few steps bounce unevenly."""
_GROUND_LOAD = 1.0
"""What the ground adds to ``dt² k + 2 dt c`` of a node of 1 kg, which must stay below 4. Our
substeps are stable with a factor of 1.25, so at a quarter of their length springs take at most 0.8
of it."""
_MOST_DAMPED = 2.0
"""Largest damping ratio of the ground; more would need a softer one."""
_ARRIVALS = 64
_BOUNCE_STEPS = 200
"""More than a bounce takes: 50 for the softest ground."""

_PLAY = (
    '''\
"""Simulates model.npz along the hand's motion in Newton, compared with PhysHanDI's own rollout.

pip install newton; python play.py. In other programs: ``for position in play(): ...``
"""

import sys
from pathlib import Path

import newton
import numpy as np
import warp as wp


def build(folder=Path(__file__).parent):
    """Make the model: nodes, then control nodes, which have no mass, so that no force moves them.

    Returns the model and the contacts of nodes with the ground, which need not be looked for.
    """
    parts = np.load(folder / "model.npz")
    builder = newton.ModelBuilder(gravity=tuple(parts["gravity"].tolist()))
    names = ("particle_q", "particle_qd", "particle_mass", "particle_radius")
    builder.add_particles(*(parts[name].tolist() for name in names))
    material = {}
    if "ground_height" in parts:
        height = float(parts["ground_height"])
        material = {name: float(parts["ground_" + name]) for name in ("ke", "kd", "kf", "mu")}
        builder.add_ground_plane(height=height, cfg=newton.ModelBuilder.ShapeConfig(**material))
    model = builder.finalize()
    # Not by the builder, which would compile what finds the springs at each node for other solvers.
    model.spring_count = len(parts["spring_rest_length"])
    model.spring_indices = wp.array(parts["spring_indices"].ravel(), dtype=wp.int32)
    for name in ("spring_rest_length", "spring_stiffness", "spring_damping"):
        setattr(model, name, wp.array(parts[name], dtype=wp.float32))
    if not material:
        return model, None
    for name, value in material.items():
        setattr(model, "soft_contact_" + name, value)
    count = int(np.sum(parts["particle_mass"] > 0))
    contacts = newton.Contacts(0, count, device=model.device)
    contacts.soft_contact_count.fill_(count)
    contacts.soft_contact_particle.assign(np.arange(count))
    contacts.soft_contact_shape.fill_(0)
    contacts.soft_contact_body_pos.fill_((0.0, 0.0, height))
    contacts.soft_contact_normal.fill_((0.0, 0.0, 1.0))
    return model, contacts


'''
    + SLIPPED
    + '''


def play(folder=Path(__file__).parent):
    """Yield the object's nodes (node 3) [m] of frame after frame."""
    motion = dict(np.load(folder / "motion.npz"))  # Else each use reads the file.
    model, contacts = build(folder)
    model.particle_grid = None  # Nodes touch the ground, not each other.
    solver = newton.solvers.SolverSemiImplicit(model)
    now, then = model.state(), model.state()
    node, control, dt = motion["node"], motion["control"], float(motion["dt"])
    count, duration = len(node), dt * int(motion["substeps"])
    place, speed = now.particle_q.numpy().copy(), now.particle_qd.numpy().copy()
    moves = wp.zeros_like(now.particle_q)

    def two_steps():
        for start, end in ((now, then), (then, now)):
            wp.map(wp.mul, start.particle_qd, -float(motion["drag"]), out=start.particle_f)
            solver.step(start, end, None, contacts, dt)
            wp.map(wp.add, end.particle_q, moves, out=end.particle_q)

    def recorded():
        with wp.ScopedCapture(model.device) as capture:
            two_steps()
        return capture.graph

    two_steps()  # Compiles what is recorded next.
    graph = recorded()
    stiffness, damping = motion["stiffness"], motion["damping"]
    ends = model.spring_indices.numpy().reshape(-1, 2).T
    yield place[:count].copy()
    for frame in range(1, len(control)):
        before = control[frame - 1]
        if frame == motion["restart_frame"] + 1:  # Prediction starts from an observed state.
            place[:count] = motion["restart_position"]
            speed[:count] = motion["restart_velocity"]
            rest, stiffness = motion["restart_rest_length"], motion["restart_stiffness"]
            model.spring_rest_length.assign(rest)
            radius = np.concatenate([motion["restart_clearance"], np.zeros(len(before))])
            model.particle_radius.assign(radius)
            before = motion["restart_control"]
            if contacts is not None:  # Their friction is the mean of what touches.
                model.soft_contact_mu *= float(motion["friction_share"])
                model.shape_material_mu.fill_(model.soft_contact_mu)
                graph = recorded()
        # Particles without mass go on with their speed, unless dashpots are not to feel it.
        place[count:], speed[count:] = before, 0.0
        way = np.zeros_like(place)
        if motion["use_control_velocity"]:
            speed[count:] = (control[frame] - before) / duration
        else:
            way[count:] = (control[frame] - before) / motion["substeps"]
        moves.assign(way)
        now.particle_q.assign(place)
        now.particle_qd.assign(speed)
        acts = (motion["spring_first"] < frame) & (frame <= motion["spring_last"])
        model.spring_stiffness.assign(acts * stiffness)
        model.spring_damping.assign(acts * damping)
        for _ in range(int(motion["substeps"]) // 2):
            wp.capture_launch(graph)
        place, speed = now.particle_q.numpy().copy(), now.particle_qd.numpy().copy()
        if frame > motion["restart_frame"]:
            first, second = np.concatenate([place[:count], control[frame]])[ends]
            length = np.linalg.norm(first - second, axis=-1)
            rest, stiffness = slipped(rest, stiffness, length, acts, motion)
            model.spring_rest_length.assign(rest)
        # What the fit had missed, by which nodes were seen beside where springs have them.
        yield place[:count] + (frame > motion["restart_frame"]) * motion["restart_node_shift"]


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    rollout = np.load(folder / "motion.npz")["rollout"]
    print(np.load(folder / "model.npz")["about"])
    for frame, position in enumerate(play(folder)):
        distance = np.linalg.norm(position - rollout[frame], axis=-1).mean()
        travel = np.linalg.norm(rollout[frame] - rollout[0], axis=-1).mean()
        print(f"frame {frame}: moved by {1e3 * travel:.1f} mm, {1e3 * distance:.2f} mm from ours")
'''
)


def newton_files(scene: SceneData) -> Iterator[tuple[str, bytes]]:
    """Write the object, the ground and what holds the object as a Newton model that moves.

    Masses, stiffness and damping are those of an object of `scene.mass`, which moves as the model
    does; each node weighs 1 kg if nobody knows. Nodes touch the ground, not each other.

    Args:
        scene: The motion, with the parameters that it was simulated with.

    Yields:
        Names and contents: ``model.npz``, named as Newton's `ModelBuilder` names it;
        ``motion.npz``, the hand's motion, when springs hold, and our rollout; ``play.py``, which
        simulates the one along the other.

    Raises:
        UsageError: If there is no object to simulate, or it bends as an elastic rod.
    """
    twin = Twin(scene, "Newton")
    yield "model.npz", _npz(_model(twin, scene.dt / _STEPS_PER_SUBSTEP))
    motion = twin.motion() | {
        "substeps": np.array(_STEPS_PER_SUBSTEP * twin.parameters["substeps_per_frame"]),
        "dt": np.array(scene.dt / _STEPS_PER_SUBSTEP),
        "drag": np.array(twin.mass * twin.parameters["drag"]),
        "use_control_velocity": np.array(twin.parameters["use_control_velocity"]),
    }
    yield "motion.npz", _npz(motion)
    yield "play.py", _PLAY.encode()


def _npz(arrays: Mapping[str, Any]) -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    return content.getvalue()


def _model(twin: Twin, dt: float) -> dict[str, ndarray]:
    held = np.zeros(len(twin.held))
    arrays = {
        "about": np.array(twin.about),
        "gravity": np.array([0.0, 0.0, -twin.parameters["gravity"]]),
        "particle_q": np.concatenate([twin.node, twin.control[0]]),
        "particle_qd": np.concatenate([twin.velocity, np.zeros((len(held), 3))]),
        "particle_mass": np.concatenate([np.full(len(twin.node), twin.mass), held]),
        "particle_radius": np.concatenate([twin.clearance, held]),
        "spring_indices": twin.ends,
        "spring_rest_length": twin.rest_length,
        "spring_stiffness": twin.stiffness,
        "spring_damping": twin.damping,
    }
    height = twin.parameters["ground_height"]
    if height is None:
        return arrays
    ratio = _damping_ratio(twin.parameters["restitution"])
    rate = _ground_rate(ratio) / dt
    return arrays | {
        "ground_height": np.array(height),
        "ground_ke": np.array(twin.mass * rate**2),
        "ground_kd": np.array(twin.mass * 2.0 * ratio * rate),
        # Friction below Coulomb's limit stops a node within one step: a load of 2.
        "ground_kf": np.array(twin.mass / dt),
        "ground_mu": np.array(twin.parameters["friction"]),
    }


def _ground_rate(ratio: float) -> float:
    """Find the highest eigenfrequency of a node on the ground that is stable [1/step].

    ``dt² k + 2 dt c`` is the load, where c is twice the damping ratio times √k.
    """
    return math.sqrt(4.0 * ratio**2 + _GROUND_LOAD) - 2.0 * ratio


def _damping_ratio(restitution: float) -> float:
    """Find how damped a ground must be for nodes to bounce as they should, as far as they can."""
    low, high = 0.0, _MOST_DAMPED
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _bounce(middle) > restitution else (low, middle)
    return high


def _bounce(ratio: float) -> float:
    """Find how much of its speed a node keeps on average that bounces in Newton.

    The ground damps a node while it sinks in, not while it comes back.
    """
    rate = _ground_rate(ratio)
    height, speed = np.arange(_ARRIVALS) / _ARRIVALS, np.full(_ARRIVALS, -1.0)
    for _ in range(_BOUNCE_STEPS):
        push = -(rate**2) * height - 2.0 * ratio * rate * np.minimum(speed, 0.0)
        speed = speed + np.where(height <= 0.0, push, 0.0)
        height = height + speed
    return float(speed.mean())
