"""Uploads: their pieces, what is refused of them, and where they end up."""

import json
import shutil
import stat
import struct
import zipfile
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient
from support.server.server_world import World
from support.waiting import until

from app.jobs.recordings import unpacking, upload_names, uploads
from app.jobs.recordings.background import BackgroundTasks
from app.jobs.recordings.unpacking import settle, unpack
from app.jobs.recordings.upload_names import check_names
from app.jobs.recordings.uploads import NoRoomError, UnknownUploadError, Uploads
from app.settings import ServerSettings
from physhandi.data.run_folder import JOB, read_yaml
from physhandi.errors import PhysHandiError, RunError, SequenceError, UsageError
from physhandi.progress import NullProgress
from physhandi.run import Run

LINK = (stat.S_IFLNK | 0o777) << 16


@pytest.mark.parametrize(
    "name",
    [
        "../out",
        "a/../../out",
        "/etc/passwd",
        "a//b",
        "C:/windows",
        "a\\b",
        "\\\\host\\share",
        "a\0b",
        "a\nb",
        "con",
        "a/NUL.txt",
        "x" * 5000,
        "a/" + "é" * 120,
        "/".join("abcdefghijklm"),
        "trailing.",
        "a /b",
        "a?b",
        "\u202egnp.exe",
        "",
    ],
)
def test_a_name_that_leads_elsewhere_is_refused_and_named(name: str) -> None:
    with pytest.raises(UsageError, match="Rename it") as told:
        check_names(["color/0.png", name])
    assert len(str(told.value)) < 250
    assert str(told.value).isprintable()


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["a.png", "a.png"], "is the same name"),
        (["A.png", "a.PNG"], "is the same name"),
        (["e\u0301.png", "\u00e9.png"], "is the same name"),
        (["a/b.png", "A"], "it is a file, and the folder of"),
    ],
)
def test_names_that_some_system_takes_for_one_are_refused(names: list[str], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        check_names(names)


def test_more_files_than_a_recording_has_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(upload_names, "MOST_FILES", 3)
    check_names(["a", "b", "c"])
    with pytest.raises(UsageError, match="more than 3 files"):
        check_names(["a", "b", "c", "d"])


def archive_of(path: Path, entries: Iterable[tuple[str, bytes]], **changes: Any) -> Path:
    """Write an archive, the last entry's fields changed."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries:
            archive.writestr(name, content)
        for field, value in changes.items():
            setattr(archive.infolist()[-1], field, value)
    return path


def tree(folder: Path) -> dict[str, bytes]:
    found = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def test_an_archive_is_unpacked_without_what_systems_leave_behind(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).bytes(3 << 20)
    entries = [("rec/color/0.png", noise), ("__MACOSX/._0.png", b"x"), ("rec/.DS_Store", b"y")]
    archive = archive_of(tmp_path / "a.zip", [*entries, ("rec/empty/", b"")])
    unpack(archive, tmp_path / "out", 4 << 20, NullProgress())
    assert tree(tmp_path / "out") == {"rec/color/0.png": noise}


@pytest.mark.parametrize(
    ("entries", "changes", "told"),
    [
        ([("../evil", b"x")], {}, "leads out of its folder"),
        ([("a", b"x"), ("a/b", b"x")], {}, "the folder of"),
        ([("link", b"/etc")], {"external_attr": LINK}, "a link or a device"),
        ([("pipe", b"")], {"external_attr": (stat.S_IFIFO | 0o666) << 16}, "a link or a device"),
        ([("a", b"x")], {"flag_bits": 1}, "is encrypted"),
        ([("a", bytes(2 << 20))], {}, "more than the 0.0 GiB"),
        ([("a", b"x")], {"compress_type": zipfile.ZIP_LZMA}, "packed in a rare way"),
        ([("a", b"abcabcabc" * 99)], {"file_size": 5}, "larger than the archive says|damaged"),
        ([("a", b"abc")], {"CRC": 7}, "The archive is damaged"),
    ],
)
def test_a_hostile_archive_is_refused_and_nothing_lies_outside(
    tmp_path: Path, entries: list[tuple[str, bytes]], changes: dict[str, Any], told: str
) -> None:
    place = tmp_path / "incoming"
    place.mkdir()
    archive = archive_of(place / "a.zip", entries, **changes)
    with pytest.raises(UsageError, match=told):
        unpack(archive, place / "out", 1 << 20, NullProgress())
    assert list(tmp_path.iterdir()) == [place]


def test_bombs_are_refused_before_they_are_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bomb = archive_of(tmp_path / "bomb.zip", [("a", bytes(200 << 20))])
    assert bomb.stat().st_size < 1 << 20
    with pytest.raises(UsageError, match="more than 100 times as large"):
        unpack(bomb, tmp_path / "out", 1 << 30, NullProgress())
    # A list of a million entries is not even read: its length is told at the end.
    long = tmp_path / "long.zip"
    for end in (
        struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 9, 9, 50_000_000, 0, 0),
        struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 9, 9, 50_000_000, 0)
        + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 9, 9, 2**32 - 1, 0, 0),
    ):
        long.write_bytes(bytes(1000) + end)
        with pytest.raises(UsageError, match="more than 20,000 files"):
            unpack(long, tmp_path / "out", 1 << 30, NullProgress())
    long.write_bytes(b"no archive at all")
    with pytest.raises(UsageError, match="no whole zip archive"):
        unpack(long, tmp_path / "out", 1 << 30, NullProgress())
    assert not (tmp_path / "out").exists()


@pytest.fixture
def places(data_dir: Path) -> dict[str, Path]:
    return {kind: data_dir / kind for kind in ("captures", "sequences", "runs")}


def test_a_sequence_and_a_run_are_checked_and_a_recording_waits_for_its_import(
    tmp_path: Path, places: dict[str, Path], sheet_folder: Path, fitted_folder: Path
) -> None:
    def put(source: Path, name: str) -> dict[str, str]:
        shutil.copytree(source, tmp_path / "in" / "folder" / "inner")
        return settle(tmp_path / "in", name, places, NullProgress())

    assert put(sheet_folder, "mine") == {"kind": "sequences", "name": "mine"}
    assert tree(places["sequences"] / "mine") == tree(sheet_folder)
    shutil.rmtree(tmp_path / "in")
    ticket = fitted_folder.parent / "with_ticket"
    shutil.copytree(fitted_folder, ticket)
    (ticket / "queued.json").write_text("{}")
    (ticket / "attempts" / "1" / "ckpt").mkdir(exist_ok=True)
    assert put(ticket, "theirs") == {"kind": "runs", "name": "theirs"}
    run = Run.open(places["runs"] / "theirs")
    run.verify()
    assert not (run.folder / "queued.json").exists()
    assert not (run.folder / "attempts" / "1" / "ckpt").exists()
    # Its recording is looked for here, wherever the other machine had it.
    assert list(run.sequences) == [str(places["sequences"] / "sheet")]
    shutil.rmtree(tmp_path / "in")
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "take.bag").write_bytes(b"#ROSBAG")
    assert put(bag, "table") == {"kind": "captures", "name": "table/take.bag"}


def test_what_is_damaged_or_has_a_taken_name_is_put_nowhere(
    tmp_path: Path, places: dict[str, Path], sheet_folder: Path, fitted_folder: Path
) -> None:
    before = tree(places["sequences"])
    sheet = tmp_path / "sheet"
    shutil.copytree(sheet_folder, sheet)
    with pytest.raises(UsageError, match="There is a 'sheet' in sequences already"):
        settle(sheet, "sheet", places, NullProgress())
    array = np.load(sheet / "control.npy")
    array[1, 0, 0] = np.nan
    np.save(sheet / "control.npy", array)
    with pytest.raises(SequenceError, match=r"control\.npy"):
        settle(sheet, "other", places, NullProgress())
    run = tmp_path / "run"
    shutil.copytree(fitted_folder, run)
    (rollout,) = run.glob("attempts/1/out/sequences/*/rollout.npy")
    rollout.write_bytes(rollout.read_bytes()[:-1] + b"!")
    with pytest.raises(RunError, match=r"rollout\.npy"):
        settle(run, "broken", places, NullProgress())
    job = read_yaml(run / JOB)
    job["sequences"] = ["/somewhere/.."]
    (run / JOB).write_text(json.dumps(job))
    with pytest.raises(UsageError, match="is no place of a sequence or run"):
        settle(run, "broken", places, NullProgress())
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(UsageError, match="holds no files"):
        settle(empty, "empty", places, NullProgress())
    assert tree(places["sequences"]) == before
    assert list(places["runs"].iterdir()) == []


def announce(client: TestClient, name: str, files: dict[str, bytes]) -> dict[str, Any]:
    listed = [{"path": path, "size": len(content)} for path, content in files.items()]
    answer = client.post("/api/v1/uploads", json={"name": name, "files": listed})
    assert answer.status_code == 201, answer.text
    return answer.json()


def piece(client: TestClient, upload: dict[str, Any], number: int, at: int, content: bytes) -> Any:
    where = f"/api/v1/uploads/{upload['id']}/files/{number}"
    return client.put(where, params={"offset": at}, content=content)


def test_a_sequence_is_sent_piece_by_piece_over_a_restart(world: World, sheet_folder: Path) -> None:
    client = world.script()
    files = tree(sheet_folder) | {".hidden": b"not wanted"}
    upload = announce(client, "sent", files)
    sent = [file["path"] for file in upload["files"]]
    assert ".hidden" not in sent
    assert upload["total"] == sum(len(files[path]) for path in sent)
    first = files[sent[0]]
    assert piece(client, upload, 0, 0, first[:10]).json() == {"received": 10}
    assert piece(client, upload, 0, 0, first[:10]).status_code == 409
    assert "goes on at byte 10" in piece(client, upload, 0, 11, first[11:]).text
    assert client.post(f"/api/v1/uploads/{upload['id']}/finish", json={}).status_code == 409
    # Another server finds what the first one got.
    later = Uploads(world.settings, BackgroundTasks())
    (waiting,) = later.unfinished()
    assert (waiting["received"], waiting["name"]) == (10, "sent")
    for number, path in enumerate(sent):
        begin = 10 if number == 0 else 0
        if files[path][begin:]:
            assert piece(client, upload, number, begin, files[path][begin:]).status_code == 200
    assert piece(client, upload, 0, len(first), b"more").status_code == 422
    address = f"/api/v1/uploads/{upload['id']}"
    assert client.post(f"{address}/finish", json={"name": "sheet"}).status_code == 202
    until(lambda: client.get(address).json()["state"] == "failed")
    assert "There is a 'sheet' in sequences already" in client.get(address).json()["reason"]
    assert client.post(f"{address}/finish", json={}).status_code == 202
    until(lambda: client.get(address).json()["state"] != "checking")
    told = client.get(address).json()
    assert told["result"] == {"kind": "sequences", "name": "sent"}, told
    assert tree(world.settings.sequence_dir / "sent") == tree(sheet_folder)
    assert list((world.settings.data_dir / "incoming").iterdir()) == []
    assert client.get("/api/v1/sequences/sent").status_code == 200


def test_an_archive_of_a_recording_is_sent_and_can_be_imported(
    world: World, tmp_path: Path
) -> None:
    client = world.script()
    archive = archive_of(tmp_path / "take.zip", [("take/color/0.png", b"picture")]).read_bytes()
    upload = announce(client, "take", {"take.zip": archive})
    for at in (0, 50):
        piece(client, upload, 0, at, archive[at:50] if at == 0 else archive[at:])
    client.post(f"/api/v1/uploads/{upload['id']}/finish", json={})
    until(lambda: client.get(f"/api/v1/uploads/{upload['id']}").json()["state"] == "done")
    entries = client.get("/api/v1/captures", params={"folder": "captures"}).json()["entries"]
    assert [entry["place"] for entry in entries] == ["captures/take"]
    # Who sent it is noted, but not its pieces.
    noted = (world.settings.audit_dir / "audit.jsonl").read_text().splitlines()
    assert [(line["what"], line["upload_id"]) for line in map(json.loads, noted)] == [
        ("POST /api/v1/uploads", upload["id"]),
        ("POST /api/v1/uploads/{upload_id}/finish", upload["id"]),
    ]


def test_what_is_too_large_or_finds_no_room_is_refused_before_it_is_sent(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ServerSettings(data_dir=data_dir, upload_gib=1)
    taken = Uploads(settings, BackgroundTasks())
    with pytest.raises(UsageError, match="this server takes 1 GiB at most"):
        taken.begin("big", [("a", 2**29), ("b", 2**29 + 1)])
    disk = SimpleNamespace(total=100 << 30, free=5 << 30)
    monkeypatch.setattr(uploads.shutil, "disk_usage", lambda _: disk)
    with pytest.raises(NoRoomError, match="uploads leave 5% of it free"):
        taken.begin("small", [("a", 1 << 20)])
    disk.free += 3 << 20
    first = taken.begin("small", [("a", 2 << 20)])
    # What was announced before counts, too.
    with pytest.raises(NoRoomError):
        taken.begin("another", [("a", 2 << 20)])
    disk.free = 5 << 30
    with pytest.raises(NoRoomError):
        taken.append(first["id"], 0, 0, b"x")
    taken.remove(first["id"])
    assert taken.unfinished() == []


def test_routes_refuse_what_is_no_upload(world: World) -> None:
    client = world.script()
    files = [{"path": "a", "size": 1}]
    for name, listed in (("../x", files), ("ok", []), ("ok", [{"path": "../a", "size": 1}])):
        answer = client.post("/api/v1/uploads", json={"name": name, "files": listed})
        assert answer.status_code == 422, name
    for method, path in (("GET", ""), ("DELETE", ""), ("POST", "/finish")):
        content = {} if method == "POST" else None
        address = f"/api/v1/uploads/0123456789abcdef{path}"
        assert client.request(method, address, json=content).status_code == 404
    upload = announce(client, "one", {"a": b"x"})
    assert piece(client, upload, 1, 0, b"x").status_code == 404
    assert piece(client, upload, 0, 0, bytes(2**20 + 1)).status_code == 413


@pytest.mark.parametrize(
    "change", [{"name": "a\0b"}, {"files": [["a", -1]]}, {"files": [["a", 2**70]]}]
)
def test_an_upload_whose_description_is_damaged_is_none(
    tmp_path: Path, change: dict[str, object]
) -> None:
    settings = ServerSettings(data_dir=tmp_path)
    sent = Uploads(settings, BackgroundTasks()).begin("take", [("a", 3)])
    about = tmp_path / "incoming" / sent["id"] / "upload.json"
    restarted = Uploads(settings, BackgroundTasks())
    assert restarted.describe(sent["id"]) == sent
    about.write_text(json.dumps({"name": "take", "files": [["a", 3]]} | change))
    again = Uploads(settings, BackgroundTasks())
    assert again.unfinished() == []
    with pytest.raises(UnknownUploadError):
        again.describe(sent["id"])


def test_an_upload_that_was_left_for_a_week_is_removed(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = Uploads(ServerSettings(data_dir=data_dir), BackgroundTasks())
    old = taken.begin("old", [("a", 1)])
    taken.begin("new", [("a", 1)])
    assert [one["name"] for one in taken.unfinished()] == ["old", "new"]
    now = uploads.time.time() + 8 * 86_400
    monkeypatch.setattr(uploads, "time", SimpleNamespace(time=lambda: now))
    taken.begin("newest", [("a", 1)])
    assert [one["name"] for one in taken.unfinished()] == ["newest"]
    with pytest.raises(PhysHandiError, match="There is no upload"):
        taken.describe(old["id"])


def test_what_is_kept_of_a_run_is_what_runs_have(fitted_folder: Path) -> None:
    names = {path.name for path in fitted_folder.iterdir()}
    assert {JOB, "run.yaml", "current", "attempts"} <= names & unpacking._OF_RUNS
