"""Links that open a live scene as it was, through the server."""

from dataclasses import replace
from urllib.parse import parse_qs, urlsplit

import pytest
from support.server.server_world import World

from app.viewer.physics.panel import PhysicsPanel
from physhandi.simulation.edits import Cut

QUERY = "f=3&cam=1,-2,0.5,0.1,0.2,0.3&fov=40&show=nodes,forces&scale=0.5&theme=dark&speed=0.5"


def open_link(world: World, query: str) -> str:
    answer = world.browser().get(f"/runs/fitted/view?{query}")
    assert answer.status_code == 303, answer.text
    place = urlsplit(answer.headers["location"])
    assert parse_qs(place.query) == parse_qs(query)
    return place.path.removeprefix("/live/")


def test_a_link_opens_a_scene_in_the_state_that_it_tells(world: World) -> None:
    session = world.sessions.get(open_link(world, f"{QUERY}&drag=4.5"))
    assert session is not None
    state = session.state
    assert (state.frame, state.speed, state.theme, state.is_playing) == (3, 0.5, "dark", False)
    shown = {name for name, on in vars(state.layers).items() if on is True}
    assert shown == {"nodes", "forces", "dark"}
    assert state.layers.force_scale == 0.5
    assert state.parameters.drag == 4.5
    assert state.parameter_changes == {"drag": 4.5}
    camera = session._server.initial_camera
    assert tuple(camera.position) == (1.0, -2.0, 0.5)
    assert tuple(camera.look_at) == (0.1, 0.2, 0.3)
    world.sessions.shutdown()


def test_the_link_of_a_scene_opens_another_one_like_it(world: World) -> None:
    browser = world.browser()
    location = browser.get(f"/runs/fitted/view?{QUERY}").headers["location"]
    session = urlsplit(location).path.removeprefix("/live/")
    link = browser.get(f"/api/v1/sessions/{session}/link").json()
    told = dict(part.split("=", 1) for part in link["query"].split("&"))
    asked = dict(part.split("=", 1) for part in QUERY.split("&"))
    # Nobody looks at it, so that there is no camera to tell of.
    assert told == {k: v for k, v in asked.items() if k not in {"cam", "fov"}} | {
        "sequence": "sheet"
    }
    again = browser.get(link["url"]).headers["location"]
    other = world.sessions.get(urlsplit(again).path.removeprefix("/live/"))
    first = world.sessions.get(session)
    assert other is not first
    assert other.state.layers == first.state.layers
    assert other.state.frame == 3
    assert link["lost"] == ""
    edited = replace(first.state, edits=(Cut(springs=((0, 1),)),))
    third = world.sessions.open("run", "fitted", first.owner, state=edited)
    told = browser.get(f"/api/v1/sessions/{third}/link").json()
    assert (told["query"], "Save it as a run" in told["lost"]) == (link["query"], True)
    stranger = world.browser().get(f"/api/v1/sessions/{session}/link")
    assert stranger.status_code == 404
    world.sessions.close(session)
    gone = browser.get(f"{location}&from=%22%3E")
    assert gone.status_code == 404
    assert f'href="runs/fitted/view?{QUERY.replace("&", "&amp;")}&amp;from=%22%3E"' in gone.text
    world.sessions.shutdown()


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("f=ten", "f"),
        ("f=1000", "f"),
        ("cam=1,2", "cam"),
        ("show=nodes&show=forces", "show"),
        ("from=nowhere", "from"),
        ("sequence=other", "sequence"),
        ("<b>=1", "b"),
        (f"sequence={'x' * 5000}", "longer"),
    ],
)
def test_a_link_that_makes_no_sense_is_a_page_that_names_the_field(
    still_world: World, query: str, field: str
) -> None:
    answer = still_world.browser().get(f"/runs/fitted/view?{query}")
    assert answer.status_code == 422
    assert "text/html" in answer.headers["content-type"]
    assert field in answer.text.split("<main", 1)[1]
    assert "<b>=" not in answer.text
    assert still_world.sessions.list() == []


def test_a_page_elsewhere_opens_no_scene_but_may_ask_for_one(world: World) -> None:
    browser = world.browser()
    visit = {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "navigate"}
    del browser.headers["origin"]
    for path in ("/runs/fitted/view", "/sequences/sheet/view"):
        asked = browser.get(path, headers={**visit, "Sec-Fetch-Dest": "document"})
        assert (asked.status_code, "Open the scene" in asked.text) == (403, True)
        loaded = browser.get(path, headers={**visit, "Sec-Fetch-Dest": "iframe"})
        assert loaded.status_code == 403
        assert browser.get(path, headers={"Origin": "http://127.0.0.1:9999"}).status_code == 403
    assert world.sessions.list() == []


def test_strangers_and_guesses_open_nothing(world: World) -> None:
    locked = world.client(Accept="text/html").get(f"/runs/fitted/view?{QUERY}")
    assert locked.status_code == 401
    assert "needs its token" in locked.text
    assert "href=''" in locked.text
    assert world.client().get("/api/v1/sessions/x/link").status_code == 401
    browser = world.browser()
    assert browser.get("/runs/nothing/view").status_code == 404
    assert browser.get("/runs/..%2Ffitted/view").status_code == 404
    early = browser.get("/runs/fitted/view", headers={"Sec-Purpose": "prefetch;prerender"})
    assert early.status_code == 503
    assert world.sessions.list() == []


def test_a_recording_has_links_too_but_nothing_to_simulate(world: World) -> None:
    browser = world.browser()
    answer = browser.get("/sequences/sheet/view?f=2&show=observed")
    session = world.sessions.get(urlsplit(answer.headers["location"]).path.removeprefix("/live/"))
    assert (session.kind, session.state.frame) == ("sequence", 2)
    refused = browser.get("/sequences/sheet/view?drag=3")
    assert refused.status_code == 422
    assert "drag: nothing is simulated here" in refused.text
    world.sessions.shutdown()


def test_the_panel_shows_what_the_link_changed(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    restore = PhysicsPanel.restore

    def remember(panel: PhysicsPanel, parameters: object, **how: object) -> None:
        asked.append((parameters.stiffness_scale, how))
        restore(panel, parameters, **how)

    monkeypatch.setattr(PhysicsPanel, "restore", remember)
    open_link(world, "stiffness_scale=0.25&substeps_per_frame=auto")
    assert asked == [(0.25, {"is_automatic": True, "edits": None})]
    world.sessions.shutdown()
