"""What people could reach at commit 57a38d7 is still there: commands, addresses, keys, controls.

More is welcome. What is dropped on purpose is named in CHANGELOG.md, in backticks and just as the
failing test writes it, with what serves in its place; ``name …`` stands for all that begins so.
"""

import json
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
import pytest
import yaml
from fastapi import FastAPI
from pydantic import SecretStr, ValidationError
from safetensors import safe_open
from starlette.testclient import TestClient
from support.inputs.old_data import FIXTURE, OldFolder, command, read_record, settle, unpack
from support.server import surface
from support.server.server_world import ORIGIN, TOKEN
from support.viewer.viewer_client import ViewerClient

from app import cli
from app.exports.permalink import state_from_query
from app.jobs.catalog import Catalog
from app.keys import KEYS
from app.server import create_app
from app.settings import ServerSettings
from app.viewer.compare.request import CompareAsk
from app.viewer.physics.presets import builtin_presets
from physhandi import pipeline
from physhandi.errors import UsageError
from physhandi.run import Run

CHANGELOG = FIXTURE.parents[1] / "CHANGELOG.md"


def assert_kept(kind: str, then: Iterable[str], now: Iterable[str]) -> None:
    """Require that nothing is lost but what the changelog names."""
    told = CHANGELOG.read_text(encoding="utf-8")
    there = set(now)
    lost = [name for name in then if name not in there and not _is_told(name, told)]
    assert not lost, (
        f"{kind}: people could reach this at commit 57a38d7, and it is gone:\n"
        + "".join(f"    {name}\n" for name in lost)
        + f"Bring it back, or name it in CHANGELOG.md as `{lost[0]}` with what serves in its place."
    )


def _is_told(name: str, told: str) -> bool:
    words = name.split(" ")
    beginnings = [" ".join([*words[:count], "…"]) for count in range(1, len(words))]
    return any(f"`{text}`" in told for text in (name, *beginnings))


