"""Good inputs, made once and copied for each line of the matrix."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support.hostile.bad_input_world import Terminal, write_filmed
from support.server.server_world import tiny_config

from app.cli import runs

Copy = Callable[[], Path]


@pytest.fixture(scope="session", autouse=True)
def one_live_process(live_process: None) -> None:
    """Every `Sessions` of these tests simulates in the same process."""


@pytest.fixture(scope="session")
def filmed_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_filmed(tmp_path_factory.mktemp("films") / "filmed").folder


@pytest.fixture
def sheet(tmp_path: Path, sheet_folder: Path) -> Path:
    """A recording of markers and point controllers, to damage."""
    return shutil.copytree(sheet_folder, tmp_path / "sheet")


@pytest.fixture
def filmed(tmp_path: Path, filmed_folder: Path) -> Path:
    """A recording with video, depth, masks and keypoints, to damage."""
    return shutil.copytree(filmed_folder, tmp_path / "filmed")


@pytest.fixture
def fitted(tmp_path: Path, fitted_folder: Path) -> Path:
    """A finished run, to damage."""
    return shutil.copytree(fitted_folder, tmp_path / "fitted")


@pytest.fixture
def terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Terminal:
    """The command line in a folder of its own, with a quick profile made quicker."""
    config = tiny_config()
    monkeypatch.setattr(runs, "load_profile", lambda _: config)
    monkeypatch.chdir(tmp_path)
    return Terminal(tmp_path, capsys)
