"""Constants of the push of hands, also for what computes it without Warp, to be drawn."""

FARTHEST_FACE = 6.0
"""Farthest that a node may be from its triangle, in lengths of the triangle's longest edge."""
MOST_DEPTH = 3.0
"""Deepest that a node may be inside of the hand, in the same lengths: what is deeper is nearer to
another side of the hand, out of which it must not be pushed."""
MOST_ASIDE = 0.7
"""Farthest that a node may be beside its triangle, seen along the normal, in the same lengths:
beyond the rim of a hand the plane goes on, but the hand does not."""
SAME_DISTANCE = 1.0e-4
"""Relative difference below which two triangles count as equally near, as those that share the
nearest edge do; the one whose plane is farther away then tells inside from outside."""
LEAVING_SPEED = 0.1
"""The s of the law: what a hand pushes never leaves it faster than this [m/s]."""
