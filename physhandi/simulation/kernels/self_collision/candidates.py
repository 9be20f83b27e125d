"""Which object nodes may hit which during a frame, found once at its start (physics.md §3.3)."""

import warp as wp

from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

SEARCH_MARGIN = wp.constant(1.01)
"""The search reaches a little further than the distance, so that both nodes see a pair."""


@wp.func
def is_candidate(
    world: World,
    node: int,
    other: int,
    rest: wp.array[wp.vec3],
    position: wp.array[wp.vec3],
):
    """Return whether two nodes are near now and, unless all may collide, were not at rest.

    The answer is the same with the nodes exchanged: differences only change their sign.
    """
    if other == node:
        return False
    reach = world.collision_distance
    if not (wp.length(position[other] - position[node]) < reach):
        return False
    return world.collides_rest_neighbors == 1 or wp.length(rest[other] - rest[node]) >= reach


@wp.kernel
def count_candidates(
    grid: wp.uint64,
    # Model:
    world: wp.array[World],
    rest: wp.array[wp.vec3],
    # State in:
    position: wp.array[wp.vec3],
    # State out:
    count_out: wp.array[int],
):
    """Count the candidates of each object node (one thread per node)."""
    node = wp.tid()
    count = int(0)
    reach = SEARCH_MARGIN * world[0].collision_distance
    for other in wp.hash_grid_query(grid, position[node], reach):
        if is_candidate(world[0], node, other, rest, position):
            count += 1
    count_out[node] = count


@wp.kernel
def list_candidates(
    grid: wp.uint64,
    # Model:
    world: wp.array[World],
    rest: wp.array[wp.vec3],
    # State in:
    position: wp.array[wp.vec3],
    start: wp.array[int],
    # State out:
    candidate_out: wp.array[int],
):
    """Write the candidates of each object node in ascending order (one thread per node).

    The grid returns them cell by cell; sorted, their sums do not depend on the grid.
    """
    node = wp.tid()
    first = start[node]
    end = int(first)
    reach = SEARCH_MARGIN * world[0].collision_distance
    for other in wp.hash_grid_query(grid, position[node], reach):
        if is_candidate(world[0], node, other, rest, position):
            place = int(end)
            while place > first and candidate_out[place - 1] > other:
                candidate_out[place] = candidate_out[place - 1]
                place -= 1
            candidate_out[place] = other
            end += 1
