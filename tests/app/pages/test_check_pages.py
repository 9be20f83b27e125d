"""The check of a recording in the browser: its frames, its stages and its problems."""

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from starlette.testclient import TestClient
from support.hostile.bad_input_world import FILMED_FRAMES, HEIGHT, fields, truncated, write_filmed
from support.server.server_world import World, make_world

from app.previews.overlay import WIDTH, draw_frame
from physhandi.data.sequence import Sequence
from physhandi.fitting.config import STAGES

FRAME = "/sequences/filmed/views/front/frames"


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_filmed(tmp_path_factory.mktemp("films") / "filmed").folder
    track = np.full((FILMED_FRAMES, 2, 2), 4.0, np.float32)
    track[:, 1] = [44.0, 30.0]
    np.save(folder / "views/front/track.npy", track)
    np.save(folder / "views/front/track_visible.npy", np.ones((FILMED_FRAMES, 2), bool))
    return folder


@pytest.fixture
def world(data_dir: Path, film: Path) -> World:
    shutil.copytree(film, data_dir / "sequences/filmed")
    return make_world(data_dir)


@pytest.fixture
def browser(world: World) -> TestClient:
    return world.browser()


@pytest.fixture(scope="module")
def still_browser(still_world: World, film: Path) -> TestClient:
    """A browser of a server that stays as it is."""
    shutil.copytree(film, still_world.settings.sequence_dir / "filmed")
    return still_world.browser()


def picture(content: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1].astype(int)


def test_the_page_shows_views_layers_and_stages_at_once(still_browser: TestClient) -> None:
    page = still_browser.get("/sequences/filmed/check?frame=2")
    assert page.status_code == 200
    text = page.text
    assert 'data-view="front"' in text
    assert 'value="2"' in text
    assert re.findall(r'name="layer" value="(\w+)"', text) == ["mask", "keypoint", "track"]
    assert "Reading every file" in text
    assert text.count("will run") == len(STAGES)
    assert 'href="sequences/filmed/check"' in still_browser.get("/sequences").text
    assert still_browser.get("/sequences/nowhere/check").status_code == 404
    # A recording of markers has no views, but stages.
    markers = still_browser.get("/sequences/sheet/check").text
    assert 'id="frames"' not in markers
    assert "Has nothing to do" in markers


def test_a_frame_is_drawn_with_the_layers_that_are_asked_for(still_browser: TestClient) -> None:
    answer = still_browser.get(f"{FRAME}/1")
    assert answer.headers["content-type"] == "image/jpeg"
    assert answer.headers["cache-control"] == "no-store"
    plain = picture(answer.content)
    assert plain.shape == (HEIGHT * WIDTH // 48, WIDTH, 3)
    scale = WIDTH / 48

    def drawn(layers: str) -> np.ndarray:
        shown = picture(still_browser.get(f"{FRAME}/1?layers={layers}").content)
        return np.abs(shown - plain).max(-1)

    def at(change: np.ndarray, x: float, y: float) -> int:
        return int(change[int((y + 0.5) * scale), int((x + 0.5) * scale)])

    masked, posed, tracked = drawn("mask"), drawn("keypoint"), drawn("track")
    # The object is in columns 11 to 30 of frame 1, the hand in 32 to 39; both from row 14 on.
    assert at(masked, 20, 18) > 20
    assert at(masked, 36, 17) > 20
    assert at(masked, 3, 3) < 8
    assert at(posed, 34, 15) > 40
    assert at(posed, 20, 18) < 8
    assert at(tracked, 4, 4) > 40
    assert at(tracked, 44, 30) > 40
    assert at(tracked, 20, 18) < 8
    assert drawn("mask,keypoint,track").max() > 40
    depth = picture(still_browser.get(f"{FRAME}/1?depth=true").content)
    near, far = depth[int(18.5 * scale), int(20.5 * scale)], depth[5, 5]
    assert near.min() > far.max() + 100


def test_a_drawn_frame_is_kept_as_long_as_the_recording_stays(
    browser: TestClient, world: World
) -> None:
    def version() -> str:
        found = re.search(r'data-version="([^"]+)"', browser.get("/sequences/filmed/check").text)
        assert found is not None
        return found[1]

    first = version()
    kept = browser.get(f"{FRAME}/0?v={first}")
    assert "max-age=3600" in kept.headers["cache-control"]
    mask = world.settings.sequence_dir / "filmed/views/front/mask"
    fresh = shutil.copytree(mask, mask.with_name("fresh"))
    shutil.rmtree(mask)
    fresh.rename(mask)
    assert version() != first
    assert browser.get(f"{FRAME}/0?v={first}").headers["cache-control"] == "no-store"


@pytest.mark.parametrize(
    "address",
    [
        f"{FRAME}/{FILMED_FRAMES}",
        f"{FRAME}/-1",
        "/sequences/filmed/views/back/frames/0",
        "/sequences/nowhere/views/front/frames/0",
    ],
)
def test_a_frame_that_is_not_there_is_not_found(still_browser: TestClient, address: str) -> None:
    assert still_browser.get(address).status_code == 404


def test_problems_are_listed_with_their_frames(browser: TestClient, world: World) -> None:
    whole = browser.get("/sequences/filmed/problems").text
    # Its pixels are too far apart for a cloud.
    assert "too few neighbouring points with depth" in whole
    assert "frame 0 shows no point of the object" in whole
    folder = world.settings.sequence_dir / "filmed"
    truncated("views/front/mask/00002.png")(folder)
    text = browser.get("/sequences/filmed/problems").text
    assert 'data-go="2"' in text
    assert "views/front/mask/00002.png" in text
    assert "the recording breaks the format" in text
    assert text.count("for the same reason") == len(STAGES) - 1
    broken = browser.get(f"{FRAME}/2?layers=mask", headers={"Accept": "*/*"})
    assert broken.status_code == 422
    assert "mask of frame 2 cannot be decoded" in broken.json()["error"]["message"]
    assert browser.get(f"{FRAME}/2").status_code == 200
    told = world.script().get("/api/v1/sequences/filmed/check").json()
    assert [p["frame"] for p in told["problems"]] == [2]
    assert list(told["stages"]) == list(STAGES)


def test_a_recording_that_does_not_open_says_why(browser: TestClient, world: World) -> None:
    fields(colour="red<b>")(world.settings.sequence_dir / "filmed")
    page = browser.get("/sequences/filmed/check")
    assert page.status_code == 200
    assert "cannot be opened" in page.text
    problems = browser.get("/sequences/filmed/problems").text
    assert "field &#39;colour&#39; is not known" in problems
    assert "<b>" not in problems
    assert browser.get(f"{FRAME}/0").status_code == 422


def test_hands_of_nobody_are_not_drawn(film: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(film, tmp_path / "filmed")
    keypoint = np.full((FILMED_FRAMES, 1, 21, 3), np.nan, np.float32)
    np.save(folder / "views/front/keypoint.npy", keypoint)
    (view,) = Sequence.load(folder).views
    plain = draw_frame(view, 0, sides=("right",), layers=frozenset())
    assert draw_frame(view, 0, sides=("right",), layers=frozenset({"keypoint"})) == plain
