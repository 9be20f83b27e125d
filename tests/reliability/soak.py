"""A server that is used for hours: fits, simulations, scenes, files, pages and uploads."""

import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from support.inputs.sheet_sequence import FRAMES, write_sheet
from support.server.measured_server import Held, MeasuredServer
from support.server.server_world import fit_sheet
from support.server.suite_world import SETTINGS
from support.waiting import until

from app.jobs.processes import processes_of, supervisor_of
from app.jobs.recovery.left_behind import find_left_behind
from app.jobs.scheduler import ENDED
from app.jobs.ticket import QUEUED, STARTED
from app.settings import ServerSettings
from physhandi.data.run_folder import read_events
from physhandi.run import Run
from reliability import Case, Counts, Report
from reliability.jobs import is_damaged
from reliability.viewers import CUTS, POOL

_WARM = 24
"""Deeds after which everything has been used and memory is looked at for the first time."""
_KEPT = 6
"""Runs that are kept; older ones are deleted."""
_ONCE_MB, _A_REQUEST_MB = 60.0, 0.01
"""Memory that the server may take after that, and with each request [MB]."""
_PAGES = (
    *("/", "/runs", "/sequences", "/system", "/recovery", "/launch", "/runs/{run}"),
    *("/runs/{run}/replay", "/sequences/towel_fold/thumbnail", "/metrics", "/healthz", "/readyz"),
    *("/api/v1/runs", "/api/v1/runs/{run}", "/api/v1/runs/{run}/losses", "/api/v1/sequences"),
    *("/api/v1/runs/{run}/frame_errors", "/api/v1/uploads"),
)
_FILES = ("npz", "csv", "ply", "gltf", "yaml", "mjcf", "png")


