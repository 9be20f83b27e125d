"""Shared pages over HTTP: who sees them, for how long, and what else they open."""

import json
from pathlib import Path

import pytest
from support.server.server_world import World, make_world

from app.exports import shares
from app.exports.request import FileRequest

SHARES = "/api/v1/runs/fitted/shares"


def test_a_shared_page_is_seen_without_token_until_it_is_withdrawn(
    world: World, made: list[FileRequest]
) -> None:
    owner, stranger = world.browser(), world.client(Accept="text/html")
    share = owner.post(f"{SHARES}?color=strain&theme=dark").json()
    assert (share["run"], share["name"]) == ("fitted", "a sheet")
    assert share["query"] == "color=strain&theme=dark"
    seen = stranger.get(share["url"])
    assert seen.status_code == 200
    assert seen.headers["content-type"].startswith("text/html")
    assert len(seen.content) == share["bytes"]
    exported = owner.get("/api/v1/runs/fitted/export?format=html&color=strain&theme=dark")
    assert seen.content == exported.content
    assert [order.format for order in made] == ["html"]
    # Whatever is in the page, it can ask this server for nothing.
    policy = seen.headers["content-security-policy"].split("; ")
    assert "sandbox allow-scripts allow-pointer-lock" in policy
    assert "connect-src data: blob:" in policy
    assert not any("'self'" in part for part in policy if not part.startswith("frame-ancestors"))
    assert seen.headers["x-robots-tag"] == "noindex"
    assert seen.headers["cache-control"] == "no-store"
    assert "set-cookie" not in seen.headers

    other = owner.post(SHARES).json()
    assert other["url"] != share["url"]
    listed = owner.get("/api/v1/shares?run=fitted").json()
    assert {item["id"] for item in listed} == {share["id"], other["id"]}
    assert owner.get("/api/v1/shares?run=another").json() == []

    # A server that is started anew, with another token, shows them as before.
    again = make_world(world.settings.data_dir)
    assert again.client().get(share["url"]).content == seen.content
    assert owner.delete(f"/api/v1/shares/{share['id']}").status_code == 204
    gone = again.client(Accept="text/html").get(share["url"])
    assert gone.status_code == 404
    assert "Nothing is shared here" in gone.text
    assert "assets/" not in gone.text  # Which a stranger could not load.
    assert owner.delete(f"/api/v1/shares/{share['id']}").status_code == 404
    assert stranger.get(other["url"]).status_code == 200
    assert [item["id"] for item in owner.get("/api/v1/shares").json()] == [other["id"]]
    assert [path.name for path in (world.settings.data_dir / "shares").iterdir()] == [other["id"]]


def test_a_shared_page_opens_nothing_else(world: World, made: list[FileRequest]) -> None:
    url = world.browser().post(SHARES).json()["url"]
    stranger = world.client()
    for method, path in (
        ("POST", SHARES),
        ("GET", "/api/v1/shares"),
        ("DELETE", url.replace("/shared/", "/api/v1/shares/")),
        ("POST", url),
        ("DELETE", url),
        ("GET", "/runs/fitted/replay"),
        ("GET", "/shared"),
    ):
        assert stranger.request(method, path).status_code == 401, (method, path)
    for path in (
        "/shared/",
        "/shared/" + "A" * 32,
        f"{url}/",
        f"{url}/share.json",
        "/shared/..%2f..%2fruns%2ffitted",
        "/shared/%2e%2e/api/v1/runs",
        f"{url.lower()}x",
    ):
        answer = stranger.get(path)
        assert answer.status_code in {401, 404}, path
        assert len(answer.content) < 2_000, path
    assert stranger.get(url, headers={"Host": "elsewhere.example"}).status_code == 400
    assert stranger.get(url).status_code == 200


def test_shares_go_with_their_run(world: World, made: list[FileRequest]) -> None:
    owner = world.browser()
    url = owner.post(SHARES).json()["url"]
    assert owner.delete("/api/v1/runs/fitted").status_code == 204
    assert world.client().get(url).status_code == 404


def test_what_cannot_be_shared_is_refused_and_leaves_nothing(
    world: World, made: list[FileRequest], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    owner, folder = world.browser(), world.settings.data_dir / "shares"
    assert owner.post("/api/v1/runs/nothing/shares").status_code == 404
    wrong = owner.post(f"{SHARES}?color=pink")
    assert (wrong.status_code, "color" in wrong.text) == (422, True)
    assert not folder.exists()

    def is_full(path: Path, _: object) -> None:
        path.write_text("{")
        raise OSError(28, "No space left on device", str(path))

    with monkeypatch.context() as full:
        full.setattr(shares, "write_json", is_full)
        assert owner.post(SHARES).status_code == 507
    assert list(folder.iterdir()) == []
    first = owner.post(SHARES).json()
    monkeypatch.setattr(shares, "MOST_SHARES", 1)
    refused = owner.post(SHARES)
    assert (refused.status_code, "Withdraw some" in refused.text) == (422, True)
    # A damaged one is not shown, and keeps no other from being listed.
    monkeypatch.setattr(shares, "MOST_SHARES", 9)
    damaged = owner.post(SHARES).json()
    about = folder / damaged["id"] / "share.json"
    about.write_text(json.dumps({**json.loads(about.read_text()), "run": ["fitted"]}))
    assert world.client().get(damaged["url"]).status_code == 404
    assert [item["id"] for item in owner.get("/api/v1/shares").json()] == [first["id"]]
    assert owner.delete(f"/api/v1/shares/{damaged['id']}").status_code == 204
