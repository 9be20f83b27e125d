"""Fixtures of the server's tests: data folders and an application inside this process."""

import json
import shutil
from pathlib import Path

import pytest
from support.server.server_world import World, make_world

from app.exports.cache import FileCache, FileJob
from app.exports.making import make
from app.exports.request import FileRequest


@pytest.fixture(scope="session", autouse=True)
def one_live_process(live_process: None) -> None:
    """Every `Sessions` of these tests simulates in the same process."""


@pytest.fixture(scope="module")
def still_world(
    tmp_path_factory: pytest.TempPathFactory, sheet_folder: Path, fitted_folder: Path
) -> World:
    """A server like `world`, shared by those tests of a file that change nothing."""
    folder = tmp_path_factory.mktemp("still")
    shutil.copytree(sheet_folder, folder / "sequences" / "sheet")
    shutil.copytree(fitted_folder, folder / "runs" / "fitted")
    return make_world(folder)


@pytest.fixture
def data_dir(tmp_path: Path, sheet_folder: Path) -> Path:
    """A data folder with one small sequence and no run."""
    folder = tmp_path / "data"
    shutil.copytree(sheet_folder, folder / "sequences" / "sheet")
    (folder / "runs").mkdir()
    return folder


@pytest.fixture
def world(data_dir: Path, fitted_folder: Path) -> World:
    """A server with one sequence and one finished run, whose queue stands still."""
    shutil.copytree(fitted_folder, data_dir / "runs" / "fitted")
    return make_world(data_dir)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[FileRequest]:
    """Has files made in this process; the orders that were carried out."""
    orders: list[FileRequest] = []

    def run(_: FileCache, order: FileRequest, work: FileJob) -> None:
        again = FileRequest(**json.loads(order.to_text()))
        orders.append(again)
        make(again, work.path)

    monkeypatch.setattr(FileCache, "_run", run)
    return orders
