"""One substep of many candidates at once: neighbouring threads are candidates, not nodes.

All candidates of a warp look at the same spring at the same time, so its data is read once and
their states lie side by side. What a candidate does not have of the master topology counts
nothing. State is laid out as [group][node][x y z vx vy vz][candidate of the group].
"""

import warp as wp

from physhandi.simulation.kernels.contacts import advance
from physhandi.simulation.kernels.dataflow import control_position, control_velocity, pull
from physhandi.simulation.kernels.integration import free_velocity, is_too_fast
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

FIELDS = (
    "dt",
    "velocity_loss",
    "gravity",
    "has_ground",
    "ground_height",
    "restitution",
    "friction",
    "control_rate",
    "speed_limit",
    "stiffness",
    "damping",
    "connection_radius",
    "max_neighbors",
    "virtual_stiffness",
    "virtual_damping",
    "virtual_connection_radius",
    "virtual_max_neighbors",
)
"""Rows of the candidates' numbers."""


@wp.func
def candidate_world(number: wp.array2d[float], candidate: int):
    """Collect what all nodes of a candidate share."""
    world = World()
    world.dt = number[wp.static(FIELDS.index("dt")), candidate]
    world.velocity_loss = number[wp.static(FIELDS.index("velocity_loss")), candidate]
    world.gravity = number[wp.static(FIELDS.index("gravity")), candidate]
    world.has_ground = int(number[wp.static(FIELDS.index("has_ground")), candidate])
    world.ground_height = number[wp.static(FIELDS.index("ground_height")), candidate]
    world.restitution = number[wp.static(FIELDS.index("restitution")), candidate]
    world.friction = number[wp.static(FIELDS.index("friction")), candidate]
    world.control_rate = number[wp.static(FIELDS.index("control_rate")), candidate]
    world.speed_limit = number[wp.static(FIELDS.index("speed_limit")), candidate]
    return world


# `dataflow.pull` summed over a node's springs, for several candidates a thread: wide loads at
# fixed offsets, which Warp's strided arrays do not give, make it 2.5 times as fast.
_SUM_SPRINGS = """
#if defined(__CUDA_ARCH__)
    typedef WIDE wide;
    const wide* states = (const wide*)state.data + group_first;
    const float4* lengths = (const float4*)entry_length.data;
    const int2* others = (const int2*)entry.data;
    #pragma unroll 4
    for (int e = begin; e < end; ++e) {
        const float4 length = __ldg(lengths + e);
        const int2 other = __ldg(others + e);
        const wide* place = states + 192 * other.x;
        wide found[6];
        #pragma unroll
        for (int k = 0; k < 6; ++k) found[k] = __ldg(place + 32 * k);
        #pragma unroll
        for (int i = 0; i < COUNT; ++i) {
            const float dx = ((const float*)&found[0])[i] - x.data[i][0];
            const float dy = ((const float*)&found[1])[i] - x.data[i][1];
            const float dz = ((const float*)&found[2])[i] - x.data[i][2];
            const float ux = ((const float*)&found[3])[i] - v.data[i][0];
            const float uy = ((const float*)&found[4])[i] - v.data[i][1];
            const float uz = ((const float*)&found[5])[i] - v.data[i][2];
            const float squared = fmaf(dx, dx, fmaf(dy, dy, fmaf(dz, dz, 1.0e-20f)));
            const float inverse = rsqrtf(squared);
            float now = squared * inverse;
            now = fmaf(0.5f * inverse, fmaf(-now, now, squared), now);
            const float rate = inverse * fmaf(ux, dx, fmaf(uy, dy, uz * dz));
            const float strain = (now - length.y) * length.z;
            const float tension = fmaf(material.data[i][0], strain, material.data[i][1] * rate);
            const bool exists = length.x < material.data[i][2] && other.y < material.data[i][3];
            const float scale = exists ? tension * inverse : 0.0f;
            force.data[i][0] = fmaf(scale, dx, force.data[i][0]);
            force.data[i][1] = fmaf(scale, dy, force.data[i][1]);
            force.data[i][2] = fmaf(scale, dz, force.data[i][2]);
        }
    }
#endif
    return force;
"""


