"""What sliders find is undone by keys, kept as a preset and as a run, in a real browser."""

import re
import shutil
from collections.abc import Callable

import numpy as np
import pytest
import yaml
from playwright.sync_api import expect
from support.browser.accessibility import COLOR_RULES, violations
from support.waiting import until

from physhandi.run import Run

pytestmark = [pytest.mark.e2e, pytest.mark.slow]


def test_a_change_is_undone_by_keys_and_simulated_frame_by_frame(shared_scene):
    scene, keyboard = shared_scene, shared_scene.page.keyboard
    fitted = scene.value("stiffness")
    scene.set("stiffness", 0.2)
    soft = scene.new_difference("a softer object")

    # Keys typed into a field are the field's own.
    scene.field("stiffness").blur()
    keyboard.press("Control+z")
    scene.until(lambda: scene.difference() == 0, "the fitted rollout")
    scene.until(lambda: scene.value("stiffness") == fitted, "its slider")
    keyboard.press("Control+Shift+Z")
    scene.until(lambda: scene.difference() == soft, "the softer object again")
    scene.until(lambda: scene.has("every frame is new"), "all frames are new")

    keyboard.press("h")
    scene.until(lambda: scene.has("Held: the next simulation"), "whatever comes is held")
    keyboard.press("n")
    keyboard.press("n")
    scene.until(lambda: scene.has("Held at frame 2"), "two frames of a held simulation")
    scene.until(lambda: scene.has("frames 0 to 2 of 59 are new"), "the strip of frames")
    scene.until(lambda: scene.value("Frame") == scene.frame() == 2, "the newest frame")
    keyboard.press("h")
    scene.until(lambda: scene.difference() == soft, "all frames")


def test_one_gesture_is_one_step_of_the_history(shared_scene):
    scene, keyboard = shared_scene, shared_scene.page.keyboard
    name = "d_max virtual"

    def steps_are(*values: int) -> None:
        last = f"{len(values) - 1} · {name} {values[-2]} → {values[-1]}"
        scene.until(lambda: scene.chosen("History") == last, f"the step {last}")
        # Lines above the sliders come and go until then, and a handle that moves is missed.
        scene.until(lambda: scene.has("every frame is new"), "all frames")

    scene.choose("History", "0 · as fitted")  # Another change forgets those that were taken back.
    scene.until(
        lambda: scene.difference() == 0 and not scene.has("every frame is new"),
        "the fitted rollout",
    )
    taken = [int(scene.value(name))]
    for _ in range(2):
        scene.drag(name, 24, values=3)
        taken.append(int(scene.value(name)))
        steps_are(*taken)
    frame, handle = scene.value("Frame"), scene.row(name).get_by_role("slider")
    handle.focus()
    for _ in range(3):  # Held, so that it repeats.
        keyboard.down("ArrowRight")
    keyboard.up("ArrowRight")
    scene.until(lambda: scene.value(name) == taken[-1] + 3, "three values more")
    taken.append(taken[-1] + 3)
    steps_are(*taken)
    assert scene.value("Frame") == frame
    for number in (15, 27):
        scene.type(name, str(number))
        scene.field(name).press("Enter")
        taken.append(number)
        steps_are(*taken)

    scene.choose("History", f"1 · {name} {taken[0]} → {taken[1]}")
    scene.until(lambda: scene.value(name) == taken[1], "the first step")
    scene.until(lambda: scene.link()["virtual_max_neighbors"] == str(taken[1]), "is in force")
    scene.press("Reset")


_HANGS_OVER = """tab => {
    let place = tab;
    while (!/auto|scroll/.test(getComputedStyle(place).overflowY)) place = place.parentElement;
    return place.scrollHeight - place.clientHeight;
}"""


