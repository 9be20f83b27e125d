"""What sliders find is undone by keys, kept as a preset and as a run, in a real browser."""

import re

import numpy as np
import pytest
import yaml
from playwright.sync_api import expect
from scene_page import ScenePage

from physhandi.run import Run

pytestmark = [pytest.mark.e2e, pytest.mark.slow]


def test_a_change_is_undone_by_keys_and_simulated_frame_by_frame(home):
    scene = ScenePage.opened_from(home)
    scene.pause()
    fitted = scene.value("stiffness 10^")
    scene.set("stiffness 10^", -0.7)
    soft = scene.new_difference("a softer object")

    # Keys typed into a field are the field's own.
    scene.field("stiffness 10^").blur()
    home.keyboard.press("Control+z")
    scene.until(lambda: scene.difference() == 0, "the fitted rollout")
    scene.until(lambda: scene.value("stiffness 10^") == fitted, "its slider")
    home.keyboard.press("Control+Shift+Z")
    scene.until(lambda: scene.difference() == soft, "the softer object again")
    scene.until(lambda: scene.has("every frame is new"), "all frames are new")

    home.keyboard.press("h")
    scene.until(lambda: scene.has("Held: the next simulation"), "whatever comes is held")
    home.keyboard.press("n")
    home.keyboard.press("n")
    scene.until(lambda: scene.has("Held at frame 2"), "two frames of a held simulation")
    scene.until(lambda: scene.has("frames 0 to 2 of 59 are new"), "the strip of frames")
    scene.until(lambda: scene.value("Frame") == scene.frame() == 2, "the newest frame")
    home.keyboard.press("h")
    scene.until(lambda: scene.difference() == soft, "all frames")


def test_a_change_is_kept_as_preset_and_run(home, served, tmp_path):
    scene = ScenePage.opened_from(home)
    scene.pause()
    scene.set("stiffness 10^", -0.7)
    scene.new_difference("a softer object")
    scene.unfold("Keep")
    scene.write("name", "Soft <b>towel")
    scene.press("Run")
    scene.until(lambda: scene.has("Saved as run"), "a published run", seconds=240)
    scene.write("name", "Soft towel")
    scene.press("Preset")
    scene.until(lambda: scene.has("Delete preset “Soft towel”"), "a preset")
    (preset,) = (served.data_dir / "presets").iterdir()
    assert yaml.safe_load(preset.read_text())["parameters"] == {
        "stiffness_scale": pytest.approx(10**-0.7)
    }

    scene.unfold("Export")
    with np.load(scene.download("NPZ", tmp_path)) as data:
        shown = data["position"]
    with home.context.expect_page() as opened:
        scene.panel.get_by_role("link", name="Soft <b>towel").click()
    page = opened.value
    expect(page.locator("h1")).to_have_text("Soft <b>towel")
    run = Run.open(served.data_dir / "runs" / re.search(r"/runs/(\w+)", page.url)[1])
    run.verify()
    assert run.kind == "simulation"
    assert run.json("metrics.json")["towel_fold"]
    np.testing.assert_array_equal(run.array("sequences/towel_fold/rollout.npy"), shown)
    home.goto(served.url)
    expect(home.locator(f"#runs [data-run='{run.id}']")).to_contain_text("Soft <b>towel")
