"""One substep of many candidates at once: neighbouring threads are candidates, not nodes.

All candidates of a warp look at the same spring at the same time, so its data is read once and
their states lie side by side. What a candidate does not have of the master topology counts
nothing. State is laid out as [group][node][x y z vx vy vz][candidate of the group].
"""

import warp as wp

from physhandi.simulation.kernels.contacts import advance, touches_ground
from physhandi.simulation.kernels.cuda_frame import control_position, control_velocity, pull
from physhandi.simulation.kernels.integration import free_velocity, is_too_fast
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

CANDIDATE_FIELDS = (
    "dt",
    "velocity_loss",
    "gravity",
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
NO_GROUND = -1.0e6
"""Height of the ground of a candidate that has none [m]."""
BLOCK_NODES = 16
"""Nodes of a block of threads where a warp has a node of its own."""


# What follows is `cuda_frame.pull` summed over a node's springs, for several candidates a thread.
# Wide loads at fixed offsets, which Warp's strided arrays do not give, make it 2.5 times as fast.
# Springs that all candidates of the group have come first and need no question. Instructions bound
# this kernel, so the root is not refined: its error is at most 1.3e-7 of the length, while rounding
# one coordinate of 0.2 m is 7e-7 of a length of 10 mm.
_SUM_SPRINGS = """
#if defined(__CUDA_ARCH__)
    typedef WIDE wide;
    const char* const states = (const char*)((const wide*)state.data + group_first);
    const uint2* const half_edges = (const uint2*)entry.data;
    const float2* const limits = (const float2*)entry_limit.data;
    // Numbers of the candidates, by rows of `CANDIDATE_FIELDS`.
    const auto number_of = [&](const int row) {
        return __ldg((const wide*)number.data + numbers + 32 * row);
    };
    const wide stiffness = number_of(STIFFNESS), damping = number_of(STIFFNESS + 1);
    const auto pull = [&](const uint2 half_edge, const int limited) {
        const wide* const place = (const wide*)(states + half_edge.x);
        const float inverse_rest = __uint_as_float(half_edge.y);
        wide found[6];
        #pragma unroll
        for (int k = 0; k < 6; ++k) found[k] = __ldg(place + 32 * k);
        #pragma unroll
        for (int i = 0; i < COUNT; ++i) {
            const float dx = ((const float*)&found[0])[i] - x.data[0][i];
            const float dy = ((const float*)&found[1])[i] - x.data[1][i];
            const float dz = ((const float*)&found[2])[i] - x.data[2][i];
            const float ux = ((const float*)&found[3])[i] - v.data[0][i];
            const float uy = ((const float*)&found[4])[i] - v.data[1][i];
            const float uz = ((const float*)&found[5])[i] - v.data[2][i];
            const float squared = fmaf(dx, dx, fmaf(dy, dy, fmaf(dz, dz, 1.0e-20f)));
            float inverse;
            asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(squared));
            const float rate = inverse * fmaf(ux, dx, fmaf(uy, dy, uz * dz));
            const float shortened = ((const float*)&stiffness)[i] * (inverse_rest - inverse);
            float scale = fmaf(((const float*)&damping)[i] * rate, inverse, shortened);
            if (limited >= 0) {
                const float2 limit = __ldg(limits + limited);
                const wide radius = number_of(STIFFNESS + 2), most = number_of(STIFFNESS + 3);
                if (!(limit.x < ((const float*)&radius)[i] && limit.y < ((const float*)&most)[i]))
                    scale = 0.0f;
            }
            force.data[0][i] = fmaf(scale, dx, force.data[0][i]);
            force.data[1][i] = fmaf(scale, dy, force.data[1][i]);
            force.data[2][i] = fmaf(scale, dz, force.data[2][i]);
        }
    };
    int e = begin + part;
    #pragma unroll 4
    for (; e < certain_end; e += PARTS) pull(__ldg(half_edges + e), -1);
    #pragma unroll 1
    for (; e < end; e += PARTS) pull(__ldg(half_edges + e), e);
#endif
    return force;
"""
# Warps that share a node add up what they found, always in the same order.
_ADD_PARTS = """
#if defined(__CUDA_ARCH__)
    __shared__ float found[PARTS][3][COUNT][32];
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < COUNT; ++i) found[part][k][i][lane] = force.data[k][i];
    __syncthreads();
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < COUNT; ++i) {
            float sum = found[0][k][i][lane];
            for (int other = 1; other < PARTS; ++other) sum += found[other][k][i][lane];
            force.data[k][i] = sum;
        }
#endif
    return force;
"""
# Warp's arrays are strided, and reading one number of them takes ten instructions.
_LOAD = """
    FLOATS value;
#if defined(__CUDA_ARCH__)
    const WIDE wide = __ldg((const WIDE*)data.data + first + offset);
    for (int i = 0; i < COUNT; ++i) value[i] = ((const float*)&wide)[i];
#endif
    return value;
"""
_STORE = """
#if defined(__CUDA_ARCH__)
    WIDE wide;
    for (int i = 0; i < COUNT; ++i) ((float*)&wide)[i] = value[i];
    __stcg((WIDE*)data.data + first + offset, wide);  // No thread of this launch reads it.
#endif
"""
# `wp.tid` divides by what a tile has of threads, which is one here.
_THREAD = """
#if defined(__CUDA_ARCH__)
    return (int)((blockIdx.z * gridDim.y + blockIdx.y) * gridDim.x * blockDim.x
        + blockIdx.x * blockDim.x + threadIdx.x);
#else
    return 0;
#endif
"""
_READ = """
#if defined(__CUDA_ARCH__)
    return __ldg(data.data + index);
#else
    return 0;
#endif
"""
_READ_FOUR = """
#if defined(__CUDA_ARCH__)
    const int4 four = __ldg((const int4*)data.data + index);
    return wp::vec4i(four.x, four.y, four.z, four.w);
#else
    return wp::vec4i();
#endif
"""


@wp.func_native(snippet=_THREAD)
def number_of_thread() -> int:
    """Return the number of the thread in the launch."""


@wp.func_native(snippet=_READ)
def int_at(data: wp.array[int], index: int) -> int:
    """Read a number of a contiguous array."""


@wp.func_native(snippet=_READ)
def float_at(data: wp.array[float], index: int) -> float:
    """Read a number of a contiguous array."""


@wp.func_native(snippet=_READ_FOUR)
def four_at(data: wp.array[wp.vec4i], index: int) -> wp.vec4i:
    """Read four numbers of a contiguous array."""


def block_threads(parts: int) -> int:
    """Give the threads of a block whose nodes are shared by so many warps each."""
    return 32 * (BLOCK_NODES if parts == 1 else parts)


def make_batch_kernel(count: int, parts: int) -> wp.Kernel:
    """Make the kernel of one substep.

    Args:
        count: Candidates of each thread: 1 or 2.
        parts: Warps that share the springs of a node: 1, or a whole block of 8, 16 or 32.
    """
    if parts not in {1, 8, 16, 32}:
        raise ValueError(f"{parts} warps cannot share a node.")
    floats = wp.types.vector(length=count, dtype=wp.float32)
    vectors = wp.types.matrix(shape=(3, count), dtype=wp.float32)
    materials = wp.types.matrix(shape=(4, count), dtype=wp.float32)
    wide = {1: "float", 2: "float2"}[count]

    def native(snippet: str) -> str:
        snippet = snippet.replace("FLOATS", f"wp::vec_t<{count}, wp::float32>")
        return (
            snippet.replace("WIDE", wide)
            .replace("COUNT", str(count))
            .replace("PARTS", str(parts))
            .replace("STIFFNESS", str(CANDIDATE_FIELDS.index("stiffness")))
        )

    @wp.func_native(snippet=native(_SUM_SPRINGS))
    def sum_springs(
        state: wp.array[float],
        group_first: int,
        entry: wp.array[wp.vec2i],
        entry_limit: wp.array[wp.vec2],
        begin: int,
        certain_end: int,
        end: int,
        part: int,
        number: wp.array[float],
        numbers: int,
        x: vectors,
        v: vectors,
        force: vectors,
    ) -> vectors:
        """Sum the object springs of one node for several candidates."""

    @wp.func_native(snippet=native(_ADD_PARTS))
    def add_parts(part: int, lane: int, force: vectors) -> vectors:
        """Sum what the warps of a block found."""

    @wp.func_native(snippet=native(_LOAD))
    def load(data: wp.array[float], first: int, offset: int) -> floats:
        """Load the numbers of a thread's candidates, a fixed offset after the first ones."""

    @wp.func_native(snippet=native(_STORE))
    def store(data: wp.array[float], first: int, offset: int, value: floats):
        """Store the numbers of a thread's candidates, a fixed offset after the first ones."""

    # Registers for two blocks of the common size: fewer spill, more leave places empty.
    bounds = (block_threads(parts), 2 if parts == 1 else 1)

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=bounds, grid_stride=False)
    def advance_batch(
        first_group: int,
        places: int,
        fraction: float,
        # Model:
        clearance: wp.array[float],
        number: wp.array[float],
        reach: wp.array2d[float],
        entries_of: wp.array[wp.vec4i],
        entry: wp.array[wp.vec2i],
        entry_limit: wp.array[wp.vec2],
        held_start: wp.array[int],
        held_length: wp.array[wp.vec4],
        held_rank: wp.array[int],
        # State in:
        control_start: wp.array[wp.vec3],
        control_end: wp.array[wp.vec3],
        state: wp.array[float],
        # State out:
        state_out: wp.array[float],
        diverged_out: wp.array[int],
    ):
        """Advance each node for some groups of candidates (`parts` warps a node and group).

        A group has `places` for nodes, of which the last ones may be empty.
        """
        thread = number_of_thread()
        lane = thread & 31
        part = (thread >> 5) & wp.static(parts - 1)
        nodes = held_start.shape[0] - 1
        group = first_group
        node = thread >> wp.static((32 * parts).bit_length() - 1)
        while node >= places:  # A division takes longer, and a launch has few groups.
            node -= places
            group += 1
        if node >= nodes:
            return
        own = 192 * (group * nodes + node) + lane
        numbers = wp.static(32 * len(CANDIDATE_FIELDS)) * group + lane
        x = vectors()
        v = vectors()
        force = vectors()
        for k in range(3):
            x[k] = load(state, own, 32 * k)
            v[k] = load(state, own, 96 + 32 * k)
        entries = four_at(entries_of, group * nodes + node)
        force = sum_springs(
            state,
            192 * group * nodes + lane,
            entry,
            entry_limit,
            entries[0],
            entries[1],
            entries[2],
            part,
            number,
            numbers,
            x,
            v,
            force,
        )
        dt = load(number, numbers, wp.static(_row("dt")))
        velocity_loss = load(number, numbers, wp.static(_row("velocity_loss")))
        gravity = load(number, numbers, wp.static(_row("gravity")))
        ground_height = load(number, numbers, wp.static(_row("ground_height")))
        held = int(0)
        if entries[3] > 0:
            held = int_at(held_start, node)
        for e in range(held + part, held + entries[3], wp.static(parts)):
            length = held_length[e]
            # The nearest control comes first, so no later one is in reach either.
            if length[0] >= reach[1, group]:
                break
            control = wp.cast(length[3], wp.int32)
            rank = held_rank[e]
            at = control_position(control, fraction, control_start, control_end)
            control_rate = load(number, numbers, wp.static(_row("control_rate")))
            tie = materials()
            for k in range(4):
                tie[k] = load(number, numbers, wp.static(_row("virtual_stiffness")) + 32 * k)
            for i in range(wp.static(count)):
                if length[0] < tie[2, i] and float(rank) < tie[3, i]:
                    speed = control_velocity(control, control_rate[i], control_start, control_end)
                    tension = pull(
                        at - wp.vec3(x[0, i], x[1, i], x[2, i]),
                        speed - wp.vec3(v[0, i], v[1, i], v[2, i]),
                        length[1],
                        tie[0, i] * length[2],
                        tie[1, i],
                    )
                    for k in range(3):
                        force[k, i] = force[k, i] + tension[k]
        if wp.static(parts > 1):
            force = add_parts(part, lane, force)
            if part > 0:
                return
        touching = float_at(clearance, node)
        for i in range(wp.static(count)):
            here = World()
            here.dt = dt[i]
            here.velocity_loss = velocity_loss[i]
            here.gravity = gravity[i]
            here.has_ground = 1
            here.ground_height = ground_height[i]
            total = wp.vec3(force[0, i], force[1, i], force[2, i])
            free = free_velocity(here, wp.vec3(v[0, i], v[1, i], v[2, i]), total)
            position = wp.vec3(x[0, i], x[1, i], x[2, i])
            if touches_ground(here, touching, position, free):
                here.restitution = load(number, numbers, wp.static(_row("restitution")))[i]
                here.friction = load(number, numbers, wp.static(_row("friction")))[i]
            here.speed_limit = load(number, numbers, wp.static(_row("speed_limit")))[i]
            motion = advance(here, touching, position, free)
            for k in range(3):
                x[k, i] = motion.position[k]
                v[k, i] = motion.velocity[k]
            if is_too_fast(here, motion.velocity):
                diverged_out[wp.static(count) * (32 * group + lane) + i] = 1
        for k in range(3):
            store(state_out, own, 32 * k, x[k])
            store(state_out, own, 96 + 32 * k, v[k])

    return advance_batch


