"""One launch a frame for a few candidates of a large object, several of them in each block.

A group of `GROUP_WIDTH` candidates has blocks of its own, each with a compact part of the nodes.
The states of these nodes and of their halo stay in shared memory for a whole frame, and so do the
group's half-edges, which its candidates share. As in `cuda_frame`, blocks wait for each other's
values. Here some threads only carry the halo of the next substep while the others sum springs, and
nodes that other blocks need come first, so that their values travel meanwhile.

What bounds this kernel is reading neighbors from shared memory. Candidates of a node lie side by
side, 16 bytes for each of the six numbers, so that `PHASE` neighbors are read at once if they lie
in different banks; `arrange_entries` orders the half-edges of nodes such that most do.
"""

import warp as wp

from physhandi.simulation.kernels.batch.substep import CANDIDATE_FIELDS
from physhandi.simulation.kernels.contacts import advance
from physhandi.simulation.kernels.cuda_frame import control_position, control_velocity, pull
from physhandi.simulation.kernels.integration import free_velocity, is_too_fast
from physhandi.simulation.kernels.intrinsics import block_barrier, publish
from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

GROUP_WIDTH = 4
"""Candidates of a group; each thread has two of them."""
TILE = 16
"""Nodes that a warp sums at once."""
PHASE = 8
"""Neighbors that shared memory delivers at once if their places differ modulo this number."""
SUMMING, CARRYING = 384, 128
"""Threads of a block that sum springs, and that carry the halo."""
CARRIED, TOGETHER = 12, 4
"""States of a candidate and node that a thread carries in a substep at most, and at once."""
MOST_HALO = CARRYING * CARRIED // GROUP_WIDTH
"""Most nodes in the halo of a block."""
MOST_TILES = 64
"""Most tiles of a block."""
BYTES_OF_A_LOCAL = 2 * 6 * 4 * GROUP_WIDTH + 8
"""Shared memory of a node: position and velocity, twice, its number and its clearance."""
BYTES_OF_AN_ENTRY = 8
NUMBERS = GROUP_WIDTH * len(CANDIDATE_FIELDS)
"""Numbers of a group's candidates."""
BYTES_OF_A_BLOCK = 8 * MOST_TILES + 4 * NUMBERS
"""Shared memory for tiles and candidates."""
_EVERY = (1 << GROUP_WIDTH) - 1

