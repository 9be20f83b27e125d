"""The first minutes of a user, in a real browser against a real server."""

import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import psutil
import pytest
import yaml
from playwright.sync_api import Route, expect
from safetensors.numpy import load_file
from support.browser.scene_page import ScenePage, object_springs

from app.jobs.processes import COOKIE
from physhandi.run import Run

pytestmark = pytest.mark.e2e
BUNDLED = Path(__file__).parents[2] / "sequences"


@dataclass(frozen=True)
class Fitted:
    """The bundled towel's run, read from its files."""

    id: str
    name: str
    parameters: dict
    rest_node: np.ndarray
    object_node: np.ndarray
    control: np.ndarray
    contacts: dict[str, np.ndarray]  # who held what, how far away, and as which of the nearest
    rollout: np.ndarray

    def object_springs(self, radius: float) -> set[tuple[int, int]]:
        return object_springs(self.rest_node, radius, self.parameters["max_neighbors"])

    def virtual_springs(self, radius: float) -> set[tuple[int, int, int]]:
        """Springs of the whole sequence, and the frames in which they begin."""
        held, most = self.contacts, self.parameters["virtual_max_neighbors"]
        is_joined = (held["distance"] < radius) & (held["rank"] < most)
        ends = held["node"], held["control"], held["interval"][:, 0]
        return set(zip(*(end[is_joined].tolist() for end in ends), strict=True))


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    run = Run.open(BUNDLED / "runs" / "towel_fold_quick")
    (name,) = run.sequence_names
    motion = run.out / "sequences" / name
    return Fitted(
        id=run.id,
        name=run.name,
        parameters=yaml.safe_load((run.out / "object" / "parameters.yaml").read_text()),
        rest_node=np.load(run.out / "object" / "rest_node.npy").astype(np.float64),
        object_node=np.load(motion / "object_node.npy").astype(np.float64),
        control=np.load(motion / "control.npy").astype(np.float64),
        contacts=load_file(motion / "contacts.safetensors"),
        rollout=np.load(motion / "rollout.npy"),
    )


_COLORS_OF_VERTICES = """() => {
  let mesh = null;
  const group = __viserMutable.nodeRefFromName["/object/surface"];
  group?.traverse((part) => (mesh ??= part.isMesh ? part : null));
  const colors = mesh?.material.vertexColors ? mesh.geometry.getAttribute("color").array : [];
  const [low, high] = [Math.min, Math.max].map((pick) => colors.reduce((a, b) => pick(a, b), 1));
  return [low, high, colors.length];
}"""
"""Least and largest share of the mesh's own color that a vertex has (1 is that color itself), and
how many shares there are."""

_LIGHTS_AND_SHADOWS = """() => {
  const found = __viserMutable.scene.children.filter((part) => part.isLight);
  return { lights: found.length, shadows: found.filter((light) => light.castShadow).length };
}"""


def test_the_printed_address_shows_sequences_and_finished_runs(home, fitted, picture):
    expect(home.locator("[data-sequence=towel_fold] h3")).to_contain_text("towel_fold")
    row = home.locator(f"#runs [data-run={fitted.id}]")
    expect(row).to_contain_text(fitted.name)
    expect(row).to_contain_text("succeeded")
    # The token has left the address, so that nobody copies it from there.
    assert "token" not in home.url
    picture(home, "home")


