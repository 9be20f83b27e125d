"""Distance of the motion of each of many candidates from the observation, frame by frame.

Every thread adds up a few terms of one candidate; neighbouring threads are candidates, whose
states lie side by side (see `kernels.batch.substep`). Sums have a fixed order.
"""

import warp as wp

from physhandi.simulation.kernels.batch.substep import place_of

wp.set_module_options({"enable_backward": False})

POINTS_PER_THREAD = 8
"""Observed points that one thread holds while it walks over the nodes."""
NODES = 16
"""Nodes whose velocities one thread compares."""

_Points = wp.types.matrix(shape=(POINTS_PER_THREAD, 3), dtype=wp.float32)
_Nearest = wp.types.vector(length=POINTS_PER_THREAD, dtype=wp.float32)


@wp.kernel
def find_nearest(
    frame: int,
    width: int,
    nodes: int,
    slices: int,
    surface: wp.array[int],
    cloud: wp.array2d[wp.vec3],
    # State in:
    state: wp.array[float],
    # Out:
    nearest_out: wp.array3d[float],
):
    """Find the squared distances of some observed points to the nearest node of a slice."""
    chunk, part, candidate = wp.tid()
    first = wp.static(POINTS_PER_THREAD) * chunk
    points = _Points()
    nearest = _Nearest()
    for k in range(wp.static(POINTS_PER_THREAD)):
        point = cloud[frame, first + k]
        points[k, 0] = point[0]
        points[k, 1] = point[1]
        points[k, 2] = point[2]
        nearest[k] = wp.inf
    of_candidate = place_of(candidate, 0, nodes, width)
    begin = part * surface.shape[0] // slices
    for s in range(begin, (part + 1) * surface.shape[0] // slices):
        base = of_candidate + 6 * width * surface[s]
        x = state[base]
        y = state[base + width]
        z = state[base + 2 * width]
        for k in range(wp.static(POINTS_PER_THREAD)):
            dx = points[k, 0] - x
            dy = points[k, 1] - y
            dz = points[k, 2] - z
            nearest[k] = wp.min(nearest[k], dx * dx + dy * dy + dz * dz)
    for k in range(wp.static(POINTS_PER_THREAD)):
        nearest_out[part, first + k, candidate] = nearest[k]


@wp.kernel
def sum_chamfer(
    frame: int,
    weight: wp.array2d[float],
    nearest: wp.array3d[float],
    # Out:
    part_out: wp.array2d[float],
):
    """Add up the squared distances of some observed points to the nearest surface node."""
    chunk, candidate = wp.tid()
    first = wp.static(POINTS_PER_THREAD) * chunk
    total = float(0.0)
    for point in range(first, first + wp.static(POINTS_PER_THREAD)):
        least = nearest[0, point, candidate]
        for part in range(1, nearest.shape[0]):
            least = wp.min(least, nearest[part, point, candidate])
        total += weight[frame, point] * least
    part_out[chunk, candidate] = total


@wp.kernel
def sum_tracks(
    frame: int,
    width: int,
    nodes: int,
    track: wp.array2d[wp.vec3],
    weight: wp.array2d[float],
    carrier: wp.array2d[int],
    carrier_weight: wp.array2d[float],
    offset: wp.array[wp.vec3],
    # State in:
    state: wp.array[float],
    # Out:
    part_out: wp.array2d[float],
):
    """Compare one observed track with the surface point that its nodes carry."""
    which, candidate = wp.tid()
    difference = offset[which] - track[frame, which]
    for k in range(carrier.shape[1]):
        base = place_of(candidate, carrier[which, k], nodes, width)
        node = wp.vec3(state[base], state[base + width], state[base + 2 * width])
        difference += carrier_weight[which, k] * node
    part_out[which, candidate] = weight[frame, which] * wp.dot(difference, difference)


@wp.func
def smooth_l1(value: float):
    """Half the square up to 1, then linear."""
    size = wp.abs(value)
    if size < 1.0:
        return 0.5 * size * size
    return size - 0.5


@wp.kernel
def sum_accelerations(
    weight: float,
    width: int,
    nodes: int,
    # States of the last three frames:
    first: wp.array[float],
    second: wp.array[float],
    third: wp.array[float],
    # Out:
    part_out: wp.array2d[float],
):
    """Add up how abruptly the velocity changes of some nodes differ from frame to frame."""
    chunk, candidate = wp.tid()
    total = float(0.0)
    begin = wp.static(NODES) * chunk
    for node in range(begin, wp.min(begin + wp.static(NODES), nodes)):
        base = place_of(candidate, node, nodes, width)
        for k in range(3, 6):
            place = base + k * width
            total += smooth_l1(third[place] - 2.0 * second[place] + first[place])
    part_out[chunk, candidate] = weight * total / (3.0 * float(nodes))


@wp.kernel
def add_losses(
    share: float,
    part: wp.array2d[float],
    diverged_frame: wp.array[int],
    # Out:
    loss_out: wp.array[float],
):
    """Add a frame's terms to each candidate's loss, `share` of them; infinite once it diverged."""
    candidate = wp.tid()
    total = float(0.0)
    for row in range(part.shape[0]):
        total += part[row, candidate]
    if diverged_frame[candidate] >= 0:
        loss_out[candidate] = wp.inf
    else:
        loss_out[candidate] = loss_out[candidate] + share * total