@pytest.fixture(scope="module")
def then() -> dict[str, Any]:
    """What there was."""
    return read_record("surface")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder of its own, to which a fit is added."""
    return settle(unpack(tmp_path_factory.mktemp("surface")))


@pytest.fixture(scope="module")
def server(data: Path) -> FastAPI:
    """The application as it is served."""
    settings = ServerSettings(data_dir=data, token=SecretStr(TOKEN))
    return create_app(settings, catalog=Catalog(settings, bundled=data / "nothing-bundled"))


@pytest.fixture(scope="module")
def client(server: FastAPI) -> TestClient:
    return TestClient(server, ORIGIN, headers={"Authorization": f"Bearer {TOKEN}"})


def test_a_loss_is_told_unless_the_changelog_names_it() -> None:
    assert_kept("things", ["a b", "c"], ["c", "d", "a b"])
    with pytest.raises(AssertionError, match="    a thing that no changelog names\n"):
        assert_kept("things", ["a thing that no changelog names"], ["another"])
    assert _is_told("fly --high", "* `fly --high` is gone")
    assert _is_told("fly --high", "* `fly …` is gone")
    assert not _is_told("fly --high", "* `fly` and `fly --higher` are gone")


def test_commands_and_their_options(then: dict[str, Any]) -> None:
    assert_kept("commands", then["commands"], surface.commands(cli.main))


def test_addresses_and_what_they_take(then: dict[str, Any], server: FastAPI) -> None:
    assert_kept("addresses", then["addresses"], surface.addresses(server))


def test_answers_of_the_api(then: dict[str, Any], old: OldFolder, client: TestClient) -> None:
    assert_kept("answers", then["answers"], surface.answers(client, old.ids["grasp"]))


def test_settings_and_profiles(then: dict[str, Any], client: TestClient) -> None:
    assert_kept("settings", then["settings"], surface.settings(client))


def test_settings_of_the_server(then: dict[str, Any]) -> None:
    now = [f"PHYSHANDI_{name.upper()}" for name in ServerSettings.model_fields]
    assert_kept("variables", then["server settings"], now)


def test_keys(then: dict[str, Any]) -> None:
    assert_kept("keys", then["keys"], surface.keys(KEYS))


def test_presets(then: dict[str, Any]) -> None:
    assert_kept("presets", then["presets"], [preset.name for preset in builtin_presets()])


def test_fields_of_links(then: dict[str, Any], client: TestClient) -> None:
    readers: dict[str, Callable[[dict[str, str]], object]] = {
        "links": state_from_query,
        "links of comparisons": CompareAsk.model_validate,
    }
    for kind, read in readers.items():
        understood: list[str] = []
        for query in then[kind]:
            with suppress(UsageError, ValidationError):
                read(query)
                understood.append(urlencode(query))
        assert_kept(kind, map(urlencode, then[kind]), understood)
    answered = [a for a in then["lists"] if client.get(f"/api/v1{a}").status_code == 200]
    assert_kept("lists", then["lists"], answered)


def test_controls_of_live_scenes(then: dict[str, Any], old: OldFolder, server: FastAPI) -> None:
    wanted, told = then["controls"], CHANGELOG.read_text(encoding="utf-8")

    def wait(scene: str, client: ViewerClient) -> None:
        kept = {name for name in wanted[scene] if not _is_told(name, told)}
        try:
            client.until(lambda: kept <= set(surface.controls(client)[0]))
        except TimeoutError:
            return  # What is missing is told below.

    sessions = server.state.sessions
    now = surface.scenes(sessions, old.ids["grasp"], ViewerClient, wait)
    sessions.shutdown()
    for scene, controls in wanted.items():
        assert_kept(f"controls ({scene})", controls, now[scene])


def test_files_of_a_run_and_their_fields(data: Path, old: OldFolder, client: TestClient) -> None:
    """A fit of today with hands and an object has all that one of then had."""
    short = {
        "hand.iterations": 2,
        "hand.depth_iterations": 1,
        "object_.search.generations": 1,
        "object_.first_order.iterations": 1,
        "refinement.iterations": 1,
    }
    settings = old.expected["runs"][old.ids["grasp"]]["overrides"] | short
    order = {"sequences": ["grasp"], "profile": "quick", "overrides": settings}
    answer = client.post("/api/v1/runs", json=order)
    assert answer.status_code == 201, answer.text
    folder = data / "runs" / answer.json()["id"]
    pipeline.run_job(Run.open(folder))
    (folder / "queued.json").unlink()
    client.patch(f"/api/v1/runs/{folder.name}", json={"note": "made again"}).raise_for_status()
    again = data / "runs" / "again"
    command("simulate", "quick", "--sequence", "sheet_high", "--out", again, "--data-dir", data)
    for was, now in ((old.run("grasp"), folder), (old.run("elsewhere"), again)):
        names = _files(now)
        assert_kept("files of a run", _files(was), names)
        for name in set(_files(was)) & set(names):
            assert_kept(f"fields of {name}", _fields(was / name), _fields(now / name))


def _files(run: Path) -> list[str]:
    own = {"log.txt", "preview.safetensors"}  # The server writes one, and a slow fit the other.
    names = [path.relative_to(run).as_posix() for path in sorted(run.rglob("*")) if path.is_file()]
    return [name for name in names if name not in own and not name.startswith(".")]


def _fields(path: Path) -> list[str]:
    """Name what is in a file: fields of text, tensors by name and shape, arrays by their axes."""
    match path.suffix:
        case ".json":
            return sorted(set(surface.fields_of(json.loads(path.read_text()))))
        case ".jsonl":
            lines = path.read_text().splitlines()
            return sorted({f for line in lines for f in surface.fields_of(json.loads(line))})
        case ".yaml":
            return sorted(set(surface.fields_of(yaml.safe_load(path.read_text()))))
        case ".safetensors":
            with safe_open(path, "numpy") as tensors:
                return [f"{n} ({_axes(tensors.get_tensor(n))})" for n in sorted(tensors.keys())]
        case ".npy":
            return [_axes(np.load(path))]
        case _:
            return []


def _axes(array: np.ndarray) -> str:
    return f"{array.ndim} axes of {array.dtype}"
