"""Finding runs among others and laying them side by side, in a real browser."""

import re
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, Route, expect
from support.browser.accessibility import COLOR_RULES, violations
from support.browser.scene_page import TIMEOUT_MS
from support.browser.small_pictures import place_pictures
from support.inputs.clicked_disc import HEIGHT, TOP, WIDTH, cameras, center, write_disc
from support.inputs.raw_capture import RawCapture
from support.inputs.sheet_sequence import write_sheet

from physhandi.data.sequence import Sequence

pytestmark = pytest.mark.e2e
BUNDLED = Path(__file__).parents[2] / "sequences"
NAMES = ("Soft towel", "Stiff towel")
ROWS = "#runs tbody .name strong"
_SCENE = re.compile("/viewer/")
_NO_MORE_ROWS = """() => {
  const counts = {};
  for (const row of document.querySelectorAll("main tbody tr")) {
    const look = row.closest("table").className
      + row.outerHTML.replace(/>[^<]+<|(data-about|title)="[^"]*"/g, "");
    counts[look] = (counts[look] ?? 0) + 1;
    if (counts[look] > 2) row.remove();
  }
}"""
"""Leave two of all rows of a table that differ in nothing but their texts and hints: stripes
alternate. Looking at colors takes its time for every cell."""
RUN_COUNT = len(NAMES) + len(list(BUNDLED.glob("runs/*/run.yaml")))


@pytest.fixture(scope="module")
def base(served) -> str:
    """The server's address; two copies of the bundled run lie in its data folder."""
    source = BUNDLED / "runs" / "towel_fold_quick"
    for number, name in enumerate(NAMES):
        folder = served.data_dir / "runs" / f"copy{number}"
        shutil.copytree(source, folder)
        job, about = folder / "job.yaml", folder / "run.yaml"
        job.write_text(job.read_text().replace("../../towel_fold", str(BUNDLED / "towel_fold")))
        about.write_text(about.read_text().replace("Towel fold, fitted", name))
    parameters = served.data_dir / "runs" / "copy1" / "attempts/1/out/object/parameters.yaml"
    parameters.write_text(re.sub(r"(?m)^drag: .*", "drag: 1.25", parameters.read_text()))
    place_pictures(served.data_dir)
    return served.base


def test_runs_are_filtered_sorted_chosen_and_compared(home: Page, base: str, picture) -> None:
    home.goto(f"{base}/runs")
    expect(home.locator("#runs tbody tr")).to_have_count(RUN_COUNT)
    home.keyboard.press("/")
    expect(home.locator("#q")).to_be_focused()
    home.keyboard.type("towel -is:bundled")
    expect(home.locator("#runs tbody tr")).to_have_count(2)
    expect(home).to_have_url(f"{base}/runs?q=towel+-is%3Abundled")
    expect(home.get_by_role("status").first).to_contain_text(f"2 of {RUN_COUNT} runs")
    home.get_by_role("columnheader", name="Run").get_by_role("link").click()
    expect(home.locator(".col-name")).to_have_attribute("aria-sort", "ascending")
    expect(home.locator(ROWS)).to_have_text(["Soft towel", "Stiff towel"])
    # htmx listens to what it put in 20 ms later, and tells by taking this away.
    home.locator("#runs:not(.htmx-added)").get_by_label("Sort").select_option("-created")
    expect(home).to_have_url(re.compile(r"sort=-created"))
    expect(home.locator(".col-name")).to_have_attribute("aria-sort", "none")
    home.get_by_role("columnheader", name="Run").get_by_role("link").click()
    expect(home.locator(".col-name")).to_have_attribute("aria-sort", "ascending")
    home.get_by_role("columnheader", name="Run").get_by_role("link").click()
    expect(home.locator(".col-name")).to_have_attribute("aria-sort", "descending")
    expect(home.locator(ROWS)).to_have_text(["Stiff towel", "Soft towel"])
    home.go_back()
    expect(home.locator(".col-name")).to_have_attribute("aria-sort", "ascending")
    expect(home.locator("#q")).to_have_value("towel -is:bundled")

    # What is chosen stays chosen while the list changes around it.
    home.get_by_label("Choose Stiff towel").check()
    home.locator("#q").fill("soft")
    expect(home.locator("#runs tbody tr")).to_have_count(1)
    home.get_by_label("Choose Soft towel").check()
    expect(home.locator("[data-chosen-text]")).to_have_text("2 runs chosen")
    home.locator("#q").fill("towel")
    expect(home.locator("#runs tbody tr")).to_have_count(len(NAMES) + 1)
    picture(home, "runs")
    home.get_by_role("button", name="Compare parameters and scores").click()
    expect(home).to_have_url(f"{base}/diff?run=copy1&run=copy0")
    table = home.locator("table.diff")
    expect(table.locator("thead strong")).to_have_text(["Stiff towel", "Soft towel"])
    drag = table.locator("tbody tr", has=home.get_by_text("drag", exact=True))
    expect(drag.locator("td").first).to_have_text("1.25")
    expect(table.get_by_text("max neighbors", exact=True)).to_have_count(0)
    home.get_by_role("link", name=re.compile("^Everything")).click()
    expect(table.get_by_text("max neighbors", exact=True)).not_to_have_count(0)
    expect(drag).to_have_class("changed")


