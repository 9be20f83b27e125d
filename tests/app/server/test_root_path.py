"""The application below a path of another site: no address may lead out of it."""

import re
import shutil
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import urljoin, urlsplit

import pytest
from pydantic import SecretStr, ValidationError
from starlette.testclient import TestClient, WebSocketDenialResponse
from support.server import queue_world
from support.server.server_world import HOST, ORIGIN, TOKEN
from support.server.surface import routes

from app.exports.cache import FileCache, FileJob
from app.exports.request import FileRequest
from app.jobs.catalog import Catalog
from app.jobs.scheduler import Scheduler
from app.pages import render
from app.security import Security
from app.server import create_app
from app.settings import BUNDLED, OWN_PATHS, WEB_ASSETS, ServerSettings

ROOT = "/lab/physhandi"
TEMPLATES = WEB_ASSETS / "templates"
ADDRESSES = {"href", "src", "action", "formaction", "hx-get", "hx-post", "data-pending"}
STARTS = (
    "/",
    "/live/scene0",
    "/live/closed",
    "/compare?a=fitted&b=again",
    "/diff?run=fitted&run=again",
    "/runs/fitted/parts",
    "/nothing",
)


class Scenes(queue_world.Scenes):
    """Live scenes that are made up, one of which was closed."""

    def closed_session(self, session_id: str, owner: str) -> Any:
        scene = queue_world.Scene("run", "fitted", "a closed scene")
        return replace(scene, reason="nobody looked") if session_id == "closed" else None


@dataclass(frozen=True)
class Below:
    """An application below `ROOT`, and a browser that is signed in."""

    app: Any
    security: Security
    browser: TestClient


def client(app: Any, **headers: str) -> TestClient:
    return TestClient(app, base_url=ORIGIN, headers=headers, follow_redirects=False)


@pytest.fixture(scope="module")
def below(
    tmp_path_factory: pytest.TempPathFactory, sheet_folder: Path, fitted_folder: Path
) -> Below:
    data = tmp_path_factory.mktemp("data")
    shutil.copytree(sheet_folder, data / "sequences" / "sheet")
    for name in ("fitted", "again"):
        shutil.copytree(fitted_folder, data / "runs" / name)
    settings = ServerSettings(data_dir=data, token=SecretStr(TOKEN), root_path=f"{ROOT}/")
    security, catalog = Security(settings), Catalog(settings, bundled=BUNDLED)
    scenes: Any = Scenes({"scene0": queue_world.Scene("run", "fitted", "a scene")})
    app = create_app(
        settings,
        security=security,
        catalog=catalog,
        scheduler=Scheduler(settings, catalog),
        sessions=scenes,
    )
    browser = client(app, Accept="text/html", Origin=ORIGIN)
    browser.cookies.set(security.cookie, security.new_pass())
    return Below(app, security, browser)


