import numpy as np
import pytest
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import hear_all

from app.viewer.content.content import Content, ShownHand
from app.viewer.content.layers import PLAYING_SPRINGS
from app.viewer.scene.framing import frame_content
from app.viewer.scene.scene import SceneDrawing
from physhandi.object_rollout import ObjectRollout
from physhandi.simulation.object_surface import lay_surface
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import build_model

FRAMES = 8
PARAMETERS = SimulationParameters(
    connection_radius=0.2, max_neighbors=20, virtual_connection_radius=0.1, virtual_max_neighbors=4
)


def large_content() -> Content:
    rng = np.random.default_rng(5)
    node = rng.uniform(-0.5, 0.5, (3_000, 3)).astype(np.float32)
    vertex = rng.uniform(-0.5, 0.5, (2, FRAMES, 1_000, 3)).astype(np.float32)
    control = np.concatenate(list(vertex), axis=1)
    model = build_model(node, control[0], PARAMETERS)
    position = node + np.linspace(0, 0.1, FRAMES, dtype=np.float32)[:, None, None]
    face = rng.integers(0, 1_000, (2_000, 3)).astype(np.int32)
    fitted = ObjectRollout(
        model=model, parameters=PARAMETERS, control=control, position=position, ready=FRAMES
    )
    return Content(
        title="large",
        sequence_name="large",
        frame_count=FRAMES,
        frame_rate=30.0,
        reconstruction_count=FRAMES,
        length_unit="m",
        ground_height=0.0,
        hands=(
            ShownHand(side="right", vertex=vertex[0], face=face),
            ShownHand(side="left", vertex=vertex[1], face=face),
        ),
        control=control,
        fitted=fitted,
        surface=lay_surface(node, kind="solid"),
    )


@pytest.mark.parametrize(("color", "surface"), [("plain", False), ("speed", True)])
def test_a_large_scene_is_thinned_while_it_plays_and_whole_when_it_rests(
    server, color, surface
) -> None:
    content = large_content()
    rollout = content.fitted
    assert rollout is not None
    assert rollout.model.object_spring_count > 10 * PLAYING_SPRINGS
    scene = SceneDrawing(server, content, frame_content(content))
    layers = scene.layers
    layers.object_springs = layers.virtual_springs = layers.controls = layers.nodes = True
    layers.color, layers.surface = color, surface
    springs = "/springs/object" if color == "plain" else "/springs/object_painted"
    scene.draw(0, rollout, 0, is_playing=True)
    with ViewerClient(f"ws://127.0.0.1:{server.get_port()}") as client:
        hear_all(server, client)
        assert springs in client.nodes
        before = client.bytes_received
        for frame in range(1, FRAMES):
            scene.draw(frame, rollout, frame, is_playing=True)
            hear_all(server, client)
        each = (client.bytes_received - before) / (FRAMES - 1)
        assert 60_000 < each < 100_000
        scene.draw(FRAMES - 1, rollout, FRAMES - 1, is_playing=False)
        client.until(lambda: client.bytes_received - before > 1_000_000)
