from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import viser
from support.viewer.viewer_client import ViewerClient
from support.viewer.viewer_world import (
    FakeSettings,
    FolderCatalog,
    Recording,
    make_run,
    make_sequence,
)

from app.viewer.physics.edit_presets import EditPresetStore
from app.viewer.physics.keep_panel import RunSaver, UserStorage
from app.viewer.physics.presets import PresetStore
from app.viewer.scene.scene_server import start_viser
from app.viewer.sessions import Sessions
from physhandi.run import Run


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
def begun() -> list[Run]:
    """Runs that a worker would work on."""
    return []


@pytest.fixture
def noted() -> list[tuple[str, str, str | None]]:
    """Who has kept or deleted what, and the run that it became."""
    return []


@pytest.fixture
def storage(
    catalog: FolderCatalog,
    tmp_path: Path,
    begun: list[Run],
    noted: list[tuple[str, str, str | None]],
) -> UserStorage:
    """Where users keep presets and runs."""

    def start(make: Callable[[], Run]) -> Run:
        begun.append(make())
        return begun[-1]

    saver = RunSaver(catalog, tmp_path / "runs", start)
    presets = PresetStore(tmp_path / "presets")
    edit_presets = EditPresetStore(presets.folder)
    return UserStorage(presets, edit_presets, saver, lambda *told: noted.append(told))


@pytest.fixture
def sessions(catalog: FolderCatalog, storage: UserStorage) -> Iterator[Sessions]:
    sessions = Sessions(FakeSettings(), catalog, storage)
    yield sessions
    sessions.shutdown()


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    """A bare viser server."""
    server = start_viser("bare")
    yield server
    server.stop()


@pytest.fixture
def server_client(server: viser.ViserServer) -> Iterator[tuple[viser.ViserServer, ViewerClient]]:
    """A bare viser server with one client, which has told it its camera."""
    with ViewerClient(f"ws://127.0.0.1:{server.get_port()}") as client:
        client.until(lambda: len(server.get_clients()) == 1)
        yield server, client
