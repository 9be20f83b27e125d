"""The Jobs API of a Ray cluster: submitting a command, asking how it is, and stopping it.

It is spoken over HTTP, as Ray documents it, so that the server needs nothing of Ray, and no call
takes longer than it may: a head that hangs must not hold up the queue.
"""

import http.client
import json
import math
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any, cast
from urllib.parse import quote, urlsplit

from app.settings import is_private
from physhandi.data.files import named_fields
from physhandi.errors import RunError, describe

_TIMEOUT_S = 5.0
_LARGEST = 2**24


class ClusterError(RunError):
    """A cluster does not answer, or not as it should."""


@dataclass(frozen=True)
class Demand:
    """Resources that a job requests of the node that it runs on."""

    cpus: int = 1
    """Processors."""
    gpus: int = 0
    """GPUs."""
    memory: int = 0
    """Memory [bytes]; 0 for none in particular."""

    def fits_into(self, resources: Mapping[str, Any]) -> int:
        """Count how many such jobs a node takes side by side, by the resources that Ray names."""
        wanted = {"CPU": self.cpus, "GPU": self.gpus, "memory": self.memory}
        return min(
            math.floor(_number(resources.get(name)) / amount)
            for name, amount in wanted.items()
            if amount
        )


@dataclass(frozen=True)
class ClusterJob:
    """State of a job, as the cluster reports it."""

    status: str
    """PENDING, RUNNING, SUCCEEDED, FAILED or STOPPED."""
    message: str = ""
    """The cluster's message about it."""
    metadata: Mapping[str, Any] | None = None
    """Metadata that was submitted with it."""


class Cluster:
    """Asks the Jobs API of one cluster."""

    def __init__(self, address: str, token: str) -> None:
        """Prepare; nothing is asked yet.

        Args:
            address: ``ray://HOST:PORT``.
            token: The cluster's token.
        """
        parts = urlsplit(address)
        self._host, self._port = parts.hostname or "", parts.port or 0
        self._token = token
        self.place = parts.netloc
        """Host and port, to be told."""

    def submit(self, job: str, command: str, demand: Demand, metadata: Mapping[str, str]) -> None:
        """Have a command executed on some node; once, even if it is called again.

        Args:
            job: Name of the job.
            command: Line for the shell.
            demand: What it needs.
            metadata: Text that is kept with it, by which the same job is known again.

        Raises:
            ClusterError: If the cluster does not take it, or has another job of this name.
        """
        wish: dict[str, Any] = {
            "submission_id": job,
            "entrypoint": command,
            "entrypoint_num_cpus": demand.cpus,
            "metadata": dict(metadata),
        }
        wish |= {"entrypoint_num_gpus": demand.gpus} if demand.gpus else {}
        wish |= {"entrypoint_memory": demand.memory} if demand.memory else {}
        status, content = self._ask("POST", "/api/jobs/", wish)
        if status == 200:
            return
        # It may have been taken before, by a request whose answer was lost.
        existing = self.job(job)
        if (
            existing is None
            or existing.metadata is None
            or dict(existing.metadata) != dict(metadata)
        ):
            raise self._error(status, content)

    def job(self, job: str) -> ClusterJob | None:
        """Look at a job; None if the cluster knows none of this name.

        Raises:
            ClusterError: If the cluster does not answer.
        """
        status, content = self._ask("GET", f"/api/jobs/{quote(job, safe='')}")
        if status == 404:
            return None
        fields = self._fields(status, content)
        state = fields.get("status")
        if not isinstance(state, str):
            raise self._error(status, content)
        return ClusterJob(state, str(fields.get("message") or ""), named_fields(fields["metadata"]))

    def stop(self, job: str) -> None:
        """Ask for the end of a job; one that still waits may be begun all the same.

        Raises:
            ClusterError: If the cluster does not answer.
        """
        status, content = self._ask("POST", f"/api/jobs/{quote(job, safe='')}/stop")
        if status not in {200, 404}:
            raise self._error(status, content)

    def places(self, demand: Demand) -> int:
        """Count how many jobs its live nodes take side by side, were they all free.

        Raises:
            ClusterError: If the cluster does not answer.
        """
        status, content = self._ask("GET", "/api/v0/nodes?detail=1&limit=10000")
        return sum(demand.fits_into(node) for node in _live_nodes(self._fields(status, content)))

    def _fields(self, status: int, content: bytes) -> dict[str, Any]:
        try:
            fields = named_fields(json.loads(content)) if status == 200 else None
        except (ValueError, RecursionError):
            fields = None
        if fields is None:
            raise self._error(status, content)
        return fields

    def _ask(
        self, method: str, path: str, content: Mapping[str, Any] | None = None
    ) -> tuple[int, bytes]:
        line = http.client.HTTPConnection(self._host, self._port, timeout=_TIMEOUT_S)
        with closing(line):
            try:
                line.connect()
                # Its name may stand for another address by now.
                if not is_private(line.sock.getpeername()[0]):
                    raise ClusterError(
                        f"The cluster at {self.place} is not in a private network, so its token is "
                        "not sent there. Lay a tunnel and name its near end."
                    )
                headers = {"Authorization": f"Bearer {self._token}"}
                body = None if content is None else json.dumps(content).encode()
                if body is not None:
                    headers["Content-Type"] = "application/json"
                line.request(method, path, body=body, headers=headers)
                answer = line.getresponse()
                return answer.status, answer.read(_LARGEST)
            except (OSError, http.client.HTTPException, UnicodeError) as error:
                why = describe(error).rstrip(".") or type(error).__name__
                raise ClusterError(
                    f"The cluster at {self.place} does not answer ({why})."
                ) from None

    def _error(self, status: int, content: bytes) -> ClusterError:
        if status in {401, 403}:
            return ClusterError(
                f"The cluster at {self.place} does not answer (it refuses the token of "
                "PHYSHANDI_ENGINE_TOKEN)."
            )
        # Ray answers with a traceback, whose last line says what is wrong.
        lines = content.decode(errors="replace").strip().splitlines() or [""]
        return ClusterError(
            f"The cluster at {self.place} does not answer as it should "
            f"(status {status}: {lines[-1][:200]})."
        )


def _live_nodes(answer: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """List the resources of nodes; what has another shape is none."""
    part = answer
    for name in ("data", "result"):
        part = named_fields(part.get(name)) or {}
    nodes: Any = part.get("result")
    for node in cast("list[Any]", nodes) if isinstance(nodes, list) else []:
        fields = named_fields(node) or {}
        if fields.get("state") == "ALIVE":
            yield named_fields(fields.get("resources_total")) or {}


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else 0.0
