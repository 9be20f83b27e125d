"""One list of keys: in the help overlay, in the documentation and in the scene."""

import html
import re
from pathlib import Path

from support.server.server_world import World

from app.keys import KEYS, key_of
from app.viewer.color.quantities import QUANTITIES

DOCS = Path(__file__).parents[3] / "docs" / "viewer.md"


def test_the_documentation_lists_every_key_and_every_color() -> None:
    text = DOCS.read_text()
    rows = {tuple(cell.strip() for cell in row.split("|")[1:-1]) for row in text.splitlines()}
    listed = {(group.title, " ".join(key.shown), key.about) for group in KEYS for key in group.keys}
    assert listed <= rows
    titles = {group.title for group in KEYS}
    assert {row for row in rows if row and row[0] in titles} == listed
    colors = {(name, quantity.unit, quantity.about) for name, quantity in QUANTITIES.items()}
    assert colors <= rows


def test_the_help_of_a_live_scene_shows_every_key(world: World) -> None:
    client = world.browser()
    page = client.get(
        client.post("/api/v1/sessions", json={"kind": "run", "id": "fitted"}).json()["url"]
    )
    dialog = page.text.partition('<dialog id="help">')[2].partition("</dialog>")[0]
    shown = re.sub(r"\s+", " ", html.unescape(re.sub("<[^>]+>", "", dialog)))
    for group in KEYS:
        assert group.title in shown
        for key in group.keys:
            assert f"{' '.join(key.shown)}{key.about}" in shown
    world.sessions.shutdown()


def test_a_browser_asks_a_scene_for_a_frame(world: World) -> None:
    client, stranger = world.browser(), world.browser()
    name = client.post("/api/v1/sessions", json={"kind": "run", "id": "fitted"}).json()["id"]
    address = f"/api/v1/sessions/{name}"
    session = world.sessions.get(name)
    last = session._content.frame_count - 1
    assert stranger.patch(address, json={"frame": 1}).status_code == 404
    assert session._playback.frame == 0
    assert client.patch(address, json={"frame": 1}).status_code == 204
    assert session._playback.frame == 1
    assert not session._playback.is_playing
    assert client.patch(address, json={"frame": 10**6}).status_code == 204
    assert session._playback.frame == last
    for wrong in ({"frame": -1}, {"frame": "x"}, {"frame": 10**9}, {"frames": 1}):
        assert client.patch(address, json=wrong).status_code == 422
    assert session._playback.frame == last
    world.sessions.shutdown()


def test_an_action_finds_its_key() -> None:
    assert key_of("figure").hotkeys == ("F",)
    assert key_of("ten_back").modifier == "shift"
