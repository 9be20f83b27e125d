"""A real server, a real browser, and a watch over what the browser complains about."""

import io
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
from PIL import Image
from playwright.sync_api import (
    Browser,
    BrowserContext,
    Page,
    Playwright,
    ViewportSize,
    expect,
    sync_playwright,
)
from support.browser.scene_page import (
    COARSER_PICTURES,
    FEWER_PICTURES,
    LESS_WORK,
    TIMEOUT_MS,
    ScenePage,
    scaled_pictures,
)
from support.browser.small_pictures import README_PICTURES, place_pictures
from support.waiting import LIMIT_S, until

from app.benchmarks.browser import find_chromium
from app.jobs.processes import end_processes

ROOT = Path(__file__).parents[2]
BELOW = "/lab/physhandi"
"""Path below which the servers of these tests serve, as behind a proxy."""
START = "from app.cli import main; main()"
_CHROMIUM = ["--no-sandbox", "--use-angle=gl-egl", "--ignore-gpu-blocklist"]
_VIEWPORT: ViewportSize = {"width": 1280, "height": 800}
_STILL: Literal["reduce"] = "reduce"
"""What moves for decoration alone is drawn sixty times a second, by software; a test that is about
motion asks for it."""
_SETTLE_MS = 2_000
"""Time that software rendering takes to catch up with the scene."""
_REPORT_VIOLATIONS = (
    "document.addEventListener('securitypolicyviolation', (event) => console.error("
    "'policy violated', event.violatedDirective, event.blockedURI));"
)

_HARMLESS = (
    "htmx:afterRequest",
    "htmx:sendAbort",
    "Tried to update non-existent component",
    "THREE.BufferGeometry.computeBoundingSphere(): Computed radius is NaN",
)
"""What htmx says of a request that ends since its page is left (of one that fails it says more).
What viser's browser says where a change of a control and its removal arrive for one picture: it
removes at once and changes at the end. A change after the removal is refused by viser's server.
And what it says of every scene with splats: each is drawn on a square whose corners have two
coordinates (its `GaussianSplatsHelpers.ts`), whatever splats are sent."""


@dataclass(frozen=True)
class Served:
    """A server that runs beside the tests."""

    url: str
    """The address that it printed, with the token."""
    read_only_url: str
    """The one for people who may only look."""
    data_dir: Path
    """Where it keeps runs."""
    process_id: int

    @property
    def base(self) -> str:
        """What all its addresses begin with; a path with a slash follows."""
        return self.url.partition("?")[0].rstrip("/")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Count no line while the program runs in a process of its own, where none would be found."""
    for item in items:
        is_served = "served" in getattr(item, "fixturenames", ())
        if is_served and item.path.parent == Path(__file__).parent:
            item.add_marker(pytest.mark.no_cover)


_PLACES = ("runs", "sequences", "captures", "incoming", "models", "damaged", "presets", "shares")
"""Folders of a server in which tests leave something."""
_ROOTS: dict[str, str] = {}
"""What addresses of each server begin with, and what they have to."""


def _leads_out(url: str) -> bool:
    """Tell whether an address of a server is not below its path."""
    begin = url.replace("ws://", "http://", 1)
    return any(
        begin.startswith(f"{origin}/") and not begin.startswith(f"{base}/")
        for origin, base in _ROOTS.items()
    )


@contextmanager
def _serving(folder: Path) -> Iterator[Served]:
    """Start the program in a folder as a user does, and end it with the fits that it began."""
    # Users start it where they work, and often have a package of this name there.
    (folder / "app").mkdir()
    (folder / "app" / "__init__.py").write_text("raise SystemExit('a package of the user')")
    place_pictures(folder / "data")
    options = ["--port", "0", "--data-dir", "data", "--root-path", BELOW]
    options += ["--read-only-token-file", "read_only"]
    command = [sys.executable, "-P", "-c", START, "serve", *options]
    printed = folder / "printed"
    with printed.open("w") as out, (folder / "log").open("w") as log:
        # Tabs that tests have left keep their scenes for a while.
        environment = os.environ | {"PYTHONPATH": str(ROOT), "PHYSHANDI_LIVE_SESSIONS": "100"}
        server = subprocess.Popen(command, cwd=folder, stdout=out, stderr=log, env=environment)
    try:

        def has_printed() -> bool:
            assert server.poll() is None, (folder / "log").read_text()
            return printed.read_text().count("\n") == 2

        until(has_printed, (folder / "log").read_text)
        served = Served(*printed.read_text().split(), folder / "data", server.pid)
        _ROOTS[served.base.removesuffix(BELOW)] = served.base
        yield served
    finally:
        for run in (folder / "data" / "runs").glob("*"):
            end_processes(run, grace_s=0)
        server.terminate()
        try:
            server.wait(LIMIT_S)
        finally:
            server.kill()
            server.wait()


@pytest.fixture(scope="package")
def _shared_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with _serving(tmp_path_factory.mktemp("shared_server")) as served:
        yield served


@pytest.fixture(scope="module")
def served(_shared_server: Served, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The server of all files, each of which leaves to the next what it found there."""
    places = [_shared_server.data_dir / name for name in _PLACES]
    found = {path for place in places for path in place.glob("*")}
    yield _shared_server
    aside = tmp_path_factory.mktemp("aside")
    for path in {path for place in places for path in place.glob("*")} - found:
        end_processes(path, grace_s=0)
        # At once: the server, which is still at work, may be writing there.
        path.rename(aside / f"{path.parent.name}.{path.name}")


