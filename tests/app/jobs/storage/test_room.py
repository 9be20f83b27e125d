"""Nothing new is begun where there is no room, and nothing of it is written."""

import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.server.server_world import World, make_world

from app.jobs.storage.room import NoRoomError, Room, files_in
from app.settings import ServerSettings

MIB = 2**20


def test_files_are_counted_once_and_links_lead_nowhere(tmp_path: Path) -> None:
    data, elsewhere = tmp_path / "data", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "large").write_bytes(bytes(9000))
    (data / "runs" / "a").mkdir(parents=True)
    (data / "runs" / "a" / "first").write_bytes(bytes(1000))
    os.link(data / "runs" / "a" / "first", data / "runs" / "again")
    (data / ".hidden").write_bytes(bytes(30))
    (data / "runs" / "out").symlink_to(elsewhere)
    link = data / "runs" / "link"
    link.symlink_to(elsewhere / "large")
    assert sum(size for _, size in files_in(data)) == 1030 + link.lstat().st_size


def test_a_full_data_folder_is_told_in_numbers_and_measured_now_and_then(tmp_path: Path) -> None:
    seconds = [100.0]
    room = Room(ServerSettings(data_dir=tmp_path, data_gib=10 / 1024), clock=lambda: seconds[0])
    (tmp_path / "a").write_bytes(bytes(6 * MIB))
    room.require("A fit")
    assert room.left() == 4 * MIB
    told = r"An import needs 4.5 MiB: the data folder has 6.0 MiB, of at most 10.0 MiB \(PHYS"
    with pytest.raises(NoRoomError, match=told):
        room.require("An import", 9 * MIB // 2)
    (tmp_path / "b").write_bytes(bytes(5 * MIB))
    seconds[0] += 29.0
    room.require("A fit")  # It was measured a moment ago.
    seconds[0] += 2.0
    with pytest.raises(NoRoomError, match=r"A fit is not begun: the data folder has 11.0 MiB"):
        room.require("A fit")
    assert room.left() == -MIB


def test_a_full_disk_is_told_in_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = [3 * 2**30]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free[0]))
    room = Room(ServerSettings(data_dir=tmp_path / "not yet", keep_free_gib=2.0))
    room.require("A fit")
    told = r"An import needs 1.50 GiB: the disk has 3.00 GiB free, of which 2.00 GiB are kept"
    with pytest.raises(NoRoomError, match=told):
        room.require("An import", 3 * 2**29)
    free[0] = 2**30
    with pytest.raises(NoRoomError, match=r"A fit is not begun: the disk has 1.00 GiB free"):
        room.require("A fit")


def test_what_is_new_is_refused_before_anything_of_it_is_written(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (data_dir / "captures" / "raw").mkdir(parents=True)
    (data_dir / "captures" / "raw" / "large").write_bytes(bytes(2 * MIB))
    monkeypatch.setenv("PHYSHANDI_DATA_GIB", "0.001")
    world: World = make_world(data_dir)
    before = sorted(path for path in data_dir.rglob("*") if "audit" not in path.parts)
    client = world.script()
    captured: dict[str, Any] = {"source": "captures/raw", "name": "new"}
    wishes: tuple[tuple[str, dict[str, Any] | None], ...] = (
        ("runs", {"sequences": ["sheet"]}),
        ("uploads", {"name": "new", "files": [{"path": "a.zip", "size": 10}]}),
        ("captures/example", None),
        ("imports", captured),
        ("sequences/sheet/annotation", {}),
    )
    for address, body in wishes:
        answer = client.post(f"/api/v1/{address}", json=body)
        assert answer.status_code == 507, answer.text
        error = answer.json()["error"]
        assert error["code"] == "storage"
        assert "of at most 1.0 MiB (PHYSHANDI_DATA_GIB)" in error["message"]
    after = sorted(path for path in data_dir.rglob("*") if "audit" not in path.parts)
    assert after == before
