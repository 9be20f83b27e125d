"""Films from recorded cameras, against the recording's own pictures and masks."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.server.server_world import World
from support.viewer.splat_world import splats_on
from support.viewer.viewer_world import FolderCatalog

from app.exports.making import make
from app.exports.permalink import state_from_query
from app.exports.recorded_film import LARGEST_DIFFERENCE, film_recorded_view, paint_difference
from app.exports.request import FileRequest
from app.settings import BUNDLED
from app.viewer.color.colormaps import table
from app.viewer.content.content import Content, open_run_content
from app.viewer.restoring import complete_state
from physhandi.errors import UsageError

TOWEL = str(BUNDLED / "runs" / "towel_fold_quick")
WHITE = (255, 255, 255)


@pytest.fixture(scope="module")
def content() -> Content:
    return open_run_content(FolderCatalog(BUNDLED), "towel_fold_quick")


def film(content: Content, out: Path, query: dict[str, str], **options: Any) -> list[np.ndarray]:
    """Film a run, and read the pictures back (red, green, blue)."""
    told: list[tuple[int, int]] = []
    film_recorded_view(
        content,
        content.fitted,
        complete_state(state_from_query(query), content),
        lambda done, of: told.append((done, of)),
        out,
        **{"as_gif": False, "time_limit_s": 1e6, "view": "", "beside": "none"} | options,
    )
    capture: Any = cv2.VideoCapture(str(out))
    pictures = []
    while True:
        is_read, picture = capture.read()
        if not is_read:
            break
        pictures.append(picture[..., ::-1].astype(int))
    assert told == [(done + 1, len(pictures)) for done in range(len(pictures))]
    return pictures


def test_a_film_shows_what_a_camera_recorded_beside_what_was_simulated(
    content: Content, tmp_path: Path
) -> None:
    view = content.views[1]
    query = {"part": "10,11", "from": view.name}
    pictures = film(content, tmp_path / "a.mp4", query, beside="difference")
    width, height = 2 * view.camera.width, 2 * view.camera.height
    assert [picture.shape for picture in pictures] == 2 * [(height, 3 * width + 4, 3)]
    for frame, picture in zip((10, 11), pictures, strict=True):
        recorded, simulated, difference = (
            picture[:, at * (width + 2) : at * (width + 2) + width] for at in range(3)
        )
        seen = cv2.resize(view.color(frame), (width, height), interpolation=cv2.INTER_CUBIC)
        # Titles are above.
        assert np.abs(recorded - seen)[40:].mean() < 6.0
        mask = cv2.resize(view.mask(frame), (width, height), interpolation=cv2.INTER_NEAREST) > 0
        drawn = (simulated < 235).any(axis=-1)
        overlap = (mask & drawn)[40:].sum() / (mask | drawn)[40:].sum()
        assert overlap > 0.8
        is_plain = (difference > 235).all(axis=-1)
        assert (is_plain & mask)[40:].sum() < 0.05 * mask[40:].sum()
        assert is_plain[40:].mean() > 0.6


def test_splats_are_filmed_where_there_are_some(content: Content, tmp_path: Path) -> None:
    fitted = content.fitted
    assert fitted is not None
    splats = splats_on(fitted.position[0], 3_000)
    red = np.tile(np.float32([0.9, 0.1, 0.1]), (3_000, 1))
    content = replace(content, splats=replace(splats, color=red))
    (picture,) = film(content, tmp_path / "a.mp4", {"part": "0,1"}, view="front")[:1]
    mask = content.views[0].mask(0)
    mask = cv2.resize(mask, picture.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    is_red = (picture[..., 0] > 150) & (picture[..., 1] < 90)
    towel = mask == 1
    assert (is_red & towel).sum() > 0.75 * towel.sum()
    assert is_red[mask == 0].mean() < 0.02
    # The hand is before the towel, and no splat shines through.
    assert is_red[cv2.erode(np.uint8(mask == 2), np.ones((15, 15))) > 0].mean() < 0.02


def test_a_difference_is_painted_where_something_is() -> None:
    seen = np.full((2, 3, 3), 100, np.uint8)
    drawn = seen.copy()
    drawn[0, 1] += np.uint8([round(255 * LARGEST_DIFFERENCE)] * 3)
    drawn[0, 2] += np.uint8([3 * round(127.5 * LARGEST_DIFFERENCE), 0, 0])
    is_there = np.array([[True, True, True], [True, False, False]])
    painted = paint_difference(seen, drawn, is_there, WHITE)
    scale = table("sequential")
    np.testing.assert_array_equal(painted[0, 0], scale[0])
    np.testing.assert_array_equal(painted[0, 1], scale[-1])
    np.testing.assert_allclose(painted[0, 2], scale[128], atol=3)
    np.testing.assert_array_equal(painted[1, 0], scale[0])
    np.testing.assert_array_equal(painted[1, 1:], [WHITE, WHITE])


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"format": "png", "beside": "recording"}, "mp4 and gif are filmed"),
        ({"format": "mp4", "view": "front", "turn": 90.0}, "it has no turn"),
        ({"format": "gif", "view": "under"}, "has no camera 'under' with pictures. It has: front"),
    ],
)
def test_what_makes_no_sense_is_refused(
    changes: dict[str, Any], reason: str, tmp_path: Path
) -> None:
    order = FileRequest(kind="run", folder=TOWEL, **changes)
    with pytest.raises(UsageError, match=reason):
        make(order, tmp_path / f"a.{changes['format']}")


def test_without_its_recording_a_run_is_not_filmed_so(content: Content, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is not there or has no pictures"):
        film(replace(content, views=()), tmp_path / "a.mp4", {}, beside="recording")
    bare = replace(content, surface=None, splats=None)
    with pytest.raises(UsageError, match="neither splats nor a surface"):
        film(bare, tmp_path / "a.mp4", {}, beside="recording")


def test_a_browser_asks_for_such_a_film(world: World, made: list[FileRequest]) -> None:
    query = "format=mp4&beside=difference&view=front"
    refused = world.script().get(f"/api/v1/runs/fitted/export?{query}")
    assert (refused.status_code, "no pictures" in refused.text) == (422, True)
    assert (made[0].view, made[0].beside) == ("front", "difference")
    wrong = world.script().get("/api/v1/runs/fitted/export?format=mp4&beside=both")
    assert (wrong.status_code, "beside" in wrong.text) == (422, True)
