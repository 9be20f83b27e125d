from collections.abc import Iterator
from pathlib import Path

import pytest
from viewer_world import FakeSettings, FolderCatalog, Recording, make_run, make_sequence

from app.viewer.session import Sessions
from physhandi.data.run import Run


@pytest.fixture(scope="session")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewer")
    make_run(folder / "runs" / "sheet")
    return folder


@pytest.fixture(scope="session")
def run(root: Path) -> Run:
    return Run.open(root / "runs" / "sheet")


@pytest.fixture(scope="session")
def recording(root: Path) -> Recording:
    return make_sequence(root / "sequences" / "gesture")


@pytest.fixture
def catalog(root: Path) -> FolderCatalog:
    return FolderCatalog(root)


@pytest.fixture
def sessions(catalog: FolderCatalog) -> Iterator[Sessions]:
    sessions = Sessions(FakeSettings(), catalog)
    yield sessions
    sessions.shutdown()
