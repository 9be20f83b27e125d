"""The whole application: who gets in, and what it says when something is wrong."""

import logging
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from starlette.routing import Mount
from starlette.testclient import WebSocketDenialResponse
from support.server.server_world import HOST, ORIGIN, TOKEN, World, make_world

from app.security import PAGE_POLICY, VIEWER_POLICY
from app.settings import WEB_ASSETS
from physhandi.errors import RunError


def addresses(world: World) -> Iterator[tuple[str, str]]:
    """Every method and path that the application knows, with an id where one belongs."""
    for route in world.app.routes:
        path = re.sub(r"\{[^}]*\}", "fitted", route.path)
        if isinstance(route, Mount):
            continue
        methods = getattr(route, "methods", None)
        for method in sorted(methods) if methods else ["WEBSOCKET"]:
            yield method, path
    for file in WEB_ASSETS.rglob("*"):
        if file.is_file():
            yield "GET", f"/assets/{file.relative_to(WEB_ASSETS).as_posix()}"
    yield "GET", "/nothing/here"


def test_nothing_is_told_to_anybody_without_the_token(world: World) -> None:
    client = world.client(Origin=ORIGIN)
    # What was shared is seen by who has its address; nothing is shared here.
    shared = "GET", "/shared/fitted"
    probes = {("GET", "/healthz"), ("GET", "/readyz")}
    known = [pair for pair in addresses(world) if pair != shared and pair not in probes]
    told = client.request(*shared)
    assert (told.status_code, "Nothing is shared here" in told.text) == (404, True)
    assert {"GET /", "POST /api/v1/runs", "GET /api/v1/openapi.json", "GET /metrics"} <= {
        " ".join(pair) for pair in known
    }
    assert sum(path.startswith("/api/v1/") for _, path in known) >= 14
    assert sum(method == "WEBSOCKET" for method, _ in known) == 3
    for method, path in known:
        if method == "WEBSOCKET":
            with (
                pytest.raises(WebSocketDenialResponse) as refused,
                client.websocket_connect(f"ws://{HOST}{path}", subprotocols=["viser-v1.1.1"]),
            ):
                pass
            assert refused.value.status_code == 401
            continue
        response = client.request(method, path)
        assert response.status_code == 401, f"{method} {path}"
        assert method == "HEAD" or response.json()["error"]["code"] == "unauthorized"


def test_the_printed_address_lets_a_browser_in(world: World) -> None:
    client = world.client(Accept="text/html")
    entered = client.get(f"/?token={TOKEN}")
    assert (entered.status_code, entered.headers["location"]) == (303, "/")
    assert TOKEN not in entered.headers["set-cookie"]
    assert client.get("/").status_code == 200
    assert client.get("/assets/app.js").status_code == 200
    assert client.get("/healthz").json()["status"] == "ok"