# Dynamic shared memory. Registers are short, and what is left of the first-level cache is small, so
# whatever a substep needs is here.
_SHARED = """
    extern __shared__ float4 large_slots[];
    float* const states = (float*)large_slots;  // [2][6][node][candidate]
    float* const numbers = states + 12 * STRIDE;  // [field][candidate]
    float* const clearances = numbers + NUMBERS;
    int* const nodes = (int*)clearances + STRIDE / GROUP_WIDTH;  // twice the number, 1 more if held
    int2* const tiles = (int2*)(nodes + STRIDE / GROUP_WIDTH);  // first half-edge, ends
    int2* const entries = tiles + MOST_TILES;
"""
_KEEP_NUMBER = """
#if defined(__CUDA_ARCH__)
    SHARED
    numbers[place] = value;
#endif
"""
_KEPT_NUMBERS = """
    wp::vec_t<2, wp::float32> value;
#if defined(__CUDA_ARCH__)
    SHARED
    const float2 two = *(const float2*)(numbers + place);
    value[0] = two.x;
    value[1] = two.y;
#endif
    return value;
"""
_KEEP_NODE = """
#if defined(__CUDA_ARCH__)
    SHARED
    nodes[local] = 2 * node + is_held;
    clearances[local] = clearance;
#endif
"""
_KEPT_NODE = """
#if defined(__CUDA_ARCH__)
    SHARED
    return nodes[local];
#else
    return 0;
#endif
"""
_KEPT_CLEARANCE = """
#if defined(__CUDA_ARCH__)
    SHARED
    return clearances[local];
#else
    return 0.0f;
#endif
"""
_KEEP_ENTRY = """
#if defined(__CUDA_ARCH__)
    SHARED
    entries[place] = make_int2(value[0], value[1]);
#endif
"""
_KEEP_TILE = """
#if defined(__CUDA_ARCH__)
    SHARED
    tiles[tile] = make_int2(first, certain | (end << 16));
#endif
"""
_KEEP = """
#if defined(__CUDA_ARCH__)
    SHARED
    states[(6 * parity + number) * STRIDE + place] = value;
#endif
"""
_KEPT = """
#if defined(__CUDA_ARCH__)
    SHARED
    return states[(6 * parity + number) * STRIDE + place];
#else
    return 0.0f;
#endif
"""
_KEEP_PAIR = """
#if defined(__CUDA_ARCH__)
    SHARED
    #pragma unroll
    for (int k = 0; k < 6; ++k)
        *(float2*)(states + (6 * parity + k) * STRIDE + place) =
            make_float2(value.data[k][0], value.data[k][1]);
#endif
"""
_KEPT_PAIR = """
    wp::mat_t<6, 2, wp::float32> value;
#if defined(__CUDA_ARCH__)
    SHARED
    #pragma unroll
    for (int k = 0; k < 6; ++k) {
        const float2 two = *(const float2*)(states + (6 * parity + k) * STRIDE + place);
        value.data[k][0] = two.x;
        value.data[k][1] = two.y;
    }
#endif
    return value;
"""
# What follows is `cuda_frame.pull` summed over a node's springs, for half-edges that say where the
# other end lies in shared memory, which candidates lack them, and one over the rest length.
_SUM_SPRINGS = """
    wp::mat_t<3, 2, wp::float32> force;
#if defined(__CUDA_ARCH__)
    SHARED
    const char* const now = (const char*)(states + 6 * parity * STRIDE + 2 * pair);
    const int2 tile_of = tiles[tile];
    const int certain = tile_of.y & 0xffff, end = tile_of.y >> 16;
    const int2* half_edge = entries + tile_of.x + row;
    const auto pull = [&](const int2 found, const bool is_certain) {
        const char* const other = now + (is_certain ? found.x : (found.x & 0xffff));
        const float inverse_rest = __int_as_float(found.y);
        float2 there[6];
        #pragma unroll
        for (int k = 0; k < 6; ++k) there[k] = *(const float2*)(other + 4 * k * STRIDE);
        #pragma unroll
        for (int i = 0; i < 2; ++i) {
            const float dx = ((const float*)&there[0])[i] - own.data[0][i];
            const float dy = ((const float*)&there[1])[i] - own.data[1][i];
            const float dz = ((const float*)&there[2])[i] - own.data[2][i];
            const float ux = ((const float*)&there[3])[i] - own.data[3][i];
            const float uy = ((const float*)&there[4])[i] - own.data[4][i];
            const float uz = ((const float*)&there[5])[i] - own.data[5][i];
            const float squared = fmaf(dx, dx, fmaf(dy, dy, fmaf(dz, dz, 1.0e-20f)));
            float inverse;
            asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(squared));
            float length = squared * inverse;
            length = fmaf(0.5f * inverse, fmaf(-length, length, squared), length);
            const float rate = inverse * fmaf(ux, dx, fmaf(uy, dy, uz * dz));
            const float strain = fmaf(length, inverse_rest, -1.0f);
            float scale = inverse * fmaf(stiffness[i], strain, damping[i] * rate);
            if (!is_certain) scale = (found.x >> (16 + 2 * pair + i)) & 1 ? 0.0f : scale;
            force.data[0][i] = fmaf(scale, dx, force.data[0][i]);
            force.data[1][i] = fmaf(scale, dy, force.data[1][i]);
            force.data[2][i] = fmaf(scale, dz, force.data[2][i]);
        }
    };
    int column = 0;
    #pragma unroll 4
    for (; column < certain; ++column, half_edge += TILE) pull(*half_edge, true);
    #pragma unroll 2
    for (; column < end; ++column, half_edge += TILE) pull(*half_edge, false);
#endif
    return force;
"""
# One thread of a warp looks whether values have come before all ask for theirs: requests of
# thousands of threads that wait would hold up the values themselves.
_CARRY_HALO = """
#if defined(__CUDA_ARCH__)
    SHARED
    // Candidates were published in the order 0, 2, 1, 3: first the first of each thread.
    const int turn = thread % GROUP_WIDTH;
    const int to = GROUP_WIDTH * (own + thread / GROUP_WIDTH) + turn % 2 * 2 + turn / 2;
    int from[CARRIED], count = 0;
    #pragma unroll
    for (int u = 0; u < CARRIED; ++u) {
        const int item = thread + CARRYING * u;
        from[u] = 0;
        if (item < GROUP_WIDTH * halo) {
            from[u] = 2 * GROUP_WIDTH * (first_relay + nodes[own + item / GROUP_WIDTH] / 2) + turn;
            count = u + 1;
        }
    }
    const auto look = [](const float4* place, unsigned long long* low, unsigned long long* high) {
        asm volatile("{ .reg .b128 t; ld.relaxed.gpu.global.b128 t, [%2]; mov.b128 {%0, %1}, t; }"
            : "=l"(*low), "=l"(*high) : "l"(place) : "memory");
    };
    for (int substep = 1; substep < substeps; ++substep) {
        const unsigned int wanted = tag + substep;
        const float4* const relay = (const float4*)values.data + (substep % 2) * half_relay;
        float* const later = states + 6 * (substep % 2) * STRIDE;
        bool waits;
        do {
            waits = false;
            if (thread % 32 == 0 && count > 0) {
                unsigned long long low, high;
                look(relay + from[0] + GROUP_WIDTH, &low, &high);
                waits = (unsigned int)(high >> 32) != wanted;
                if (waits) __nanosleep(40);
            }
        } while (__any_sync(0xffffffffu, waits));
        // More at once would not fit the registers.
        #pragma unroll
        for (int begin = 0; begin < CARRIED; begin += TOGETHER) {
            unsigned long long word[TOGETHER][4];
            do {
                waits = false;
                #pragma unroll
                for (int u = 0; u < TOGETHER; ++u) if (begin + u < count) {
                    look(relay + from[begin + u], &word[u][0], &word[u][1]);
                    look(relay + from[begin + u] + GROUP_WIDTH, &word[u][2], &word[u][3]);
                }
                #pragma unroll
                for (int u = 0; u < TOGETHER; ++u)
                    waits |= begin + u < count && ((unsigned int)(word[u][1] >> 32) != wanted
                        || (unsigned int)(word[u][3] >> 32) != wanted);
            } while (waits);
            #pragma unroll
            for (int u = 0; u < TOGETHER; ++u) if (begin + u < count) {
                float* const place = later + to + CARRYING * (begin + u);
                place[0] = __uint_as_float((unsigned int)word[u][0]);
                place[STRIDE] = __uint_as_float((unsigned int)(word[u][0] >> 32));
                place[2 * STRIDE] = __uint_as_float((unsigned int)word[u][1]);
                place[3 * STRIDE] = __uint_as_float((unsigned int)word[u][2]);
                place[4 * STRIDE] = __uint_as_float((unsigned int)(word[u][2] >> 32));
                place[5 * STRIDE] = __uint_as_float((unsigned int)word[u][3]);
            }
        }
        __syncthreads();
    }
    __syncthreads();
#endif
"""
_PAIR = wp.types.matrix(shape=(6, 2), dtype=wp.float32)
"""Position and velocity of a node for two candidates."""
_FORCES = wp.types.matrix(shape=(3, 2), dtype=wp.float32)
"""Force on a node for two candidates [N]."""


