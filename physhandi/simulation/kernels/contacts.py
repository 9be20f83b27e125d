"""The ground plane: restitution, Coulomb friction and the time of impact.

A node touches the ground at a height of its own, its clearance: it may be a point of the upper side
of what lies there.
"""

import warp as wp

from physhandi.simulation.kernels.world import World

wp.set_module_options({"enable_backward": False})

APPROACH_SPEED = wp.constant(1.0e-4)
"""A node that sinks slower than this is not in contact [m/s]."""
SLIDING_SPEED = wp.constant(1.0e-6)
"""Below this the direction of sliding is not resolved [m/s]."""


@wp.struct
class Motion:
    """Position and velocity of one node."""

    position: wp.vec3
    velocity: wp.vec3


@wp.func
def touches_ground(world: World, clearance: float, position: wp.vec3, velocity: wp.vec3):
    """Return whether a node is about to go through the ground in this substep."""
    height = position[2] - world.ground_height - clearance
    is_approaching = velocity[2] < -APPROACH_SPEED
    return world.has_ground == 1 and is_approaching and height + velocity[2] * world.dt < 0.0


@wp.func
def advance(world: World, clearance: float, position: wp.vec3, velocity: wp.vec3):
    """Move a node through one substep, bouncing and sliding on the ground."""
    motion = Motion()
    motion.velocity = velocity
    motion.position = position + velocity * world.dt
    if touches_ground(world, clearance, position, velocity):
        restitution = wp.clamp(world.restitution, 0.0, 1.0)
        friction = wp.clamp(world.friction, 0.0, 2.0)
        speed = wp.max(wp.length(wp.vec2(velocity[0], velocity[1])), SLIDING_SPEED)
        keep = wp.max(0.0, 1.0 + friction * (1.0 + restitution) * velocity[2] / speed)
        bounced = wp.vec3(keep * velocity[0], keep * velocity[1], -restitution * velocity[2])
        # Negative if the node is already below: it returns to the plane along its velocity.
        impact = -(position[2] - world.ground_height - clearance) / velocity[2]
        motion.velocity = bounced
        motion.position = position + velocity * impact + bounced * (world.dt - impact)
    return motion
