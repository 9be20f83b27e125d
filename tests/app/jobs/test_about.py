"""Name, tags and note of a run, as a user changes them."""

from typing import Any

import pytest
import yaml
from starlette.testclient import TestClient
from support.server.server_world import World

from physhandi.data import files
from physhandi.run import Run

ADDRESS = "/api/v1/runs/fitted"
HOSTILE = "</textarea><script>alert('note')</script>\nsecond line: {{ 7 * 7 }}"


@pytest.fixture
def client(world: World) -> TestClient:
    return world.script()


def test_name_tags_and_note_are_written_and_listed(world: World, client: TestClient) -> None:
    created = world.catalog.run("fitted").created
    asked = {"name": " Wider δ ", "tags": ["paper", "wide", "paper"], "note": "Two\r\nlines "}
    told = client.patch(ADDRESS, json=asked).json()
    assert (told["name"], told["tags"], told["note"]) == (
        "Wider δ",
        ["paper", "wide"],
        "Two\nlines",
    )
    folder = world.catalog.run("fitted").folder
    assert yaml.safe_load((folder / "run.yaml").read_text("utf-8")) == {
        "format": "physhandi-run/1",
        "name": "Wider δ",
        "label": "paper, wide",
        "note": "Two\nlines",
        "created": created,
    }
    again = Run.open(folder)
    assert (again.name, again.note) == ("Wider δ", "Two\nlines")
    for query in ("tag:wide", "lines"):
        found = client.get("/api/v1/runs", params={"q": query}).json()["runs"]
        assert [run["id"] for run in found] == ["fitted"]


def test_what_is_left_out_stays(client: TestClient) -> None:
    client.patch(ADDRESS, json={"tags": ["one"], "note": "kept"})
    told = client.patch(ADDRESS, json={"name": "another"}).json()
    assert (told["name"], told["tags"], told["note"]) == ("another", ["one"], "kept")
    told = client.patch(ADDRESS, json={"tags": [], "note": ""}).json()
    assert (told["name"], told["tags"], told["note"]) == ("another", [], "")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "   "}, "a run needs a name"),
        ({"name": "x" * 121}, "120"),
        ({"name": "two\nlines"}, "line break"),
        ({"tags": ["two words"]}, "one word"),
        ({"tags": ["a,b"]}, "one word"),
        ({"tags": [""]}, "one word"),
        ({"tags": ["x" * 41]}, "40"),
        ({"tags": [f"t{i}" for i in range(21)]}, "20"),
        ({"note": "x" * 4001}, "4000"),
        ({"note": "a\0b"}, "cannot be printed"),
        ({"note": "\u202ereversed"}, "cannot be printed"),
        ({"created": "yesterday"}, "created"),
    ],
)
def test_what_is_too_long_or_not_text_is_refused(
    still_world: World, changes: dict[str, Any], words: str
) -> None:
    client = still_world.script()
    before = client.get(ADDRESS).json()
    answer = client.patch(ADDRESS, json=changes)
    assert answer.status_code == 422
    assert words in answer.text
    assert client.get(ADDRESS).json() == before


def test_bundled_and_unknown_runs_are_refused_and_the_gate_stays_shut(
    world: World, client: TestClient
) -> None:
    answer = client.patch("/api/v1/runs/towel_fold_quick", json={"name": "mine"})
    assert (answer.status_code, "stays as it is" in answer.text) == (409, True)
    assert client.patch("/api/v1/runs/nothing", json={"name": "x"}).status_code == 404
    assert world.client().patch(ADDRESS, json={"name": "x"}).status_code in {401, 403}
    foreign = world.browser()
    foreign.headers["Origin"] = "http://elsewhere.example"
    assert foreign.patch(ADDRESS, json={"name": "x"}).status_code == 403


def test_a_page_shows_the_note_as_plain_text(world: World, client: TestClient) -> None:
    assert client.patch(ADDRESS, json={"note": HOSTILE, "tags": ["<b>"]}).status_code == 200
    page = world.browser().get("/runs/fitted").text
    assert "<script>alert" not in page
    assert "<b>" not in page
    assert page.count("&lt;script&gt;alert(&#39;note&#39;)") == 2  # shown, and in the form
    assert "{{ 7 * 7 }}" in page
    bundled = world.browser().get("/runs/towel_fold_quick").text
    assert "data-edit-about" not in bundled


def test_a_full_disk_leaves_what_was_there(
    world: World, client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    client.patch(ADDRESS, json={"note": "first"})
    folder = world.catalog.run("fitted").folder
    before = (folder / "run.yaml").read_bytes()

    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", fail)
    with pytest.raises(OSError, match="No space left"):
        Run.open(folder).rename(note="second")
    assert (folder / "run.yaml").read_bytes() == before
    assert [path.name for path in folder.iterdir() if ".tmp" in path.name] == []


def test_a_page_begins_with_the_errors_of_the_run(world: World, client: TestClient) -> None:
    error = client.get(ADDRESS).json()["track_error_fitted"]
    assert error > 0
    page = world.browser().get("/runs/fitted").text
    assert f"<dd>{1000 * error:.2f} mm</dd>" in page
    assert '<li><a href="runs">Runs</a></li>' in page
