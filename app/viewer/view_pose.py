"""Where a camera of the scene stands when it looks from a view of the recording."""

import numpy as np

from app.viewer.framing import Framing
from app.viewer.session_state import Pose
from physhandi.data.view import View


def pose_of_view(view: View, framing: Framing) -> Pose:
    """Stand where a view's camera stood, looking its way, with its field of view.

    Args:
        view: The view.
        framing: Tells how far away the middle of the scene is, about which the camera turns.
    """
    camera = view.camera
    _, down, ahead, origin = camera.T_world_camera[:3].T
    distance = max(float((framing.center - origin) @ ahead), 0.1 * framing.extent)
    return Pose(
        position=origin,
        look_at=origin + distance * ahead,
        up=-down,
        fov=float(2 * np.arctan2(camera.height / 2, camera.K[1, 1])),
    )
