"""Two runs together, in a real browser: one scene, its numbers and their table."""

import re
import shutil

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page, expect
from support.browser.scene_page import ScenePage, scaled_pictures
from support.browser.small_pictures import place_pictures

from app.settings import BUNDLED
from physhandi.run import Run

pytestmark = pytest.mark.e2e
FRAME = 40
PANEL = 345
"""Width of what the panel covers, in pixels."""
NOTICE = 30
"""The browser's notice of slow graphics has an orange edge, this far from the left."""
LIFT = np.array([0.0, 0.0, 0.012], dtype=np.float32)
"""By how much the second run's nodes are higher at the last frame: 12 mm."""


@pytest.fixture(scope="module")
def lifted(served) -> str:
    """The bundled run again, of which the nodes rise evenly."""
    source = Run.open(BUNDLED / "runs" / "towel_fold_quick")
    run = Run.create(
        served.data_dir / "runs" / "lifted",
        name="raised <by 12 mm>",
        kind="simulation",
        sequences=["towel_fold"],
        config={},
    )
    with run.begin_attempt() as attempt:
        shutil.copytree(source.out, attempt.out, dirs_exist_ok=True)
        at = "sequences/towel_fold/rollout.npy"
        rollout = source.array(at)
        share = np.linspace(0.0, 1.0, len(rollout), dtype=np.float32)[:, None, None]
        attempt.save_array(at, rollout + share * LIFT)
        attempt.publish()
    place_pictures(served.data_dir)
    return run.id


def test_two_runs_are_compared_in_one_scene(home: Page, lifted: str, picture) -> None:
    home.goto(home.url.split("?")[0].rstrip("/") + "/runs")
    for run in ("towel_fold_quick", lifted):
        home.locator(f"tr[data-run={run}] [data-choose]").check()
    home.add_init_script(scaled_pictures(1.0))  # Both sides have room beside the panel.
    home.locator("[data-chosen-scene]").click()
    home.wait_for_url("**/compare?**")
    scene = ScenePage(home)
    scene.until(lambda: scene.has("Swap sides"), "the panel appears")
    scene.pause()
    scene.go(FRAME)
    expected = 12.0 * FRAME / 59
    scene.until(lambda: scene.has(f"mean {expected:.3g} mm"), "the difference is told")
    # The table knows both, and the name of a user is text.
    expect(home.locator("h1 .b")).to_contain_text("raised <by 12 mm>")
    expect(home.locator(".diff.only").first).to_contain_text("raised <by 12 mm>")
    # Charts of the difference and of both errors; a click goes to a frame.
    expect(home.locator("figure.chart")).to_have_count(3)
    chart = home.locator("figure.chart", has_text="Difference of A and B")
    chart.locator(".plot").focus()
    home.keyboard.press("End")
    expect(chart.locator("output")).to_have_class("readout at-cursor")
    expect(chart.locator("output")).to_contain_text("mean 12 mm")
    assert scene.frame() == FRAME, "the key is the chart's, not the scene's"
    home.keyboard.press("Enter")
    scene.until(lambda: scene.value("Frame") == 59, "the chart goes to the frame")

    # Beside each other both colors are seen, each in its half; over each other in one place.
    def are_apart() -> bool:
        left, right = (colored(home, color) for color in ("blue", "orange"))
        return min(left.size, right.size) > 60 and left.max() < right.min()

    scene.until(are_apart, "both halves are drawn")
    picture(home, "compare")
    home.keyboard.press("m")
    scene.until(lambda: scene.has("A ↔ B"), "the overlay")

    def are_together() -> bool:
        blue, orange = (colored(home, color) for color in ("blue", "orange"))
        return min(blue.size, orange.size) > 60 and orange.min() < blue.max()

    scene.until(are_together, "both in one place")
    home.keyboard.press("c")
    scene.until(lambda: scene.has("≥"), "the legend with numbers")
    # The address follows, which the server answers; one run alone is refused.
    address = re.compile("mode=overlay&color=difference&f=59")
    home.wait_for_url(address)
    assert home.request.get(home.url).ok
    alone = home.request.get(home.url.replace(f"b={lifted}", "b=towel_fold_quick"))
    assert alone.status == 422


def colored(page: Page, color: str) -> np.ndarray:
    """Find the columns of the scene's picture that have a side's color."""
    # What arrives while a picture is drawn may be missing in it until something asks for another.
    scene = page.frame_locator("#scene").locator("body")
    scene.evaluate("() => window.__viserMutable?.requestRender()")
    shot = page.locator("#scene").screenshot()
    image = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    image = image[:, NOTICE:-PANEL]
    hue, saturation, value = np.moveaxis(cv2.cvtColor(image, cv2.COLOR_BGR2HSV), -1, 0)
    # Surfaces are paler where light falls on them and where the other shines through (orange:
    # 90 to 150 instead of 200); hands have a hue of up to 12.
    low, high, least = {"blue": (104, 112, 90), "orange": (13, 20, 90)}[color]
    found = (hue >= low) & (hue <= high) & (saturation > least) & (value > 150)
    return np.flatnonzero(found.sum(axis=0) > 1)
