"""The example of docs/security.md in a real nginx: TLS, forwarded addresses, websockets, events."""

import getpass
import http.client
import json
import os
import re
import shutil
import socket
import ssl
import subprocess
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from support.server.server_world import TOKEN, World
from support.viewer.viewer_client import PROTOCOL
from support.waiting import LIMIT_S, until
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from app.graceful_server import GracefulServer
from app.security import Security
from app.server import create_app
from app.slow_requests import ImpatientProtocol

PAGE = Path(__file__).parents[3] / "docs/security.md"
NAME = "physhandi.example"
ORIGIN = f"https://{NAME}"
NEEDED = [program for program in ("nginx", "openssl") if not shutil.which(program)]
pytestmark = pytest.mark.skipif(bool(NEEDED), reason=f"needs {' and '.join(NEEDED)}")


@dataclass
class Proxy:
    """An nginx on loopback, in front of the server of a world."""

    world: World
    port: int
    trust: ssl.SSLContext
    root: str
    """Path below which it serves."""

    def wire(self, client: str = "127.0.0.1") -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), LIMIT_S, (client, 0))

    def send(
        self, method: str, path: str, body: str = "", client: str = "127.0.0.1", **headers: str
    ) -> http.client.HTTPResponse:
        connection = http.client.HTTPSConnection(NAME, timeout=LIMIT_S)
        connection.sock = self.trust.wrap_socket(self.wire(client), server_hostname=NAME)
        sent = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, self.root + path, body, sent | {"Connection": "close"})
        return connection.getresponse()

    def watch(self, session: str, **headers: str) -> ClientConnection:
        return connect(
            f"wss://{NAME}{self.root}/viewer/{session}",
            sock=self.wire(),
            ssl=self.trust,
            server_hostname=NAME,
            additional_headers=headers,
            subprotocols=[PROTOCOL],
            proxy=None,
            max_size=None,
        )

    def sign_in(self) -> str:
        """Come in as a browser does; returns its cookie."""
        answer = self.send("GET", f"/runs?token={TOKEN}")
        assert (answer.status, answer.headers["Location"]) == (303, f"{self.root}/runs")
        cookie = answer.headers["Set-Cookie"]
        kinds = {"Secure", "HttpOnly", "SameSite=strict", f"Path={self.root or '/'}"}
        assert kinds <= set(cookie.split("; "))
        return cookie.partition(";")[0]


