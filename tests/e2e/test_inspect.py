"""Colors, clicks and keys of the bundled run, with splats too, in a real browser."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import expect
from support.browser.scene_page import ScenePage
from support.browser.small_pictures import place_pictures
from support.viewer.viewer_world import FolderCatalog

from app.benchmarks.splats import scattered
from app.viewer.content.content import open_run_content
from app.viewer.scene.framing import frame_content
from physhandi.data.layout import SPLATS_FILE
from physhandi.run import Run

pytestmark = pytest.mark.e2e
BUNDLED = Path(__file__).parents[2] / "sequences"
FRAME, NODE = 30, 0
PURPLE = (0.8, 0.0, 0.8)
"""A color that nothing of the scene has."""
TEAL = (50, 136, 152)
"""The towel's color in frame 0 of the recording."""
BELOW = (0, 80, 94)
"""The same as its underside is seen, which faces no lamp."""


def place_on_page(scene: ScenePage, point: np.ndarray) -> tuple[float, float]:
    """Where a point of the scene is seen, with the camera where it stands at first."""
    framing = frame_content(open_run_content(FolderCatalog(BUNDLED), "towel_fold_quick"))
    ahead = framing.look_at - framing.camera
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    offset = point - framing.camera
    box = scene.page.locator("#scene").bounding_box()
    scale = 0.5 * box["height"] / np.tan(0.5 * framing.fov) / (offset @ ahead)
    x, y = scale * (offset @ right), -scale * (offset @ np.cross(right, ahead))
    return box["x"] + 0.5 * box["width"] + float(x), box["y"] + 0.5 * box["height"] + float(y)


def shot_of(scene: ScenePage) -> np.ndarray:
    """What the scene shows left of the panel."""
    # What arrives while a picture is drawn may be missing in it until something asks for another.
    scene.panel.locator("body").evaluate("() => window.__viserMutable?.requestRender()")
    scene.draw()
    shot = scene.page.screenshot(clip={"x": 330, "y": 60, "width": 600, "height": 700})
    return cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def blue(image: np.ndarray) -> int:
    """Count the pixels that have the color of plain nodes."""
    return int(((image[..., 2] > 180) & (image[..., 2] - image[..., 0] > 110)).sum())


def yellow(image: np.ndarray) -> int:
    """Count the pixels that have the color of the highest values."""
    return int(((image[..., 0] > 120) & (image[..., 1] > 180) & (image[..., 2] < 100)).sum())


def go_by_the_chart(scene: ScenePage) -> None:
    """Click into a chart over frames, at three quarters of its width."""
    chart = scene.panel.locator(".u-over").first

    def width() -> float:
        box = chart.bounding_box()
        return 0.0 if box is None else box["width"]

    scene.until(lambda: width() > 0.0, "the chart has its size")
    chart.click(position={"x": 0.75 * width(), "y": 20.0})
    scene.until(lambda: abs(scene.value("Frame") - 0.75 * 59) <= 1, "the frame in the chart")


def blue_at_rest(scene: ScenePage) -> int:
    """Count the blue pixels once the plain nodes are drawn and nothing changes any more."""
    counts = [0, 0]

    def is_at_rest() -> bool:
        counts.append(blue(shot_of(scene)))
        return counts[-1] == counts[-2] > 500

    scene.until(is_at_rest, "the plain nodes are drawn")
    return counts[-1]


def press_and_see(scene: ScenePage, key: str, field: str) -> None:
    """Press a key and wait until the server has changed what it shows."""
    before = scene.link().get(field)
    scene.page.keyboard.press(key)
    scene.until(lambda: scene.link().get(field) != before, f"another '{field}' by {key}")


def test_keys_colors_and_clicks_work_in_the_scene_and_around_it(shared_scene, picture):
    scene, page = shared_scene, shared_scene.page
    scene.tab("Look")
    plain = scene.chosen("Color by")
    # The page around has the focus; the keys reach the scene all the same.
    page.locator(".hints").click()
    page.keyboard.press("Home")
    scene.until(lambda: scene.value("Frame") == 0, "the first frame")
    for count in (10, 20, 30):
        page.keyboard.press("Shift+ArrowRight")
        scene.until(lambda count=count: scene.value("Frame") == count, f"frame {count}")
    for layer in "123":  # Nodes alone.
        press_and_see(scene, layer, "show")

    before = blue_at_rest(scene)
    for _ in range(5):
        press_and_see(scene, "c", "color")
    scene.tab("Look")
    scene.until(lambda: scene.has("Speed"), "the legend")
    scene.until(lambda: blue(shot_of(scene)) < 0.1 * before, "other colors than plain blue")
    scene.until(lambda: yellow(shot_of(scene)) > 50, "the fastest nodes are yellow")

    rollout = np.load(
        next(BUNDLED.glob("runs/towel_fold_quick/attempts/1/out/sequences/*/rollout.npy"))
    )
    page.mouse.click(*place_on_page(scene, rollout[FRAME, NODE].astype(np.float64)))
    scene.until(lambda: scene.number("velocity") is not None, "the reading of a node")
    reading = scene.text()
    named = int(scene.number("object node ", text=reading))
    shown = np.linalg.norm(rollout[FRAME, named] - rollout[FRAME, NODE])
    assert shown < 0.02  # It, or one in front of it.
    speed = 30 * np.linalg.norm(rollout[FRAME, named] - rollout[FRAME - 1, named])
    assert scene.number("velocity", text=reading) == pytest.approx(speed, rel=0.01)

    go_by_the_chart(scene)

    press_and_see(scene, "3", "show")
    picture(page, "inspect")
    page.keyboard.press("?")
    help_overlay = page.locator("dialog#help")
    help_overlay.get_by_text("show or hide a layer").wait_for()
    page.keyboard.press("Escape")
    help_overlay.wait_for(state="hidden")
    page.keyboard.press("Escape")
    scene.until(lambda: not scene.has("object node "), "the reading is gone")
    with page.expect_download() as download:
        page.keyboard.press("s")
    assert download.value.suggested_filename.endswith(".png")
    for layer in "12":
        press_and_see(scene, layer, "show")
    scene.tab("Look")
    scene.choose("Color by", plain)


