"""Who may only look meets no button that answers "you may not", on any page."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Page, Request, expect
from support.browser.scene_page import FEWER_PICTURES, TIMEOUT_MS
from support.browser.small_pictures import place_pictures

from app.security import only_looks

pytestmark = pytest.mark.e2e
BUNDLED = Path(__file__).parents[2] / "sequences"
RUN, TORN = "kept_towel", "torn_towel"
PAGES = (
    "/",
    "/runs",
    f"/runs/{RUN}",
    f"/runs/{TORN}",
    f"/runs/{RUN}/compare",
    "/runs/towel_fold_quick/replay",
    "/sequences",
    "/sequences/towel_fold/check",
    f"/launch?run={RUN}",
    "/import",
    "/import?folder=captures",
    "/system",
    "/recovery",
    "/suites",
    f"/diff?run={RUN}&run=towel_fold_quick",
    f"/compare?a={RUN}&b=towel_fold_quick",
    f"/runs/{RUN}/view",
)
WITH_SCENES = {"/runs/towel_fold_quick/replay", *PAGES[-2:]}
"""Pages whose scenes are left empty. A page of which anything is answered here keeps no script."""
_LAUNCH = {"+ Launch fit", "Launch fit", "Launch", "Change settings first …"}
_ROWS = {f"Delete {RUN}", "Move aside"}
_SEND = {"Choose a folder", "Choose files", "Pause", "Try the example"}
CHANGING = {
    "/": _LAUNCH | _ROWS | {"Import a recording"},
    "/runs": _LAUNCH - {"Launch fit"} | _ROWS,
    f"/runs/{RUN}": {"Edit", "Save", "Cancel", "Share", "Rerun with changes"} | {f"Delete {RUN}"},
    f"/runs/{TORN}": {"Move aside"},
    "/sequences": _LAUNCH - {"+ Launch fit"} | {"Import a recording"},
    "/sequences/towel_fold/check": {"Launch fit"},
    f"/launch?run={RUN}": {"Launch"},
    "/import": _SEND,
    "/import?folder=captures": _SEND,
    "/recovery": {"Move aside"},
    f"/runs/{RUN}/view": {"Share this replay LINK"},
}
"""What pages offer to those alone who may change things; others offer everybody the same."""
_BUTTONS = "button, summary, [data-share-view]"
_OFFERED = """([buttons, page]) => {
  const shown = page === null ? document : new DOMParser().parseFromString(page, "text/html");
  return [...shown.querySelectorAll(buttons)]
    .filter((button) => !button.disabled && !button.closest(".charts"))
    .map((button) => button.getAttribute("aria-label") ?? button.textContent.trim());
}"""
"""What buttons say in a page that the server sent or, if that is null, in the one that is open."""
_PRESS_ALL = """(names) => {
  const buttons = [...document.querySelectorAll(names)]
    .filter((button) => !button.disabled && !button.closest("form[method=get], [data-open]"));
  buttons.forEach((button) => button.click());
  return buttons.length;
}"""
"""Press all buttons, be they visible or not, but those that only lead to another address."""
_EMPTY_SCENE = re.compile("/viewer/")


@pytest.fixture
def shown(served: Any) -> Iterator[None]:
    """A run that may be deleted, and one that is damaged."""
    for name in (RUN, TORN):
        folder = served.data_dir / "runs" / name
        shutil.copytree(BUNDLED / "runs" / "towel_fold_quick", folder)
        job, about = folder / "job.yaml", folder / "run.yaml"
        job.write_text(job.read_text().replace("../../towel_fold", str(BUNDLED / "towel_fold")))
        about.write_text(about.read_text().replace("Towel fold, fitted", name))
    (served.data_dir / "runs" / TORN / "run.yaml").write_text("[")
    place_pictures(served.data_dir)
    yield
    for name in (RUN, TORN):
        shutil.rmtree(served.data_dir / "runs" / name)


@pytest.fixture
def reader(browser: Browser, served: Any, shown: None) -> Iterator[Page]:
    """A tab of somebody who may only look, which may not even ask for anything else."""
    context = browser.new_context(viewport={"width": 1280, "height": 800}, reduced_motion="reduce")
    context.set_default_timeout(TIMEOUT_MS)
    context.add_init_script(FEWER_PICTURES)
    changes: list[str] = []

    def note(request: Request) -> None:
        path = urlsplit(request.url).path.removeprefix(urlsplit(served.base).path)
        if not only_looks({"type": "http", "method": request.method, "path": path}):
            changes.append(f"{request.method} {path}")

    context.on("request", note)
    page = context.new_page()
    page.on("dialog", lambda dialog: dialog.accept())
    page.goto(served.read_only_url)
    yield page
    page.wait_for_load_state()
    context.close()
    assert changes == []


def offered(page: Page, sent: str | None = None) -> set[str]:
    """Read the buttons that may be pressed in a page, or in what the server sent in its place."""
    return set(page.evaluate(_OFFERED, [f"{_BUTTONS}, [role=button]", sent]))


def test_what_only_some_may_do_is_offered_to_them_alone(
    home: Page, reader: Page, served: Any
) -> None:
    pressed = 0
    for path in PAGES:
        reader.unroute_all()
        if path in WITH_SCENES:
            reader.route(_EMPTY_SCENE, lambda route: route.fulfill(content_type="text/html"))
        reader.goto(f"{served.base}{path}")
        expect(reader.locator("[data-only-looks]")).to_have_count(1)
        # Where both are offered the same, what is pressed below tells.
        if path in CHANGING:
            addresses = {home: f"{served.base}{path}", reader: reader.url}
            sent = [page.request.get(address).text() for page, address in addresses.items()]
            assert ["data-only-looks" in page for page in sent] == [False, True]
            of_all, of_reader = (offered(reader, page) for page in sent)
            assert of_all - of_reader == CHANGING[path], path
            assert of_reader <= of_all, path
            assert not CHANGING[path] & offered(reader), path  # No script adds one.
        reader.keyboard.press("n")  # Launches where that may be done.
        pressed += reader.evaluate(_PRESS_ALL, _BUTTONS)
        expect(reader.locator("#new")).to_have_count(0)
    assert pressed > 100
    reader.goto(served.base)
    reader.locator("[data-only-looks]").hover()
    expect(reader.locator("#tip")).to_contain_text("You may only look here.")
