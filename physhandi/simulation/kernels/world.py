"""The numbers that all nodes share, kept on the device so that a captured graph sees changes."""

import warp as wp


@wp.struct
class World:
    """Global parameters of one simulation; one element of an array on the device."""

    dt: wp.float32
    velocity_decay: wp.float32
    gravity: wp.float32
    has_ground: wp.int32
    ground_height: wp.float32
    restitution: wp.float32
    friction: wp.float32
    stiffness_scale: wp.float32
    control_rate: wp.float32
    """Frames in a second, or 0 if springs see the control nodes at rest."""
    speed_limit: wp.float32