@pytest.fixture(params=["", "/physhandi"])
def proxy(world: World, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Proxy]:
    root: str = request.param
    settings = world.settings.model_copy(update={"allowed_hosts": (NAME,), "root_path": root})
    app = create_app(
        settings,
        security=Security(settings),
        catalog=world.catalog,
        scheduler=world.scheduler,
        sessions=world.sessions,
    )
    config = uvicorn.Config(
        app, port=0, http=ImpatientProtocol, lifespan="off", log_level="error", ws_max_size=2**26
    )
    server = GracefulServer(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    until(lambda: server.started)
    listener = socket.create_server(("127.0.0.1", 0))
    upstream = server.servers[0].sockets[0].getsockname()[1]
    nginx = start_nginx(tmp_path, listener, upstream, root)
    trust = ssl.create_default_context(cafile=tmp_path / "cert.pem")
    try:
        yield Proxy(world, listener.getsockname()[1], trust, root)
    finally:
        nginx.terminate()
        nginx.wait()
        listener.close()
        app.state.stopping.set()
        server.should_exit = True
        thread.join()
        world.sessions.shutdown()


def start_nginx(
    folder: Path, listener: socket.socket, upstream: int, root: str
) -> subprocess.Popen[bytes]:
    """Start it with the text of the page, in which only addresses and places are others."""
    made = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -batch"
    wanted = ["-subj", f"/CN={NAME}", "-addext", f"subjectAltName=DNS:{NAME}"]
    files = ["-keyout", str(folder / "key.pem"), "-out", str(folder / "cert.pem")]
    subprocess.run(["openssl", *made.split(), *wanted, *files], check=True, capture_output=True)
    (example,) = re.findall(r"```nginx\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    place = f"127.0.0.1:{listener.getsockname()[1]}"
    for old, new in (
        ("listen 443 ssl;", f"listen {place} ssl;"),
        ("/etc/ssl/certs/physhandi.pem", f"{folder}/cert.pem"),
        ("/etc/ssl/private/physhandi.key", f"{folder}/key.pem"),
        ("        proxy_pass http://127.0.0.1:8080;", f"proxy_pass http://127.0.0.1:{upstream};"),
        ("    location / {", f"    location {root}/ {{"),
    ):
        assert example.count(old) == 1
        example = example.replace(old, new)
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    temporary = "".join(f"{kind}_temp_path {folder}/{kind};" for kind in kinds)
    log = folder / "nginx.log"
    user = f"user {getpass.getuser()};" if os.geteuid() == 0 else ""  # Else its workers are nobody.
    (folder / "nginx.conf").write_text(
        f"daemon off; {user} pid {folder}/pid; error_log {log} notice;"
        f"events {{}} http {{ access_log off; {temporary} {example} }}"
    )
    # It takes the socket over as from an nginx that it replaces, so that nobody else has the port.
    inherited = os.environ | {"NGINX": f"{listener.fileno()};"}
    command = ["nginx", "-p", str(folder), "-c", str(folder / "nginx.conf")]
    nginx = subprocess.Popen(
        command, env=inherited, pass_fds=[listener.fileno()], stderr=subprocess.DEVNULL
    )
    until(
        lambda: (
            (log.is_file() and "start worker process " in log.read_text())
            or nginx.poll() is not None
        )
    )
    assert nginx.poll() is None, log.read_text()
    return nginx


def told(answer: http.client.HTTPResponse) -> Any:
    return json.loads(answer.read())


def test_pages_changes_and_addresses_are_as_without_a_proxy(proxy: Proxy) -> None:
    assert proxy.send("GET", "/api/v1/runs").status == 401
    own = {"Cookie": proxy.sign_in()}
    page = proxy.send("GET", "/runs", **own)
    assert (page.status, b"fitted" in page.read()) == (200, True)
    assert page.headers["Strict-Transport-Security"] == "max-age=31536000"
    path, change = "/api/v1/runs/fitted", json.dumps({"name": "through nginx"})
    own["Content_Type"] = "application/json"
    for origin in (f"http://{NAME}", f"{ORIGIN}:444", "https://evil.example", "null"):
        assert proxy.send("PATCH", path, change, Origin=origin, **own).status == 403
    forged = {"X_Forwarded_For": "6.6.6.6", "Origin": ORIGIN}
    answer = proxy.send("PATCH", path, change, client="127.0.0.2", **forged, **own)
    assert (answer.status, told(answer)["name"]) == (200, "through nginx")
    log = proxy.world.settings.audit_dir / "audit.jsonl"
    # It is noted once it has been answered.
    until(lambda: json.loads(log.read_text().splitlines()[-1])["client"] == "127.0.0.2")
    assert proxy.send("POST", path, "x" * (2**20 + 1), Origin=ORIGIN, **own).status == 413
    # Nobody counts for others behind the same proxy.
    for _ in range(21):
        guessed = proxy.send("GET", "/api/v1/runs", client="127.0.0.3", Authorization="Bearer x")
    assert guessed.status == 429
    assert (
        proxy.send("GET", "/api/v1/runs", client="127.0.0.4", Authorization="Bearer x").status
        == 401
    )


def test_events_come_at_once(proxy: Proxy) -> None:
    script = {"Authorization": f"Bearer {TOKEN}"}
    events = proxy.send("GET", "/api/v1/events", **script)
    assert events.readline() == b"retry: 2000\n"
    events.close()


def test_a_live_scene_is_seen_by_its_own_page_alone(proxy: Proxy) -> None:
    cookie = proxy.sign_in()
    opened = proxy.send("GET", "/sequences/sheet/view", Cookie=cookie)
    session = opened.headers["Location"].removeprefix(f"{proxy.root}/live/").partition("?")[0]
    assert proxy.send("GET", f"/viewer/{session}/", Cookie=cookie).status == 200
    with proxy.watch(session, Cookie=cookie, Origin=ORIGIN) as scene:
        assert scene.subprotocol == PROTOCOL
        assert len(scene.recv(timeout=LIMIT_S)) > 10
    for headers in ({"Origin": f"http://{NAME}"}, {"Origin": "https://evil.example"}, {}):
        with pytest.raises(InvalidStatus) as refused:
            proxy.watch(session, Cookie=cookie, **headers)
        assert refused.value.response.status_code == 403
