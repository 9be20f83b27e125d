"""Names of hands: sides, kinds of models, keypoints and joints."""

from typing import Literal

HandSide = Literal["right", "left"]
HandKind = Literal["open", "mano"]
"""The built-in open hand, or the user's MANO."""

KEYPOINT_NAMES = (
    "wrist",
    "thumb_cmc",
    "thumb_mcp",
    "thumb_ip",
    "thumb_tip",
    "index_mcp",
    "index_pip",
    "index_dip",
    "index_tip",
    "middle_mcp",
    "middle_pip",
    "middle_dip",
    "middle_tip",
    "ring_mcp",
    "ring_pip",
    "ring_dip",
    "ring_tip",
    "pinky_mcp",
    "pinky_pip",
    "pinky_dip",
    "pinky_tip",
)
"""The 21 keypoints in MediaPipe's order."""
JOINT_NAMES = tuple(name for name in KEYPOINT_NAMES if name != "wrist" and not name.endswith("tip"))
"""The 15 joints that articulate, thumb to pinky, each finger from the palm outwards."""
