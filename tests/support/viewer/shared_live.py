"""One live simulation process for all servers of a test process, which take turns anyway."""

from collections.abc import Generator
from contextlib import contextmanager
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


@contextmanager
def shared_live() -> Generator[None]:
    """Let every `Sessions` simulate in the same process, which ends at the end."""
    client = SimulationClient()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sessions, "SimulationClient", lambda _device: LentClient(client))
        yield
    client.close()