def _row(name: str) -> int:
    """Return where the candidates' numbers of this name begin, 32 threads a row."""
    return 32 * CANDIDATE_FIELDS.index(name)


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


@wp.kernel
def hold_springs(
    step: int,
    # Model:
    interval: wp.array[wp.vec2i],
    stiffness: wp.array[float],
    damping: wp.array[float],
    # Out:
    stiffness_out: wp.array[float],
    damping_out: wp.array[float],
):
    """Let the virtual springs act that are attached in a frame (one thread a spring)."""
    spring = wp.tid()
    acts = float(0.0)
    if interval[spring][0] < step <= interval[spring][1]:
        acts = 1.0
    stiffness_out[spring] = acts * stiffness[spring]
    damping_out[spring] = acts * damping[spring]


@wp.kernel
def interleave_states(
    # State in:
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    # State out:
    state_out: wp.array[float],
):
    """Lay the states of bodies side by side as `place_of` finds them in groups of one."""
    node = wp.tid()
    for k in range(3):
        state_out[6 * node + k] = position[node][k]
        state_out[6 * node + 3 + k] = velocity[node][k]


@wp.kernel
def note_first_divergence(
    frame: int,
    never: int,
    # State in:
    first_divergence: wp.array[int],
    # State out:
    first_frame_out: wp.array[int],
):
    """Keep the first frame in which each body diverged (one thread a body)."""
    body = wp.tid()
    if first_divergence[body] != never and first_frame_out[body] < 0:
        first_frame_out[body] = frame