def test_a_scene_opens_plays_and_saves_what_it_shows(home, fitted, tmp_path, picture):
    scene = ScenePage.opened_from(home)

    frames = {scene.value("Frame")}
    scene.until(lambda: len(frames.add(scene.value("Frame")) or frames) >= 3, "playing")
    scene.pause()
    before = scene.value("Frame")
    scene.tab("Play")
    scene.press("1 ▶")
    scene.until(lambda: scene.value("Frame") == (before + 1) % 60, "a step by one frame")
    scene.go(40)  # A frame in which much happens.
    picture(home, "viewer")

    scene.go(30)
    scene.tab("Export")

    points = ply_vertices(scene.download("PLY", tmp_path))
    expected = np.concatenate([fitted.rollout[30], fitted.control[30]])
    np.testing.assert_allclose(points[: len(expected)], expected, atol=1e-6)

    # It shows the teal towel and the hand, not an empty canvas; browsers without a graphics card
    # may be late to draw them.
    inside = next(frame for frame in home.frames if "/viewer/" in frame.url)
    canvas = inside.locator("canvas[data-engine]")

    def shows_the_object() -> bool:
        image = cv2.imread(str(scene.download("PNG", tmp_path)))
        assert list(image.shape[:2]) == canvas.evaluate("it => [it.height, it.width]")
        blue, green, red = (image[..., channel].astype(int) for channel in range(3))
        objects = np.mean((blue > 150) & (blue - red > 60))
        skin = np.mean((red > 150) & (red - blue > 30) & (red - green > 20))
        return objects > 1e-3 and skin > 1e-3

    scene.until(shows_the_object, "a picture of towel and hand")
    # Each vertex has a color of its own: stripes are lighter than what is between them. They are
    # painted one picture after the mesh is there.
    scene.until(lambda: inside.evaluate(_COLORS_OF_VERTICES)[2] == 3 * 1961, "colors of vertices")
    low, high, _ = inside.evaluate(_COLORS_OF_VERTICES)
    assert low < 0.5
    assert high > 2.0
    expect(inside.get_by_text("Opening the scene")).to_have_count(0)
    # viser fades its canvas in and may stop halfway; everything would stay pale.
    canvas.evaluate("canvas => (canvas.style.opacity = 0.4)")
    expect(canvas).to_have_css("opacity", "1")
    # This browser draws without a graphics card, for which shadows are too much.
    lights = inside.evaluate(_LIGHTS_AND_SHADOWS)
    assert lights["lights"] >= 4
    assert lights["shadows"] == 0
    if home.locator("[data-first-hint]").is_visible():  # A picture was taken without it.
        home.get_by_role("button", name="Got it").click()
    home.reload(wait_until="load")
    # Before that, this tab has hung up: it is not sent on to a copy of its scene.
    assert urlsplit(inside.url).path in {urlsplit(frame.url).path for frame in home.frames}
    assert home.evaluate("localStorage.getItem('physhandi.first-hint')") == "seen"
    expect(home.locator("[data-first-hint]")).to_be_hidden()


def test_sliders_simulate_again_and_reset_returns(shared_scene, fitted, tmp_path, picture):
    scene = shared_scene
    radius = fitted.parameters["connection_radius"]
    virtual_radius = fitted.parameters["virtual_connection_radius"]
    as_fitted = len(fitted.object_springs(radius)), len(fitted.virtual_springs(virtual_radius))
    scene.until(lambda: scene.rollout() == (*as_fitted, 0), "the fitted rollout")

    wide = fitted.object_springs(0.045)
    assert len(wide) > 1.15 * as_fitted[0]
    scene.set("δ object [mm]", 45)
    scene.until(lambda: scene.springs()[0] == len(wide), "the springs of δ = 45 mm")
    by_radius = scene.new_difference("another rollout")
    assert by_radius > 0
    known = (len(wide), as_fitted[1], by_radius)
    scene.until(lambda: scene.rollout() == known, "as many virtual springs as before")
    scene.go(40)
    picture(scene.page, "tweak")

    scene.set("stiffness", 0.1)
    softer = scene.new_difference("a third rollout", by_radius)
    assert softer > 0
    scene.tab("Export")
    with np.load(scene.download("NPZ", tmp_path)) as data:
        pairs = data["spring_nodes"][: data["object_spring_count"]].tolist()
        assert set(map(tuple, pairs)) == wide
        moved = np.linalg.norm(data["position"] - fitted.rollout, axis=-1).mean()
    assert softer == pytest.approx(1e3 * moved, rel=0.01)

    scene.tab("Physics")
    scene.press("Undo")
    scene.until(lambda: scene.difference() == by_radius, "the rollout of δ = 45 mm")
    scene.until(lambda: scene.value("stiffness") == 1, "its slider")

    virtual = fitted.virtual_springs(0.012)
    assert len(virtual) != as_fitted[1]
    scene.set("δ virtual [mm]", 12)
    scene.until(lambda: scene.springs() == (len(wide), len(virtual)), "the virtual springs")

    scene.press("Reset")
    scene.until(lambda: scene.rollout() == (*as_fitted, 0), "the fitted rollout")
    fitted_radius = pytest.approx(1e3 * radius, rel=5e-3)
    scene.until(lambda: scene.value("δ object [mm]") == fitted_radius, "its slider")


