"""Addresses and orders that compare two runs."""

import shutil
from typing import Any

import numpy as np
import pytest
from support.server.server_world import World

from physhandi.data.run_folder import RUN
from physhandi.run import Run

HOSTILE = "<img src=x onerror=alert(1)>"
LIFT = 0.004


def lift(world: World) -> tuple[str, str]:
    """Give a server another run, of which every node is 4 mm higher; returns both."""
    source = world.catalog.run("fitted")
    name = source.sequence_names[0]
    folder = world.settings.run_dir / "lifted"
    run = Run.create(
        folder, name=HOSTILE, kind="simulation", sequences=source.sequences, config={"x": 1}
    )
    with run.begin_attempt() as attempt:
        shutil.copytree(source.out, attempt.out, dirs_exist_ok=True)
        at = f"sequences/{name}/rollout.npy"
        attempt.save_array(at, source.array(at) + np.array([0, 0, LIFT], np.float32))
        parameters = source.yaml("object/parameters.yaml") | {"drag": 7.25}
        attempt.save_yaml("object/parameters.yaml", parameters)
        attempt.publish()
    return "fitted", run.id


@pytest.fixture
def pair(world: World) -> tuple[str, str]:
    """The fitted run and the one that is lifted."""
    return lift(world)


@pytest.fixture(scope="module")
def still_pair(still_world: World) -> World:
    """A server with both runs, for tests that change nothing."""
    lift(still_world)
    return still_world


def test_the_numbers_of_a_pair(world: World, pair: tuple[str, str]) -> None:
    script = world.script()
    found = script.get(f"/api/v1/comparison?a={pair[0]}&b={pair[1]}").json()
    count = len(found["frames"])
    assert found["frames"] == [[frame, frame] for frame in range(count)]
    assert count > 3
    assert found["difference"]["way"] == "nodes"
    np.testing.assert_allclose(found["difference"]["mean"], [LIFT] * count, rtol=1e-4)
    np.testing.assert_allclose(found["difference"]["largest"], [LIFT] * count, rtol=1e-4)
    errors = found["errors"]["track_error"]
    assert errors["a"] == errors["b"]
    assert max(value for value in errors["a"] if value is not None) > 0
    assert found["notes"] == []


def test_the_page_shows_both_and_only_where_they_differ(
    world: World, pair: tuple[str, str]
) -> None:
    client = world.browser()
    page = client.get(f"/compare?a={pair[0]}&b={pair[1]}&mode=overlay&f=2").text
    assert "&#34;mode&#34;: &#34;overlay&#34;" in page or '"mode": "overlay"' in page
    assert HOSTILE not in page
    assert "&lt;img src=x" in page
    row = page[page.index(">drag</span>") :]
    assert "7.25" in row[: row.index("</tr>")]
    chooser = client.get(f"/runs/{pair[0]}/compare").text
    assert f'href="compare?a={pair[0]}&amp;b={pair[1]}"' in chooser
    assert HOSTILE not in chooser
    assert client.get("/runs/nothing/compare").status_code == 404


@pytest.mark.parametrize(
    ("query", "status", "word"),
    [
        ("a=fitted", 422, "lacks “b=…”"),
        ("a=fitted&b=fitted", 422, "both run"),
        ("a=fitted&b=nothing", 404, "nothing"),
        ("a=fitted&b=..%2F..%2Fetc", 422, "b"),
        ("a=fitted&b=lifted&mode=round", 422, "mode"),
        ("a=fitted&b=lifted&color=red", 422, "color"),
        ("a=fitted&b=lifted&f=-1", 422, "f"),
        ("a=fitted&b=lifted&extra=1", 422, "extra"),
        ("a=fitted&b=lifted&sequence=nowhere", 422, "nowhere"),
    ],
)
def test_a_wrong_address_names_the_field(
    still_pair: World, query: str, status: int, word: str
) -> None:
    for address in ("/compare", "/api/v1/comparison"):
        answer = still_pair.script().get(f"{address}?{query}")
        assert answer.status_code == status
        message = answer.json()["error"]["message"]
        assert word in message
        assert "Value error" not in message


def test_two_sides_that_are_the_same_are_told_in_plain_words(still_pair: World) -> None:
    answer = still_pair.script().get("/compare?a=fitted&b=fitted")
    assert answer.json()["error"]["message"].startswith("A and B are both run 'fitted'; ")


def test_a_damaged_run_is_told(world: World, pair: tuple[str, str]) -> None:
    (world.settings.run_dir / pair[1] / RUN).write_text("name: [")
    answer = world.script().get(f"/compare?a={pair[0]}&b={pair[1]}")
    assert answer.status_code == 409
    assert "cannot be opened" in answer.json()["error"]["message"]


def test_a_scene_of_two_runs_obeys_owner_and_limit(world: World, pair: tuple[str, str]) -> None:
    order: dict[str, Any] = {"kind": "comparison", "a": pair[0], "b": pair[1], "mode": "wipe"}
    script, browser = world.script(), world.browser()
    for change, word in (
        ({"b": pair[0]}, "both run"),
        ({"id": pair[0]}, "id"),
        ({"mode": "round"}, "mode"),
        ({"f": 1.5}, "f"),
    ):
        refused = script.post("/api/v1/sessions", json=order | change)
        assert refused.status_code == 422
        assert word in refused.json()["error"]["message"]
    assert world.sessions.list() == []
    try:
        opened = script.post("/api/v1/sessions", json=order).json()
        link = script.get(f"/api/v1/sessions/{opened['id']}/link").json()
        assert link["url"] == f"/compare?a={pair[0]}&b={pair[1]}&mode=wipe"
        assert (
            script.patch(f"/api/v1/sessions/{opened['id']}", json={"frame": 2}).status_code == 204
        )
        assert "f=2" in script.get(f"/api/v1/sessions/{opened['id']}/link").json()["url"]
        assert browser.get(f"/api/v1/sessions/{opened['id']}").status_code == 404
        assert browser.get(f"/viewer/{opened['id']}/").status_code == 404
        page = script.get(opened["url"]).text
        assert f'href="compare?a={pair[0]}&amp;b={pair[1]}' in page
        assert script.delete(f"/api/v1/sessions/{opened['id']}").status_code == 204
        closed = script.get(opened["url"], headers={"Accept": "text/html"})
        assert closed.status_code == 404
        assert f'href="compare?a={pair[0]}&amp;b={pair[1]}' in closed.text
        world.sessions._opening["others"] = world.settings.live_sessions - 1
        answers = [script.post("/api/v1/sessions", json=order).status_code for _ in range(2)]
        assert answers == [201, 429]
    finally:
        world.sessions.shutdown()
