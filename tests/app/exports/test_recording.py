"""Recordings, read by the format alone and compared with the run's arrays."""

import base64
import re
from dataclasses import replace

import numpy as np
import pytest
from support.viewer.viewer_world import content_of
from support.viewer.viser_file import Recording

from app.exports.offscreen import GRID
from app.exports.permalink import state_from_query
from app.exports.recording import BYTES_FOR_300_FRAMES, record_scene
from app.viewer.content.content import Content
from app.viewer.restoring import complete_state
from physhandi.errors import UsageError

FRAMES = 12


@pytest.fixture
def content() -> Content:
    """A sheet and a hand that move, differently in every frame."""
    rng = np.random.default_rng(3)
    vertex = rng.normal(0, 0.05, (40, 3)).astype(np.float32)
    face = rng.integers(0, 40, (30, 3)).astype(np.int32)
    control = np.cumsum(rng.normal(0, 0.004, (FRAMES, 1, 3)), axis=0) + vertex[None, :20]
    still = content_of({"right": (vertex, face)}, control.astype(np.float32))
    assert still.fitted is not None
    position = still.fitted.position + control[:, :1] - control[:1, :1]
    hands = (replace(still.hands[0], vertex=np.asarray(control[:, :1] + vertex, np.float32)),)
    fitted = replace(still.fitted, position=position.astype(np.float32))
    return replace(still, fitted=fitted, hands=hands, frame_count=FRAMES)


def recorded(content: Content, query: dict[str, str], *, as_html: bool = False) -> bytes:
    state = complete_state(state_from_query(query), content)
    told: list[tuple[int, int]] = []
    result = record_scene(
        content, content.fitted, state, lambda *step: told.append(step), as_html=as_html
    )
    assert told == [(frame + 1, FRAMES) for frame in range(FRAMES)]
    return result


def test_a_recording_holds_every_frame_at_its_time(content: Content) -> None:
    recording = Recording.read(recorded(content, {"show": "hands,nodes,virtual_springs"}))
    assert recording.seconds == pytest.approx(FRAMES / 30)
    assert content.fitted is not None
    # Rounding moves a coordinate by at most half a step of the grid.
    tolerance = GRID * 2
    for frame in (0, 1, FRAMES - 1):
        nodes = recording.at(frame / 30 + 0.001)
        shown = nodes["/object/nodes"]["points"].reshape(-1, 3)
        np.testing.assert_allclose(shown, content.fitted.position[frame], atol=tolerance)
        vertex = nodes["/hand/right"]["vertices"].reshape(-1, 3)
        np.testing.assert_allclose(vertex, content.hands[0].vertex[frame], atol=tolerance)
        assert not nodes.get("/forces", {"visible": False})["visible"]
    moved = np.linalg.norm(content.fitted.position[1] - content.fitted.position[0], axis=-1)
    assert moved.min() > 20 * tolerance


def test_forces_are_those_of_the_exact_positions(content: Content) -> None:
    state = complete_state(state_from_query({"show": "forces", "f": "5"}), content)
    exact = content.fitted
    assert exact is not None
    strength = np.linalg.norm(exact.forces(5), axis=-1)
    recording = Recording.read(
        record_scene(content, exact, state, lambda _done, _of: None, as_html=False)
    )
    arrow = recording.at(5 / 30 + 0.001)["/forces"]["points"].reshape(-1, 2, 3)
    length = np.linalg.norm(arrow[:, 1] - arrow[:, 0], axis=-1)
    strongest = np.sort(strength)[::-1][: len(length)]
    free = length < 0.99 * length.max()
    assert free.sum() >= 2
    ratio = (length / strongest)[free]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-4)


def test_speed_camera_and_theme_of_the_link_are_kept(content: Content) -> None:
    query = {"speed": "0.5", "theme": "dark", "cam": "1,2,3,0,0,0.5", "fov": "40"}
    recording = Recording.read(recorded(content, query))
    assert recording.seconds == pytest.approx(2 * FRAMES / 30)
    camera = {m["type"]: m for _, m in recording.messages if m["type"].startswith("SetCamera")}
    assert camera["SetCameraPositionMessage"]["position"] == pytest.approx([1, 2, 3])
    assert camera["SetCameraFovMessage"]["fov"] == pytest.approx(np.deg2rad(40))
    assert (
        recording.at(0)["/ground"]["cell_color"]
        != Recording.read(recorded(content, {})).at(0)["/ground"]["cell_color"]
    )


def test_a_large_scene_stays_within_its_weight(content: Content) -> None:
    rng = np.random.default_rng(0)
    assert content.fitted is not None
    model = content.fitted.model
    first, step = (rng.integers(1, model.node_count, 40_000) for _ in range(2))
    many = np.stack([first, (first + step) % model.node_count], axis=1).astype(np.int32)
    springs = np.concatenate([many, model.spring_nodes[model.object_spring_count :]])
    count = len(springs)
    crowded = replace(
        model,
        spring_nodes=springs,
        object_spring_count=len(many),
        rest_length=np.full(count, 0.01, np.float32),
        stiffness=np.full(count, 10.0, np.float32),
        damping=np.zeros(count, np.float32),
    )
    heavy = replace(content, fitted=replace(content.fitted, model=crowded))
    packed = recorded(heavy, {"show": "hands,nodes,controls,object_springs,virtual_springs"})
    assert len(Recording.read(packed).at(0)["/springs/object"]["points"]) > 3_000
    assert len(packed) < BYTES_FOR_300_FRAMES / 300 * FRAMES


def test_a_page_holds_the_recording_and_loads_nothing(content: Content) -> None:
    named = replace(content, title="<script>alert(1)</script>")
    page = recorded(named, {}, as_html=True).decode()
    assert "<title>&lt;script&gt;alert(1)&lt;/script&gt; · PhysHanDI</title>" in page
    assert "<script>alert(1)" not in page
    found = re.search(r'__VISER_EMBED_DATA__="([A-Za-z0-9+/=]+)"', page)
    assert found is not None
    recording = Recording.read(base64.b64decode(found[1]))
    assert recording.seconds == pytest.approx(FRAMES / 30)
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", page)


def test_endless_sequences_are_refused(content: Content) -> None:
    state = complete_state(state_from_query({}), content)
    with pytest.raises(UsageError, match="at most 3000 are recorded"):
        record_scene(
            replace(content, frame_count=3_001),
            content.fitted,
            state,
            lambda _done, _of: None,
            as_html=False,
        )