@wp.kernel
def arrange_entries(
    # Half-edges by row, then certain ones first, then by place modulo `PHASE`:
    entry: wp.array[wp.vec2i],
    first: wp.array[int],
    tile_first: wp.array[int],
    tile_end: wp.array[int],
    padding: wp.array[int],
    # Out:
    left_out: wp.array[int],
    arranged_out: wp.array[wp.vec2i],
):
    """Order the half-edges of `PHASE` rows so that few of a column lie in the same banks.

    One thread a group of rows. Row by row it takes a half-edge from banks that no other row of
    this column reads, as long as there is one, and from where the row has most left.
    """
    group = wp.tid()
    tile = group // wp.static(TILE // PHASE)
    phase, kinds = int(PHASE), int(2)  # Not constants: the loops would be unrolled 16 times.
    for column in range(tile_end[tile]):
        used = int(0)
        for turn in range(phase):
            place = (turn + column) % wp.static(PHASE)
            row = group * wp.static(PHASE) + place
            best = int(-1)
            most = int(0)
            for kind in range(kinds):
                if best < 0:
                    for bank in range(wp.static(PHASE)):
                        here = (2 * row + kind) * wp.static(PHASE) + bank
                        count = left_out[here]
                        if count > 0 and (used >> bank) % 2 == 0:
                            count += 10000
                        if count > most:
                            most = count
                            best = here
            slot = tile_first[tile] + wp.static(TILE) * column + row % wp.static(TILE)
            if best < 0:
                arranged_out[slot] = wp.vec2i(padding[row], 0)
            else:
                left_out[best] -= 1
                arranged_out[slot] = entry[first[best] + left_out[best]]
                used = used | (1 << (best % wp.static(PHASE)))


