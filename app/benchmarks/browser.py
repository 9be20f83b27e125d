"""Delays in a real browser: the home page, a live scene and its slider."""

import json
import re
import shutil
import time
from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np

from app.benchmarks.served import Served, ServerFailedError
from app.benchmarks.sliders import TOLERANCE, MeasuredSlider, Move
from app.benchmarks.streams import percentiles
from app.benchmarks.viewer_client import PATIENCE_S
from physhandi.errors import MissingInputError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Frame, Page

BROWSERS = ("chromium", "chromium-browser", "chromium-headless-shell")
"""Programs that are looked for, in this order; the last one draws no windows, only pages."""
_FLAGS = ("--no-sandbox", "--use-angle=gl-egl", "--ignore-gpu-blocklist")
_SIZE = (1280, 800)
_PATIENCE_MS = 1e3 * PATIENCE_S
_COUNTED_MS = 3000.0
_POLLING_MS = 100.0
"""Pages are asked so often, and not with their pictures, of which a stalled one draws none."""
_PAINTED = """() => {
  const paint = performance.getEntriesByName("first-contentful-paint")[0];
  const page = performance.getEntriesByType("navigation")[0];
  return paint && page.loadEventEnd > 0
    ? { painted: paint.startTime, answered: page.responseEnd, loaded: page.loadEventEnd } : null;
}"""
# viser's messages come in through a worker: the page is told of them after they were unpacked.
_WATCH = """(() => {
  const watch = { expected: null, pressed: 0, arrived: 0, drawn: 0, frames: 0, first: 0 };
  let isResult = false;
  window.physhandiWatch = watch;
  const isOf = (rollout, shown) => rollout.some((frame) =>
    frame.length === shown.length
      && frame.every((value, i) => Math.abs(value - shown[i]) <= watch.expected.tolerance));
  const isNew = (shown) =>
    isOf(watch.expected.rollout, shown) && !isOf(watch.expected.before, shown);
  const look = ({ data }) => {
    if (data?.type !== "message_batch") return;
    for (const message of data.messages) {
      if (!isResult && message.name?.startsWith("/object/")) {
        isResult = true;
        const note = () => { watch.first = performance.timeOrigin + performance.now(); };
        requestAnimationFrame(() => requestAnimationFrame(note));
      }
      const moved = message.type === "SceneNodeUpdateMessage" && message.name === "/object/surface"
        && message.updates.vertices;
      if (!moved) continue;
      watch.frames += 1;
      if (watch.arrived || !watch.expected || !watch.pressed
        || !isNew(moved.subarray(0, watch.expected.count))) continue;
      watch.arrived = performance.now();
      // The next callback draws it; when the one after that begins, it is on its way to the screen.
      const note = () => { watch.drawn = performance.now(); };
      requestAnimationFrame(() => requestAnimationFrame(note));
    }
  };
  const Original = window.Worker;
  window.Worker = class extends Original {
    constructor(...given) {
      super(...given);
      this.addEventListener("message", look);
    }
  };
  addEventListener("pointerdown", (event) => { watch.pressed = event.timeStamp; }, true);
  addEventListener("mousedown", (event) => { watch.pressed ||= event.timeStamp; }, true);
})()"""
# The page of the scene is another one; what a tab remembers is known to both.
_CLICKED = "physhandi-clicked"
_REMEMBER = f"""() => addEventListener("click", (event) => sessionStorage.setItem(
  "{_CLICKED}", performance.timeOrigin + event.timeStamp), true)"""
_SINCE_CLICK = f"""() => window.physhandiWatch.first
  - Number(sessionStorage.getItem("{_CLICKED}"))"""
# A scene belongs to the browser that opened it.
_OPEN = """(id) => fetch("/api/v1/sessions", {
  method: "POST", headers: { "Content-Type": "application/json" },
  body: JSON.stringify({ kind: "run", id }),
}).then((answer) => answer.ok ? answer.json() : answer.text().then((text) => { throw text; }))
  .then((session) => new URL(session.url, location).href)"""