class Soak:
    """Uses a server in a random order that is always the same, and counts what goes wrong."""

    def __init__(self, folder: Path) -> None:
        """Start a server on a folder with a recording of a sheet, and fit that."""
        self._sheet = write_sheet(folder / "sequences" / "sheet").folder
        self._settings = ServerSettings(data_dir=folder)
        self._chance = np.random.default_rng(741)  # Begins with what is quickly done.
        self._runs = [fit_sheet(folder / "runs" / "first", self._sheet).id]
        self._server = MeasuredServer(folder)
        self.counts = Counts("lost", "corrupt", "orphans", "wrong", "leaked", "published twice")

    def __enter__(self) -> "Soak":
        return self

    def __exit__(self, *told: Any) -> None:
        self._server.__exit__(*told)

    def deeds(self) -> Iterator[Callable[[], None]]:
        """Give what is to be done: everything once, in a random order, and so on for ever."""
        deeds = (
            *(self._fit, self._cancel, self._simulate, self._watch, self._export, self._look),
            *(self._upload, self._give_up_an_upload),
        )
        while True:
            yield from (deeds[index] for index in self._chance.permutation(len(deeds)))
            while len(self._runs) > _KEPT:
                self._server.told("DELETE", f"/api/v1/runs/{self._runs.pop(0)}")

    def _look_for_all(self) -> None:
        """Look whether the runs that were kept are there, and no others."""
        listed = self._server.told("GET", "/api/v1/runs?limit=200")["runs"]
        own = {run["id"]: run["state"] for run in listed if not run["is_bundled"]}
        self.counts["lost"] += len(own.keys() ^ set(self._runs))
        self.counts.require(
            {*own.values()} == {"succeeded"},
            f"GET /api/v1/runs tells {own}; expected that all have succeeded",
        )

    def settled(self) -> Held:
        """Count what the server holds when all of it is over."""
        until(lambda: self._server.connections() == 0)
        return self._server.held()

    def judge(self, warm: Held) -> Report:
        """Compare with what the server held before, and look for what is left in the folder."""
        self._look_for_all()
        until(lambda: self.settled().is_no_more_than(warm), self.settled)
        end = self.settled()
        counts = self.counts
        counts["leaked"] += end.scenes
        counts["leaked"] += max(0, end.threads - warm.threads - POOL)
        grown = end.megabytes - warm.megabytes
        counts["leaked"] += grown > _ONCE_MB + _A_REQUEST_MB * self._server.requests
        left = find_left_behind(self._settings)
        counts["leaked"] += len(left.temporaries) + len(left.claims) + len(left.replaced)
        counts.update(
            {
                "requests": self._server.requests,
                "memory after warming up [MB]": round(warm.megabytes),
                "at the end": round(end.megabytes),
                "files open then": warm.files,
                "files open at the end": end.files,
                "threads then": warm.threads,
                "threads at the end": end.threads,
                "children": end.children,
            }
        )
        return counts

    def _fetch(self, path: str) -> None:
        """Fetch something that has to be there; what is not is kept with its request."""
        status, content = self._server.ask("GET", path)
        self.counts.require(
            status == 200 and bool(content),
            f"request {self._server.requests}, GET {path}, was answered by {status} "
            f"{content[:300]!r}; expected 200 and some content",
        )

    def _launch(self, name: str, **overrides: Any) -> Run:
        body = {"sequences": ["sheet"], "name": name, "overrides": {**SETTINGS, **overrides}}
        run_id = self._server.told("POST", "/api/v1/runs", body)["id"]
        return Run.open(self._settings.run_dir / run_id)

    def _await_end(self, run: Run) -> str:
        def state() -> str:
            return self._server.told("GET", f"/api/v1/runs/{run.id}")["state"]

        until(lambda: state() in ENDED, interval=0.2)
        until(lambda: supervisor_of(run.folder) is None)
        self.counts["orphans"] += len(list(processes_of(run.folder)))
        return state()

    def _keep(self, run: Run, state: str) -> None:
        """Look at a run that has ended, and remember it."""
        self.counts["lost"] += state != "succeeded"
        self.counts["corrupt"] += not run.is_published or is_damaged(run)
        manifests = list(run.folder.glob("attempts/*/MANIFEST.json"))
        self.counts["published twice"] += max(0, len(manifests) - 1)
        self._runs.append(run.id)

    def _fit(self) -> None:
        run = self._launch(f"fit {self.counts['fits']}")
        self._keep(run, self._await_end(run))
        self.counts["fits"] += 1

    def _cancel(self) -> None:
        """Cancel a fit after some of its reports."""
        run = self._launch("to be cancelled", **{"object_.search.generations": 50})
        reports = int(self._chance.integers(0, 4))
        until(lambda: len(read_events(run.folder)[0]) >= reports)
        status, content = self._server.ask("POST", f"/api/v1/runs/{run.id}/cancel")
        state = self._await_end(run)
        # One that had ended already has nothing to cancel; one that publishes is told to stop, and
        # has succeeded all the same (R6). That a fit at work is really stopped is shown by R5.
        self.counts["cancelled too late"] += (state, status) == ("succeeded", 200)
        self.counts.require(
            (state, status) in {("cancelled", 200), ("succeeded", 409), ("succeeded", 200)},
            f"POST /api/v1/runs/{run.id}/cancel after {reports} reports was answered by {status} "
            f"{content[:300]!r}, and the run is {state}; expected 200 and cancelled or succeeded, "
            "or 409 and succeeded",
        )
        self.counts.require(
            run.is_published == (state == "succeeded"),
            f"run {run.id} is {state}, and {'' if run.is_published else 'not '}published",
        )
        self._server.told("DELETE", f"/api/v1/runs/{run.id}")
        self.counts["cancelled"] += 1

    def _some_run(self) -> str:
        return self._runs[int(self._chance.integers(len(self._runs)))]

    def _simulate(self) -> None:
        """Move a slider in a scene, and keep what comes of it as a run."""
        scene = self._server.open("run", self._some_run())
        before = set(self._settings.run_dir.iterdir())
        with self._server.viewer(scene) as client:
            client.until(lambda: client.find("Pause"))
            client.set("stiffness", round(float(self._chance.uniform(-0.5, 0.5)), 2))
            client.until(lambda: f"simulated {FRAMES}/{FRAMES}" in client.texts())
            client.set("name", "kept")
            client.set("Save as", "Run")
            until(lambda: self._new_run(before))
        run = Run.open(self._new_run(before)[0])
        self._server.shut(scene)
        self._keep(run, self._await_end(run))
        self.counts["simulations"] += 1

    def _new_run(self, before: set[Path]) -> list[Path]:
        """Find runs that came up since, once they are in line: until then they count as failed."""
        new = set(self._settings.run_dir.iterdir()) - before
        return [path for path in new if (path / QUEUED).is_file() or (path / STARTED).is_file()]

    def _watch(self) -> None:
        """Open scenes, leave them politely or not, and close them."""
        for number in range(3):
            kind, target = ("sequence", "sheet") if number == 2 else ("run", self._some_run())
            scene = self._server.open(kind, target)
            client = self._server.viewer(scene)
            client.tell_camera()
            client.until(lambda client=client: client.find("Pause") or client.find("Play"))
            cut = int(self._chance.integers(len(CUTS) + 1))
            if cut == len(CUTS):
                client.connection.close()
            else:
                CUTS[cut](client.connection)
            self._server.shut(scene)
            self.counts["scenes"] += 1

    def _export(self) -> None:
        for kind in _FILES:
            self._fetch(f"/api/v1/runs/{self._some_run()}/export?format={kind}")
            self.counts["files"] += 1

    def _look(self) -> None:
        for page in _PAGES:
            self._fetch(page.format(run=self._some_run()))
            self.counts["pages"] += 1

    def _upload(self) -> None:
        """Send a sequence piece by piece, look at it, and remove it by hand."""
        upload = self._send("sent", whole=True)
        address = f"/api/v1/uploads/{upload}"
        self._server.told("POST", f"{address}/finish", {})
        until(lambda: self._server.told("GET", address)["state"] != "checking", interval=0.1)
        told = self._server.told("GET", address)
        self.counts.require(
            told["state"] == "done", f"GET {address} tells {told}; expected that it is done"
        )
        self._fetch("/api/v1/sequences/sent")
        shutil.rmtree(self._settings.sequence_dir / "sent")
        self.counts["uploads"] += 1

    def _give_up_an_upload(self) -> None:
        upload = self._send("never", whole=False)
        self._server.told("DELETE", f"/api/v1/uploads/{upload}")
        self.counts["lost"] += (self._settings.sequence_dir / "never").exists()

    def _send(self, name: str, *, whole: bool) -> str:
        files = {path.name: path.read_bytes() for path in self._sheet.iterdir() if path.is_file()}
        listed = [{"path": path, "size": len(content)} for path, content in files.items()]
        upload = self._server.told("POST", "/api/v1/uploads", {"name": name, "files": listed})
        for number, file in enumerate(upload["files"]):
            content = files[file["path"]] if whole else files[file["path"]][:10]
            place = f"/api/v1/uploads/{upload['id']}/files/{number}?offset=0"
            self._server.told("PUT", place, content)
        return upload["id"]


def soak(seconds: float, folder: Path, *, most: int | None = None) -> Report:
    """Use a server for some time, or so many times, and count what it holds in the end."""
    end = time.monotonic() + seconds
    with Soak(folder) as used:
        warm = None
        for deed in used.deeds():
            done = used.counts["done"]
            if done == most if most is not None else time.monotonic() >= end:
                break
            deed()
            used.counts["done"] += 1
            if used.counts["done"] == min(_WARM, most or _WARM):
                warm = used.settled()
        return used.judge(warm or used.settled())


def use_often(count: int, folder: Path) -> Report:
    """Do so many things with a server."""
    return soak(0.0, folder, most=count)


CASES = {
    "R18": Case(
        "A server is used by everybody: fits, cancels, simulations, scenes, files, pages, uploads",
        *(400, 4, use_often),
        last=soak,
        minutes=120.0,
    )
}
