"""How stiff and how damped the stiffest direction of each node is, for each candidate of a search.

A node's block of the stiffness matrix sums k d dᵀ over the unit directions d of its springs.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

OBJECT, VIRTUAL = 0, 1
RADIUS, MOST, FLOOR, STIFFNESS, DAMPING = 0, 1, 2, 3, 4


@wp.func
def largest_eigenvalue(matrix: wp.mat33d) -> wp.float64:
    """Largest eigenvalue of a symmetric matrix, in closed form.

    Smith, Eigenvalues of a symmetric 3 x 3 matrix, Communications of the ACM 4, 1961.
    """
    mean = wp.trace(matrix) / wp.float64(3.0)
    rest = matrix - mean * wp.identity(n=3, dtype=wp.float64)
    spread = wp.sqrt(wp.ddot(rest, rest) / wp.float64(6.0))
    if spread <= wp.float64(0.0):
        return mean
    half = wp.determinant(rest / spread) / wp.float64(2.0)
    angle = wp.acos(wp.clamp(half, wp.float64(-1.0), wp.float64(1.0))) / wp.float64(3.0)
    return mean + wp.float64(2.0) * spread * wp.cos(angle)


@wp.kernel
def find_loads(
    start: wp.array[wp.int32],
    spring: wp.array[wp.int32],
    object_springs: int,
    direction: wp.array[wp.vec3d],
    length: wp.array[wp.float64],
    rank: wp.array[wp.int32],
    limits: wp.array3d[wp.float64],
    stiffness_out: wp.array2d[wp.float64],
    damping_out: wp.array2d[wp.float64],
) -> None:
    """Bound a node's share of the stiffness [N/m] and the damping [N·s/m] of any mode.

    One thread for each candidate and node. Springs to control nodes count in all directions.

    Args:
        start: First half-edge of each node, and their number.
        spring: Spring of each half-edge.
        object_springs: Leading springs that join object nodes.
        direction: Unit direction of each of these.
        length: Of each spring [m].
        rank: Of each spring; see `MasterTopology`.
        limits: By candidate and kind of spring: radius [m], neighbors, floor of the rest length
            [m], stiffness [N], damping [N·s/m].
        stiffness_out: By candidate and node.
        damping_out: By candidate and node.
    """
    candidate, node = wp.tid()
    stiff = wp.mat33d()
    damped = wp.mat33d()
    held = wp.vec2d()
    for half_edge in range(start[node], start[node + 1]):
        at = spring[half_edge]
        kind = wp.where(at < object_springs, OBJECT, VIRTUAL)
        is_near = length[at] < limits[candidate, kind, RADIUS]
        if is_near and wp.float64(rank[at]) < limits[candidate, kind, MOST]:
            # As short as the model has it, which is in single precision.
            floored = wp.float32(wp.max(length[at], limits[candidate, kind, FLOOR]))
            rate = limits[candidate, kind, STIFFNESS] / wp.float64(floored)
            dashpot = limits[candidate, kind, DAMPING]
            if kind == OBJECT:
                along = wp.outer(direction[at], direction[at])
                stiff += rate * along
                damped += dashpot * along
            else:
                held += wp.vec2d(rate, dashpot)
    # A spring between nodes that both move stores up to twice what it does if one of them moves.
    stiffness_out[candidate, node] = wp.float64(2.0) * largest_eigenvalue(stiff) + held[0]
    damping_out[candidate, node] = wp.float64(2.0) * largest_eigenvalue(damped) + held[1]