def test_a_picture_appears_when_it_is_made_and_moves_while_it_is_pointed_at(
    home: Page, base: str, served
) -> None:
    for picture in (served.data_dir / "cache" / "previews").glob("sequence-towel_fold-*"):
        picture.unlink()
    home.emulate_media(reduced_motion="no-preference")
    home.goto(f"{base}/sequences")
    card = home.locator("article[data-sequence=towel_fold]")
    moving = card.locator("img.moving")
    expect(card.locator("img.still")).to_be_visible()
    # Pictures are drawn when nothing else has to be done, which may be late.
    expect(moving).to_have_count(1, timeout=2 * TIMEOUT_MS)
    expect(moving).to_be_hidden()
    card.hover()
    expect(moving).to_be_visible()
    expect(card.locator(".shot")).to_have_class(re.compile("is-loaded"))
    shown: set[bytes] = set()
    end = time.monotonic() + TIMEOUT_MS / 1e3
    while len(shown) < 3:
        assert time.monotonic() < end, "the picture does not move"
        shown.add(card.locator(".shot").screenshot(animations="disabled"))
    home.emulate_media(reduced_motion="reduce")
    expect(moving).to_be_hidden()
    home.mouse.move(0, 0)
    home.emulate_media(reduced_motion="no-preference")
    expect(moving).to_be_hidden()
    card.get_by_role("button", name="Launch fit").focus()
    expect(moving).to_be_visible()


def test_lists_work_without_scripts_and_on_a_phone(home: Page, base: str, browser) -> None:
    cookies = home.context.cookies()
    plain = browser.new_context(java_script_enabled=False, viewport={"width": 390, "height": 800})
    plain.set_default_timeout(TIMEOUT_MS)
    try:
        plain.add_cookies(cookies)
        page = plain.new_page()
        page.goto(f"{base}/runs")
        page.get_by_placeholder("Filter by name").fill("stiff")
        page.get_by_role("button", name="Filter", exact=True).click()
        expect(page.locator("#runs tbody tr")).to_have_count(1)
        page.get_by_role("link", name="clear the filter").click()
        expect(page.locator("#runs tbody tr")).to_have_count(
            RUN_COUNT
        )  # What is checked before is lost.
        page.get_by_label("Choose Stiff towel").check()
        page.get_by_label("Choose Soft towel").check()
        page.get_by_role("button", name="Compare parameters and scores").click()
        expect(page.locator("table.diff thead th")).to_have_count(3)
        for path in ("/", "/runs", "/sequences", "/diff?run=copy0&run=copy1"):
            page.goto(f"{base}{path}")
            width = page.locator("body").bounding_box()["width"]
            assert page.locator("main").bounding_box()["width"] <= width <= 390
    finally:
        plain.close()


def test_no_page_keeps_anybody_out(home: Page, base: str) -> None:
    """Not by names that are missing, nor by colors that cannot be told apart.

    Scenes are looked at where one is open; here only the pages around them are.
    """
    paths = (
        "/",
        "/runs",
        "/runs/copy1",
        "/sequences",
        "/sequences/towel_fold/check",
        "/suites",
        "/diff?run=copy1&run=copy0",
        "/import",
        "/system",
    )
    scenes = ("/compare?a=towel_fold_quick&b=copy0", "/runs/copy0/view")
    for path in (*paths, *scenes):
        if path == scenes[0]:
            home.route(_SCENE, lambda route: route.fulfill(content_type="text/html"))
        home.emulate_media(color_scheme="light")
        home.goto(f"{base}{path}")
        home.evaluate(_NO_MORE_ROWS)
        assert violations(home) == [], path
        home.emulate_media(color_scheme="dark")
        assert violations(home, *COLOR_RULES) == [], f"{path} in the dark"


