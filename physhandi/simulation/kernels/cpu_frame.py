"""A frame on a CPU in one launch a thread: parts of the object that meet after every substep.

Each part owns some nodes. Springs within a part are worked out once; a spring that is cut by
the border is worked out by both parts, each for its own end, so that no two threads ever write
to the same place. A thread walks one part or all of them: the order of every sum, and so every
bit, is the same.
"""

import warp as wp

from physhandi.simulation.kernels.barrier import meet
from physhandi.simulation.kernels.contacts import advance
from physhandi.simulation.kernels.integration import free_velocity, is_too_fast
from physhandi.simulation.kernels.simd import Parts, Record, SpringMaterial, pull_cut, pull_inner
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})


@wp.func
def as_record(position: wp.vec3, velocity: wp.vec3):
    """Put position and velocity into a record."""
    return Record(
        position[0], position[1], position[2], 0.0, velocity[0], velocity[1], velocity[2], 0.0
    )


@wp.func
def record_position(record: Record):
    """Return the position in a record."""
    return wp.vec3(record[0], record[1], record[2])


@wp.func
def record_velocity(record: Record):
    """Return the velocity in a record."""
    return wp.vec3(record[4], record[5], record[6])


@wp.func
def gather_material(
    part: int,
    world: World,
    parts: Parts,
    rest_length: wp.array[float],
    stiffness: wp.array[float],
    damping: wp.array[float],
    material: SpringMaterial,
):
    """Copy what a part's springs are made of, as it is now; padding pulls at nothing."""
    for group in range(2):
        first = parts.inner_start[part]
        last = parts.inner_start[part + 1]
        if group == 1:
            first = parts.cut_start[part]
            last = parts.cut_start[part + 1]
        for place in range(first, last):
            spring = parts.spring[place]
            material.rest[place] = 1.0
            material.elastic[place] = 0.0
            material.dashpot[place] = 0.0
            if spring >= 0:
                material.rest[place] = rest_length[spring]
                material.elastic[place] = world.stiffness_scale * stiffness[spring]
                material.dashpot[place] = damping[spring]


@wp.func
def place_controls(
    part: int,
    row: int,
    fraction: float,
    rate: float,
    parts: Parts,
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
    state: wp.array2d[Record],
    force: wp.array[wp.vec4],
):
    """Write where a part's control nodes are, and how fast springs see them move."""
    for place in range(parts.held_start[part], parts.held_start[part + 1]):
        control = parts.control[place - parts.node.shape[0]]
        start = control_start[control]
        way = control_end[control] - start
        state[row, place] = as_record(start + fraction * way, rate * way)
        force[place] = wp.vec4(0.0, 0.0, 0.0, 0.0)


@wp.func
def move_nodes(
    part: int,
    substep: int,
    row: int,
    next_row: int,
    world: World,
    clearance: wp.array[float],
    parts: Parts,
    state: wp.array2d[Record],
    force: wp.array[wp.vec4],
    free_tape: wp.array2d[wp.vec4],
    first_divergence: wp.array[int],
):
    """Move a part's own nodes by one substep, and forget the forces on them."""
    count = parts.node.shape[0]
    for node in range(parts.own_start[part], parts.own_start[part + 1]):
        before = state[row, node]
        f = force[node]
        force[node] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        free = free_velocity(world, record_velocity(before), wp.vec3(f[0], f[1], f[2]))
        touching = clearance[parts.node[node]]
        motion = advance(world, touching, record_position(before), free)
        state[next_row, node] = as_record(motion.position, motion.velocity)
        if free_tape.shape[0] > 0:
            free_tape[substep, node] = wp.vec4(free[0], free[1], free[2], 0.0)
        if is_too_fast(world, motion.velocity):
            place = substep * count + parts.node[node]
            first_divergence[part] = wp.min(first_divergence[part], place)


@wp.kernel
def advance_parts(
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
    # State in:
    control_start: wp.array[wp.vec3],
    control_end: wp.array[wp.vec3],
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    # Scratch:
    material_out: SpringMaterial,
    state_out: wp.array2d[Record],
    force_out: wp.array[wp.vec4],
    # State out:
    free_tape_out: wp.array2d[wp.vec4],
    position_out: wp.array[wp.vec3],
    velocity_out: wp.array[wp.vec3],
    first_divergence_out: wp.array[int],
):
    """Advance a thread's parts from substep `job_out[0]` to `job_out[1]`, or to where threads stop.

    States go round in the rows of `state_out`: two, or one more than substeps to keep them all.
    `job_out[2]` becomes the substep that was reached.
    """
    here = world[0]
    part_count = parts.own_start.shape[0] - 1
    part_first = thread * part_count // threads
    part_last = (thread + 1) * part_count // threads
    rows = state_out.shape[0]
    first = job_out[0]
    last = job_out[1]
    if first == 0:
        for part in range(part_first, part_last):
            gather_material(part, here, parts, rest_length, stiffness, damping, material_out)
            first_divergence_out[part] = wp.static(2**31 - 1)
            for own in range(parts.own_start[part], parts.own_start[part + 1]):
                node = parts.node[own]
                state_out[0, own] = as_record(position[node], velocity[node])
                force_out[own] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    waited = meet(meeting_out, 0, threads, 0, give_way)
    substep = int(first)
    while substep < last and waited >= 0:
        row = substep % rows
        next_row = (substep + 1) % rows
        fraction = float(substep + 1) / float(substeps)
        for part in range(part_first, part_last):
            place_controls(
                part,
                row,
                fraction,
                here.control_rate,
                parts,
                control_start,
                control_end,
                state_out,
                force_out,
            )
            pull_inner(part, row, parts, material_out, state_out, force_out)
            pull_cut(part, row, parts, material_out, state_out, force_out)
            move_nodes(
                part,
                substep,
                row,
                next_row,
                here,
                clearance,
                parts,
                state_out,
                force_out,
                free_tape_out,
                first_divergence_out,
            )
        substep += 1
        waited = meet(meeting_out, substep - first, threads, waited, give_way)
    if thread == 0:
        job_out[2] = substep
    if substep == substeps:
        for part in range(part_first, part_last):
            for own in range(parts.own_start[part], parts.own_start[part + 1]):
                node = parts.node[own]
                record = state_out[substeps % rows, own]
                position_out[node] = record_position(record)
                velocity_out[node] = record_velocity(record)
