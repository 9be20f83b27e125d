"""The page of a replay and what it plays."""

from typing import Any
from urllib.parse import quote

from support.server.server_world import World
from support.viewer.viser_file import Recording
from support.waiting import until

from app.exports.request import FileRequest

REPLAY = "/api/v1/runs/fitted/replay"


def test_a_replay_is_made_in_the_background_and_played_without_a_session(
    world: World, made: list[FileRequest]
) -> None:
    browser = world.browser()
    page = browser.get("/runs/fitted/replay")
    assert page.status_code == 200
    assert f'data-replay="{REPLAY[1:]}"' in page.text

    def have_made(query: str) -> Any:
        def told() -> Any:
            answer = browser.post(f"{REPLAY}?{query}").json()
            return answer if answer["state"] != "making" else None

        answer = until(told)
        assert answer["state"] == "ready"
        return answer

    told = have_made("sequence=sheet")
    file = browser.get(told["url"])
    assert len(file.content) == told["bytes"]
    assert Recording.read(file.content).seconds > 0.3
    client = browser.get(f"/viewer/replay/?playbackPath={quote(told['url'])}")
    assert client.status_code == 200
    assert "playbackPath" not in client.text[:2000]
    assert "worker-src 'self' blob:" in client.headers["content-security-policy"]
    assert len(made) == 1
    have_made("theme=dark&sequence=sheet")
    assert [order.query.get("theme") for order in made] == ["light", "dark"]
    assert world.sessions.list() == []


def test_the_camera_of_a_link_reaches_the_player(world: World) -> None:
    page = world.browser().get("/runs/fitted/replay?cam=1,2,3,0,0,0.5&fov=60&theme=dark").text
    assert "initialCameraPosition=1%2C2%2C3&amp;initialCameraLookAt=0%2C0%2C0.5" in page
    assert "initialCameraFov=1.0472" in page
    assert 'data-theme="dark"' in page


def test_wrong_wishes_and_strangers_get_no_replay(world: World, made: list[FileRequest]) -> None:
    browser = world.browser()
    for query, word in (
        ("cam=1,2", "cam"),
        ("drag=3", "drag"),
        ("sequence=other", "sequence"),
        ("theme=pink", "theme"),
    ):
        answer = browser.get(f"/runs/fitted/replay?{query}")
        assert answer.status_code == 422
        assert word in answer.text.split("<main", 1)[1]
    assert browser.post(f"{REPLAY}?theme=pink").status_code == 422
    assert browser.post(f"{REPLAY}?sequence=other").status_code == 422
    assert browser.post("/api/v1/runs/nothing/replay").status_code == 404
    assert browser.get("/runs/nothing/replay").status_code == 404
    stranger = world.client(Accept="text/html")
    for path in ("/runs/fitted/replay", f"{REPLAY}.viser", "/viewer/replay/"):
        assert stranger.get(path).status_code == 401
    elsewhere = world.browser()
    elsewhere.headers["Origin"] = "http://evil.example"
    assert elsewhere.post(REPLAY).status_code == 403
    assert made == []