def test_a_damaged_run_is_told_and_moved_aside(home: Page, base: str, served) -> None:
    bad = served.data_dir / "runs" / "bad"
    shutil.copytree(served.data_dir / "runs" / "copy0", bad)
    (bad / "run.yaml").write_text((bad / "run.yaml").read_text() + "label: [1, 2]\n")
    place_pictures(served.data_dir)
    home.goto(f"{base}/runs")
    row = home.locator("tr[data-run=bad]")
    expect(row.locator(".state")).to_have_text("damaged")
    expect(row.locator(".problem")).to_contain_text("run.yaml")
    home.once("dialog", lambda dialog: dialog.dismiss())
    row.get_by_role("button", name="Move aside").click()
    expect(row).to_have_count(1)
    home.goto(f"{base}/recovery")
    assert violations(home) == []
    home.once("dialog", lambda dialog: dialog.accept())
    home.locator("[data-damaged=bad]").get_by_role("button", name="Move aside").click()
    expect(home.locator("[data-damaged=bad]")).to_have_count(0)
    expect(home.get_by_text("damaged/runs/bad", exact=True)).to_be_visible()
    assert violations(home) == []
    assert not bad.exists()
    assert (served.data_dir / "damaged" / "runs" / "bad" / "job.yaml").is_file()


def test_a_recording_is_checked_frame_by_frame(home: Page, base: str) -> None:
    home.goto(f"{base}/sequences")
    home.locator("[data-sequence=towel_fold]").get_by_role("link", name="Check").click()
    front = home.locator("[data-view=front]")
    expect(front.locator("img")).to_have_attribute("src", re.compile(r"/frames/0\?layers=mask,key"))
    expect(home.get_by_text("every file was read")).to_be_visible()
    expect(home.locator(".stage-lights .ready")).to_have_count(6)
    home.keyboard.press("ArrowRight")
    home.keyboard.press("Shift+ArrowRight")
    expect(front.locator("img")).to_have_attribute("src", re.compile(r"/frames/11\?layers=mask"))
    expect(home).to_have_url(re.compile(r"frame=11$"))
    home.get_by_label("Masks").uncheck()
    expect(front.locator("img")).to_have_attribute("src", re.compile(r"/11\?layers=keypoint"))
    home.wait_for_function(
        "() => document.querySelector('[data-view=front] img').naturalWidth > 300"
    )
    home.get_by_role("button", name="Launch fit").click()
    expect(home.locator("[data-readiness]")).to_contain_text("All stages will run.")


def test_the_bar_of_a_new_search_begins_empty(home: Page, base: str, served) -> None:
    write_disc(served.data_dir / "sequences/searched", masks=True, frames=2)
    jobs = [{"stage": "point_tracking", "iteration": 180, "total": 180}, {}]

    def answer(route: Route) -> None:
        job = {"state": "running", "reason": "", "progress": jobs[0]}
        route.fulfill(json=job)
        del jobs[:-1]

    home.route("**/api/v1/sequences/searched/annotation", answer)
    home.goto(f"{base}/sequences/searched/check")
    expect(home.locator("[data-found]")).to_have_text("starting …")
    bar = home.locator("[data-finding] progress")
    expect(bar).to_be_visible()
    expect(bar).to_have_js_property("value", 0)


def find_in_a_box(page: Page) -> dict[str, float | str]:
    """Draw a box around the disc, from its lower right to its upper left corner, and find it."""
    x, y = cameras()["top"].project(np.append(center(0), TOP))
    x, y = round(float(x)), round(float(y))
    box = {"view": "top", "frame": 0, "x": x, "y": y, "width": 44, "height": 40}
    picks = page.locator("[data-picks]")
    image = page.locator("[data-view=top] img")
    for one in page.locator("[data-view] img").all():  # Each that comes moves those below it.
        expect(one).to_be_visible()
    page.get_by_role("button", name="Pick the object").click()
    image.scroll_into_view_if_needed()
    at = image.bounding_box()

    def move(column: float, row: float) -> None:
        share = (column + 0.5) / WIDTH, (row + 0.5) / HEIGHT
        page.mouse.move(at["x"] + share[0] * at["width"], at["y"] + share[1] * at["height"])

    def draw(width: float, height: float) -> None:
        move(x + width / 2, y + height / 2)
        page.mouse.down()
        move(x, y)
        move(x - width / 2, y - height / 2)
        page.mouse.up()

    draw(30, 20)
    expect(picks).to_have_text(re.compile(rf"top, frame 0: {x}, {y}, box 30 × 20"))
    expect(page.locator(".pick.box")).to_have_count(1)
    page.get_by_role("button", name="Take back the click in top").click()
    expect(page.locator(".pick")).to_have_count(0)
    expect(page.get_by_role("button", name="Find masks and tracks")).to_be_disabled()
    draw(box["width"], box["height"])
    drawn = page.locator(".pick.box").bounding_box()
    assert drawn["width"] / at["width"] == pytest.approx(box["width"] / WIDTH, abs=0.02)
    assert drawn["x"] + drawn["width"] / 2 == pytest.approx(
        at["x"] + (x + 0.5) / WIDTH * at["width"], abs=2
    )
    page.get_by_label("Replace those that are there").check()
    # A tracker of the user is code, so that it is executed is asked, for each anew.
    page.get_by_text("With networks that you have").click()
    trust = page.get_by_label("I looked at its folder")
    expect(trust).to_be_hidden()
    page.get_by_label("Tracks by").select_option("follower")
    trust.check()
    page.get_by_label("Tracks by").select_option("what is built in")
    expect(trust).to_be_hidden()
    expect(trust).not_to_be_checked()
    with page.expect_navigation(timeout=2 * TIMEOUT_MS):  # The page shows what was found.
        page.get_by_role("button", name="Find masks and tracks").click()
    return box


