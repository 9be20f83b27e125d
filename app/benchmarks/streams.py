"""Streams of live scenes to a client without a browser, and their timing."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from app.benchmarks.served import Served, ServerFailedError
from app.benchmarks.viewer_client import PATIENCE_S, ViewerClient

_SURFACE = "/object/surface"
_ARROWS = "/forces"
_SETTLING_S = 3.0


def percentiles(seconds: list[float]) -> dict[str, float]:
    """Give the median, the 95th percentile and the largest of some times [ms]."""
    p50, p95, largest = 1e3 * np.quantile(seconds, [0.5, 0.95, 1.0])
    return {"p50_ms": float(p50), "p95_ms": float(p95), "worst_ms": float(largest)}


class Screen:
    """Frames of a playing object that one client gets."""

    def __init__(self, client: ViewerClient) -> None:
        self.client = client
        # A new scene begins to play when its first client is there.
        client.until(lambda: self.is_playing and _SURFACE in client.nodes)

    @property
    def is_playing(self) -> bool:
        """Whether the clock is running."""
        return bool(self.client.find("Pause"))

    @property
    def positions(self) -> Float[ndarray, "vertex 3"]:
        """Positions of the shown surface of the object [m]."""
        return self.client.array(_SURFACE, "vertices")

    def play(self, *, on: bool) -> None:
        """Press the button that starts or stops the clock."""
        if self.is_playing != on:
            self.client.send("GuiUpdateMessage", uuid=self._button(), updates={"value": True})
            self.client.until(lambda: self.is_playing == on)

    def rest_at(self, frame: int, place: Float[ndarray, "vertex 3"]) -> None:
        """Stop the clock at a frame, and wait until the object is drawn there.

        Args:
            frame: Which one.
            place: Where the object's surface is in it [m].
        """
        self.play(on=False)
        # Nobody hears a slider that is moved to where it stands: it comes from another frame.
        for step in (frame - 1 if frame else 1, frame):
            self.client.set("Frame", step)
        self.client.until(lambda: np.allclose(self.positions, place, atol=1e-6))

    def seconds_until(self, is_there: Callable[[ndarray], bool]) -> float:
        """Wait until the surface arrives at a place of which something is true.

        Returns:
            When they arrived [s, clock of `time.perf_counter`].

        Raises:
            TimeoutError: If they do not come.
        """
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            for message in self.client.take_in(0.5):
                is_moved = message["type"] == "SceneNodeUpdateMessage" and (
                    message["name"] == _SURFACE and "vertices" in message["updates"]
                )
                if is_moved and is_there(self.positions):
                    return self.client.moment
        raise TimeoutError(f"no such frame came in {PATIENCE_S:g} s")

    def _button(self) -> str:
        return self.client.find("Pause") or self.client.find("Play")


def measure_scrub(
    served: Served, run_id: str, shown: Float[ndarray, "frame vertex 3"], moves: int
) -> dict[str, Any]:
    """Drag the timeline of a paused scene, and wait for the object in each frame.

    Args:
        served: The server.
        run_id: The run to show.
        shown: Where the surface of its object is [m].
        moves: How often.

    Returns:
        Time from the slider's message to the frame's.
    """
    session = served.open("run", run_id)
    seconds: list[float] = []
    with served.watch(session) as client:
        screen = Screen(client)
        # No two frames in turn are alike, and none is far from the one before for long.
        start_frame, *frames = (23 * move % len(shown) for move in range(moves + 1))
        screen.rest_at(start_frame, shown[start_frame])
        for frame in frames:
            client.listen(0.1)
            start = time.perf_counter()
            client.set("Frame", frame)
            wanted = shown[frame]
            seconds.append(
                screen.seconds_until(lambda p, w=wanted: np.allclose(p, w, atol=1e-6)) - start
            )
    served.shut(session)
    return {"moves": moves, **percentiles(seconds)}


@dataclass
class _Received:
    """Messages and times that one client received while a scene played."""

    frames: list[int] = field(default_factory=list[int])
    sizes: list[int] = field(default_factory=list[int])
    arrows: list[int] = field(default_factory=list[int])
    seconds: float = 0.0
    error: str = ""

    def skipped(self, frame_count: int) -> int:
        """Count the frames that were never there."""
        steps = np.diff(self.frames) % frame_count
        return int(np.maximum(steps - 1, 0).sum())


def measure_sessions(
    served: Served, run_id: str, *, count: int, frame_count: int, frame_rate: float, seconds: float
) -> dict[str, Any]:
    """Let several scenes play at once, each with a client of its own.

    Args:
        served: The server.
        run_id: The run that all show.
        count: Scenes.
        frame_count: Frames of the run's sequence.
        frame_rate: Its frames a second [Hz].
        seconds: How long [s].

    Returns:
        Frames received and skipped in a second by the worst client, the size of a frame, and how
        busy the server was.

    Raises:
        ServerFailedError: If a client lost its scene.
    """
    sessions = [served.open("run", run_id) for _ in range(count)]
    everyone = threading.Barrier(count + 1)
    received = [_Received() for _ in sessions]
    threads = [
        threading.Thread(
            target=_receive, args=(served, session, everyone, seconds, mine), daemon=True
        )
        for session, mine in zip(sessions, received, strict=True)
    ]
    for thread in threads:
        thread.start()
    everyone.wait(PATIENCE_S)
    time.sleep(_SETTLING_S)
    busy, start = served.cpu_seconds(), time.perf_counter()
    everyone.wait(PATIENCE_S)
    for thread in threads:
        thread.join()
    busy, passed = served.cpu_seconds() - busy, time.perf_counter() - start
    for session in sessions:
        served.shut(session)
    errors = [mine.error for mine in received if mine.error]
    if errors:
        raise ServerFailedError(f"A client lost its scene: {errors[0]}")
    rates = [len(mine.frames) / mine.seconds for mine in received]
    lost = [mine.skipped(frame_count) / mine.seconds for mine in received]
    sizes = np.concatenate([mine.sizes for mine in received])
    return {
        "sessions": count,
        "seconds": seconds,
        "frame_rate": frame_rate,
        "frames_per_s": float(np.mean(rates)),
        "worst_frames_per_s": min(rates),
        "skipped_per_s": float(np.mean(lost)),
        "worst_skipped_per_s": max(lost),
        "frame_bytes": {
            "p50": float(np.median(sizes)),
            "p95": float(np.quantile(sizes, 0.95)),
            "largest": int(sizes.max()),
        },
        "arrows": max(max(mine.arrows) for mine in received),
        "megabytes_per_s": 1e-6 * float(sizes.sum()) / seconds,
        "server_cpu_share": busy / passed,
        "server_cpu_ms_per_frame": 1e3 * busy / sum(len(mine.frames) for mine in received),
    }


def _receive(
    served: Served, session: str, everyone: threading.Barrier, seconds: float, mine: _Received
) -> None:
    try:
        with served.watch(session) as client:
            screen = Screen(client)
            everyone.wait(PATIENCE_S)
            end = time.monotonic() + _SETTLING_S
            while time.monotonic() < end:
                client.take_in(0.1)
            screen.play(on=True)
            everyone.wait(PATIENCE_S)
            _count(client, seconds, mine)
    except (OSError, threading.BrokenBarrierError, ValueError) as error:
        mine.error = str(error) or type(error).__name__
        everyone.abort()


def _count(client: ViewerClient, seconds: float, mine: _Received) -> None:
    """Note frame numbers and sizes for some time, and until there is a frame."""
    slider = client.find("Frame")
    start = time.perf_counter()
    held = client.bytes_received
    while (left := start + seconds - time.perf_counter()) > 0 or not mine.frames:
        if left < -PATIENCE_S:
            raise TimeoutError(f"no frame came in {PATIENCE_S:g} s")
        for message in client.take_in(min(left, 0.2) if left > 0 else 0.2):
            if message["type"] != "GuiUpdateMessage" or message["uuid"] != slider:
                continue
            frame = int(message["updates"].get("value", -1))
            if frame >= 0 and (not mine.frames or frame != mine.frames[-1]):
                mine.frames.append(frame)
                mine.sizes.append(client.bytes_received - held)
                held = client.bytes_received
                arrows = client.nodes.get(_ARROWS, {}).get("points", ())
                mine.arrows.append(len(arrows) // 6)
    mine.seconds = time.perf_counter() - start
