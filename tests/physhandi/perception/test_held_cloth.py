"""A cloth that hands hold up before a wall: from depth images and masks to its nodes."""

import cv2
import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, KDTree
from support.inputs import made_clouds as made

from physhandi.data.camera import PinholeCamera
from physhandi.data.observation import ObjectObservation
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.perception.lifting import observe_object
from physhandi.perception.shape import ObjectShape, shape_of_observation
from physhandi.perception.shape_class import links
from physhandi.rendering.renderer import rasterize
from physhandi.rendering.shapes import Balls, Surface

SIZE = (0.35, 0.40)
RELIEF = 0.066
SPACING = 0.012
CLOTH, HAND = 0, 2


def camera(degrees: float) -> PinholeCamera:
    """A camera a metre away from the cloth, at its height and so many degrees to the side."""
    angle = np.radians(degrees)
    eye = np.array([np.sin(angle), -np.cos(angle), 0.75])
    ahead = (np.array([0.0, 0.0, 0.6]) - eye) / np.linalg.norm([0.0, 0.0, 0.6] - eye)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    pose[:3, 3] = eye
    K = np.array([[230.0, 0, 120], [0, 230, 95], [0, 0, 1]])
    return PinholeCamera(K=K, T_world_camera=pose, width=241, height=191)


def quad(*corner: tuple[float, float, float]) -> Surface:
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Surface(vertex=np.array(corner, dtype=float), faces=faces, color=np.zeros((4, 3)))


def scene() -> list[Surface | Balls]:
    vertex = made.hanging(RELIEF, size=SIZE)
    faces = Delaunay(vertex[:, [0, 2]]).simplices
    fists = np.array([[-0.16, 0.0, 0.80], [0.16, 0.0, 0.80], [0.0, 0.0, 0.60]])
    return [
        Surface(vertex=vertex, faces=faces, color=np.zeros((len(vertex), 3))),
        quad((-3, 0.7, 0), (3, 0.7, 0), (3, 0.7, 3), (-3, 0.7, 3)),
        Balls(center=fists, radius=np.full(3, 0.045), color=np.zeros((3, 3))),
        quad((-3, -3, 0), (3, -3, 0), (3, 3, 0), (-3, 3, 0)),
    ]


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    random = np.random.default_rng(0)
    cameras = {f"view{n}": camera(degrees) for n, degrees in enumerate((-55, 0, 50))}
    with SequenceWriter(tmp_path_factory.mktemp("held") / "cloth") as writer:
        for name, one in cameras.items():
            picture = rasterize(one, scene())
            depth = picture.depth + random.normal(scale=0.0015, size=picture.depth.shape)
            cloth = (picture.shape == CLOTH).astype(np.uint8)
            # Two pixels too wide, so that wall and floor are in it.
            mask = cv2.dilate(cloth, np.ones((5, 5), np.uint8))
            mask[picture.shape == HAND] = 2
            writer.save_image(
                f"views/{name}/depth/00000.png", np.round(1000 * depth).astype(np.uint16)
            )
            writer.save_image(f"views/{name}/mask/00000.png", mask)
        views = tuple(ViewMeta(name=name, camera=one) for name, one in cameras.items())
        return writer.finish(
            SequenceMeta(
                name="cloth", frame_rate=30.0, frame_count=1, ground_height=0.0, views=views
            )
        )


@pytest.fixture(scope="module")
def observation(held: Sequence) -> ObjectObservation:
    return observe_object(held)


@pytest.fixture(scope="module")
def shape(held: Sequence, observation: ObjectObservation) -> ObjectShape:
    return shape_of_observation(observation, SPACING, held)


def test_a_cloth_held_up_becomes_one_sheet_without_background(
    observation: ObjectObservation, shape: ObjectShape
) -> None:
    surface = made.hanging(RELIEF, size=SIZE)
    away = KDTree(surface).query(observation.cloud[0])[0]
    assert (away > 0.1).sum() > 300  # What the masks let through.
    assert shape.kind == "sheet"
    assert KDTree(surface).query(shape.node)[0].max() < 0.012
    assert np.ptp(shape.node[:, 1]) > 0.055
    covered = KDTree(shape.node).query(surface)[0]
    assert np.percentile(covered, 98) < 1.2 * SPACING
    area = 0.35 * 1.17 * 0.40  # The wave is 1.17 times as long as it is wide.
    assert 0.9 * area / SPACING**2 < len(shape.node) < 1.6 * area / SPACING**2
    graph = links(shape.node.astype(np.float64), 2 * SPACING)
    assert connected_components(graph, directed=False)[0] == 1


def test_the_background_is_named(shape: ObjectShape) -> None:
    (warning,) = shape.warnings
    assert warning["code"] == "object_points_removed"
    assert "behind or beside it according to another view (up to" in warning["message"]


def test_what_a_hand_hides_is_filled_and_nothing_beside_the_cloth(
    observation: ObjectObservation, shape: ObjectShape
) -> None:
    node = shape.node
    middle = np.array([0.0, 0.0, 0.6])
    hidden = [
        np.linalg.norm(p[:, [0, 2]] - middle[[0, 2]], axis=1) < 0.02
        for p in (
            observation.cloud[0],
            node,
        )
    ]
    assert not hidden[0].any()
    assert hidden[1].sum() >= 6
    assert np.abs(node[hidden[1], 1] - RELIEF / 2).max() < 0.012
    assert np.abs(node[:, 0]).max() < 0.19
    assert node[:, 2].min() > 0.385
    assert node[:, 2].max() < 0.815
