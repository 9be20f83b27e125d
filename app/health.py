"""Endpoints for operators of a server: liveness, readiness and metrics.

``/healthz`` and ``/readyz`` answer everybody, for a container's probes and load balancers, and tell
no names and no paths; ``/metrics`` needs the token, as everything else does.
"""

import logging
import time
from collections import Counter as Tally
from collections.abc import Iterable
from urllib.parse import quote

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse
from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector
from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics_core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.jobs.catalog import Catalog
from app.jobs.machine import Machine
from app.jobs.scheduler import Scheduler
from app.viewer.sessions import Sessions
from physhandi import __version__

logger = logging.getLogger(__name__)
LEAST_DISK = 2**30
"""Free space below which a server is not ready: fits end when there is none [bytes]."""
_SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0)


class RequestFigures:
    """ASGI middleware: counts requests and times their first bytes, by route, not by address."""

    def __init__(self, app: ASGIApp, *, registry: CollectorRegistry) -> None:
        """Prepare.

        Args:
            app: What answers.
            registry: Holds the figures.
        """
        self._app = app
        self._count = Counter(
            "physhandi_http_requests",
            "Requests that were answered.",
            ("method", "route", "status"),
            registry=registry,
        )
        self._seconds = Histogram(
            "physhandi_http_request_seconds",
            "Time until an answer begins.",
            ("route",),
            buckets=_SECONDS,
            registry=registry,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start = time.perf_counter()

        async def send_counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                seconds, status = time.perf_counter() - start, message["status"]
                # The address is of a client's making; the route it led to is of ours.
                route = getattr(scope.get("route"), "path", "none")
                method = scope["method"] if scope["method"] in _METHODS else "other"
                self._count.labels(method, route, status).inc()
                self._seconds.labels(route).observe(seconds)
                place = quote(scope["path"])  # It may hold what looks like another line.
                logger.info("%s %s %d %.1f ms", method, place, status, 1e3 * seconds)
            await send(message)

        await self._app(scope, receive, send_counted)


_METHODS = frozenset({"GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE"})


class _State(Collector):
    """Reads the queue, scenes and the machine when somebody asks for the figures."""

    def __init__(
        self, catalog: Catalog, scheduler: Scheduler, sessions: Sessions, machine: Machine
    ) -> None:
        self._catalog = catalog
        self._scheduler = scheduler
        self._sessions = sessions
        self._machine = machine

    def collect(self) -> Iterable[Metric]:
        """List the figures as they are now."""
        states = Tally(self._scheduler.view(item).state for item in self._catalog.runs())
        yield _family("physhandi_runs", "Runs in the data folder.", "state", states)
        slots = self._scheduler.slots
        yield GaugeMetricFamily("physhandi_fit_slots", "Fits that run side by side.", value=slots)
        scenes = len(self._sessions.list())
        yield GaugeMetricFamily("physhandi_live_scenes", "Live scenes that are open.", value=scenes)
        load = self._machine.load()
        for name in ("memory", "disk"):
            for kind in ("used", "total"):
                about = f"{name.capitalize()} of the machine, {kind}."
                title = f"physhandi_{name}_{kind}_bytes"
                yield GaugeMetricFamily(title, about, value=load[name][kind])
        cards = {str(card["index"]): card for card in load["cards"]}
        for key, name, about in (
            ("memory", "physhandi_gpu_memory_used_bytes", "Memory of a graphics card, used."),
            ("memory_total", "physhandi_gpu_memory_total_bytes", "Memory of a graphics card."),
            ("share", "physhandi_gpu_busy_ratio", "Share of time that a graphics card worked."),
        ):
            values = {index: card[key] for index, card in cards.items() if card[key] is not None}
            yield _family(name, about, "card", values)


def create_health(
    catalog: Catalog,
    scheduler: Scheduler,
    sessions: Sessions,
    machine: Machine,
    registry: CollectorRegistry,
) -> APIRouter:
    """Make the routes.

    Args:
        catalog: Finds runs.
        scheduler: Works through the queue.
        sessions: Live scenes.
        machine: Measures the load.
        registry: Holds the figures of requests; gets the others.
    """
    registry.register(_State(catalog, scheduler, sessions, machine))
    ProcessCollector(registry=registry)
    router = APIRouter(include_in_schema=False)

    @router.get("/healthz")
    def healthz(request: Request) -> dict[str, str]:
        is_known = getattr(request.state, "owner", None) is not None
        return {"status": "ok"} | ({"version": __version__} if is_known else {})

    @router.get("/readyz")
    def readyz() -> Response:
        reasons: list[str] = []
        if not scheduler.is_working:
            reasons.append("The queue does not work: the server starts or ends.")
        free = machine.load()["disk"]["free"]
        if free < LEAST_DISK:
            reasons.append(f"The disk has {free / 2**20:.0f} MiB left; free some space.")
        state = {"status": "not ready" if reasons else "ready", "reasons": reasons}
        return JSONResponse(state, status_code=503 if reasons else 200)

    @router.get("/metrics")
    def metrics(request: Request) -> Response:
        encode, kind = choose_encoder(request.headers.get("accept", ""))
        return Response(encode(registry), media_type=kind)

    return router


def _family(name: str, about: str, label: str, values: dict[str, float] | Tally[str]) -> Metric:
    family = GaugeMetricFamily(name, about, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family
