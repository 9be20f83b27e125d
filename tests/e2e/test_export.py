"""Links, pictures, archives and replays in a real browser."""

import io
import json
import zipfile
from pathlib import Path
from time import monotonic
from typing import Any
from urllib.parse import parse_qs, urljoin, urlsplit

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect
from support.browser.scene_page import FEWER_PICTURES, TIMEOUT_MS, ScenePage, scaled_pictures
from support.viewer.gltf_player import Player

pytestmark = pytest.mark.e2e
BUNDLED = Path(__file__).parents[2] / "sequences/runs/towel_fold_quick"
FRAME = 30
CAMERA = "0.45,-0.7,0.55,0.02,0.01,0.08"
# Large blue disks, so that the two painters can be compared.
LINK = f"f={FRAME}&cam={CAMERA}&fov=40&show=nodes&theme=light&stiffness_scale=0.5"


def blue(image: np.ndarray) -> np.ndarray:
    return (image[..., 0].astype(int) - image[..., 2]) > 70


def places(position: np.ndarray, camera: dict[str, Any], shape: Any) -> tuple[Any, Any]:
    """Rows and columns where a camera sees points, as far as they are in the picture."""
    local = np.linalg.inv(camera["T_world_camera"]) @ np.c_[position, np.ones(len(position))].T
    pixel = (np.array(camera["K"]) @ local[:3] / local[2])[:2].T
    inside = ((pixel > 5) & (pixel < np.array(shape[1::-1]) - 5)).all(axis=1)
    column, row = np.round(pixel[inside]).astype(int).T
    return row, column


_ZOOM = """(widest) => {
  const { camera } = document.getElementById("scene").contentWindow.__viserMutable;
  const isThere = camera.aspect < widest && camera.aspect > widest / 2;
  return isThere && Math.abs(camera.zoom - Math.min(1, camera.aspect)) < 1e-4;
}"""

_ONE_FILE = "api/v1/runs/towel_fold_quick/export?format=html&sequence=towel_fold"


@pytest.fixture
def base(served: Any) -> str:
    return served.base


def test_a_link_opens_a_scene_whose_files_agree_with_the_server_s(
    home: Page, base: str, context: BrowserContext, tmp_path: Path
) -> None:
    context.grant_permissions(["clipboard-read", "clipboard-write"])
    # Of few pixels, a disk is more or less than it should be, and differently so for each painter.
    home.add_init_script(scaled_pictures(1.0))
    home.goto(f"{base}/runs/towel_fold_quick/view?{LINK}")
    scene = ScenePage(home)
    scene.new_difference("the simulation of the link")
    scene.until(lambda: scene.value("Frame") == scene.frame() == FRAME, "the frame of the link")
    half = 0.5
    scene.until(lambda: scene.value("stiffness") == half, "the stiffness of the link")

    asked = parse_qs(LINK)
    # A browser's camera stands elsewhere for a moment, before it hears of the link's.
    scene.until(lambda: query(home).get("cam") == asked["cam"], "the camera of the link")
    scene.until(lambda: scene.link().get("cam") == CAMERA, "the server hears of it")
    told = copied_link(home)
    assert told["cam"] == asked["cam"]
    assert told["stiffness_scale"] == ["0.5"]
    scene.until(lambda: query(home) == told, "the address tells the same")

    scene.tab("Export")
    with zipfile.ZipFile(scene.download("ZIP", tmp_path)) as archive:
        names = set(archive.namelist())
        seen = cv2.imdecode(np.frombuffer(archive.read("picture.png"), np.uint8), 1)
        camera = json.loads(archive.read("camera.json"))["picture"]
        with np.load(io.BytesIO(archive.read("frame.npz"))) as arrays:
            position = arrays["position"]
        link = archive.read("permalink.txt").decode().strip()
    assert {"README.txt", "nodes.csv", "springs.csv", "forces.csv"} <= names
    assert any(name.startswith("views/") for name in names)
    assert parse_qs(urlsplit(link).query)["f"] == [str(FRAME)]
    played = Player(scene.download("GLB", tmp_path)).vertices("object", FRAME)
    np.testing.assert_allclose(played, position, atol=1e-6)
    fitted = np.load(next(BUNDLED.rglob("rollout.npy")))[FRAME]
    assert np.abs(position - fitted).max() > 1e-3

    size = f"width={seen.shape[1]}&height={seen.shape[0]}"
    session = urlsplit(home.url).path.partition("/live/")[2]
    answer = context.request.get(f"{base}/api/v1/sessions/{session}/export?format=png&{size}")
    painted = cv2.imdecode(np.frombuffer(answer.body(), np.uint8), 1)
    ours, theirs = blue(painted), blue(seen)
    assert theirs.sum() > 2_000
    assert (ours & theirs).sum() / (ours | theirs).sum() > 0.85
    assert theirs[*places(position, camera, seen.shape)].mean() > 0.97


