"""The paper's figure and sessions of one's own, in a real browser."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import expect
from support.browser.scene_page import ScenePage

pytestmark = pytest.mark.e2e
FRAME = 30
_LETTERS = """() => {
  let count = 0;
  window.__viserMutable.scene.traverseVisible((part) => {
    if (part.material?.uniforms?.uLabelData) count += 1;
  });
  return count;
}"""
"""Counts meshes of letters that are drawn within the scene."""


def hue(image: np.ndarray, low: int, high: int) -> np.ndarray:
    """Find the pixels of a strong color between two hues of OpenCV's circle of 180."""
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    return (hsv[..., 0] >= low) & (hsv[..., 0] <= high) & (hsv[..., 1] > 110)


def test_the_figure_shows_both_topologies_in_one_picture(
    shared_scene: ScenePage, tmp_path: Path, picture
) -> None:
    scene = shared_scene
    scene.page.keyboard.press("f")
    scene.tab("Play")
    scene.until(lambda: scene.has("PhysTwin-style: simulated 60/60 frames"), "the figure")
    scene.go(FRAME)
    texts = scene.panel.locator("[data-scene-texts] > span").filter(visible=True)
    for text in ("ours", "PhysTwin-style", "object nodes", "virtual springs"):
        expect(texts.get_by_text(text, exact=True)).to_be_in_viewport()
    assert scene.panel.locator("body").evaluate(_LETTERS) == 0
    picture(scene.page, "figure_view")
    scene.tab("Export")
    with np.load(scene.download("NPZ", tmp_path)) as data:
        assert data["ours_frame"] == data["phystwin_frame"] == FRAME
        assert data["phystwin_control"].shape == (60, 30, 3)
        mean = {}
        for side in ("ours", "phystwin"):
            assert data[f"{side}_force"].shape == data[f"{side}_position"].shape
            mean[side] = data[f"{side}_rest_length"][data[f"{side}_object_spring_count"] :].mean()
        held = [
            (np.linalg.norm(data[f"{side}_force"][FRAME], axis=1) > 1e-6).sum()
            for side in ("ours", "phystwin")
        ]
    # The paper's point: longer virtual springs, and forces spread over more nodes.
    assert mean["phystwin"] > max(mean["ours"], 0.02)
    assert held[1] > held[0] > 5
    image = cv2.imread(str(scene.download("PNG", tmp_path)))
    assert image.shape[1] == 1600
    halves = image[:, :800], image[:, 800:]
    object_nodes = [hue(half, 100, 125).sum() for half in halves]
    virtual_springs = [hue(half, 20, 32).sum() for half in halves]
    # The object is the same on both sides.
    assert min(object_nodes) > 2_000
    assert max(object_nodes) < 2 * min(object_nodes)
    # Ours are a fifth as long and half as many.
    assert virtual_springs[0] > 100
    assert virtual_springs[1] > 500
    scene.tab("Play")
    scene.press("Back to the scene")
    scene.until(lambda: scene.has("Compare with PhysTwin"), "the scene")


def test_a_scene_is_one_tab_s_own(shared_scene: ScenePage) -> None:
    scene = shared_scene
    scene.tab("Physics")
    scene.go(FRAME)
    scene.set("stiffness", 0.1)
    difference, address = scene.new_difference("another rollout"), scene.page.url
    shown = *scene.springs(), difference

    second = scene.page.context.new_page()
    second.set_viewport_size({"width": 800, "height": 500})  # All of whose pixels are drawn.
    second.goto(address)
    copied = ScenePage(second)
    copied.until(lambda: copied.rollout() == shown, "the same rollout")
    original = address.partition("?")[0]
    copied.until(lambda: second.url.partition("?")[0] != original, "an address of its own")
    copied.until(lambda: copied.value("Frame") == copied.frame() == FRAME, "the same frame")
    copied.go(FRAME + 2)
    assert (scene.value("Frame"), scene.frame()) == (FRAME, FRAME)
    # It is not merely frozen: it answers its own user.
    scene.tab("Play")
    scene.press("1 ▶")
    scene.until(lambda: scene.value("Frame") == FRAME + 1, "a step by one frame")
    assert copied.frame() == FRAME + 2
    scene.tab("Physics")
    second.close()
    scene.press("Reset")
