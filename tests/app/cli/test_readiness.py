"""Before a launch people learn which stages run, and are asked before the object is left out."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from support.hostile.bad_input_world import Terminal, write_filmed
from support.server.server_world import World, make_world

from app.cli import runs
from physhandi.errors import RunError
from physhandi.fitting.config import EVALUATION, HANDS, OBSERVATION, STAGES
from physhandi.run import Run


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with color and depth, whose masks are missing."""
    folder = write_filmed(tmp_path_factory.mktemp("films") / "maskless").folder
    shutil.rmtree(folder / "views/front/mask")
    return folder


@pytest.fixture
def world(data_dir: Path, film: Path) -> World:
    shutil.copytree(film, data_dir / "sequences/maskless")
    return make_world(data_dir)


def order(world: World, **fields: Any) -> Any:
    return world.script().post("/api/v1/runs", json={"sequences": ["maskless"]} | fields)


def test_a_launch_that_would_leave_out_the_object_asks(world: World) -> None:
    refused = order(world)
    assert refused.status_code == 422
    error = refused.json()["error"]
    assert error["code"] == "skips_object"
    assert "'maskless' lacks mask" in error["message"]
    assert "accepts_missing" in error["message"]
    assert list((world.settings.run_dir).iterdir()) == []
    assert order(world, accepts_missing=True).status_code == 201
    assert len(list((world.settings.run_dir).iterdir())) == 1


def test_color_alone_is_fitted_unasked(world: World) -> None:
    shutil.rmtree(world.settings.sequence_dir / "maskless/views/front/depth")
    assert order(world).status_code == 201


def test_a_launch_of_nothing_is_refused(world: World) -> None:
    view = world.settings.sequence_dir / "maskless/views/front"
    for file in ("keypoint.npy", "color.mp4"):
        (view / file).unlink()
    refused = order(world, accepts_missing=True)
    assert refused.status_code == 422
    assert refused.json()["error"]["code"] == "missing_input"
    assert "color or keypoint for the hands" in refused.json()["error"]["message"]


def test_a_draft_tells_its_stages(world: World) -> None:
    def check(**draft: Any) -> Any:
        return world.script().post("/api/v1/runs/check", json=draft).json()

    told = check(sequences=["maskless"])
    assert list(told["stages"]) == list(STAGES)
    assert told["stages"][HANDS]["ready"]
    assert told["stages"][OBSERVATION]["missing"] == ["mask"]
    assert told["skips_object"].startswith("Only the hands will be fitted")
    assert told["nothing_to_fit"] is None
    both = check(sequences=["sheet", "maskless"])
    assert not both["stages"][EVALUATION]["ready"]
    assert "There is nothing to fit" in both["nothing_to_fit"]
    whole = check(sequences=["sheet"], overrides={"node_spacing": 9})
    assert whole["stages"][OBSERVATION]["ready"]
    assert whole["skips_object"] is None
    assert check()["stages"] == {}


def test_the_command_line_warns_before_it_begins(
    film: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:

    def begin(run: Run, device: str, store: None) -> dict[str, Any]:
        raise RunError("it began")

    monkeypatch.setattr(runs, "_execute", begin)
    monkeypatch.chdir(tmp_path)
    terminal = Terminal(tmp_path, capsys)
    _, _, error = terminal("reconstruct", film, "--out", "run", "--device", "cpu")
    first, second = error.splitlines()
    assert first.startswith("physhandi: warning: Only the hands will be fitted")
    assert "add views/<view>/mask/" in first
    assert second == "physhandi: it began"
    code, out, _ = terminal("check", film, "--json")
    assert code == 0
    told = json.loads(out)
    assert not told["stages"][OBSERVATION]["ready"]
    assert told[str(film)]["object"] == "lacks mask"
