"""The numbers that all nodes share, kept on the device so that a captured graph sees changes."""

import warp as wp


@wp.struct
class World:
    """Global parameters of one simulation; one element of an array on the device."""

    dt: wp.float32
    velocity_loss: wp.float32
    """Part of the velocity that drag takes in one substep, 1 - exp(-dt drag)."""
    gravity: wp.float32
    has_ground: wp.int32
    ground_height: wp.float32
    restitution: wp.float32
    friction: wp.float32
    stiffness_scale: wp.float32
    control_rate: wp.float32
    """Frames in a second, or 0 if springs see the control nodes at rest."""
    collision_distance: wp.float32
    self_restitution: wp.float32
    self_friction: wp.float32
    collides_rest_neighbors: wp.int32
    push_stiffness: wp.float32
    """Push of a hand on a node, for each metre that the node is inside of it [N/m]."""
    hand_friction: wp.float32
    speed_limit: wp.float32
    """A node that is faster has diverged [m/s]."""
