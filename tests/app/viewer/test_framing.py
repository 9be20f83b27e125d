from dataclasses import replace

import numpy as np
import pytest

from app.viewer.content.content import Content, open_run_content, open_sequence_content
from app.viewer.content.layers import default_layers
from app.viewer.scene.framing import frame_content
from app.viewer.scene.layers_panel import legend_of


def in_view(framing, point) -> bool:
    """Whether a point is inside the vertical field of view of a square picture."""
    ahead = framing.look_at - framing.camera
    depth = (point - framing.camera) @ ahead / np.linalg.norm(ahead)
    distance = np.linalg.norm(point - framing.camera)
    return depth > 0 and np.arccos(depth / distance) < framing.fov / 2


@pytest.mark.parametrize("scale", [0.001, 1.0, 40.0])
def test_everything_that_moves_is_in_the_picture_at_any_scale(scale: float) -> None:
    rng = np.random.default_rng(1)
    control = scale * (rng.uniform(-1, 1, (10, 50, 3)) + np.array([5.0, -3.0, 2.0]))
    content = Content(
        title="t",
        sequence_name="s",
        frame_count=10,
        frame_rate=30.0,
        reconstruction_count=10,
        length_unit="m",
        ground_height=None,
        control=control.astype(np.float32),
    )
    framing = frame_content(content)
    assert framing.extent == pytest.approx(2 * np.sqrt(3) * scale, rel=0.1)
    np.testing.assert_allclose(framing.center, scale * np.array([5.0, -3.0, 2.0]), atol=0.1 * scale)
    assert all(in_view(framing, point) for point in control[::3].reshape(-1, 3))
    assert framing.camera[2] > framing.center[2]


def test_the_overview_stands_between_the_recording_cameras(catalog, recording) -> None:
    framing = frame_content(open_sequence_content(catalog, recording.sequence.name))
    for view in recording.sequence.views:
        eye = view.camera.T_world_camera[:2, 3] - framing.center[:2]
        away = np.angle(np.exp(1j * (np.arctan2(eye[1], eye[0]) - framing.azimuth)))
        assert abs(away) > np.deg2rad(60)


def test_a_run_hides_the_recording_at_first_and_a_recording_shows_it(catalog, recording) -> None:
    of_run = default_layers(open_run_content(catalog, "sheet"))
    of_recording = default_layers(open_sequence_content(catalog, recording.sequence.name))
    assert (of_run.observed, of_run.cameras) == (False, False)
    # Springs would hide the surface, and come in its place where there is none.
    assert (of_run.surface, of_run.nodes, of_run.object_springs) == (True, False, False)
    bare = default_layers(replace(open_run_content(catalog, "sheet"), surface=None))
    assert (bare.surface, bare.nodes, bare.object_springs) == (False, True, True)
    assert (of_recording.observed, of_recording.cameras) == (True, True)


def test_the_legend_of_parts_names_what_is_shown_alone(catalog) -> None:
    content = open_run_content(catalog, "sheet")
    layers = default_layers(content)

    def said() -> list[str]:
        names = ("hand", "object nodes", "controls", "forces", "virtual springs", "observed")
        return [name for name in names if name in legend_of(content, layers)]

    assert said() == ["forces"]  # Of this run there is no hand.
    layers.nodes = layers.controls = layers.virtual_springs = layers.observed = True
    assert said() == ["object nodes", "controls", "forces", "virtual springs", "observed"]
    assert "contact begins" not in legend_of(content, layers)
    fitted = content.fitted
    late = replace(fitted.model, attached=np.int32([[2, 9]]).repeat(53, axis=0))
    changing = replace(content, fitted=replace(fitted, model=late))
    assert "contact begins" in legend_of(changing, layers)
    assert "contact ends" not in legend_of(changing, replace(layers, forces=False))
    layers.color = "speed"  # Nodes and springs have other colors now.
    assert said() == ["controls", "forces", "observed"]