def test_values_typed_key_by_key_keep_their_sign_and_factors_are_typed_as_such(
    shared_scene: ScenePage,
):
    scene, slider = shared_scene, "height [mm]"

    def is_simulated(height: float) -> bool:
        return float(scene.link().get("ground_height", 0)) == pytest.approx(1e-3 * height)

    scene.tab("Ground")
    scene.set(slider, -0.7)
    scene.until(lambda: is_simulated(-0.7), "what was pasted")
    scene.type(slider, "-0.6")
    assert scene.value(slider) == -0.6
    scene.field(slider).press("Enter")
    scene.until(lambda: is_simulated(-0.6), "what was typed")

    scene.press("Reset")
    scene.until(lambda: is_simulated(0) and scene.value(slider) == 0, "the fitted height")
    scene.set(slider, -0.6)  # As before the reset, which must not make it old news.
    scene.until(lambda: is_simulated(-0.6), "what was pasted once more")
    scene.type(slider, "-0")
    assert is_simulated(-0.6)  # It may become any number, until it is entered.
    scene.field(slider).press("Enter")
    scene.until(lambda: is_simulated(0), "the fitted height, typed as -0")
    scene.tab("Springs")

    handle = scene.row("stiffness").get_by_role("slider", name="stiffness")
    expect(handle).to_have_attribute("aria-valuetext", "×1.0")
    for typed, shown in (("×0.25", "×0.25"), ("400", "×10")):
        scene.type("stiffness", typed)
        scene.field("stiffness").press("Enter")
        expect(scene.field("stiffness")).to_have_value(shown)
        expect(handle).to_have_attribute("aria-valuetext", shown)
        factor = float(shown[1:])
        scene.until(
            lambda to=factor: float(scene.link()["stiffness_scale"]) == to, "what was typed"
        )
    scene.press("Reset")
    expect(scene.field("stiffness")).to_have_value("×1.0")


def test_a_run_page_exports_the_rollout(home, fitted, tmp_path, picture):
    home.locator(f"#runs [data-run={fitted.id}] a").first.click()
    expect(home.locator("h1")).to_have_text(fitted.name)
    expect(home.locator("#losses .uplot").first).to_be_visible()
    picture(home, "run")

    with home.expect_download() as download:
        home.locator(".exports").get_by_text("PLY", exact=True).click()
    download.value.save_as(tmp_path / "frames.zip")

    with zipfile.ZipFile(tmp_path / "frames.zip") as archive:
        archive.extractall(tmp_path / "frames")
    frames = sorted((tmp_path / "frames").rglob("*.ply"))
    assert len(frames) == len(fitted.rollout) == 60
    for frame in (0, 31, 59):
        nodes = ply_vertices(frames[frame])[: fitted.rollout.shape[1]]
        np.testing.assert_allclose(nodes, fitted.rollout[frame], atol=1e-6)
    home.set_viewport_size({"width": 390, "height": 844})
    expect(home.locator("#metrics-heading")).to_be_visible()
    # Tables of scores that are wider than a phone scroll by themselves.
    assert home.evaluate("document.documentElement.scrollWidth") == 390


def test_what_is_clicked_stays_in_place_when_the_server_says_what_will_run(home):
    dialog = home.locator("dialog#new")
    profile = dialog.get_by_label("paper")
    before = []

    def measure(route: Route) -> None:
        expect(dialog.locator("[data-readiness]")).to_be_hidden()
        before.append(profile.bounding_box())
        route.continue_()

    home.route("**/api/v1/runs/check", measure)
    home.locator("[data-sequence=towel_fold] [data-new]").click()

    expect(dialog.locator("[data-readiness]")).to_be_visible()
    assert [profile.bounding_box()] == before


def test_a_fit_is_launched_followed_and_cancelled(home, served):
    home.locator("[data-sequence=towel_fold] [data-new]").click()
    dialog = home.locator("dialog#new")
    dialog.get_by_label("paper").check()  # It would take minutes, on any machine.
    dialog.get_by_label("Name").fill("A fit <b>from</b> the browser")
    dialog.get_by_role("button", name="Launch", exact=True).click()
    expect(dialog).to_be_hidden()

    row = home.locator("#runs tr", has_text="A fit <b>from</b> the browser")
    expect(row.locator(".state")).to_have_text("running")
    expect(row.locator("[data-text]")).to_have_text(re.compile(r"\w+ reconstruction · \d+ of \d+"))
    seen = row.locator("progress").evaluate("bar => bar.value")
    expect(row.locator("progress")).not_to_have_js_property("value", seen)
    run_id = row.get_attribute("data-run")
    assert processes_of(served.data_dir / "runs" / run_id)

    row.get_by_role("button", name="Cancel").click()
    expect(row.locator(".state")).to_have_text("cancelled")

    assert processes_of(served.data_dir / "runs" / run_id) == []
    expect(row.get_by_role("button", name="Resume")).to_be_visible()


def ply_vertices(path: Path) -> np.ndarray:
    import trimesh

    return np.asarray(trimesh.load(path, process=False).vertices)


def processes_of(run_folder: Path) -> list[psutil.Process]:
    """Find the processes that carry a run's mark, without the help of the application."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get(COOKIE, "").startswith(f"{run_folder}:"):
                found.append(process)
        except psutil.Error:
            continue
    return found
