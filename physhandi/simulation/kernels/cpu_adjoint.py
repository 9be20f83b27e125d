"""The adjoint of `cpu_frame`: threads walk a frame's tape back, meeting once a substep.

A part undoes contact, drag and integration of its own nodes and writes the adjoints of their
forces; after the meeting its springs read those of both ends. A bar is the derivative of the
loss.
"""

import warp as wp

from physhandi.simulation.kernels.adjoint import before_drag, node_adjoint
from physhandi.simulation.kernels.barrier import meet
from physhandi.simulation.kernels.contacts import Motion
from physhandi.simulation.kernels.cpu_frame import (
    as_record,
    gather_material,
    record_position,
    record_velocity,
)
from physhandi.simulation.kernels.simd import (
    Bars,
    Parts,
    Record,
    SpringMaterial,
    cut_springs_adjoint,
    inner_springs_adjoint,
)
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})


@wp.func
def zero_springs(first: int, last: int, bars: Bars):
    """Forget what springs added up."""
    for place in range(first, last):
        bars.log_stiffness[place] = 0.0
        bars.damping[place] = 0.0


@wp.func
def begin_part(
    part: int,
    parts: Parts,
    position_bar: wp.array[wp.vec3],
    velocity_bar: wp.array[wp.vec3],
    bars: Bars,
):
    """Take in the adjoints of a part's states at the end of the frame."""
    zero = wp.vec3(0.0, 0.0, 0.0)
    zero_springs(parts.inner_start[part], parts.inner_start[part + 1], bars)
    zero_springs(parts.cut_start[part], parts.cut_start[part + 1], bars)
    for own in range(parts.own_start[part], parts.own_start[part + 1]):
        node = parts.node[own]
        bars.state[own] = as_record(position_bar[node], velocity_bar[node])
        bars.coefficients[own] = zero
    for place in range(parts.held_start[part], parts.held_start[part + 1]):
        held = place - parts.node.shape[0]
        bars.state[place] = as_record(zero, zero)
        bars.start[held] = zero
        bars.end[held] = zero


@wp.func
def part_nodes_adjoint(
    part: int,
    substep: int,
    world: World,
    clearance: wp.array[float],
    parts: Parts,
    state: wp.array2d[Record],
    free_tape: wp.array2d[wp.vec4],
    bars: Bars,
):
    """Carry a part's adjoints to before contact and drag, and to the forces on its nodes."""
    for own in range(parts.own_start[part], parts.own_start[part + 1]):
        record = bars.state[own]
        after = Motion()
        after.position = record_position(record)
        after.velocity = record_velocity(record)
        taped = free_tape[substep, own]
        free = wp.vec3(taped[0], taped[1], taped[2])
        touching = clearance[parts.node[own]]
        before = node_adjoint(world, touching, record_position(state[substep, own]), free, after)
        free_bar = before.motion.velocity
        old_bar = before_drag(world, free_bar)
        bars.state[own] = as_record(before.motion.position, old_bar)
        pull = world.dt * old_bar
        bars.force[substep % 2, own] = wp.vec4(pull[0], pull[1], pull[2], 0.0)
        bars.coefficients[own] += wp.vec3(
            -world.dt * wp.dot(free, free_bar), before.restitution, before.friction
        )


@wp.func
def collect_controls(part: int, fraction: float, rate: float, parts: Parts, bars: Bars):
    """Add what springs say of a part's control nodes to their places at start and end."""
    zero = wp.vec3(0.0, 0.0, 0.0)
    for place in range(parts.held_start[part], parts.held_start[part + 1]):
        held = place - parts.node.shape[0]
        record = bars.state[place]
        place_bar = record_position(record)
        by_rate = rate * record_velocity(record)
        bars.start[held] += (1.0 - fraction) * place_bar - by_rate
        bars.end[held] += fraction * place_bar + by_rate
        bars.state[place] = as_record(zero, zero)


@wp.func
def give_springs(
    first: int,
    last: int,
    parts: Parts,
    bars: Bars,
    log_stiffness_bar: wp.array[float],
    damping_bar: wp.array[float],
):
    """Hand over the adjoints of the material of springs that a part speaks for."""
    for place in range(first, last):
        spring = parts.spoken[place]
        if spring >= 0:
            log_stiffness_bar[spring] = bars.log_stiffness[place]
            damping_bar[spring] = bars.damping[place]


@wp.kernel
def parts_adjoint(
    thread: int,
    threads: int,
    substeps: int,
    give_way: wp.uint64,
    job_out: wp.array[int],
    meeting_out: wp.array[int],
    # Model:
    world: wp.array[World],
    clearance: wp.array[float],
    parts: Parts,
    rest_length: wp.array[float],
    stiffness: wp.array[float],
    damping: wp.array[float],
    # Scratch:
    material_out: SpringMaterial,
    # State in:
    state: wp.array2d[Record],
    free_tape: wp.array2d[wp.vec4],
    # Adjoint, changed in place:
    bars_out: Bars,
    position_bar_out: wp.array[wp.vec3],
    velocity_bar_out: wp.array[wp.vec3],
    # Adjoint out:
    log_stiffness_bar_out: wp.array[float],
    damping_bar_out: wp.array[float],
    drag_bar_out: wp.array[float],
    restitution_bar_out: wp.array[float],
    friction_bar_out: wp.array[float],
):
    """Carry the adjoints of a thread's parts back from step `job_out[0]` to `job_out[1]`.

    Step 0 is a frame's last substep; `job_out[2]` becomes the step that was reached.
    """
    here = world[0]
    part_count = parts.own_start.shape[0] - 1
    part_first = thread * part_count // threads
    part_last = (thread + 1) * part_count // threads
    first = job_out[0]
    last = job_out[1]
    if first == 0:
        for part in range(part_first, part_last):
            gather_material(part, here, parts, rest_length, stiffness, damping, material_out)
            begin_part(part, parts, position_bar_out, velocity_bar_out, bars_out)
    waited = meet(meeting_out, 0, threads, 0, give_way)
    step = int(first)
    while step < last and waited >= 0:
        substep = substeps - 1 - step
        fraction = float(substep + 1) / float(substeps)
        for part in range(part_first, part_last):
            part_nodes_adjoint(part, substep, here, clearance, parts, state, free_tape, bars_out)
        waited = meet(meeting_out, step - first + 1, threads, waited, give_way)
        for part in range(part_first, part_last):
            inner_springs_adjoint(part, substep, parts, material_out, state, bars_out)
            cut_springs_adjoint(part, substep, parts, material_out, state, bars_out)
            collect_controls(part, fraction, here.control_rate, parts, bars_out)
        step += 1
    if thread == 0:
        job_out[2] = step
    if step == substeps:
        for part in range(part_first, part_last):
            give_springs(
                parts.inner_start[part],
                parts.inner_start[part + 1],
                parts,
                bars_out,
                log_stiffness_bar_out,
                damping_bar_out,
            )
            give_springs(
                parts.cut_start[part],
                parts.cut_start[part + 1],
                parts,
                bars_out,
                log_stiffness_bar_out,
                damping_bar_out,
            )
            for own in range(parts.own_start[part], parts.own_start[part + 1]):
                node = parts.node[own]
                position_bar_out[node] = record_position(bars_out.state[own])
                velocity_bar_out[node] = record_velocity(bars_out.state[own])
                drag_bar_out[node] = bars_out.coefficients[own][0]
                restitution_bar_out[node] = bars_out.coefficients[own][1]
                friction_bar_out[node] = bars_out.coefficients[own][2]
