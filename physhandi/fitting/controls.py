"""Which hand points pull the object, and how an object is laid into another sequence."""

from collections.abc import Sequence as Listing

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from physhandi.data.view import View


def farthest_points(point: Float[ndarray, "point 3"], count: int) -> Int[ndarray, " chosen"]:
    """Pick points that are far from each other, beginning with the first one."""
    chosen = [0]
    distance = np.linalg.norm(point - point[0], axis=1)
    while len(chosen) < min(count, len(point)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(point - point[chosen[-1]], axis=1))
    return np.array(chosen)


def visible_vertices(
    views: Listing[View], vertex: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Int[ndarray, " visible"]:
    """Find the hand vertices whose surface faces at least one camera.

    Occlusion by the object or by other fingers is not considered.
    """
    corner = vertex[faces]
    face_normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal = np.zeros_like(vertex)
    for k in range(3):
        np.add.at(normal, faces[:, k], face_normal)
    seen = np.zeros(len(vertex), bool)
    for view in views:
        eye = view.camera.T_world_camera[:3, 3]
        seen |= ((eye - vertex) * normal).sum(axis=1) > 0
    return np.flatnonzero(seen)


def lay_object(
    template: Float[ndarray, "node 3"], cloud: Float[ndarray, "point 3"], *, iterations: int = 40
) -> Float[ndarray, "node 3"]:
    """Move a known object rigidly to where another sequence shows it at frame 0.

    Point-to-point ICP from eight headings around the vertical; the best end wins. It supposes that
    the object starts in about the shape in which it was first reconstructed.

    Args:
        template: Nodes of the object in the sequence that it was fitted on [m].
        cloud: Object points seen at frame 0 of the other sequence [m].
        iterations: Alignment steps from each heading.

    Returns:
        The nodes in the other sequence [m].
    """
    tree = KDTree(cloud)
    best, best_error = template, np.inf
    for turn in np.arange(8) * np.pi / 4:
        heading = Rotation.from_euler("z", turn).as_matrix()
        node = (template - template.mean(axis=0)) @ heading.T + cloud.mean(axis=0)
        for _ in range(iterations):
            target = cloud[tree.query(node)[1]]
            centred = node - node.mean(axis=0)
            rotation = Rotation.align_vectors(target - target.mean(axis=0), centred)[0]
            node = rotation.apply(centred) + target.mean(axis=0)
        error = float(
            np.mean(tree.query(node)[0] ** 2) + np.mean(KDTree(node).query(cloud)[0] ** 2)
        )
        if error < best_error:
            best, best_error = node, error
    return best.astype(np.float32)