def test_browsers_keep_scripts_and_ask_whether_they_are_the_same(still_world: World) -> None:
    client = still_world.browser()
    script = client.get("/assets/app.js")
    assert script.headers["cache-control"] == "private, no-cache"
    again = client.get("/assets/app.js", headers={"If-None-Match": script.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["cache-control"] == "private, no-cache"
    changed = client.get("/assets/app.js", headers={"If-None-Match": '"another"'})
    assert (changed.status_code, changed.content) == (200, script.content)
    assert client.get("/").headers["cache-control"] == "no-store"


def test_the_token_never_reaches_a_log_or_a_page(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    client = world.client(Accept="text/html")
    pages = [client.get(f"/x?token={TOKEN}z"), client.get(f"/?token={TOKEN}"), client.get("/")]
    told = [record.getMessage() for record in caplog.records if record.name.startswith("app")]
    assert told
    assert not any(TOKEN in line for line in told)
    assert not any(TOKEN in page.text for page in pages)


def test_another_site_can_neither_launch_nor_cancel(world: World) -> None:
    client = world.browser()
    body = {"sequences": ["sheet"], "name": "publish"}
    for origin in ("http://evil.example", "null", "http://127.0.0.1:9999"):
        for method, path in addresses(world):
            if method in {"POST", "DELETE"}:
                headers = {"Origin": origin}
                response = client.request(method, path, json=body, headers=headers)
                assert response.status_code == 403, f"{method} {path}"
    assert [item.id for item in world.catalog.runs() if not item.is_bundled] == ["fitted"]


def test_pages_run_no_foreign_and_no_inline_script(still_world: World) -> None:
    client = still_world.browser()
    for path in ("/", "/runs/fitted", "/nothing"):
        response = client.get(path)
        assert response.headers["content-security-policy"] == PAGE_POLICY
        assert not re.search(r"<script(?![^>]*\ssrc=)|\son\w+=|javascript:|<style", response.text)
        assert not re.search(r"(src|href)=\"(https?:)?//", response.text)
    assert "unsafe" not in PAGE_POLICY
    scene = client.get("/viewer/nothing/")
    assert scene.headers["content-security-policy"] == VIEWER_POLICY


@pytest.mark.parametrize(
    "path",
    [
        "/assets/../app/cli.py",
        "/assets/%2e%2e/app/cli.py",
        "/assets/..%2fapp/cli.py",
        "/assets/..%5capp/cli.py",
        "/assets//etc/passwd",
        "/assets/%00",
        "/assets/templates",
        "/viewer/x/../../etc/passwd",
        "/viewer/x/index.html",
        "/viewer/x/%2e%2e/%2e%2e/etc/passwd",
        "/runs/..%2f..%2fetc",
        "/runs/" + "a" * 10_000,
        "/runs/a.b",
        "/live/%2e%2e",
    ],
)
def test_no_path_leads_out(still_world: World, path: str) -> None:
    response = still_world.browser().get(path)
    assert response.status_code == 404
    assert "root:" not in response.text


def test_errors_are_pages_for_browsers_and_json_for_scripts(still_world: World) -> None:
    page = still_world.browser().get("/runs/nothing")
    assert (page.status_code, page.headers["content-type"]) == (404, "text/html; charset=utf-8")
    assert "There is no run &#39;nothing&#39;." in page.text
    for client in (still_world.script(), still_world.browser()):
        answer = client.get("/api/v1/runs/nothing")
        assert answer.status_code == 404
        error = {"code": "not_found", "message": "There is no run 'nothing'."}
        assert answer.json() == {"error": error}
    assert still_world.script().get("/nothing").json()["error"]["code"] == "not_found"
    wrong = still_world.script().put("/api/v1/runs")
    assert (wrong.status_code, wrong.json()["error"]["code"]) == (405, "wrong_method")


def test_a_defect_is_logged_and_told_without_details(
    still_world: World, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def break_down() -> None:
        raise ZeroDivisionError("secret detail")

    monkeypatch.setattr(still_world.catalog, "sequences", break_down)
    client = still_world.script()
    client._transport.raise_server_exceptions = False
    response = client.get("/api/v1/sequences")
    assert response.status_code == 500
    assert response.json()["error"]["code"] == "defect"
    assert "secret detail" not in response.text
    assert "secret detail" in caplog.text


def test_a_large_body_is_refused(still_world: World) -> None:
    body = {"sequences": ["sheet"], "name": "x" * 2**20}
    assert still_world.script().post("/api/v1/runs", json=body).status_code == 413
    assert [item.id for item in still_world.catalog.runs() if not item.is_bundled] == ["fitted"]


def test_a_second_server_on_the_same_data_folder_says_so(world: World) -> None:
    with world.script(), pytest.raises(RunError, match="Another server"):
        world.scheduler.__class__(world.settings, world.catalog).start()


def test_what_a_sequence_says_of_itself_is_text(world: World, data_dir: Path) -> None:
    hostile = "<img src=x onerror=alert(1)>\u202e"
    folder = data_dir / "sequences" / "hostile"
    shutil.copytree(data_dir / "sequences" / "sheet", folder)
    meta = yaml.safe_load((folder / "sequence.yaml").read_text())
    meta |= {"name": "hostile", "description": hostile, "label": hostile}
    (folder / "sequence.yaml").write_text(yaml.safe_dump(meta))
    (data_dir / "sequences" / "broken").mkdir()
    (data_dir / "sequences" / "broken" / "sequence.yaml").write_text(f"{hostile}: 1")
    page = world.browser().get("/").text
    assert "&lt;img src=x onerror=alert(1)&gt;" in page
    assert "<img src=x" not in page


def test_an_empty_server_tells_how_to_begin(tmp_path: Path) -> None:
    world = make_world(tmp_path / "data", bundled=tmp_path)
    page = world.browser().get("/")
    assert page.status_code == 200
    assert "No sequences." in page.text
    assert "physhandi import" in page.text
    assert "No runs yet." in page.text


def test_a_server_and_what_annotates_start_without_what_only_fits_need() -> None:
    heavy = ["torch", "ai_edge_litert", "mujoco", "matplotlib"]
    # Every command waits for what the command line imports, and processes of suites for theirs.
    commands, served = ["tyro", "pydantic"], ["fastapi", "viser"]
    # Children simulate and draw; smoothing and splats are rare. What makes files shows nothing.
    simulated = ["warp", "scipy.ndimage", "scipy.cluster"]
    code = f"""
import sys
sys.modules.update(dict.fromkeys({heavy + commands + served + simulated + ["scipy"]!r}))
import app.cli.suite_processes
for name in {commands!r}:
    del sys.modules[name]
app.cli.build()
del sys.modules["scipy"]
import app.exports.making
for name in {served!r}:
    del sys.modules[name]
import app.server
for name in {simulated!r}:
    del sys.modules[name]
import app.jobs.recordings.annotator
"""
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
