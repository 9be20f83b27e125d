"""Splats before a camera that stands askew, for tests."""

import numpy as np
from scipy.spatial.transform import Rotation

from physhandi.appearance.splats import Splats
from physhandi.data.camera import PinholeCamera


def askew_camera(width: int = 61, height: int = 45) -> PinholeCamera:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()
    pose[:3, 3] = [0.2, -0.1, 0.4]
    K = np.array([[70.0, 3.0, width / 2 - 2.0], [0.0, 64.0, height / 2 + 1.5], [0.0, 0.0, 1.0]])
    return PinholeCamera(K=K, T_world_camera=pose, width=width, height=height)


def random_splats(
    camera: PinholeCamera, count: int = 150, seed: int = 1, beyond: float = 20
) -> Splats:
    """Scatter splats of all sizes and opacities in and around what a camera sees."""
    random = np.random.default_rng(seed)
    depth = random.uniform(0.3, 0.6, count)
    depth[:3] = [-0.2, 0.005, 0.02]  # Behind the camera, too near, and just not too near.
    pixel = random.uniform(-beyond, np.array([camera.width, camera.height]) + beyond, (count, 2))
    return Splats(
        center=camera.unproject(pixel, depth).astype(np.float32),
        scale=random.uniform(0.001, 0.02, count).astype(np.float32),
        color=random.random((count, 3)).astype(np.float32),
        opacity=random.choice([0.002, 0.3, 0.8, 1.0], count).astype(np.float32),
        rest_node=np.zeros((1, 3), np.float32),
    )
