"""One live simulation process for all servers of a test process, which take turns anyway."""

from collections.abc import Iterator
from typing import Any

import pytest

from app.viewer import sessions
from app.viewer.live.client import SimulationClient


class LentClient:
    """A client that servers share: closing it lets go of it, and the process goes on."""

    def __init__(self, client: SimulationClient) -> None:
        self._client = client
        self.is_closed = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._client, name)

    def close(self) -> None:
        self.is_closed = True


@pytest.fixture(scope="session", autouse=True)
def live_process() -> Iterator[None]:
    """Let every `Sessions` of the tests simulate in the same process."""
    client = SimulationClient()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sessions, "SimulationClient", lambda _device: LentClient(client))
        yield
    client.close()
