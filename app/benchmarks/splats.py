"""Speed of an object shown as splats: pictures a second in a browser, bytes and work of a frame."""

import itertools
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from app.benchmarks.browser import new_page
from app.benchmarks.viewer_client import ViewerClient
from app.viewer.content.content import Content, open_run_content
from app.viewer.content.layers import OBJECT_FORMS, ObjectForm
from app.viewer.scene.framing import frame_content
from app.viewer.scene.scene import SceneDrawing
from app.viewer.scene.scene_server import start_viser
from physhandi.appearance.splats import Splats
from physhandi.data.sequence import Sequence
from physhandi.errors import MissingInputError
from physhandi.object_rollout import ObjectRollout
from physhandi.run import Run
from physhandi.simulation.object_surface import ObjectSurface

if TYPE_CHECKING:
    from playwright.sync_api import Browser

COUNTS = (1_000, 5_000, 20_000)
"""Numbers of splats that are shown."""
BUDGETED = "splats_5000"
"""Name of the scene that is compared with the goals."""
_RATE = 30.0
_EVERY = 4
"""Of how many frames one is received whole, for its bytes."""
_OVERLAP = 0.7
"""Deviation of a made splat, in distances between splats."""
_OPACITY = 0.95
_COUNT_PICTURES = """() => {
  window.physhandiPictures = 0;
  const count = () => { window.physhandiPictures += 1; requestAnimationFrame(count); };
  requestAnimationFrame(count);
}"""
_IS_SHOWN = """(name) => Boolean(window.__viserMutable?.nodeRefFromName?.[name])"""


@dataclass(frozen=True)
class _Places:
    """Finds one run, and recordings where the run found them."""

    shown: Run

    def run(self, _: str, /) -> Run:
        return self.shown

    def sequence(self, name: str, /) -> Sequence:
        raise MissingInputError(f"The recording '{name}' is not where the run found it.")


def measure_splats(
    run: Run, sequence: str, browser: "Browser", seconds: float, counts: tuple[int, ...] = COUNTS
) -> dict[str, Any]:
    """Play a run's object as nodes, as a surface, and as made splats on that surface.

    Args:
        run: The run.
        sequence: One of its sequences.
        browser: Draws the pictures.
        seconds: How long pictures are counted of each.
        counts: Numbers of splats.

    Returns:
        By what is shown: ``pictures_per_s`` in the browser while 30 frames a second are sent,
        ``frame_bytes``, ``draw_ms``, the work of the thread that draws a frame, and ``server_ms``,
        that of all threads until it is on its way; and those of `BUDGETED`, or of the most splats
        below it, beside them.

    Raises:
        MissingInputError: If the object has no surface.
    """
    content = open_run_content(_Places(run), run.id, sequence)
    if content.fitted is None or content.surface is None:
        raise MissingInputError(f"The object of run '{run.name}' has no surface to lay splats on.")
    kinds: dict[str, tuple[ObjectForm, Splats | None]] = {
        "nodes": ("nodes", None),
        "surface": ("surface", None),
    }
    for count in counts:
        splats = scattered(content.surface, content.fitted.position[0], count)
        kinds[f"splats_{count}"] = "splats", splats
    measured = {
        name: _measure(replace(content, splats=splats), content.fitted, form, browser, seconds)
        for name, (form, splats) in kinds.items()
    }
    held = measured.get(BUDGETED, measured[f"splats_{max(counts)}"])
    return {"frame_bytes": held["frame_bytes"], "server_ms": held["server_ms"], "kinds": measured}


