"""Images of the recording in the scene: straightened, and as new as what is drawn over them."""

import numpy as np
import pytest
from support.viewer.viewer_world import Recording

from app.viewer.content.content import open_sequence_content
from app.viewer.scene.cameras import CameraNodes, Lens
from app.viewer.scene.framing import frame_content
from physhandi.data.camera import PinholeCamera

LENS = np.array([0.3, -0.1, 0.01, -0.02, 0.0])


@pytest.mark.parametrize("width", [200, 100])
@pytest.mark.parametrize("distortion", [LENS, np.zeros(5)])
def test_a_straightened_image_shows_a_point_where_a_pinhole_sees_it(width, distortion) -> None:
    K = np.array([[170.0, 0.0, 92.0], [0.0, 160.0, 80.0], [0.0, 0.0, 1.0]])
    camera = PinholeCamera(K, np.eye(4), 200, 150, distortion)
    point = np.array([-0.35, 0.3, 1.0])
    column, row = np.meshgrid(np.arange(200), np.arange(150))
    away = np.linalg.norm(np.stack([column, row], axis=-1) - camera.project(point), axis=-1)
    spot = (255 * np.exp(-((away / 3.0) ** 2))).astype(np.uint8)
    image = Lens(camera, width).straighten(np.repeat(spot[..., None], 3, axis=2))
    assert image.shape == (3 * width // 4, width, 3)

    # A frustum has one focal length, and its axis goes through the middle of the image.
    scale, light = width / 200, image[..., 0].astype(float)
    rows, columns = np.indices(light.shape)
    seen = np.array([(light * columns).sum(), (light * rows).sum()]) / light.sum()
    middle = 0.5 * (np.array([width, 3 * width // 4]) - 1)
    np.testing.assert_allclose(seen, middle + scale * 160.0 * point[:2], atol=0.3)


def test_an_image_that_is_straight_stays_as_it_is() -> None:
    K = np.array([[160.0, 0.0, 99.5], [0.0, 160.0, 74.5], [0.0, 0.0, 1.0]])
    image = np.random.default_rng(0).integers(0, 256, (150, 200, 3)).astype(np.uint8)
    lens = Lens(PinholeCamera(K, np.eye(4), 200, 150), 200)
    np.testing.assert_array_equal(lens.straighten(image), image)


def test_a_backdrop_follows_every_frame_and_other_images_now_and_then(
    server, catalog, recording: Recording
) -> None:
    content = open_sequence_content(catalog, recording.sequence.name)
    cameras = CameraNodes(server, content.views, frame_content(content), clock=lambda: 5.0)

    def brightness(frame: int, looks_from: str | None) -> list[float]:
        """How bright the images are; frame f of the recording has 40 f."""
        cameras.draw(frame, is_visible=True, looks_from=looks_from, is_playing=True)
        images = (server.scene._handle_from_node_name[f"/cameras/view{i}"].image for i in (0, 1))
        return [-1.0 if image is None else float(image.mean()) for image in images]

    assert [brightness(frame, "view1") for frame in (1, 2, 3)] == [[-1, 40], [-1, 80], [-1, 120]]
    # Another view is shown at once, although no time went by.
    assert brightness(3, "view0") == [120, 120]
    assert brightness(2, None) == brightness(1, None) == [120, 120]
    content.close()
