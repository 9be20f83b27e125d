"""What every route answers to whom; the routes are taken from the application itself."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse
from support.server import surface
from support.server.server_world import HOST, ORIGIN, TOKEN, World, make_world

from app.security import Security

ONLY = "a-token-for-people-who-only-look"
LOOKING = {
    "POST /api/v1/sessions",
    "PATCH /api/v1/sessions/{session_id}",
    "DELETE /api/v1/sessions/{session_id}",
    "POST /api/v1/runs/check",
    "POST /api/v1/runs/{run_id}/export",
    "POST /api/v1/runs/{run_id}/replay",
    "POST /viewer/{session_id}/shape",
}
"""All that changes nothing for others, though it is not asked for by GET."""
PROBES = {"/healthz", "/readyz"}
"""What answers everybody, for containers and load balancers."""
SOCKETS = {"/viewer/{session_id}", "/viewer/{session_id}/", "/viewer/{session_id}/keys"}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    data = tmp_path_factory.mktemp("data")
    (data / "read_only").write_text(ONLY)
    (data / "read_only").chmod(0o600)
    world = make_world(data, bundled=data / "nothing")
    settings = world.settings.model_copy(update={"read_only_token_file": data / "read_only"})
    yield replace(world, settings=settings, security=Security(settings))
    world.sessions.shutdown()


def routes(world: World) -> list[tuple[str, str]]:
    """All methods and paths: those of the OpenAPI document, and those that it leaves out."""
    found = {
        (method, route.path)
        for route in surface.routes(world.app.routes)
        for method in getattr(route, "methods", None) or ()
    }
    described = world.app.openapi()["paths"]
    told = {(method.upper(), path) for path, item in described.items() for method in item}
    assert told <= found
    assert len(found) > 70
    return sorted(found)


def sockets(world: World) -> set[str]:
    return {r.path for r in surface.routes(world.app.routes) if "WebSocket" in type(r).__name__}


def address(path: str) -> str:
    return re.sub(r"\{[^}]*\}", "x", path)


def ask(client: TestClient, method: str, path: str) -> Any:
    return client.request(method, address(path), headers={"Accept": "*/*"})


def test_without_token_no_route_answers_but_pages_that_were_shared(world: World) -> None:
    client = world.client(Origin=ORIGIN)
    for method, path in [*routes(world), ("GET", "/assets/app.js"), ("GET", "/nothing")]:
        response = ask(client, method, path)
        if path.startswith("/shared/"):
            assert response.status_code == 404
            continue
        if path in PROBES:
            told = {"status", "version", "reasons"}
            assert method == "HEAD" or set(response.json()) <= told
            continue
        assert response.status_code == 401, f"{method} {path}"
        assert method == "HEAD" or response.json()["error"]["code"] == "unauthorized"
    assert sockets(world) == SOCKETS
    for path in SOCKETS:
        for headers in ({"Origin": ORIGIN}, {}):
            assert refusal(world.client(**headers), path) == 401


def refusal(client: TestClient, path: str) -> int:
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        client.websocket_connect(f"ws://{HOST}{address(path)}"),
    ):
        pass
    return refused.value.status_code


def readers(world: World) -> list[TestClient]:
    """A script, and a browser, that may only look."""
    browser = world.client(Origin=ORIGIN)
    browser.cookies.set(world.security.cookie, world.security.new_pass(may_change=False))
    return [world.client(Authorization=f"Bearer {ONLY}"), browser]


def test_who_may_only_look_changes_nothing_on_any_route(world: World) -> None:
    asked = 0
    for client in readers(world):
        for method, path in routes(world):
            if method in {"GET", "HEAD"}:
                continue
            response = ask(client, method, path)
            is_refused = response.status_code == 403
            assert is_refused == (f"{method} {path}" not in LOOKING), f"{method} {path}"
            assert not is_refused or response.json()["error"]["code"] == "read_only"
            asked += 1
    assert asked >= 2 * 20
    for path in ("/api/v1/runs/{run_id}/cancel", "/api/v1/runs", "/api/v1/imports"):
        assert ask(world.script(), "POST", path).status_code in {404, 422}
    # What there is not is no way round it either.
    for method in ("PUT", "POST", "QUERY"):
        assert ask(readers(world)[0], method, "/api/v1/something").status_code == 403


def test_who_may_only_look_sees_all_and_has_live_scenes_of_its_own(world: World) -> None:
    for client in readers(world):
        for path in ("/", "/runs", "/api/v1/runs", "/api/v1/system", "/healthz"):
            assert client.get(path).status_code == 200
        for path in SOCKETS:
            assert refusal(client, path) == 404  # Past the gate, but there is no such scene.
        assert client.post("/api/v1/sessions", json={}).status_code == 422


def test_scenes_of_who_may_only_look_keep_nothing(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []

    def note(*_arguments: object, may_keep: bool, **_more: object) -> str:
        asked.append(may_keep)
        return "scene"

    monkeypatch.setattr(world.sessions, "open", note)
    body = {"kind": "run", "id": "x"}
    for client in (*readers(world), world.script()):
        assert client.post("/api/v1/sessions", json=body).status_code == 201
        assert client.get("/runs/x/view").status_code == 303
    assert asked == [False] * 4 + [True] * 2


def test_a_browser_that_only_looked_gets_more_by_the_full_address(world: World) -> None:
    client = world.client(Origin=ORIGIN)
    entered = client.get("/runs", params={"token": ONLY})
    assert (entered.status_code, entered.headers["location"]) == (303, "/runs")
    assert ONLY not in entered.headers["set-cookie"]
    assert client.post("/api/v1/runs/x/cancel").status_code == 403
    client.get("/runs", params={"token": "wrong"})
    assert client.post("/api/v1/runs/x/cancel").status_code == 403
    assert client.get("/runs", params={"token": TOKEN}).status_code == 303
    assert client.post("/api/v1/runs/x/cancel").status_code == 404
    # And does not lose it by an address of somebody who may only look.
    assert client.get("/runs", params={"token": ONLY}).status_code == 303
    assert client.post("/api/v1/runs/x/cancel").status_code == 404


def test_another_site_can_use_nobodys_cookie_on_any_route(world: World) -> None:
    browser = world.browser()
    browser.headers["origin"] = "http://127.0.0.1:9999"
    for method, path in routes(world):
        response = ask(browser, method, path)
        if not path.startswith("/shared/") and path not in PROBES:
            assert response.status_code == 403, f"{method} {path}"
    for path in SOCKETS:
        assert refusal(browser, path) == 403


def test_no_token_is_kept_where_it_can_be_read(world: World, tmp_path: Path) -> None:
    for client in readers(world):
        for path in ("/system", "/api/v1/system", "/api/v1/openapi.json", "/"):
            text = client.get(path).text
            assert TOKEN not in text
            assert ONLY not in text
