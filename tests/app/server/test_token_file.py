"""Files that keep tokens over restarts."""

import os
import stat
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import ValidationError

from app.security import Security
from app.settings import ServerSettings
from app.token_file import read_or_make_token
from physhandi.errors import UsageError

TOKEN = "a.kept-token_of~letters0"  # noqa: S105


def kept(path: Path, content: str, mode: int = 0o600) -> Path:
    path.write_text(content)
    path.chmod(mode)
    return path


def test_a_missing_file_is_made_for_its_owner_alone_and_then_kept(tmp_path: Path) -> None:
    path = tmp_path / "token"
    before = os.umask(0)
    try:
        made = read_or_make_token(path)
    finally:
        os.umask(before)
    assert len(made) >= 40
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert path.read_text() == made + "\n"
    assert read_or_make_token(path) == made
    assert [item.name for item in tmp_path.iterdir()] == ["token"]
    assert read_or_make_token(tmp_path / "other") != made


def test_servers_that_make_it_at_once_agree(tmp_path: Path) -> None:
    found: list[str] = []
    barrier = threading.Barrier(8)

    def make() -> None:
        barrier.wait()
        found.append(read_or_make_token(tmp_path / "token"))

    threads = [threading.Thread(target=make) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    assert len(set(found)) == 1


def test_what_is_written_there_by_hand_is_taken(tmp_path: Path) -> None:
    assert read_or_make_token(kept(tmp_path / "token", f" {TOKEN}\r\n")) == TOKEN
    assert read_or_make_token(kept(tmp_path / "own", TOKEN, 0o400)) == TOKEN


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602, 0o610, 0o601])
def test_a_file_that_others_may_use_is_refused(tmp_path: Path, mode: int) -> None:
    path = kept(tmp_path / "token", TOKEN, mode)
    with pytest.raises(UsageError, match=rf"others may use it \(mode {mode:o}\).*chmod 600 ") as no:
        read_or_make_token(path)
    assert TOKEN not in str(no.value)


def test_a_file_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = kept(tmp_path / "token", TOKEN)
    monkeypatch.setattr(os, "geteuid", lambda: path.stat().st_uid + 1)
    with pytest.raises(UsageError, match="belongs to another user"):
        read_or_make_token(path)


@pytest.mark.parametrize(
    "content",
    ["", "short", f"{TOKEN} {TOKEN}", f"{TOKEN}\n{TOKEN}", "x" * 257, "ü" * 20, "a&b" * 9],
)
def test_what_is_no_token_is_refused_and_kept(tmp_path: Path, content: str) -> None:
    path = kept(tmp_path / "token", content)
    with pytest.raises(UsageError, match="holds no token"):
        read_or_make_token(path)
    assert path.read_text() == content


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_file_is_refused_without_waiting_for_it(
    tmp_path: Path, make: Callable[[Path], None]
) -> None:
    make(tmp_path / "token")
    with pytest.raises(UsageError, match="no file that could hold a token"):
        read_or_make_token(tmp_path / "token")


def test_a_file_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_or_make_token(tmp_path / "nowhere" / "token")


def test_cookies_and_addresses_outlive_the_server_with_its_token(tmp_path: Path) -> None:
    settings = ServerSettings(
        token_file=tmp_path / "token", read_only_token_file=tmp_path / "read_only"
    )
    first, second = Security(settings), Security(settings)
    assert second.token == first.token != second.read_only_token == first.read_only_token
    for may_change in (True, False):
        visitor = second.browser(first.new_pass(may_change=may_change))
        assert visitor is not None
        assert visitor.may_change == may_change
    (tmp_path / "read_only").unlink()
    assert Security(settings).browser(first.new_pass(may_change=False)) is None


def test_settings_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "token"
    with pytest.raises(ValidationError, match="token and token_file are both set"):
        ServerSettings(token=TOKEN, token_file=path)
    with pytest.raises(ValidationError, match="read_only_token_file protects nothing"):
        ServerSettings(auth=False, read_only_token_file=path)
    with pytest.raises(UsageError, match="token with which everything may be changed"):
        Security(ServerSettings(token_file=path, read_only_token_file=path))