def make_batch_kernel(count: int) -> wp.Kernel:
    """Make the kernel of one substep.

    Args:
        count: Candidates of each thread: 1 or 2.
    """
    vectors = wp.types.matrix(shape=(count, 3), dtype=wp.float32)
    materials = wp.types.matrix(shape=(count, 4), dtype=wp.float32)
    wide = {1: "float", 2: "float2"}[count]
    snippet = _SUM_SPRINGS.replace("WIDE", wide).replace("COUNT", str(count))

    @wp.func_native(snippet=snippet)
    def sum_springs(
        state: wp.array[float],
        group_first: int,
        entry: wp.array[wp.vec2i],
        entry_length: wp.array[wp.vec4],
        begin: int,
        end: int,
        x: vectors,
        v: vectors,
        material: materials,
        force: vectors,
    ) -> vectors:
        """Sum the object springs of one node for several candidates."""

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=256)
    def advance_batch(
        groups: int,
        fraction: float,
        # Model:
        number: wp.array2d[float],
        reach: wp.array2d[float],
        entry_start: wp.array[int],
        entry_end: wp.array2d[int],
        entry: wp.array[wp.vec2i],
        entry_length: wp.array[wp.vec4],
        held_start: wp.array[int],
        held: wp.array[wp.vec2i],
        held_length: wp.array[wp.vec4],
        # State in:
        control_start: wp.array[wp.vec3],
        control_end: wp.array[wp.vec3],
        state: wp.array[float],
        # State out:
        state_out: wp.array[float],
        diverged_out: wp.array[int],
    ):
        """Advance each node for each group of candidates (a warp a node and group)."""
        thread = wp.tid()
        lane = thread % 32
        nodes = held_start.shape[0] - 1
        node = (thread // 32) % nodes
        group = thread // (32 * nodes)
        if group >= groups:
            return
        candidate = wp.static(count) * (32 * group + lane)
        base = wp.static(count) * (192 * (group * nodes + node) + lane)
        x = vectors()
        v = vectors()
        material = materials()
        force = vectors()
        for i in range(wp.static(count)):
            for k in range(3):
                x[i, k] = state[base + i + wp.static(32 * count) * k]
                v[i, k] = state[base + i + wp.static(32 * count) * (3 + k)]
            material[i, 0] = number[wp.static(FIELDS.index("stiffness")), candidate + i]
            material[i, 1] = number[wp.static(FIELDS.index("damping")), candidate + i]
            material[i, 2] = number[wp.static(FIELDS.index("connection_radius")), candidate + i]
            material[i, 3] = number[wp.static(FIELDS.index("max_neighbors")), candidate + i]
        force = sum_springs(
            state,
            192 * group * nodes + lane,
            entry,
            entry_length,
            entry_start[node],
            entry_end[group, node],
            x,
            v,
            material,
            force,
        )
        for i in range(wp.static(count)):
            here = candidate_world(number, candidate + i)
            own_position = wp.vec3(x[i, 0], x[i, 1], x[i, 2])
            own_velocity = wp.vec3(v[i, 0], v[i, 1], v[i, 2])
            total = wp.vec3(force[i, 0], force[i, 1], force[i, 2])
            radius = number[wp.static(FIELDS.index("virtual_connection_radius")), candidate + i]
            most = number[wp.static(FIELDS.index("virtual_max_neighbors")), candidate + i]
            for e in range(held_start[node], held_start[node + 1]):
                length = held_length[e]
                # The nearest control comes first, so no later one is in reach either.
                if length[0] >= reach[1, group]:
                    break
                control = held[e]
                if length[0] < radius and float(control[1]) < most:
                    at = control_position(control[0], fraction, control_start, control_end)
                    speed = control_velocity(
                        control[0], here.control_rate, control_start, control_end
                    )
                    total += pull(
                        at - own_position,
                        speed - own_velocity,
                        length[1],
                        number[wp.static(FIELDS.index("virtual_stiffness")), candidate + i]
                        * length[2],
                        number[wp.static(FIELDS.index("virtual_damping")), candidate + i],
                    )
            motion = advance(here, own_position, free_velocity(here, own_velocity, total))
            for k in range(3):
                state_out[base + i + wp.static(32 * count) * k] = motion.position[k]
                state_out[base + i + wp.static(32 * count) * (3 + k)] = motion.velocity[k]
            if is_too_fast(here, motion.velocity):
                diverged_out[candidate + i] = 1

    return advance_batch


@wp.func
def place_of(candidate: int, node: int, nodes: int, width: int):
    """Return where a candidate's x of a node is; y, z and the velocity follow `width` apart."""
    return width * 6 * (candidate // width * nodes + node) + candidate % width


@wp.kernel
def place_batch(
    width: int,
    # Model:
    model_node: wp.array[int],
    # State in:
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    # State out:
    state_out: wp.array[float],
):
    """Give all candidates the same state (one thread per candidate and node)."""
    node, candidate = wp.tid()
    base = place_of(candidate, node, model_node.shape[0], width)
    x = position[model_node[node]]
    v = velocity[model_node[node]]
    for k in range(3):
        state_out[base + width * k] = x[k]
        state_out[base + width * (3 + k)] = v[k]


@wp.kernel
def take_batch(
    width: int,
    # Model:
    model_node: wp.array[int],
    # State in:
    state: wp.array[float],
    # State out:
    position_out: wp.array2d[wp.vec3],
):
    """Copy every candidate's positions out, in the model's order of nodes."""
    node, candidate = wp.tid()
    base = place_of(candidate, node, model_node.shape[0], width)
    position_out[candidate, model_node[node]] = wp.vec3(
        state[base], state[base + width], state[base + 2 * width]
    )


@wp.kernel
def note_divergence(
    frame: int,
    # State in:
    diverged: wp.array[int],
    # State out:
    first_frame_out: wp.array[int],
):
    """Keep the first frame in which each candidate diverged (one thread a candidate)."""
    candidate = wp.tid()
    if diverged[candidate] == 1 and first_frame_out[candidate] < 0:
        first_frame_out[candidate] = frame