def test_every_tab_fits_its_window_and_is_reached_by_keys(shared_scene):
    scene, page = shared_scene, shared_scene.page
    page.set_viewport_size({"width": 1440, "height": 900})
    scene.tab("Physics")
    scene.set("d_max virtual", 15)  # What is changed takes two lines more.
    scene.until(lambda: scene.has("every frame is new"), "all frames")
    for name in ("Springs", "More", "Ground", "Collisions", "Hands"):
        scene.tab(name)
        assert scene.panel.get_by_role("tab", name=name).evaluate(_HANGS_OVER) <= 0, name
    page.keyboard.press("v")
    for name in ("Export", "Inspect", "Edit", "Look", "Play"):
        tab = scene.panel.get_by_role("tab", name=name, exact=True)
        tab.focus()
        page.keyboard.press("Enter")
        expect(tab).to_have_attribute("aria-selected", "true")
        tab.blur()  # Where it has the focus, Home is the first tab.
        frame = scene.value("Frame")
        page.keyboard.press("End" if frame == 0 else "Home")  # Keys work in every tab.
        scene.until(lambda at=frame: scene.value("Frame") != at, "another frame")
        if name == "Look":
            page.keyboard.press("v")
            plain = scene.chosen("Color by")
            scene.choose("Color by", "stiffness")
            scene.until(lambda: scene.has("Force per unit strain"), "the legend")
            scene.row("Cameras").get_by_role("checkbox").check()  # Keys go on working.
            page.keyboard.press("v")
        if name == "Play":
            scene.until(lambda: scene.has("Swap sides"), "the comparison")
        assert tab.evaluate(_HANGS_OVER) <= 0, name
    page.keyboard.press("v")
    scene.tab("Look")
    scene.choose("Color by", plain)
    scene.row("Cameras").get_by_role("checkbox").uncheck()
    scene.tab("Physics")
    scene.press("Reset")


def test_no_tab_keeps_anybody_out(shared_scene):
    """Not by names that are missing, nor by colors that cannot be told apart."""
    scene, page = shared_scene, shared_scene.page
    frame = next(frame for frame in page.frames if "/viewer/" in frame.url)
    for scheme, rules in (("dark", ()), ("light", COLOR_RULES)):
        page.emulate_media(color_scheme=scheme)
        frame.locator(f"html[data-mantine-color-scheme={scheme}]").wait_for(state="attached")
        scene.rest(on=True)  # Each tab has one picture drawn; nobody looks at others.
        for tab in ("Physics", "Look", "Play", "Edit", "Export"):
            scene.tab(tab)
            assert violations(frame, *rules) == [], f"{tab}, {scheme}"
        scene.rest(on=False)
    page.emulate_media(color_scheme="null")


_STEERED = """() => {
  const { nodeRefFromName, nodePoseData, camera, canvas } = __viserMutable;
  const vertices = window.__viserSceneTree.getState()["/object/surface"].message.props.vertices;
  const object = [0, 0, 0];
  vertices.forEach((value, place) => (object[place % 3] += (3 * value) / vertices.length));
  const wrist = nodePoseData["/steer/wrist"]?.position;
  if (!wrist) return { object };
  const Point = camera.position.constructor;
  const box = canvas.getBoundingClientRect();
  const pixel = (x, y, z) => {
    const place = nodeRefFromName["/steer"].localToWorld(new Point(x, y, z)).project(camera);
    return [box.left + (place.x + 1) / 2 * box.width, box.top + (1 - place.y) / 2 * box.height];
  };
  const { scale } = window.__viserSceneTree.getState()["/steer/wrist"].message.props;
  const arrow = [0.5, 1.5].map((part) => pixel(wrist[0], wrist[1], wrist[2] + part * scale));
  return { object, wrist: [...wrist], turn: [...nodePoseData["/steer/wrist"].wxyz], arrow };
}"""
"""Middle of the object, wrist [m] and turn of the hand, and ends of a drag upwards [px]."""


def hold_and_take_back(scene, look: Callable[[], dict], start: dict) -> None:
    """Hold keys that mean something else while nothing is steered.

    They are held until it is seen that they steer, and taken back: no hand, which the gizmo
    follows, moves any more when somebody drags that.
    """
    keyboard = scene.page.keyboard
    moves = (("l", "turn", 0.05), ("s", "wrist", 0.01))
    for key, what, by in moves:
        keyboard.down(key)
        scene.until(
            lambda what=what, by=by: not np.allclose(look()[what], start[what], atol=by), what
        )
        keyboard.up(key)
    assert scene.value("Frame") == 12
    for _, what, _ in reversed(moves):
        keyboard.press("Control+z")
        scene.until(lambda what=what: np.allclose(look()[what], start[what], atol=1e-6), "is back")