_CLOSE = """(id) => fetch(`/api/v1/sessions/${id}`, { method: "DELETE" })"""
_COMPARED = 600
"""Coordinates by which frames are told apart."""
# As one text: Playwright takes seconds for so many numbers, one by one.
_EXPECT = """(text) => {
  const [rollout, before, tolerance] = JSON.parse(text);
  Object.assign(window.physhandiWatch, {
    expected: { rollout, before, tolerance, count: rollout[0].length },
    pressed: 0, arrived: 0, drawn: 0,
  });
}"""


def find_chromium(*, draws_windows: bool = True) -> str | None:
    """Find an installed Chromium.

    Args:
        draws_windows: Whether one that draws windows is preferred; one that does not takes a third
            less processor time.

    Returns:
        Its program; None if there is none.
    """
    programs = BROWSERS if draws_windows else reversed(BROWSERS)
    return next(filter(None, map(shutil.which, programs)), None)


@contextmanager
def open_chromium() -> "Generator[Browser]":
    """Start a headless Chromium.

    Raises:
        MissingInputError: If Playwright's package or Chromium is not installed.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        raise MissingInputError(
            "Measuring in a browser needs Playwright: pip install playwright. "
            "Or leave these parts out with --parts."
        ) from None
    executable = find_chromium()
    if executable is None:
        raise MissingInputError(
            "Measuring in a browser needs Chromium: apt-get install chromium libegl-mesa0 "
            "libgl1-mesa-dri. Or leave these parts out with --parts."
        )
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=executable, args=list(_FLAGS))
        try:
            yield browser
        finally:
            browser.close()


def measure_first_paint(served: Served, browser: "Browser", visits: int) -> dict[str, Any]:
    """Open the home page in new browser profiles, which know nothing of it.

    Args:
        served: The server.
        browser: The browser.
        visits: How often.

    Returns:
        Time from the navigation to the first paint of content, and medians of when the page had
        been answered and when everything on it had been loaded.
    """
    visited: list[dict[str, float]] = []
    for _ in range(visits):
        with new_page(browser) as page:
            page.goto(served.url, wait_until="load")
            page.wait_for_function(_PAINTED, polling=_POLLING_MS)
            visited.append(page.evaluate(_PAINTED))
    return {
        "visits": visits,
        **percentiles([1e-3 * visit["painted"] for visit in visited]),
        "answered_ms": float(np.median([visit["answered"] for visit in visited])),
        "loaded_ms": float(np.median([visit["loaded"] for visit in visited])),
    }


def measure_opening(served: Served, browser: "Browser", run_id: str, visits: int) -> dict[str, Any]:
    """Press *Open* of a run on the home page, and wait for the first frame of its object.

    The first visit, in which the browser gets the scene's scripts, is not counted.

    Args:
        served: The server.
        browser: The browser.
        run_id: The run, which the home page lists.
        visits: How often.

    Returns:
        Time from the click until the first frame with the object is drawn.
    """
    seconds: list[float] = []
    with new_page(browser) as page:
        page.add_init_script(_WATCH)
        page.goto(served.url)
        for _ in range(1 + visits):
            page.evaluate(_REMEMBER)
            page.locator(f'#runs [data-run="{run_id}"] [data-open]').click()
            scene = _scene_of(page)
            scene.wait_for_function("() => window.physhandiWatch.first > 0", polling=_POLLING_MS)
            seconds.append(1e-3 * float(scene.evaluate(_SINCE_CLICK)))
            _close(page, served)
    return {"visits": visits, **percentiles(seconds[1:])}


def measure_slider_in_browser(
    served: Served, browser: "Browser", run_id: str, slider: MeasuredSlider, moves: list[Move]
) -> dict[str, Any]:
    """Press on a slider of a playing scene, and wait for the first new frame.

    Args:
        served: The server; its live simulation runs on the CPU.
        browser: The browser.
        run_id: The run to show.
        slider: The slider.
        moves: Where to.

    Returns:
        Time from the press to the arrival of the first surface that only the new rollout
        has (``arrived_…``), and until they are drawn; and how many frames a second arrived.
    """
    arrived: list[float] = []
    drawn: list[float] = []
    before = slider.fitted
    with new_page(browser) as page:
        page.add_init_script(_WATCH)
        page.goto(served.url)
        page.goto(page.evaluate(_OPEN, run_id))
        scene = _scene_of(page)
        scene.get_by_role("button", name="Pause", exact=True).wait_for()
        scene.wait_for_function("() => window.physhandiWatch.frames > 30", polling=_POLLING_MS)
        opened = 1e-3 * float(page.evaluate("() => performance.now()"))
        for move in moves:
            pair = [r.reshape(len(r), -1)[:, :_COMPARED].tolist() for r in (move.shown, before)]
            scene.evaluate(_EXPECT, json.dumps([*pair, TOLERANCE]))
            _press(page, scene, slider, move)
            scene.wait_for_function("() => window.physhandiWatch.drawn > 0", polling=_POLLING_MS)
            moments = scene.evaluate("() => window.physhandiWatch")
            arrived.append(1e-3 * (moments["arrived"] - moments["pressed"]))
            drawn.append(1e-3 * (moments["drawn"] - moments["pressed"]))
            page.wait_for_timeout(300)
            before = move.shown
        rate = _rate(page, scene)
        _close(page, served)
    when = {f"arrived_{name}": value for name, value in percentiles(arrived).items()}
    return {
        "moves": len(moves),
        **percentiles(drawn),
        **when,
        "playing_after_ms": 1e3 * opened,
        "frames_per_s": rate,
    }


@contextmanager
def new_page(browser: "Browser") -> "Generator[Page]":
    """Open a page in a new browser profile, which knows nothing of others."""
    context = browser.new_context(viewport={"width": _SIZE[0], "height": _SIZE[1]})
    context.set_default_timeout(_PATIENCE_MS)
    yield context.new_page()
    # After an error only the browser as a whole is closed: Chromium may never end a page that is
    # on its way to another one.
    context.close()


def _scene_of(page: "Page") -> "Frame":
    """Wait for the page of a live scene, and give the scene in it."""
    page.wait_for_url("**/live/**")
    frame = page.wait_for_selector("#scene")
    scene = frame.content_frame() if frame is not None else None
    if scene is None:
        raise ServerFailedError("The page of the live scene holds no scene.")
    return scene


def _close(page: "Page", served: Served) -> None:
    """Go home and end the live scene; its own page would load itself again to say that it ended."""
    session = urlsplit(page.url).path.split("/")[-1]
    page.goto(served.url)
    page.evaluate(_CLOSE, session)


def _press(page: "Page", scene: "Frame", slider: MeasuredSlider, move: Move) -> None:
    """Press on the slider's track where the value is, as a mouse does."""
    knob = slider.knob
    label = scene.locator("label", has_text=re.compile(f"^(● )?{re.escape(knob.label)}$"))
    row = label.locator("xpath=ancestor::div[contains(@class, 'mantine-Flex-root')][1]")
    track = row.locator(".mantine-Slider-trackContainer")
    track.scroll_into_view_if_needed()
    box = track.bounding_box()
    if box is None:
        raise ServerFailedError(f"The slider '{knob.label}' is not on the page.")
    part = (move.value - knob.low) / (knob.high - knob.low)
    # Where the track is by then: lines above it come and go while something is simulated.
    track.click(position={"x": part * box["width"], "y": 0.5 * box["height"]})
    field = row.locator("input.mantine-NumberInput-input").first  # Factors have one more.
    end = time.monotonic() + PATIENCE_S
    while abs((shown := float(field.input_value())) - move.value) > 0.01 * knob.step:
        if time.monotonic() > end:
            raise ServerFailedError(f"The slider went to {shown:g} instead of {move.value:g}.")
        page.wait_for_timeout(50)


def _rate(page: "Page", scene: "Frame") -> float:
    """Count the frames that arrive in a second."""
    start = time.perf_counter()
    count = scene.evaluate("() => window.physhandiWatch.frames")
    page.wait_for_timeout(_COUNTED_MS)
    count = scene.evaluate("() => window.physhandiWatch.frames") - count
    return float(count / (time.perf_counter() - start))
