"""The data folder that the program of commit 57a38d7 left, unpacked; see README.md."""

from pathlib import Path

import pytest
from support.inputs.old_data import OldFolder, read_record, serve, settle, unpack
from support.server.server_world import World


@pytest.fixture(scope="session", autouse=True)
def one_live_process(live_process: None) -> None:
    """Every `Sessions` of these tests simulates in the same process."""


@pytest.fixture(scope="session")
def old(tmp_path_factory: pytest.TempPathFactory) -> OldFolder:
    """The folder for tests that only read."""
    data = settle(unpack(tmp_path_factory.mktemp("made_by_57a38d7")))
    return OldFolder(data, read_record("expected"), read_record("permalinks"))


@pytest.fixture
def own_copy(old: OldFolder, tmp_path: Path) -> OldFolder:
    """The folder for a test that writes into it."""
    data = settle(unpack(tmp_path))
    return OldFolder(data, old.expected, old.links)


@pytest.fixture(scope="session")
def world(old: OldFolder) -> World:
    """An application over the folder whose queue stands still."""
    return serve(old.path)