def test_a_held_key_and_the_dragged_gizmo_move_hand_and_object(shared_scene):
    scene, page = shared_scene, shared_scene.page
    keyboard, mouse = page.keyboard, page.mouse

    def look() -> dict:
        return scene.panel.locator("body").evaluate(_STEERED)

    scene.go(12)
    scene.tab("Physics")
    before = look()["object"]
    hint = page.locator("[data-first-hint]")
    hint.evaluate("hint => (hint.hidden = false)")  # Somebody may have closed it.
    expect(hint).to_be_visible()
    keyboard.press("g")
    sign = scene.panel.get_by_role("status").filter(has_text="Steering the right hand")
    expect(sign).to_be_visible()
    expect(hint).to_be_hidden()  # It would lie over the sign.
    scene.until(lambda: "wrist" in look(), "the gizmo")
    start = look()

    keyboard.down("e")
    scene.until(lambda: look()["wrist"][2] > start["wrist"][2] + 0.05, "the hand rises")
    keyboard.up("e")
    scene.until(lambda: look()["object"][2] > before[2] + 0.02, "the object rises with it")
    keyboard.press("Control+z")
    scene.until(lambda: np.allclose(look()["wrist"], start["wrist"], atol=1e-6), "it is back")
    hold_and_take_back(scene, look, start)

    frame = page.locator("#scene").bounding_box()
    scene.draw()  # The gizmo is caught where it was drawn last, and comes to rest there.
    held = look()
    (x, y), (to_x, to_y) = ((frame["x"] + u, frame["y"] + v) for u, v in held["arrow"])
    mouse.move(x, y)
    mouse.down()
    for part in (0.3, 0.6, 1.0):
        mouse.move(x + part * (to_x - x), y + part * (to_y - y))
    scene.until(lambda: look()["wrist"][2] > held["wrist"][2] + 0.03, "the gizmo is dragged up")
    mouse.up()
    scene.until(lambda: look()["object"][2] > before[2] + 0.01, "the object follows")

    keyboard.press("g")
    expect(sign).to_be_hidden()
    scene.until(lambda: np.allclose(look()["object"], before, atol=1e-6), "playback again")
    assert scene.value("Frame") == 12
    scene.tab("Physics")


def test_on_a_phone_the_panel_is_a_sheet_below_the_scene(shared_scene):
    scene, page, height = shared_scene, shared_scene.page, 844
    page.set_viewport_size({"width": 390, "height": height})
    head = scene.panel.get_by_text("Towel fold, fitted", exact=True)
    sheet = scene.panel.locator(".mantine-Paper-root", has=head)

    def parts() -> tuple[float, float, float]:
        """Height of the scene, of the sheet, and where it begins below the scene."""
        measure = "e => e.getBoundingClientRect().toJSON()"
        canvas = scene.panel.locator("canvas").first.evaluate(measure)
        panel = sheet.evaluate(measure)
        return canvas["height"], panel["height"], panel["top"] - canvas["top"] - canvas["height"]

    def is_laid() -> bool:
        canvas, panel, between = (part / height for part in parts())
        return abs(between) * height <= 1 and canvas > 0.4 and 0.3 < panel <= 0.45

    scene.until(is_laid, "scene above sheet")
    head.click()
    scene.until(lambda: parts()[1] < 60 and parts()[0] > 0.8 * height, "a folded sheet")
    page.set_viewport_size({"width": 1280, "height": 800})


def test_a_change_is_kept_as_preset_and_run(shared_scene, served, tmp_path):
    scene = shared_scene
    scene.set("stiffness", 0.2)
    scene.new_difference("a softer object")
    scene.tab("Export")
    scene.write("name", "Soft <b>towel")
    scene.press("Run")
    scene.rest(on=True)  # Simulating and measuring takes longer than all else here.
    until(lambda: any((served.data_dir / "runs").glob("*/current")), scene.text)
    scene.rest(on=False)
    scene.until(lambda: scene.has("Saved as run"), "a published run")
    scene.write("name", "Soft towel")
    scene.press("Preset")
    scene.until(lambda: scene.has("Delete preset “Soft towel”"), "a preset")
    (preset,) = (served.data_dir / "presets").iterdir()
    assert yaml.safe_load(preset.read_text())["parameters"] == {"stiffness_scale": 0.2}

    with np.load(scene.download("NPZ", tmp_path)) as data:
        shown = data["position"]
    with scene.page.context.expect_page() as opened:
        scene.panel.get_by_role("link", name="Soft <b>towel").click()
    page = opened.value
    expect(page.locator("h1")).to_have_text("Soft <b>towel")
    run = Run.open(served.data_dir / "runs" / re.search(r"/runs/(\w+)", page.url)[1])
    run.verify()
    assert run.kind == "simulation"
    assert run.json("metrics.json")["towel_fold"]
    np.testing.assert_array_equal(run.array("sequences/towel_fold/rollout.npy"), shown)
    page.close()
    scene.tab("Physics")
    scene.press("Reset")
    shutil.rmtree(run.folder)  # Other tests show the lists of this server.