@pytest.fixture(scope="package")
def playwright_driver() -> Iterator[Playwright]:
    expect.set_options(timeout=TIMEOUT_MS)
    with sync_playwright() as driver:
        yield driver


@pytest.fixture(scope="package")
def browser(playwright_driver: Playwright) -> Iterator[Browser]:
    executable = find_chromium(draws_windows=False)
    if executable is None:
        reason = "needs Debian's chromium-headless-shell with libegl-mesa0 and libgl1-mesa-dri"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)
    browser = playwright_driver.chromium.launch(
        executable_path=executable,
        args=_CHROMIUM + ([] if os.environ.get(README_PICTURES) else [*LESS_WORK]),
        timeout=TIMEOUT_MS,
    )
    yield browser
    browser.close()


def _complaints_in(context: BrowserContext) -> list[str]:
    """Prepare a browser without history, and list what its pages complain of from now on."""
    complaints: list[str] = []
    context.set_default_timeout(TIMEOUT_MS)
    context.add_init_script(_REPORT_VIOLATIONS + FEWER_PICTURES)
    # Else viser draws fewer pixels where it is slow, which pictures of the docs would show.
    for_docs = bool(os.environ.get(README_PICTURES))
    context.add_init_script(scaled_pictures(1.0) if for_docs else COARSER_PICTURES)
    context.on(
        "console",
        lambda m: (
            m.type == "error"
            and not any(known in m.text for known in _HARMLESS)
            and complaints.append(m.text)
        ),
    )
    context.on("weberror", lambda error: complaints.append(str(error.error)))

    def watch(url: str) -> None:
        if _leads_out(url):
            complaints.append(f"{url} is not below the server's path")

    context.on("request", lambda request: watch(request.url))
    context.on("page", lambda page: page.on("websocket", lambda socket: watch(socket.url)))
    return complaints


def _close(context: BrowserContext) -> None:
    for page in context.pages:
        page.wait_for_load_state()  # Chromium may never end a page that is still being loaded.
    context.close()


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    """A browser for one test; its pages may not complain of anything."""
    context = browser.new_context(viewport=_VIEWPORT, reduced_motion=_STILL)
    complaints = _complaints_in(context)
    yield context
    _close(context)
    assert complaints == []


@dataclass(eq=False)
class _OpenedScene:
    """The scene that tests share; none before the first of them, and after one that failed."""

    scene: ScenePage | None = None
    complaints: list[str] = field(default_factory=list[str])

    def close(self) -> None:
        if self.scene is not None:
            _close(self.scene.page.context)
        self.scene = None


@pytest.fixture(scope="package")
def _opened_scene(browser: Browser) -> Iterator[_OpenedScene]:
    opened = _OpenedScene()
    yield opened
    opened.close()


@pytest.fixture
def shared_scene(
    browser: Browser,
    served: Served,
    _opened_scene: _OpenedScene,
    request: pytest.FixtureRequest,
) -> Iterator[ScenePage]:
    """The finished run in the viewer, paused and as fitted, in a browser that tests share.

    Opening a scene takes longer than most of what is done in it. Whoever changes its physics or
    what it shows of it changes that back.
    """
    opened = _opened_scene
    if opened.scene is None:
        page = browser.new_context(viewport=_VIEWPORT, reduced_motion=_STILL).new_page()
        opened.complaints = _complaints_in(page.context)
        page.goto(served.url)
        scene = ScenePage.opened_from(page)
        scene.pause()
        scene.calm_down()
        opened.scene = scene
    opened.scene.rest(on=False)
    failed = request.session.testsfailed
    opened.scene.page.set_viewport_size(_VIEWPORT)
    for tab in ("Physics", "Springs"):
        opened.scene.tab(tab)
    yield opened.scene
    complaints = [*opened.complaints]
    opened.complaints.clear()
    if complaints or request.session.testsfailed > failed:
        opened.close()
    else:
        opened.scene.rest(on=True)
    assert complaints == []


@pytest.fixture
def open_home(context: BrowserContext, served: Served) -> Callable[[], Page]:
    """Open a tab at the printed address; all tabs belong to the same browser."""

    def open_one() -> Page:
        page = context.new_page()
        page.goto(served.url)
        return page

    return open_one


@pytest.fixture
def home(open_home: Callable[[], Page]) -> Page:
    """The start page."""
    return open_home()


@pytest.fixture(scope="session")
def picture() -> Callable[[Page, str], None]:
    """Keep a picture of a page for the README, if somebody wants pictures.

    Tests call it where they have just shown that the page is what the picture claims.
    """
    folder = os.environ.get(README_PICTURES, "")

    def keep(page: Page, name: str) -> None:
        if not folder:
            return
        if page.locator("#scene").count():  # Notices of this machine's slow graphics.
            notices = page.frame_locator("#scene").locator(".mantine-Notification-closeButton")
            for _ in range(notices.count()):
                notices.first.click()
        if page.locator("[data-first-hint]").is_visible():
            page.get_by_role("button", name="Got it").click()
        page.mouse.move(640, 790)
        expect(page.locator(".shot.pending:not(:has(img))")).to_have_count(0)
        page.wait_for_timeout(_SETTLE_MS)
        image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        image.save(Path(folder) / f"{name}.webp", quality=88, method=6)

    return keep
