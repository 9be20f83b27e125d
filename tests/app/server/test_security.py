"""The middleware alone, in front of an application that always answers."""

import re

import pytest
from fastapi.testclient import TestClient
from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse
from starlette.routing import Route, WebSocketRoute
from starlette.testclient import WebSocketDenialResponse
from starlette.websockets import WebSocket

from app.security import PAGE_POLICY, Gatekeeper, Security
from app.settings import ServerSettings

HOST = "127.0.0.1:8080"
OWN = f"http://{HOST}"
SOCKET = f"ws://{HOST}/"
ANY_ADDRESS = "0.0.0.0"  # noqa: S104  # never bound
GIVEN = "0123456789abcdef"
FOREIGN = [
    "http://evil.example",
    "null",
    "http://127.0.0.1:9999",
    f"http://{HOST}.evil.example",
    f"https://{HOST}",
    f"http://{HOST}/",
    f"http://user@{HOST}",
    "http://127.0.0.1",
    "",
]


async def answer(request: Request) -> JSONResponse:
    return JSONResponse({"owner": request.state.owner, "path": request.url.path})


async def talk(websocket: WebSocket) -> None:
    await websocket.accept()
    await websocket.send_text("hello")
    await websocket.close()


async def frame(request: Request) -> PlainTextResponse:
    return PlainTextResponse("scene", headers={"Cache-Control": "no-cache"})


class Door:
    def __init__(self, **settings: object) -> None:
        self.now = 0.0
        self.security = Security(ServerSettings(**settings), clock=lambda: self.now)
        routes = [
            Route("/viewer/x/", frame),
            Route("/{rest:path}", answer, methods=["GET", "POST", "DELETE"]),
            WebSocketRoute("/{rest:path}", talk),
        ]
        self.app = Gatekeeper(Starlette(routes=routes), self.security)
        self.client = TestClient(self.app, base_url=OWN, follow_redirects=False)

    def enter(self) -> None:
        assert self.client.get("/", params={"token": self.security.token}).status_code == 303

    @property
    def bearer(self) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.security.token}"}


@pytest.fixture
def door() -> Door:
    return Door()


def test_the_token_moves_from_the_address_into_a_cookie(door: Door) -> None:
    response = door.client.get("/runs/a?x=1&token=" + door.security.token + "&y=2")
    assert response.status_code == 303
    assert response.headers["location"] == "/runs/a?x=1&y=2"
    cookie = response.headers["set-cookie"]
    assert cookie.startswith("physhandi_8080=")
    assert all(part in cookie for part in ("HttpOnly", "SameSite=strict", "Path=/"))
    assert door.security.token not in cookie
    answered = door.client.get("/runs/a")
    assert answered.status_code == 200
    assert re.fullmatch(r"[0-9a-f]{16}", answered.json()["owner"])


def test_two_browsers_are_told_apart_and_a_forged_cookie_is_not_believed(door: Door) -> None:
    owners = set()
    for _ in range(2):
        door.client.cookies.clear()
        door.enter()
        owners.add(door.client.get("/").json()["owner"])
    assert len(owners) == 2
    visitor, _, signature = door.security.new_pass().partition(".")
    for forged in (f"{visitor}x.{signature}", f"{visitor}.", visitor, "", ".", "a.b", "ü.ü"):
        door.client.cookies.clear()
        refused = door.client.get("/", headers={"Cookie": f"physhandi_8080={forged}".encode()})
        assert refused.status_code == 401
    assert Security(ServerSettings()).browser(f"{visitor}.{signature}") is None


@pytest.mark.parametrize("other", ["_xsrf=2|a|b", '{"a":1}', "a b=1", "x[]=1", "k=a,b c", "="])
def test_cookies_of_other_programs_on_this_host_lock_nobody_out(door: Door, other: str) -> None:
    own = f"physhandi_8080={door.security.new_pass()}"
    for cookies in (f"{other}; {own}", f"{own}; {other}"):
        assert door.client.get("/", headers={"Cookie": cookies}).status_code == 200


@pytest.mark.parametrize(
    "path", ["//evil.example/", "/\\evil.example/", "///evil.example", "/%5C/evil.example"]
)
def test_signing_in_never_leads_to_another_site(door: Door, path: str) -> None:
    url = f"{OWN}{path}?token={door.security.token}"
    location = door.client.get(url).headers["location"]
    assert re.match(r"/[^/\\]", location)


