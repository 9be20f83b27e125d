"""A made-up Jobs API of a Ray cluster, which does what a test tells it."""

import json
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any
from unittest.mock import patch

import psutil

from app.jobs.engines import cluster as cluster_module
from support.waiting import LIMIT_S, until

TOKEN = 4 * "the cluster's"


@dataclass
class MadeCluster:
    port: int
    nodes: list[dict[str, Any]] = field(default_factory=lambda: [{"CPU": 1.0}])
    jobs: dict[str, dict[str, Any]] = field(default_factory=dict)
    submitted: list[dict[str, Any]] = field(default_factory=list)
    stopped: list[str] = field(default_factory=list)
    silence: str = ""
    """`all`: it hangs up on everybody; `submit`: it takes jobs, but answers nothing."""
    broken: tuple[int, bytes] | None = None
    """What it answers in the place of everything."""
    token: str = TOKEN
    executes: bool = False
    """Whether jobs are processes of this machine, and their status is theirs."""
    gate: Path | None = None
    """File for which jobs that are submitted from now on wait; None for nothing."""
    processes: dict[str, "subprocess.Popen[bytes]"] = field(default_factory=dict)

    @property
    def address(self) -> str:
        return f"ray://127.0.0.1:{self.port}"

    @property
    def place(self) -> str:
        return f"127.0.0.1:{self.port}"

    def set(self, status: str, job: str = "", message: str = "") -> None:
        """Set the status of a job; of the last one if none is named."""
        self.jobs[job or [*self.jobs][-1]].update(status=status, message=message)

    def answer(self, method: str, path: str, token: str, content: Any) -> tuple[int, Any] | None:
        if self.silence == "all":
            return None
        if self.broken is not None:
            return self.broken
        if token != f"Bearer {self.token}":
            return 401, b"Unauthorized"
        if path.startswith("/api/v0/nodes"):
            dead = {"state": "DEAD", "resources_total": {"CPU": 64.0, "GPU": 8.0}}
            alive = [{"state": "ALIVE", "resources_total": node} for node in self.nodes]
            return 200, {"data": {"result": {"result": [dead, *alive]}}}
        return self.of_jobs(method, path.removeprefix("/api/jobs/"), content)

    def of_jobs(self, method: str, name: str, content: Any) -> tuple[int, Any] | None:
        if (method, name) == ("POST", ""):
            job = content["submission_id"]
            if job in self.jobs:
                return 500, f"Traceback\nValueError: Job with submission_id {job} exists.".encode()
            self.submitted.append(content)
            self.jobs[job] = {"status": "PENDING", "metadata": content["metadata"]}
            if self.executes:
                wait = f"until [ -e '{self.gate}' ]; do sleep 0.02; done; " if self.gate else ""
                self.processes[job] = subprocess.Popen(
                    ["bash", "-c", wait + content["entrypoint"]], start_new_session=True
                )
            return None if self.silence == "submit" else (200, {"submission_id": job})
        job, _, deed = name.partition("/")
        if job not in self.jobs:
            return 404, f"Job {job} does not exist".encode()
        if deed == "stop":
            self.stopped.append(job)
            if self.executes:
                self.kill(job)
                self.jobs[job]["status"] = "STOPPED"
            return 200, {"stopped": True}
        if self.executes and self.jobs[job]["status"] in {"PENDING", "RUNNING"}:
            code = self.processes[job].poll()
            ended = "SUCCEEDED" if code == 0 else "FAILED"
            self.jobs[job]["status"] = "RUNNING" if code is None else ended
        return 200, self.jobs[job]

    def kill(self, job: str) -> None:
        """Kill a job with all that it started, as when its machine loses its power."""
        process = self.processes[job]
        if process.poll() is None:
            family = psutil.Process(process.pid).children(recursive=True)
            # What watches the others goes first, or it would still tell that they were killed.
            for member in (process, *family):
                with suppress(psutil.NoSuchProcess, ProcessLookupError):
                    member.kill()
            until(lambda: all(_has_ended(member) for member in family))
        process.wait()


def _has_ended(process: psutil.Process) -> bool:
    """Tell whether a process has; what nobody asks after stays a zombie."""
    try:
        return process.status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


@contextmanager
def made_cluster() -> Iterator[MadeCluster]:
    """Let a made-up head answer on a port of this machine."""

    class Handler(BaseHTTPRequestHandler):
        def do(self) -> None:
            size = int(self.headers.get("Content-Length") or 0)
            content = json.loads(self.rfile.read(size)) if size else None
            token = self.headers.get("Authorization", "")
            answer = cluster.answer(self.command, self.path, token, content)
            if answer is None:
                return
            body = answer[1] if isinstance(answer[1], bytes) else json.dumps(answer[1]).encode()
            self.send_response(answer[0])
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        do_GET = do_POST = do  # noqa: N815  # the names that the library looks for

        def log_message(self, *_: object) -> None:
            pass

    # Whether it answers is what a test says, however busy the machine is.
    patience = patch.object(cluster_module, "_TIMEOUT_S", LIMIT_S)
    with patience, ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        cluster = MadeCluster(server.server_address[1])
        thread = Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield cluster
        server.shutdown()
        thread.join()
        for job in cluster.processes:
            cluster.kill(job)
