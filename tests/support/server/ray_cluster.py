"""A real Ray cluster on this machine: a head that runs no fits, and nodes with one processor each.

Every process of it is marked by a variable of its environment, and ended by that.
"""

import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from app.jobs.engines.cluster import Cluster, ClusterError, Demand
from support.waiting import until

RAY = Path(sys.executable).parent / "ray"
NEEDED = "needs Ray beside this Python: pip install 'physhandi[cluster]'"
_MARK = "PHYSHANDI_TEST_CLUSTER"
_SMALL = "--object-store-memory=80000000"


def free_port() -> int:
    with socket.socket() as line:
        line.bind(("127.0.0.1", 0))
        return line.getsockname()[1]


@dataclass
class RealCluster:
    folder: Path
    environment: dict[str, str]
    token: str
    port: int = field(default_factory=free_port)
    head_port: int = field(default_factory=free_port)
    head: "subprocess.Popen[bytes] | None" = None
    nodes: "list[subprocess.Popen[bytes]]" = field(default_factory=list)

    @property
    def address(self) -> str:
        return f"ray://127.0.0.1:{self.port}"

    def places(self) -> int:
        try:
            return Cluster(self.address, self.token).places(Demand())
        except ClusterError:
            return -1

    def start_head(self) -> None:
        self.head = self._start(
            *("--head", f"--port={self.head_port}", "--num-cpus=0", "--disable-usage-stats"),
            *("--dashboard-host=127.0.0.1", f"--dashboard-port={self.port}"),
            *("--include-dashboard=true", f"--ray-client-server-port={free_port()}"),
            f"--temp-dir={self.folder}",
        )
        until(lambda: self.places() == 0, self.log)

    def start_node(self, core: int | None = None) -> None:
        """Start a further node; returns when the head counts on it.

        Args:
            core: The only processor that it and its jobs may use; None for all.
        """
        before = self.places()
        held = () if core is None else ("taskset", "--cpu-list", str(core))
        options = f"--address=127.0.0.1:{self.head_port}", "--num-cpus=1"
        self.nodes.append(self._start(*options, held=held))
        until(lambda: self.places() == before + 1, self.log)

    def lose_node(self) -> None:
        """Kill the last node, as when its machine loses its power; returns when the head knows."""
        before = self.places()
        self._kill(self.nodes.pop())
        until(lambda: self.places() == before - 1, self.log)

    def lose_head(self) -> None:
        """Kill the head; returns when the nodes have ended, which do not outlive it."""
        assert self.head is not None
        self._kill(self.head)
        while self.nodes:
            node = self.nodes.pop()
            until(lambda node=node: node.poll() is not None, self.log)

    def end(self) -> None:
        """Kill every process of the cluster and of its jobs."""
        mark = self.environment[_MARK]
        while left := list(_marked(mark)):
            _kill_all(_families(left))
            for started in (self.head, *self.nodes):
                if started is not None:
                    started.poll()

    def _kill(self, started: "subprocess.Popen[bytes]") -> None:
        marked = list(_marked(self.environment[_MARK]))
        of_it = [process for process in marked if _group(process) == started.pid]
        # With the jobs that it runs: a job outlives the daemon of its node for a while.
        _kill_all(_families(of_it))
        started.wait()

    def log(self) -> str:
        return (self.folder / "start.log").read_text()[-2000:]

    def _start(self, *options: str, held: tuple[str, ...] = ()) -> "subprocess.Popen[bytes]":
        with (self.folder / "start.log").open("ab") as log:
            return subprocess.Popen(
                [
                    *held,
                    str(RAY),
                    "start",
                    "--block",
                    "--node-ip-address=127.0.0.1",
                    _SMALL,
                    *options,
                ],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=os.environ | self.environment,
                start_new_session=True,
            )


def _kill_all(processes: list[psutil.Process]) -> None:
    for process in processes:
        with suppress(psutil.Error):
            process.send_signal(signal.SIGKILL)
    psutil.wait_procs(processes, timeout=5)


def _families(processes: list[psutil.Process]) -> list[psutil.Process]:
    """Add all descendants: Ray's own write their titles where their environment was."""
    found = {process.pid: process for process in processes}
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            found |= {child.pid: child for child in process.children(recursive=True)}
    return list(found.values())


def _group(process: psutil.Process) -> int:
    try:
        return os.getpgid(process.pid)
    except ProcessLookupError:
        return 0


def _marked(mark: str) -> Iterator[psutil.Process]:
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if process.environ().get(_MARK) == mark:
                yield process


@contextmanager
def real_cluster() -> Iterator[RealCluster]:
    """Start a head; when it is over, no process of the cluster is left."""
    # Sockets have short names.
    folder = Path(tempfile.mkdtemp(prefix="ray"))
    token, mark = secrets.token_hex(16), secrets.token_hex(8)
    environment = {
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": token,
        "PYTHONPATH": os.pathsep.join(str(path) for path in Path(__file__).parents[2:4]),
        _MARK: mark,
        # Losses are found in seconds, not in minutes.
        "RAY_health_check_initial_delay_ms": "0",
        "RAY_health_check_period_ms": "500",
        "RAY_health_check_failure_threshold": "3",
        "RAY_gcs_rpc_server_reconnect_timeout_s": "3",
    }
    cluster = RealCluster(folder, environment, token)
    try:
        cluster.start_head()
        yield cluster
    finally:
        cluster.end()
        shutil.rmtree(folder, ignore_errors=True)