def test_a_recording_is_imported_and_its_masks_are_painted(home: Page, base: str, served) -> None:
    RawCapture(served.data_dir / "captures/ball").write()
    _, true = write_disc(served.data_dir / "sequences/disc", masks=True, frames=2)
    home.get_by_role("button", name="Import a recording").click()
    home.get_by_role("link", name="ball").click()
    expect(home.locator("#survey")).to_contain_text("2 cameras, 6 frames")
    home.get_by_role("button", name="Import", exact=True).click()
    expect(home).to_have_url(f"{base}/sequences/ball/check?frame=0")
    follower = served.data_dir / "models/follower"
    follower.mkdir(parents=True)
    (follower / "hubconf.py").write_text("def cotracker3_offline(): ...")
    (follower / "scaled_offline.pth").touch()
    home.goto(f"{base}/sequences/disc/check")
    box = find_in_a_box(home)
    found = Sequence.load(served.data_dir / "sequences/disc")
    assert found.provenance["masks"]["clicks"] == [box]
    is_object, is_disc = found.views[0].mask(0) == 1, true["top"][0] == 1
    assert (is_object & is_disc).sum() > 0.9 * (is_object | is_disc).sum()
    home.get_by_role("button", name="Correct masks").click()
    canvas = home.locator("[data-view=top] canvas")
    expect(canvas).to_be_visible()

    def label() -> list[int]:
        """Color of the mask in the image's corner, which the stroke begins in."""
        return canvas.evaluate("c => [...c.getContext('2d').getImageData(2, 2, 1, 1).data]")

    assert label() == [0, 0, 0, 0]
    canvas.drag_to(canvas, source_position={"x": 6, "y": 6}, target_position={"x": 60, "y": 6})
    assert label() == [74, 155, 232, 255]
    expect(home.get_by_role("button", name="Save the mask")).to_be_enabled()
    home.keyboard.press("0")
    canvas.drag_to(canvas, source_position={"x": 6, "y": 6}, target_position={"x": 60, "y": 6})
    assert label() == [0, 0, 0, 0]
    home.keyboard.press("Control+z")
    assert label() == [74, 155, 232, 255]
    home.keyboard.press("Control+z")
    expect(home.get_by_role("button", name="Save the mask")).to_be_disabled()


def test_a_sequence_is_sent_from_the_users_machine(home: Page, base: str, tmp_path: Path) -> None:
    folder = write_sheet(tmp_path / "sheet").folder.rename(tmp_path / "My sheet (2)")
    (folder / ".hidden").write_text("not wanted")
    chosen = home.locator("#upload [data-of=folder]")
    home.goto(f"{base}/import")
    chosen.set_input_files(folder)
    home.wait_for_url(f"{base}/sequences/My_sheet_2/check**")
    # The name is taken now; what was sent needs not be sent again to have another one.
    home.goto(f"{base}/import")
    chosen.set_input_files(folder)
    told = home.get_by_role("alert").filter(has_text="There is a 'My_sheet_2' in sequences already")
    expect(told).to_be_visible()
    assert violations(home) == []
    home.get_by_label("Name for My_sheet_2").fill("other")
    home.get_by_role("button", name="Check again").click()
    home.wait_for_url(f"{base}/sequences/other/check**")
    home.goto(f"{base}/import")
    expect(home.locator("#upload .unfinished li")).to_have_count(0)
