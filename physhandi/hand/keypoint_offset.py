"""Where MediaPipe's networks see the keypoints of the open hand, relative to its joints.

Measured on the template alone: 40 poses, each rendered from 30 directions, the networks' keypoints
triangulated robustly; half of the offsets agree between poses to 2 mm, the ring finger's tip to 7.
Without them the wrist is 18 mm and the knuckles 5 mm from what keypoint networks call by that name.
"""

import numpy as np

KEYPOINT_OFFSET = 1e-3 * np.array(
    [
        (-5.3, -17.1, 0.8),
        (-3.8, 1.4, -2.0),
        (1.8, -1.4, -1.8),
        (1.0, 3.0, 4.1),
        (-0.5, -0.3, -2.4),
        (1.1, -6.1, 1.8),
        (0.3, 1.9, -0.4),
        (0.3, 3.2, -0.3),
        (0.5, -3.9, 0.1),
        (-1.4, -3.9, 0.9),
        (-1.3, 2.4, 0.0),
        (-0.2, 3.8, -0.4),
        (0.3, -4.4, 0.5),
        (0.0, -4.7, 0.8),
        (-2.1, 0.7, -0.9),
        (-2.2, 4.3, -2.1),
        (-3.0, -1.8, -0.6),
        (-1.1, -4.7, -1.3),
        (-0.1, 0.8, 0.6),
        (-0.5, 1.4, -0.2),
        (0.6, -3.4, 1.8),
    ]
)
"""Offset of each keypoint from its joint (or fingertip node) in the right template's frame [m]."""