class Page(HTMLParser):
    """All addresses of a page, as a browser understands them."""

    def __init__(self, url: str, text: str) -> None:
        super().__init__()
        self.base, self.found = url, set[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if tag == "base" and value is not None:
                self.base = urljoin(self.base, value)
            elif name in ADDRESSES and value is not None and not value.startswith("#"):
                self.found.add(urljoin(self.base, value))
            else:
                assert name == "aria-keyshortcuts" or not (value or "").startswith("/"), value


def test_every_address_on_every_page_stays_below(
    below: Below, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: set[str] = set()
    fill = render.fill

    def noted(name: str, **values: Any) -> str:
        shown.add(name)
        return fill(name, **values)

    monkeypatch.setattr(render, "fill", noted)
    waiting = [f"{ORIGIN}{ROOT}{start}" for start in STARTS]
    seen = set(waiting)
    while waiting:
        url = waiting.pop()
        answer = below.browser.get(url)
        is_page = "text/html" in answer.headers["content-type"]
        found = Page(url, answer.text).found if is_page and "/viewer/" not in url else set[str]()
        for name in ("location", "hx-push-url", "hx-replace-url"):
            if name in answer.headers:
                found.add(urljoin(f"{ORIGIN}{ROOT}/", answer.headers[name]))
        for address in found:
            parts = urlsplit(address)
            if parts.netloc == HOST:
                assert parts.path.startswith(f"{ROOT}/"), f"{url} leads to {address}"
                # Files are not pages, and a scene is opened once only, below.
                kind = parts.path.rpartition("/")[2]
                is_known = address in seen or kind in {"export", "log", "view", "replay.viser"}
                if not is_known:
                    seen.add(address)
                    waiting.append(address)
    assert len(seen) > 80
    pages = {p.name for p in TEMPLATES.glob("*.html") if "{% extends" in p.read_text()}
    # Of a suite there is one where it was made; what these two say is looked at as text below.
    assert pages - shown <= {"suite.html"}


def test_no_page_and_no_script_names_an_address_from_the_root() -> None:
    first = "|".join(OWN_PATHS)
    from_root = re.compile(
        rf"([\"'`=(]|%}})/({first})\b|[\"'`]/\$?\{{|(href|src|action|hx-\w+)=[\"']/"
    )
    looked_at = [*WEB_ASSETS.glob("*.js"), *TEMPLATES.glob("*.html"), *WEB_ASSETS.glob("*.css")]
    assert len(looked_at) > 50
    for path in looked_at:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            assert not from_root.search(line), f"{path.name}:{number}: {line.strip()[:120]}"


def test_signing_in_and_redirects_lead_below(below: Below) -> None:
    for asked in (f"{ROOT}/runs", "/runs"):  # Passed on as it is, or without the path.
        signed_in = client(below.app).get(f"{asked}?token={TOKEN}&q=a")
        assert (signed_in.status_code, signed_in.headers["location"]) == (303, f"{ROOT}/runs?q=a")
        assert f"; Path={ROOT};" in signed_in.headers["set-cookie"]
    assert below.browser.get(ROOT).status_code == 200
    slash = below.browser.get(f"{ROOT}/runs/")
    assert (slash.status_code, slash.headers["location"]) == (307, f"{ORIGIN}{ROOT}/runs")
    assert below.browser.get(f"{ROOT}physhandi/runs").status_code == 404
    assert client(below.app).get(f"{ROOT}/runs").status_code == 401
    assert client(below.app).get(f"{ROOT}/healthz").status_code == 200


def test_answers_of_the_api_name_addresses_below(
    below: Below, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make(_: FileCache, order: FileRequest, work: FileJob) -> None:
        work.path.write_bytes(b"made")

    monkeypatch.setattr(FileCache, "_run", make)
    script = client(below.app, Authorization=f"Bearer {TOKEN}")

    def told(method: str, path: str, **body: Any) -> Any:
        answer = script.request(method, f"{ROOT}/api/v1{path}", json=body or None)
        assert answer.is_success, answer.text
        return answer.json()

    opened = told("POST", "/sessions", kind="run", id="fitted")
    assert opened["url"] == f"{ROOT}/live/{opened['id']}"
    assert told("GET", f"/sessions/{opened['id']}")["url"] == opened["url"]
    replay, export = "/runs/fitted/replay", "/runs/fitted/export?format=html"
    assert told("POST", replay)["url"].startswith(f"{ROOT}/api/v1/runs/fitted/replay.viser?")
    assert told("POST", export)["url"] == f"{ROOT}/api/v1{export}"
    share = told("POST", "/runs/fitted/shares")
    assert share["url"].startswith(f"{ROOT}/shared/")
    assert told("GET", "/shares")[0]["url"] == share["url"]
    assert client(below.app).get(share["url"]).content == b"made"
    assert told("GET", "/openapi.json")["servers"] == [{"url": ROOT}]


def test_websockets_are_found_below_and_judged_alike(below: Below) -> None:
    for path in ("/viewer/x", "/viewer/x/keys"):
        for headers, status in (({"Origin": ORIGIN}, 404), ({"Origin": "http://evil"}, 403)):
            other = client(below.app, **headers)
            other.cookies = below.browser.cookies
            with (
                pytest.raises(WebSocketDenialResponse) as refused,
                other.websocket_connect(f"ws://{HOST}{ROOT}{path}"),
            ):
                pass
            assert refused.value.status_code == status


def test_a_path_that_could_be_an_address_of_the_application_is_refused(below: Below) -> None:
    assert ServerSettings(root_path="/").root_path == ""
    assert ServerSettings(root_path="/a/b.c/").root_path == "/a/b.c"
    for wrong in ("lab", "/runs", "/api/lab", "/a//b", "/..", "/a/./b", "/a?b", "//evil.example"):
        with pytest.raises(ValidationError, match="root_path"):
            ServerSettings(root_path=wrong)
    assert {route.path.split("/")[1] for route in routes(below.app.routes)} - {""} == OWN_PATHS