def test_a_replay_plays_without_a_session_and_from_one_file(
    home: Page, base: str, browser: Browser, served: Any
) -> None:
    home.goto(f"{base}/runs/towel_fold_quick/replay")
    player = home.frame_locator("#scene")
    time = player.locator("input.mantine-NumberInput-input")
    time.wait_for()
    first = time.input_value()
    home.wait_for_function(
        "first => document.getElementById('scene').contentDocument"
        ".querySelector('input.mantine-NumberInput-input').value !== first",
        arg=first,
    )
    # Until the frame has the focus, keys are those of the page around it.
    home.wait_for_function("() => document.activeElement === document.getElementById('scene')")
    home.keyboard.press("Space")
    player.locator(".tabler-icon-player-play-filled").wait_for()
    until_drawn(home)
    (cached,) = (served.data_dir / "cache" / "exports").glob("towel_fold_quick-*.viser")
    assert cached.stat().st_size < 60 / 300 * 20e6

    # A narrow picture shows as much from side to side as one that is as wide as high.
    home.set_viewport_size({"width": 390, "height": 844})
    home.wait_for_function(_ZOOM, arg=0.6)
    home.set_viewport_size({"width": 1280, "height": 800})
    home.wait_for_function(_ZOOM, arg=2.0)

    # What that address answers is tested where files are; here, that a browser saves it.
    home.locator("summary", has_text="Save").click()
    link = home.get_by_role("link", name="One HTML file")
    expect(link).to_have_attribute("download", "")
    expect(link).to_have_attribute("href", _ONE_FILE)
    # Who has not the token sees the same page, which may ask the server for nothing.
    home.goto(f"{base}/runs/towel_fold_quick")
    home.get_by_role("button", name="Share").click()
    address = home.locator("#shares a").get_attribute("href")
    window = {"width": 560, "height": 350}  # Whose pixels are all drawn, unlike a scene's.
    stranger = browser.new_context(viewport=window, reduced_motion="reduce").new_page()
    stranger.set_default_timeout(TIMEOUT_MS)
    stranger.add_init_script(FEWER_PICTURES)
    complaints: list[str] = []
    stranger.on("console", lambda m: m.type == "error" and complaints.append(m.text))
    stranger.goto(urljoin(base, address))
    stranger.locator("input.mantine-NumberInput-input").wait_for()
    until_drawn(stranger)
    stranger.context.close()
    assert complaints == []
    home.get_by_role("button", name="Withdraw").click()
    expect(home.locator("#shares")).to_be_hidden()


def copied_link(page: Page) -> dict[str, list[str]]:
    """Press the button that copies the link, and read what it asks for."""
    page.get_by_role("button", name="Copy link").click()
    expect(page.locator("#toast")).to_contain_text("Link copied")
    copied = urlsplit(page.evaluate("navigator.clipboard.readText()"))
    below = urlsplit(page.url).path.partition("/live/")[0]
    assert copied.path == f"{below}/runs/towel_fold_quick/view"
    return parse_qs(copied.query)


def query(page: Page) -> dict[str, list[str]]:
    """Read what the address asks for."""
    return parse_qs(urlsplit(page.url).query)


def until_drawn(page: Page) -> None:
    """Wait until the object is in the picture; without a graphics card that takes its time."""
    end = monotonic() + TIMEOUT_MS / 1e3
    while blue(cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), 1)).sum() <= 1_000:
        assert monotonic() < end, "no object was drawn"
        page.wait_for_timeout(500)  # Until the next picture; taking one takes as long.