def test_nothing_is_answered_without_token(door: Door) -> None:
    for method in ("GET", "POST", "DELETE", "PUT", "OPTIONS", "HEAD"):
        response = door.client.request(method, "/api/v1/runs", headers={"Origin": OWN})
        assert response.status_code == 401
        assert b"owner" not in response.content
    page = door.client.get("/", headers={"Accept": "text/html"})
    assert page.status_code == 401
    assert "physhandi serve" in page.text
    assert "style-src 'sha256-" in page.headers["content-security-policy"]


def test_a_token_in_the_address_only_opens_the_door_for_pages(door: Door) -> None:
    url = f"/api?token={door.security.token}"
    assert door.client.post(url, headers={"Origin": OWN}).status_code == 401
    with pytest.raises(WebSocketDenialResponse), door.client.websocket_connect(f"ws://{HOST}{url}"):
        pass


def test_wrong_tokens_are_counted_and_the_right_one_still_works(door: Door) -> None:
    wrongs = [{"token": f"wrong{number}"} for number in range(200)]
    with door.client:  # Else each request starts an event loop.
        codes = [door.client.get("/", params=wrong).status_code for wrong in wrongs]
    assert codes[:20] == [401] * 20
    assert set(codes[20:]) == {429}
    wrong = {"Authorization": "Bearer wrong"}
    assert door.client.get("/", headers=wrong).status_code == 429
    assert door.client.get("/", headers=door.bearer).json()["owner"] == "bearer"
    door.now = 61.0
    assert door.client.get("/", headers=wrong).status_code == 401


def test_wrong_cookies_count_as_wrong_tokens_do(door: Door) -> None:
    def ask(cookie: str, **headers: str) -> int:
        sent = {"Cookie": f"other=1; physhandi_8080={cookie}", **headers}
        return door.client.get("/", headers=sent).status_code

    visitor, _, signature = door.security.new_pass().partition(".")
    forged = signature[:-1] + ("0" if signature[-1] != "0" else "1")
    codes = [ask(f"{visitor}.{n:04x}{forged[4:]}") for n in range(30)]
    assert codes == [401] * 20 + [429] * 10
    # Others from there, who guess nothing, are only told to bring a token.
    assert door.client.get("/").status_code == 401
    assert ask(f"{visitor}.{signature}") == 200
    page = {"Cookie": "physhandi_8080=old", "Accept": "text/html"}
    told = door.client.get("/", headers=page)
    assert (told.status_code, "needs its token" in told.text) == (429, True)
    door.now = 61.0
    assert ask("x.y") == 401


def test_a_bearer_needs_no_origin(door: Door) -> None:
    assert door.client.post("/", headers=door.bearer).status_code == 200
    with door.client.websocket_connect(SOCKET, headers=door.bearer) as websocket:
        assert websocket.receive_text() == "hello"


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "evil.example:8080", "127.0.0.1.evil.example", "localhost.", ""),
        *("[::2]:8080", "localhost:8080@evil.example", "localhost:", "localhost:80800000"),
        *("localhost:80:80", "localhost/x", "[::1]evil.example", "[::1", "localhost:8o80"),
    ],
)
def test_another_host_name_is_refused_even_with_the_token(door: Door, host: str) -> None:
    response = door.client.get("/", headers={**door.bearer, "Host": host})
    assert response.status_code == 400


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "[::1]:8080", "LOCALHOST"])
def test_names_of_this_machine_are_known(door: Door, host: str) -> None:
    assert door.client.get("/", headers={**door.bearer, "Host": host}).status_code == 200


def test_more_names_can_be_allowed() -> None:
    door = Door(allowed_hosts="lab.example, other.example")
    assert door.client.get("/", headers={**door.bearer, "Host": "lab.example"}).status_code == 200
    assert door.client.get("/", headers={**door.bearer, "Host": "x.lab.example"}).status_code == 400


