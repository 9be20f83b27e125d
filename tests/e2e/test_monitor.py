"""A fit watched while it goes on, and made again with other settings, in a real browser."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import BrowserContext, Page, expect
from support.inputs.sheet_sequence import write_sheet
from support.server.queue_world import QueueWorld, queue_world, serving

from physhandi.data.attempt import PreviewFile
from physhandi.progress import Preview

pytestmark = pytest.mark.e2e
IN_BYTES = re.compile(r"^[\d.]+ GiB of [\d.]+ GiB$")
BLUE = """(canvas) => {
  const { width, height } = canvas;
  const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
  let [count, rows] = [0, 0];
  for (let i = 0; i < data.length; i += 4) {
    if (data[i + 2] <= data[i] + 60 || data[i + 3] <= 200) continue;
    count++;
    rows += Math.floor(i / 4 / width);
  }
  return [count, rows / count / height];
}"""


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[QueueWorld]:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    (tmp_path / "bundled").mkdir()
    write_sheet(tmp_path / "data" / "sequences" / "sheet")
    with queue_world(tmp_path / "data", tmp_path / "bundled") as world:
        yield world


@pytest.fixture
def page(world: QueueWorld, context: BrowserContext) -> Iterator[Page]:
    with serving(world) as port:
        page = context.new_page()
        page.emulate_media(reduced_motion="no-preference")  # So that previews play.
        page.goto(f"http://127.0.0.1:{port}/system?token={world.token}")
        yield page
        page.goto("about:blank")


def falling_sheet() -> Preview:
    """A square of nodes that sinks by 0.3 m."""
    axis = np.linspace(0.0, 0.3, 12)
    node = np.stack([*np.meshgrid(axis, axis), np.full((12, 12), 0.3)], -1).reshape(1, -1, 3)
    fall = np.linspace(0.0, 0.3, 10)[:, None, None] * np.array([0.0, 0.0, 1.0])
    motion = (node - fall).astype(np.float32)
    points = {"object": motion, "seen": motion[:, :1]}
    return Preview(
        stage="zeroth_order", sequence="sheet", loss=0.02, frame_rate=10.0, points=points
    )


def test_a_fit_is_watched_as_it_goes(world: QueueWorld, page: Page) -> None:
    expect(page.locator("#idle")).to_be_visible()
    run_id = world.launch("script")
    waiting = world.launch("wait")
    expect(page.locator("#running [data-run]")).to_contain_text("script")
    expect(page.locator("#waiting [data-run]")).to_contain_text("No. 1")
    expect(page.locator("[data-slots]")).to_have_text("1 of 1 place for fits taken, 1 in line")
    urgent = world.launch("wait too")
    rows = page.locator("#waiting [data-run]")
    expect(rows.nth(1)).to_contain_text("No. 2")
    page.get_by_role("button", name="High priority for wait too").click()
    expect(rows.first).to_contain_text(re.compile("No. 1.*wait too.*high"))
    for name in ("wait too", "wait"):
        page.get_by_role("button", name=f"Cancel {name}", exact=True).click()
        expect(rows.filter(has_text=f"{name}sheet")).to_have_count(0)
    expect(page.locator("#line")).to_be_hidden()
    for run in (waiting, urgent):
        world.until(run, "cancelled")

    page.locator("#running a").click()
    world.tell(run_id, ["report", "zeroth_order", 1, 4, 0.03])
    expect(page.locator("#now [data-takes]")).to_contain_text("This fit takes")
    expect(page.get_by_role("meter", name="Memory")).to_have_attribute("aria-valuetext", IN_BYTES)
    # What an earlier attempt showed is removed by a worker that begins.
    world.until_reported(run_id, "zeroth_order")
    PreviewFile(world.folder(run_id)).write(falling_sheet)
    text = page.locator("[data-preview-text]")
    expect(text).to_contain_text("zeroth order · loss 0.02000")
    canvas = page.locator(".preview canvas")
    canvas.focus()
    page.keyboard.press(" ")
    page.evaluate("page.preview.frame = 0; page.preview.draw()")
    expect(text).to_contain_text("frame 0")
    count, high = canvas.evaluate(BLUE)
    assert count > 300
    page.evaluate("page.preview.frame = 9; page.preview.draw()")
    count, low = canvas.evaluate(BLUE)
    assert count > 300
    assert low > high + 0.15


def test_a_fit_is_made_again_with_other_settings(world: QueueWorld, page: Page) -> None:
    world.launch("wait")
    page.locator("#running a").click()
    page.get_by_role("button", name="Rerun with changes").click()
    page.wait_for_url("**/launch?**")  # With its scripts, which hear what is typed.
    page.get_by_label("Find a setting").fill("evolution strategy")
    generations = page.get_by_label("generations", exact=True)
    generations.fill("-3")
    row = page.locator("[data-setting='object_.search.generations']")
    expect(row.locator(".wrong")).to_have_text("It is -3; expected a whole number from 0 to 10000.")
    generations.fill("12")
    expect(row.locator(".wrong")).to_be_hidden()
    expect(row.locator(".base")).to_have_text("6 in the profile")
    page.get_by_label("Find a setting").fill("")
    page.locator("summary", has_text="Stage 2: searched intervals").click()
    page.get_by_label("Search self friction").check()
    expect(page.get_by_label("Upper end of self friction")).to_have_value("0.9")  # three times 0.3
    page.get_by_label("Lower end of self friction").fill("0.1")
    page.get_by_label("Scale of self friction").select_option("linear")
    expect(page.locator("[data-changes] li")).to_have_count(2)
    expect(page.locator("[data-title]")).to_have_text("2 changes to quick")
    expect(page.locator("[data-changes]")).to_contain_text("object / search / generations")
    page.locator("[data-changes]").get_by_role("button", name="generations").click()
    expect(generations).to_have_value("6")
    page.locator("[name=name]").fill("wait again")
    page.get_by_role("button", name="Launch", exact=True).click()
    expect(page.locator("h1")).to_have_text("wait again")
    expect(page.locator(".changes li")).to_contain_text("not searched → 0.1 to 0.9")
    page.get_by_role("link", name="wait", exact=True).click()
    expect(page.locator("h1")).to_have_text("wait")
