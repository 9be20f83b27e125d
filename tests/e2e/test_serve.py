"""`physhandi serve` as a user starts it: one address, a page, and an end without remains."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from urllib.parse import urljoin, urlsplit

import pytest
from support.browser.small_pictures import place_pictures
from support.waiting import LIMIT_S

pytestmark = pytest.mark.e2e
START = "from app.cli import main; main()"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    (tmp_path / "elsewhere").mkdir()
    place_pictures(tmp_path / "data")
    command = [sys.executable, "-c", START, "serve", "--port", "0", "--data-dir", "../data"]
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen(
            command,
            cwd=tmp_path / "elsewhere",
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
        )
        assert process.stdout is not None
        yield process, process.stdout.readline().strip()
        process.kill()
        process.wait()
        process.stdout.close()


def test_the_printed_address_opens_and_the_server_ends_while_it_is_followed(
    server: tuple[subprocess.Popen[str], str], tmp_path: Path
) -> None:
    process, url = server
    match = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=([\w-]{40,})", url)
    assert match is not None, url
    port, token = int(match[1]), match[2]
    cookie: dict[str, str] = {}

    def ask(path: str) -> tuple[HTTPConnection, HTTPResponse]:
        connection = HTTPConnection("127.0.0.1", port, timeout=LIMIT_S)
        connection.request("GET", path, headers=cookie)
        return connection, connection.getresponse()

    def get(path: str) -> tuple[HTTPResponse, bytes]:
        """Ask by a connection of its own: the server hangs up on one that was idle for long."""
        connection, answer = ask(path)
        with closing(connection):
            return answer, answer.read()

    moved, _ = get(url.removeprefix(f"http://127.0.0.1:{port}"))
    assert (moved.status, moved.headers["location"]) == (303, "/")
    cookie["Cookie"] = moved.headers["set-cookie"].partition(";")[0]
    page = get("/")[1].decode()
    assert "towel_fold" in page
    addresses = re.findall(r'(?:src|href)="([^"#]+)"', page)
    assert len(addresses) > 20
    for address in addresses:
        assert get(urlsplit(urljoin(url, address)).path)[0].status == 200, address

    stream, events = ask("/api/v1/events")
    assert events.readline().startswith(b"retry")
    connection, answer = ask("/?token=wrong-token-of-somebody")
    answer.read()
    process.send_signal(signal.SIGTERM)
    process.wait(LIMIT_S)  # If it waited for the stream's reader, it would never end.
    for opened in (events, stream, connection):
        opened.close()
    log = (tmp_path / "log").read_text()
    assert token not in log
    assert "wrong-token-of-somebody" not in log
    assert "Traceback" not in log
    assert (tmp_path / "data" / "runs").is_dir()


def test_a_second_server_on_the_same_data_folder_says_who_has_it(served) -> None:
    command = [sys.executable, "-c", START, "serve", "--port", "0"]
    second = subprocess.run(
        [*command, "--data-dir", str(served.data_dir)],
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
        cwd=Path(__file__).parents[2],
    )
    assert second.returncode == 1
    assert f"process {served.process_id}" in second.stderr
    assert "Traceback" not in second.stderr