@pytest.mark.parametrize("origin", FOREIGN)
def test_another_site_can_change_nothing(door: Door, origin: str) -> None:
    door.enter()
    assert door.client.post("/", headers={"Origin": OWN}).status_code == 200
    assert door.client.post("/", headers={"Origin": origin}).status_code == 403
    assert door.client.delete("/", headers={"Origin": origin}).status_code == 403
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        door.client.websocket_connect(SOCKET, headers={"Origin": origin}),
    ):
        pass
    assert refused.value.status_code == 403


def test_a_page_elsewhere_can_lead_here_but_load_nothing(door: Door) -> None:
    door.enter()

    def ask(**headers: str) -> int:
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        return door.client.get("/runs/a/view", headers=sent).status_code

    for site in ("cross-site", "same-site"):
        assert ask(Sec_Fetch_Site=site, Sec_Fetch_Mode="no-cors", Sec_Fetch_Dest="image") == 403
        assert ask(Sec_Fetch_Site=site, Sec_Fetch_Mode="navigate", Sec_Fetch_Dest="iframe") == 403
        assert ask(Sec_Fetch_Site=site, Sec_Fetch_Mode="navigate", Sec_Fetch_Dest="document") == 200
    for site in ("same-origin", "none"):
        assert ask(Sec_Fetch_Site=site, Sec_Fetch_Mode="no-cors") == 200
    for origin in FOREIGN:
        if origin.partition("://")[2] != HOST:
            assert ask(Origin=origin) == 403
    assert ask(Origin=OWN) == ask() == 200
    sent = {**door.bearer, "Origin": FOREIGN[0]}
    assert door.client.get("/", headers=sent).status_code == 200


def test_a_cookie_alone_neither_posts_nor_opens_a_websocket(door: Door) -> None:
    door.enter()
    assert door.client.post("/").status_code == 403
    with pytest.raises(WebSocketDenialResponse) as refused, door.client.websocket_connect(SOCKET):
        pass
    assert refused.value.status_code == 403
    with door.client.websocket_connect(SOCKET, headers={"Origin": OWN}) as websocket:
        assert websocket.receive_text() == "hello"


def test_a_websocket_without_token_is_refused_before_it_is_accepted(door: Door) -> None:
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        door.client.websocket_connect(SOCKET, headers={"Origin": OWN}),
    ):
        pass
    assert refused.value.status_code == 401


def test_every_answer_carries_the_policies(door: Door) -> None:
    for headers in (door.bearer, {}):
        answered = door.client.get("/", headers=headers).headers
        assert answered["content-security-policy"] == PAGE_POLICY
        assert answered["x-content-type-options"] == "nosniff"
        assert answered["referrer-policy"] == "no-referrer"
        assert answered["cache-control"] == "no-store"
    assert "unsafe" not in PAGE_POLICY
    assert "frame-ancestors 'self'" in PAGE_POLICY
    scene = door.client.get("/viewer/x/", headers=door.bearer).headers
    assert "frame-ancestors 'self'" in scene["content-security-policy"]
    assert scene["cache-control"] == "no-cache"


def test_only_a_server_that_nobody_else_can_reach_may_do_without_token() -> None:
    door = Door(auth=False)
    assert door.client.get("/").json()["owner"] == "open"
    assert door.client.post("/", headers={"Origin": "http://evil.example"}).status_code == 403
    with pytest.raises(ValidationError, match="auth cannot be switched off"):
        ServerSettings(auth=False, host=ANY_ADDRESS)


def test_a_given_token_must_be_long() -> None:
    with pytest.raises(ValidationError, match="at least 16"):
        ServerSettings(token=GIVEN[:5])
    assert Security(ServerSettings(token=GIVEN)).token == GIVEN
    assert GIVEN not in repr(ServerSettings(token=GIVEN))


def test_on_all_addresses_only_numbers_and_allowed_names_are_known() -> None:
    security = Security(ServerSettings(host=ANY_ADDRESS))
    assert security.is_known_host("192.168.1.7:8080")
    assert not security.is_known_host("rebound.example:8080")


def test_the_address_that_is_listened_on_is_known() -> None:
    assert Security(ServerSettings(host="fd00::7")).is_known_host("[fd00::7]:8080")
    assert Security(ServerSettings(host="Lab.example")).is_known_host("lab.example:8080")
    assert not Security(ServerSettings(host="fd00::7")).is_known_host("[fd00::8]:8080")
