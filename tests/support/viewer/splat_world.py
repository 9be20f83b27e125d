"""Splats for the sheet of `viewer_world`: a pattern that tells its four corners apart."""

import numpy as np
from numpy import ndarray

from app.benchmarks.viewer_client import ViewerClient
from physhandi.appearance.splats import Splats


def splats_on(node: ndarray, count: int = 600) -> Splats:
    """Scatter splats around the middle plane of nodes that lie flat."""
    rng = np.random.default_rng(11)
    low, high = node.min(axis=0), node.max(axis=0)
    center = rng.uniform(low, high, (count, 3))
    center[:, 2] += rng.normal(0.0, 0.0005, count)
    part = (center[:, :2] - low[:2]) / (high - low)[:2]
    color = np.concatenate([part, np.full((count, 1), 0.3)], axis=1)
    return Splats(
        center=center.astype(np.float32),
        scale=rng.uniform(0.003, 0.006, count).astype(np.float32),
        color=color.astype(np.float32),
        opacity=np.full(count, 0.9, np.float32),
        rest_node=node.astype(np.float32),
    )


def splats_seen(client: ViewerClient, root: str = "/object/splats") -> tuple[ndarray, ndarray]:
    """Find the splats that a browser draws: their middles and their colors.

    Args:
        client: Has taken in the scene.
        root: Path of the groups.
    """
    middles: list[ndarray] = []
    colors: list[ndarray] = []
    for name in sorted(client.nodes):
        if not name.startswith(f"{root}/"):
            continue
        props = client.nodes[name]
        buffer = props["buffer"].reshape(-1, 8)
        center = buffer[:, :3].copy().view(np.float32) * float(props["scale"])
        middles.append(center @ rotation(client.turns[name]).T + client.positions[name])
        colors.append(buffer[:, 7:].copy().view(np.uint8)[:, :3] / 255.0)
    return np.concatenate(middles), np.concatenate(colors)


def rotation(wxyz: tuple[float, ...]) -> ndarray:
    """Write a unit quaternion as a matrix."""
    w, x, y, z = wxyz
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