def scattered(surface: ObjectSurface, node: np.ndarray, count: int) -> Splats:
    """Scatter splats on a surface in its colors, so wide that they cover it.

    Args:
        surface: The surface.
        node: Nodes that carry it [m].
        count: How many splats.
    """
    rng = np.random.default_rng(0)
    vertex = surface.place(node).astype(np.float64)
    a, b, c = (vertex[surface.face[:, corner]] for corner in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    part = rng.dirichlet(np.ones(3), count)
    corner = surface.face[face]
    color = np.full((len(vertex), 3), 160) if surface.color is None else surface.color
    width = _OVERLAP * np.sqrt(area.sum() / count)
    return Splats(
        center=np.einsum("sk,skd->sd", part, vertex[corner]).astype(np.float32),
        scale=np.full(count, width, np.float32),
        color=(np.einsum("sk,skd->sd", part, color[corner]) / 255.0).astype(np.float32),
        opacity=np.full(count, _OPACITY, np.float32),
        rest_node=np.asarray(node, np.float32),
    )


def _measure(
    content: Content, rollout: ObjectRollout, form: ObjectForm, browser: "Browser", seconds: float
) -> Mapping[str, float]:
    server = start_viser("splats")
    try:
        scene = SceneDrawing(server, content, frame_content(content))
        for one in OBJECT_FORMS:
            setattr(scene.layers, one, one == form)
        scene.layers.controls = scene.layers.virtual_springs = False
        scene.layers.object_springs = False
        scene.draw(0, rollout, 0, is_playing=True)
        sent = _measure_sending(server, scene, rollout)
        return sent | {"pictures_per_s": _measure_drawing(server, scene, rollout, browser, seconds)}
    finally:
        server.stop()


def _measure_sending(
    server: viser.ViserServer, scene: SceneDrawing, rollout: ObjectRollout
) -> dict[str, float]:
    """Play all frames once to a client that only reads afterwards."""
    with ViewerClient(f"ws://127.0.0.1:{server.get_port()}", remembers=False) as client:
        _hear_all(server, client)
        busy, drawn = time.process_time(), 0.0
        count = rollout.ready - 1
        for frame in range(1, count + 1):
            start, own = time.monotonic(), time.thread_time()
            scene.draw(frame, rollout, frame, is_playing=True)
            drawn += time.thread_time() - own
            time.sleep(max(1 / _RATE - (time.monotonic() - start), 0.0))
        busy = time.process_time() - busy
        _hear_all(server, client)
        return {
            "frame_bytes": _measure_bytes(server, client, scene, rollout),
            "draw_ms": 1e3 * drawn / count,
            "server_ms": 1e3 * busy / count,
        }


def _measure_bytes(
    server: viser.ViserServer, client: ViewerClient, scene: SceneDrawing, rollout: ObjectRollout
) -> float:
    """Receive every fourth frame whole; one that is late in being sent is replaced by the next."""
    frames = range(1, rollout.ready, _EVERY)
    before = client.bytes_received
    for _ in frames:
        _hear_all(server, client)
    other = client.bytes_received - before
    before = client.bytes_received
    for frame in frames:
        scene.draw(frame, rollout, frame, is_playing=True)
        _hear_all(server, client)
    return (client.bytes_received - before - other) / len(frames)


def _hear_all(server: viser.ViserServer, client: ViewerClient) -> None:
    """Take in what was sent up to now."""
    node = f"/heard_{time.monotonic_ns()}"
    server.scene.add_frame(node, show_axes=False)
    client.until(lambda: node in client.nodes)
    server.scene.remove_by_name(node)


def _measure_drawing(
    server: viser.ViserServer,
    scene: SceneDrawing,
    rollout: ObjectRollout,
    browser: "Browser",
    seconds: float,
) -> float:
    """Count the pictures that a browser draws while the object moves."""
    is_over = threading.Event()

    def play() -> None:
        for frame in itertools.cycle(range(rollout.ready)):
            scene.draw(frame, rollout, frame, is_playing=True)
            if is_over.wait(1 / _RATE):
                return

    playing = threading.Thread(target=play)
    with new_page(browser) as page:
        page.goto(f"http://127.0.0.1:{server.get_port()}")
        page.wait_for_function(_IS_SHOWN, arg="/ground")
        playing.start()
        try:
            page.evaluate(_COUNT_PICTURES)
            page.wait_for_function("() => window.physhandiPictures > 2", polling=100.0)
            start, first = time.perf_counter(), page.evaluate("() => window.physhandiPictures")
            page.wait_for_timeout(1e3 * seconds)
            count = page.evaluate("() => window.physhandiPictures") - first
            return float(count / (time.perf_counter() - start))
        finally:
            is_over.set()
            playing.join()
