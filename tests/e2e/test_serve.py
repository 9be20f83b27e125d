"""`physhandi serve` as a user starts it: one address, a page, and an end without remains."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytestmark = pytest.mark.e2e
START = "from app.cli import main; main()"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    (tmp_path / "elsewhere").mkdir()
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


def test_the_printed_address_opens_and_the_server_ends_within_seconds(
    server: tuple[subprocess.Popen[str], str], tmp_path: Path
) -> None:
    process, url = server
    match = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=([\w-]{40,})", url)
    assert match is not None, url
    port, token = int(match[1]), match[2]
    connection = HTTPConnection("127.0.0.1", port, timeout=20)

    connection.request("GET", url.removeprefix(f"http://127.0.0.1:{port}"))
    moved = connection.getresponse()
    moved.read()
    assert (moved.status, moved.headers["location"]) == (303, "/")
    cookie = {"Cookie": moved.headers["set-cookie"].partition(";")[0]}
    connection.request("GET", "/", headers=cookie)
    page = connection.getresponse().read().decode()
    assert "towel_fold" in page
    for path in re.findall(r'(?:src|href)="(/[^"#]+)"', page):
        connection.request("GET", urlsplit(path).path, headers=cookie)
        answer = connection.getresponse()
        answer.read()
        assert answer.status == 200, path

    stream = HTTPConnection("127.0.0.1", port, timeout=20)
    stream.request("GET", "/api/v1/events", headers=cookie)
    events = stream.getresponse()
    assert events.readline().startswith(b"retry")
    connection.request("GET", "/?token=wrong-token-of-somebody")
    connection.getresponse().read()
    start = time.monotonic()
    process.send_signal(signal.SIGTERM)
    process.wait(timeout=10)
    assert time.monotonic() - start < 6
    for opened in (events, stream, connection):
        opened.close()
    log = (tmp_path / "log").read_text()
    assert token not in log
    assert "wrong-token-of-somebody" not in log
    assert "Traceback" not in log
    assert (tmp_path / "data" / "runs").is_dir()


def test_a_second_server_on_the_same_data_folder_says_who_has_it(
    server: tuple[subprocess.Popen[str], str], tmp_path: Path
) -> None:
    process, _ = server
    command = [sys.executable, "-c", START, "serve", "--port", "0"]
    second = subprocess.run(
        [*command, "--data-dir", str(tmp_path / "data")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=Path(__file__).parents[2],
    )
    assert second.returncode == 1
    assert f"process {process.pid}" in second.stderr
    assert "Traceback" not in second.stderr
