"""Fixtures of the server's tests: data folders and an application inside this process."""

import shutil
from pathlib import Path

import pytest
from support.inputs.sheet_sequence import write_sheet
from support.server.server_world import World, fit_sheet, make_world
from support.viewer.shared_live import live_process as live_process


@pytest.fixture(scope="session")
def sheet_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sheet(tmp_path_factory.mktemp("sheets") / "sheet").folder


@pytest.fixture(scope="session")
def fitted_folder(tmp_path_factory: pytest.TempPathFactory, sheet_folder: Path) -> Path:
    return fit_sheet(tmp_path_factory.mktemp("fits") / "fitted", sheet_folder).folder


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
