"""Fixtures of the server's tests: data folders and an application inside this process."""

import shutil
from pathlib import Path

import pytest
from sheet_sequence import write_sheet


@pytest.fixture(scope="session")
def sheet_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sheet(tmp_path_factory.mktemp("sheets") / "sheet").folder


@pytest.fixture
def data_dir(tmp_path: Path, sheet_folder: Path) -> Path:
    """A data folder with one small sequence and no run."""
    folder = tmp_path / "data"
    shutil.copytree(sheet_folder, folder / "sequences" / "sheet")
    (folder / "runs").mkdir()
    return folder
