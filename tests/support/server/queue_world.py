"""An application whose queue works, with the workers of `job_worker` and made-up live scenes."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import Any

import uvicorn
from fastapi import FastAPI
from fastapi.testclient import TestClient

from app.graceful_server import GracefulServer
from app.jobs.catalog import Catalog
from app.jobs.processes import end_processes
from app.jobs.scheduler import Scheduler
from app.security import Security
from app.server import create_app
from app.settings import ServerSettings
from app.viewer.sessions import TooManySessionsError
from physhandi.data.run_folder import read_events
from support.server.route_checks import share_checks
from support.waiting import LIMIT_S, until

share_checks()

HOSTILE = "<img src=x onerror=alert(1)>"


@dataclass
class Scene:
    kind: str
    target: str
    title: str
    offers: tuple[str, ...] = ("object", "colors", "figure")
    reason: str = ""

    @property
    def info(self) -> "Scene":
        return self


@dataclass
class Scenes:
    """Stands for the live viewer; it has room for two scenes."""

    opened: dict[str, Scene] = field(default_factory=dict)
    owners: list[str] = field(default_factory=list)

    def open(self, kind: str, target: str, owner: str, *, may_keep: bool) -> str:
        if len(self.opened) == 2:
            raise TooManySessionsError("2 live sessions are open.")
        self.owners.append(owner)
        name = f"scene{len(self.opened)}"
        self.opened[name] = Scene(kind, target, HOSTILE)
        return name

    def find(self, session_id: str, owner: str) -> Scene | None:
        return self.opened.get(session_id)

    def closed_session(self, session_id: str, owner: str) -> None:
        return None

    def close(self, session_id: str) -> bool:
        return self.opened.pop(session_id, None) is not None

    def shutdown(self) -> None:
        self.opened.clear()


@dataclass
class QueueWorld:
    app: FastAPI
    client: TestClient
    scenes: Scenes
    data_dir: Path
    token: str

    def launch(self, name: str) -> str:
        body = {"sequences": ["sheet"], "profile": "quick", "name": name}
        response = self.client.post("/api/v1/runs", json=body)
        assert response.status_code == 201
        return response.json()["id"]

    def until(self, run_id: str, state: str) -> dict[str, Any]:
        run: dict[str, Any] = {}

        def has_state() -> bool:
            run.clear()
            run.update(self.client.get(f"/api/v1/runs/{run_id}").json())
            return run["state"] == state

        until(has_state, lambda: run)
        return run

    def until_reported(self, run_id: str, stage: str, iteration: int = 1) -> None:
        """Wait for a report; a run is called running before its worker has made its files."""
        until(lambda: (stage, iteration) in self._reports(run_id), lambda: self._reports(run_id))

    def _reports(self, run_id: str) -> list[tuple[str, int]]:
        events, _ = read_events(self.folder(run_id))
        return [(event["stage"], event["iteration"]) for event in events]

    def tell(self, run_id: str, *commands: list[Any]) -> None:
        """Give a run named `script` its next commands; see `job_worker.script`."""
        with (self.folder(run_id) / "script").open("a") as stream:
            stream.writelines(json.dumps(command) + "\n" for command in commands)

    def folder(self, run_id: str) -> Path:
        return self.data_dir / "runs" / run_id


@contextmanager
def queue_world(data_dir: Path, bundled: Path) -> Iterator[QueueWorld]:
    """Serve a data folder; when it is over, no process of a run is left."""
    settings = ServerSettings(data_dir=data_dir, cancel_grace_s=1.0)
    catalog = Catalog(settings, bundled=bundled)
    scheduler = Scheduler(settings, catalog, worker="support.server.job_worker")
    security = Security(settings)
    scenes: Any = Scenes()
    app = create_app(
        settings, security=security, catalog=catalog, scheduler=scheduler, sessions=scenes
    )
    bearer = {"Authorization": f"Bearer {security.token}"}
    with TestClient(app, "http://127.0.0.1:8080", headers=bearer) as client:
        yield QueueWorld(app, client, scenes, data_dir, security.token)
    for folder in (data_dir / "runs").iterdir():
        end_processes(folder, grace_s=0.0)
    for process in scheduler._local.started.values():
        process.wait()


@contextmanager
def serving(world: QueueWorld) -> Iterator[int]:
    """Let browsers in on a port of this machine; when it is over, every stream has ended."""
    # A server that gives up waiting leaves sockets open, of which Python complains later.
    config = uvicorn.Config(
        world.app, port=0, lifespan="off", log_level="error", timeout_graceful_shutdown=60
    )
    server = GracefulServer(config)
    thread = Thread(target=server.run, daemon=True)
    thread.start()
    until(lambda: server.started)
    yield server.servers[0].sockets[0].getsockname()[1]
    world.app.state.stopping.set()
    server.should_exit = True
    thread.join(LIMIT_S)
    assert not thread.is_alive()