def make_batch_frame_kernel(locals_: int, entries: int) -> wp.Kernel:
    """Make the kernel that advances one frame.

    Args:
        locals_: Nodes, its own and its halo, that a block has room for.
        entries: Half-edges that it has room for, padding included.
    """
    stride = GROUP_WIDTH * locals_
    room = (BYTES_OF_A_LOCAL * locals_ + BYTES_OF_A_BLOCK + BYTES_OF_AN_ENTRY * entries) // 4

    def native(snippet: str) -> str:
        snippet = snippet.replace("SHARED\n", _SHARED.strip() + "\n").replace(
            "MOST_TILES", str(MOST_TILES)
        )
        for name, value in (
            ("STRIDE", stride),
            ("TILE", TILE),
            ("GROUP_WIDTH", GROUP_WIDTH),
            ("CARRIED", CARRIED),
            ("TOGETHER", TOGETHER),
            ("NUMBERS", NUMBERS),
            ("CARRYING", CARRYING),
        ):
            snippet = snippet.replace(name, str(value))
        return snippet

    @wp.func_native(snippet=native(_KEEP_ENTRY))
    def keep_entry(place: int, value: wp.vec2i):
        """Write a half-edge to shared memory."""

    @wp.func_native(snippet=native(_KEEP_TILE))
    def keep_tile(tile: int, first: int, certain: int, end: int):
        """Write to shared memory where a tile's half-edges are, and how many columns they have."""

    @wp.func_native(snippet=native(_KEEP))
    def keep(parity: int, number: int, place: int, value: float):
        """Write a coordinate of a node and candidate to shared memory."""

    @wp.func_native(snippet=native(_KEPT))
    def kept_value(parity: int, number: int, place: int) -> float:
        """Read a coordinate of a node and candidate from shared memory."""

    @wp.func_native(snippet=native(_KEEP_PAIR))
    def keep_pair(parity: int, place: int, value: _PAIR):
        """Write the state of a node for two candidates to shared memory."""

    @wp.func_native(snippet=native(_KEPT_PAIR))
    def kept_pair(parity: int, place: int) -> _PAIR:
        """Read the state of a node for two candidates from shared memory."""

    @wp.func_native(snippet=native(_SUM_SPRINGS))
    def sum_springs(
        parity: int,
        tile: int,
        row: int,
        pair: int,
        own: _PAIR,
        stiffness: wp.vec2,
        damping: wp.vec2,
    ) -> _FORCES:
        """Sum the object springs of one node for two candidates."""

    @wp.func_native(snippet=native(_CARRY_HALO))
    def carry_halo(
        thread: int,
        own: int,
        halo: int,
        first_relay: int,
        half_relay: int,
        substeps: int,
        tag: int,
        values: wp.array[wp.vec4],
    ):
        """Bring the halo of every substep but the first; each ends at the block's barrier."""

    @wp.func_native(snippet=native(_KEEP_NUMBER))
    def keep_number(place: int, value: float):
        """Write a number of a candidate to shared memory."""

    @wp.func_native(snippet=native(_KEPT_NUMBERS))
    def kept_numbers(place: int) -> wp.vec2:
        """Read a number of two candidates from shared memory."""

    @wp.func_native(snippet=native(_KEEP_NODE))
    def keep_node(local: int, node: int, is_held: int, clearance: float):
        """Write to shared memory which node this is, and whether virtual springs hold it."""

    @wp.func_native(snippet=native(_KEPT_NODE))
    def kept_node(local: int) -> int:
        """Read twice a node's number, and one more if virtual springs hold it."""

    @wp.func_native(snippet=native(_KEPT_CLEARANCE))
    def kept_clearance(local: int) -> float:
        """Read a node's clearance."""

    @wp.func
    def add_held(
        node: int,
        pair: int,
        fraction: float,
        reach: float,
        here: _PAIR,
        force: _FORCES,
        held_start: wp.array[int],
        held_length: wp.array[wp.vec4],
        held_rank: wp.array[int],
        control_start: wp.array[wp.vec3],
        control_end: wp.array[wp.vec3],
    ) -> _FORCES:
        """Add the virtual springs of one node for two candidates."""
        near = kept_numbers(wp.static(_row("virtual_connection_radius")) + 2 * pair)
        limit = kept_numbers(wp.static(_row("virtual_max_neighbors")) + 2 * pair)
        stiffness = kept_numbers(wp.static(_row("virtual_stiffness")) + 2 * pair)
        damping = kept_numbers(wp.static(_row("virtual_damping")) + 2 * pair)
        rate = kept_numbers(wp.static(_row("control_rate")) + 2 * pair)
        for e in range(held_start[node], held_start[node + 1]):
            length = held_length[e]
            # The nearest control comes first, so no later one is in reach either.
            if length[0] >= reach:
                break
            control = wp.cast(length[3], wp.int32)
            rank = float(held_rank[e])
            end = control_position(control, fraction, control_start, control_end)
            for c in range(2):
                if length[0] < near[c] and rank < limit[c]:
                    speed = control_velocity(control, rate[c], control_start, control_end)
                    tension = pull(
                        end - wp.vec3(here[0, c], here[1, c], here[2, c]),
                        speed - wp.vec3(here[3, c], here[4, c], here[5, c]),
                        length[1],
                        stiffness[c] * length[2],
                        damping[c],
                    )
                    for k in range(3):
                        force[k, c] = force[k, c] + tension[k]
        return force

    @wp.func
    def moved(
        clearance: float,
        pair: int,
        here: _PAIR,
        force: _FORCES,
        candidate: int,
        diverged_out: wp.array[int],
    ) -> _PAIR:
        """Move one node by a substep for two candidates; `candidate` is the first of them."""
        dt = kept_numbers(wp.static(_row("dt")) + 2 * pair)
        loss = kept_numbers(wp.static(_row("velocity_loss")) + 2 * pair)
        gravity = kept_numbers(wp.static(_row("gravity")) + 2 * pair)
        height = kept_numbers(wp.static(_row("ground_height")) + 2 * pair)
        restitution = kept_numbers(wp.static(_row("restitution")) + 2 * pair)
        friction = kept_numbers(wp.static(_row("friction")) + 2 * pair)
        fastest = kept_numbers(wp.static(_row("speed_limit")) + 2 * pair)
        for c in range(2):
            world = World()
            world.dt = dt[c]
            world.velocity_loss = loss[c]
            world.gravity = gravity[c]
            world.has_ground = 1
            world.ground_height = height[c]
            world.restitution = restitution[c]
            world.friction = friction[c]
            world.speed_limit = fastest[c]
            total = wp.vec3(force[0, c], force[1, c], force[2, c])
            x = wp.vec3(here[0, c], here[1, c], here[2, c])
            v = wp.vec3(here[3, c], here[4, c], here[5, c])
            motion = advance(world, clearance, x, free_velocity(world, v, total))
            for k in range(3):
                here[k, c] = motion.position[k]
                here[3 + k, c] = motion.velocity[k]
            if is_too_fast(world, motion.velocity):
                diverged_out[candidate + c] = 1
        return here

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=SUMMING + CARRYING)
    def advance_batch_frame(
        substeps: int,
        tag: int,
        nodes: int,
        groups: int,
        # Model:
        clearance: wp.array[float],
        number: wp.array[float],
        reach: wp.array2d[float],
        group_of: wp.array[int],
        own_count: wp.array[int],
        border_count: wp.array[int],
        local_start: wp.array[int],
        local_node: wp.array[int],
        tile_start: wp.array[int],
        tile_first: wp.array[int],
        tile_certain: wp.array[int],
        tile_end: wp.array[int],
        entry: wp.array[wp.vec2i],
        held_start: wp.array[int],
        held_length: wp.array[wp.vec4],
        held_rank: wp.array[int],
        # State in:
        control_start: wp.array[wp.vec3],
        control_end: wp.array[wp.vec3],
        state: wp.array[float],
        # State out:
        relay_out: wp.array[wp.vec4],
        state_out: wp.array[float],
        diverged_out: wp.array[int],
    ):
        """Advance each block's nodes through all substeps of a frame."""
        # The only tile: Warp launches with as much dynamic shared memory as it needs.
        tile_memory = wp.tile_empty(shape=wp.static(room), dtype=wp.float32, storage="shared")  # noqa: F841

        thread = wp.tid()
        block = thread // wp.static(SUMMING + CARRYING)
        place = thread - block * wp.static(SUMMING + CARRYING)
        group = group_of[block]
        own = own_count[block]
        border = border_count[block]
        first_local = local_start[block]
        local_count = local_start[block + 1] - first_local
        first_tile = tile_start[block]
        tiles = tile_start[block + 1] - first_tile
        first_entry = tile_first[first_tile]
        entries_here = tile_first[first_tile + tiles] - first_entry

        for i in range(place, entries_here, wp.static(SUMMING + CARRYING)):
            keep_entry(i, entry[first_entry + i])
        for i in range(place, tiles, wp.static(SUMMING + CARRYING)):
            keep_tile(
                i,
                tile_first[first_tile + i] - first_entry,
                tile_certain[first_tile + i],
                tile_end[first_tile + i],
            )
        for i in range(place, local_count, wp.static(SUMMING + CARRYING)):
            node = local_node[first_local + i]
            is_held = int(0)
            if held_start[node] < held_start[node + 1]:
                is_held = 1
            keep_node(i, node, is_held, clearance[node])
        if place < wp.static(NUMBERS):
            keep_number(
                place, number[wp.static(GROUP_WIDTH * len(CANDIDATE_FIELDS)) * group + place]
            )
        block_barrier()
        for i in range(place, wp.static(GROUP_WIDTH) * local_count, wp.static(SUMMING + CARRYING)):
            node = kept_node(i // wp.static(GROUP_WIDTH)) // 2
            at = wp.static(6 * GROUP_WIDTH) * (group * nodes + node) + i % wp.static(GROUP_WIDTH)
            for k in range(6):
                keep(0, k, i, state[at + wp.static(GROUP_WIDTH) * k])
        block_barrier()

        half_relay = wp.static(2 * GROUP_WIDTH) * groups * nodes
        if place >= wp.static(SUMMING):
            carry_halo(
                place - wp.static(SUMMING),
                own,
                local_count - own,
                group * nodes,
                half_relay,
                substeps,
                tag,
                relay_out,
            )
        else:
            lane = place % 32
            pair = lane % 2
            row = lane // 2
            stiffness = kept_numbers(wp.static(_row("stiffness")) + 2 * pair)
            damping = kept_numbers(wp.static(_row("damping")) + 2 * pair)
            for substep in range(substeps):
                parity = substep % 2
                fraction = float(substep + 1) / float(substeps)
                for tile in range(place // 32, tiles, wp.static(SUMMING // 32)):
                    i = wp.static(TILE) * tile + row
                    local = wp.min(i, own - 1)
                    slot = wp.static(GROUP_WIDTH) * local + 2 * pair
                    here = kept_pair(parity, slot)
                    force = sum_springs(parity, tile, row, pair, here, stiffness, damping)
                    if i < own:
                        place_of_node = kept_node(i)
                        node = place_of_node // 2
                        if place_of_node % 2 == 1:
                            force = add_held(
                                node,
                                pair,
                                fraction,
                                reach[1, group],
                                here,
                                force,
                                held_start,
                                held_length,
                                held_rank,
                                control_start,
                                control_end,
                            )
                        first = wp.static(GROUP_WIDTH) * group + 2 * pair
                        here = moved(kept_clearance(i), pair, here, force, first, diverged_out)
                        if i < border:
                            relay = (1 - parity) * half_relay + pair
                            relay += wp.static(2 * GROUP_WIDTH) * (group * nodes + node)
                            beside = relay + wp.static(GROUP_WIDTH)
                            next_tag = tag + substep + 1
                            for c in range(2):
                                x = wp.vec3(here[0, c], here[1, c], here[2, c])
                                v = wp.vec3(here[3, c], here[4, c], here[5, c])
                                publish(relay_out, relay + 2 * c, x, next_tag)
                                publish(relay_out, beside + 2 * c, v, next_tag)
                        keep_pair(1 - parity, slot, here)
                block_barrier()

        for i in range(place, wp.static(GROUP_WIDTH) * own, wp.static(SUMMING + CARRYING)):
            node = kept_node(i // wp.static(GROUP_WIDTH)) // 2
            at = wp.static(6 * GROUP_WIDTH) * (group * nodes + node) + i % wp.static(GROUP_WIDTH)
            for k in range(6):
                state_out[at + wp.static(GROUP_WIDTH) * k] = kept_value(substeps % 2, k, i)

    return advance_batch_frame


def _row(name: str) -> int:
    """Return where the numbers of a group's candidates of this name begin."""
    return GROUP_WIDTH * CANDIDATE_FIELDS.index(name)