def test_a_lasso_selects_nodes_that_are_cut_apart_and_undone(shared_scene) -> None:
    scene, page = shared_scene, shared_scene.page
    page.keyboard.press("b")
    scene.until(lambda: scene.has("Selected: nothing"), "the scene is edited")
    scene.choose("Tool", "lasso")
    view = page.locator("#scene").bounding_box()
    frame = page.locator("#scene").content_frame
    frame.locator("[data-draws=lasso]").wait_for(state="attached")
    corners = [(0.3, 0.35), (0.68, 0.35), (0.68, 0.95), (0.3, 0.95)]
    x, y = zip(*corners, strict=True)
    page.mouse.move(view["x"] + x[0] * view["width"], view["y"] + y[0] * view["height"])
    page.mouse.down()
    for across, down in corners[1:]:
        page.mouse.move(view["x"] + across * view["width"], view["y"] + down * view["height"])
    page.mouse.up()
    scene.until(lambda: (scene.number("Selected: ", " nodes") or 0) > 50, "nodes are selected")
    scene.press("Cut")
    scene.until(lambda: (scene.number("Cut ", " springs") or 0) > 50, "springs are cut")
    page.keyboard.press("Control+z")
    scene.until(lambda: scene.has("No edits."), "it is undone")
    page.keyboard.press("b")
    scene.until(lambda: scene.has("Edit (B)"), "playback again")


def purple(scene: ScenePage) -> int:
    """Count the pixels that have the color of the splats."""
    image = shot_of(scene)
    red, green, blue = np.moveaxis(image, -1, 0)
    return int(((red > 110) & (blue > 110) & (green < 70)).sum())


def seen_as(scene: ScenePage, color: tuple[int, int, int]) -> int:
    """Count the pixels that have about a color."""
    return int((np.abs(shot_of(scene) - color) < 20).all(axis=-1).sum())


@pytest.fixture(scope="module")
def seen(served) -> Run:
    """The bundled run as one whose object has purple splats."""
    content = open_run_content(FolderCatalog(BUNDLED), "towel_fold_quick")
    surface, fitted = content.surface, content.fitted
    assert surface is not None
    assert fitted is not None
    splats = scattered(surface, fitted.position[0], 1_000)
    splats = replace(splats, color=np.tile(np.float32(PURPLE), (1_000, 1)))
    bundled = Run.open(BUNDLED / "runs" / "towel_fold_quick")
    run = Run.create(
        served.data_dir / "runs" / "seen",
        name="Seen",
        kind="reconstruction",
        sequences=[str(served.data_dir / "sequences" / "towel_fold")],
        config={},
    )
    with run.begin_attempt() as attempt:
        shutil.copytree(bundled.out, attempt.out, dirs_exist_ok=True)
        attempt.save_tensors(SPLATS_FILE, splats.to_tensors())
        attempt.publish()
    place_pictures(served.data_dir)
    return run


def test_a_scene_opens_on_the_surface_and_a_key_shows_splats(context, served, seen) -> None:
    home = context.new_page()
    home.goto(served.url)
    home.goto(f"{home.url.partition('?')[0].rstrip('/')}/runs/{seen.id}")
    home.locator("[data-open=run]").first.click()
    home.wait_for_url("**/live/**")
    scene = ScenePage(home)
    scene.until(lambda: scene.has("object springs"), "the panel appears")
    scene.pause()
    scene.go(0)
    scene.until(lambda: seen_as(scene, TEAL) > 5_000, "the surface has the recording's color")
    expect(home.locator("[data-first-hint]")).to_contain_text("0 shows splats")
    home.locator(".hints").click()
    press_and_see(scene, "0", "show")
    scene.until(lambda: purple(scene) > 5_000, "the splats are drawn in their color")
    for form in ("nodes", "surface"):
        press_and_see(scene, "0", "show")
        scene.until(lambda: purple(scene) < 50, f"the {form} has its own color")
    assert seen_as(scene, BELOW) < 500
    home.mouse.move(400, 300)
    home.mouse.down()
    home.mouse.move(400, -100, steps=4)
    home.mouse.up()
    scene.until(lambda: seen_as(scene, BELOW) > 5_000, "the underside is darker, and not black")
    keys = home.locator("[data-first-hint] kbd").first
    expect(keys).to_be_visible()
    home.set_viewport_size({"width": 390, "height": 844})
    expect(keys).to_be_hidden()
    expect(home.locator("[data-first-hint]")).to_be_visible()
