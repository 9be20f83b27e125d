"""Metres per unit of depth images: what recorders use, and what a measured one is likely to be."""

KNOWN_SCALES = (1.0, 0.01, 0.001, 0.00025, 0.0002, 0.0001)
"""Metres, centimetres, millimetres, RealSense L515, TUM, tenths of millimetres [m]."""
LARGEST_SCALE = 1.0
"""Largest scale that can be given; a number above it counts as units per metre [m]."""
_NEAR = 1.4


def likely_scales(scale: float) -> tuple[float, ...]:
    """Name the scales of known recorders near a measured one, the nearest first.

    Args:
        scale: Metres per unit, good to some ten per cent.

    Returns:
        Known scales; the measured one, rounded, if none is near.
    """
    off = {one: max(one / scale, scale / one) for one in KNOWN_SCALES}
    near = sorted((one for one in KNOWN_SCALES if off[one] < _NEAR), key=off.__getitem__)
    return tuple(near) or (float(f"{scale:.1g}"),)
