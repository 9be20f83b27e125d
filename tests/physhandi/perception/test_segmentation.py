import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from support.inputs.clicked_disc import (
    ABOVE_HAND,
    FRAMES,
    HEIGHT,
    WIDTH,
    cameras,
    disc_click,
    joints,
    write_disc,
)

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import CancelledError, MissingInputError, UsageError
from physhandi.perception import segmentation
from physhandi.perception.segmentation import Click, segment
from physhandi.progress import Progress


def agreement(found: np.ndarray, true: np.ndarray, label: int) -> np.ndarray:
    """Intersection over union of a label in every frame."""
    both = ((found == label) & (true == label)).sum(axis=(1, 2))
    either = ((found == label) | (true == label)).sum(axis=(1, 2))
    return both / np.maximum(either, 1)


@pytest.fixture(scope="module")
def disc(tmp_path_factory):
    return write_disc(tmp_path_factory.mktemp("segment") / "disc")


@pytest.fixture(scope="module")
def held_disc(tmp_path_factory):
    return write_disc(tmp_path_factory.mktemp("segment") / "held", hand=True, frames=5)


def test_one_click_finds_the_object_in_all_frames_of_all_views(disc):
    sequence, true = disc
    # From the middle it is followed both ways.
    found = segment(sequence, [Click(*disc_click("top", 4))])
    assert set(found) == {"top", "side"}
    for view, label in found.items():
        assert label.shape == (FRAMES, HEIGHT, WIDTH)
        assert label.dtype == np.uint8
        assert set(np.unique(label)) == {0, 1}
        assert agreement(label, true[view], 1).min() > 0.93


def test_clicks_in_two_frames_and_views_agree_with_the_truth(disc):
    sequence, true = disc
    clicks = [Click(*disc_click("side", 1)), Click(*disc_click("top", 7))]
    for view, label in segment(sequence, [*clicks, Click(*disc_click("top", 2))]).items():
        assert agreement(label, true[view], 1).min() > 0.93


def test_hands_are_found_from_keypoints_and_are_never_the_object(held_disc):
    sequence, true = held_disc
    found = segment(sequence, [Click(*disc_click())])
    for view, label in found.items():
        assert agreement(label, true[view], 1).mean() > 0.9
        assert agreement(label, true[view], 2).mean() > 0.8
        taken = (label == 1) & (true[view] == 2)
        assert taken.sum() < 0.05 * (true[view] == 2).sum()
        assert (label != 3).all()


def test_the_object_is_not_the_fingers_behind_it(tmp_path):
    sequence, true = write_disc(tmp_path / "over", hand=True, top=ABOVE_HAND, frames=5)
    found = segment(sequence, [Click(*disc_click(top=ABOVE_HAND))])
    for view, label in found.items():
        assert ((label > 1) & (true[view] == 1)).sum() < 0.02 * (true[view] == 1).sum()
        assert agreement(label, true[view], 1).mean() > 0.95
        assert agreement(label, true[view], 2).mean() > 0.7


def test_a_hand_that_one_view_does_not_detect_is_shown_to_it_by_the_other(tmp_path):
    sequence, true = write_disc(tmp_path / "held", hand=True, frames=5)
    path = sequence.folder / "views" / "side" / "keypoint.npy"
    np.save(path, np.full_like(np.load(path), np.nan))
    found = segment(type(sequence).load(sequence.folder), [Click(*disc_click())])
    assert agreement(found["side"], true["side"], 2).mean() > 0.7


@pytest.mark.parametrize("unsure", ["side", "top"])
def test_what_one_view_takes_for_a_hand_yields_to_a_view_that_is_surer(tmp_path, unsure):
    sequence, true = write_disc(tmp_path / "held", hand=True, frames=4)
    path = sequence.folder / "views" / unsure / "keypoint.npy"
    keypoint = np.load(path)
    # On the table, 0.1 m and more from the hand; surer than the other view, but in few frames.
    keypoint[:, :, :, 0] -= 55
    keypoint[1:, :, :, 2], keypoint[:1, :, :, 2] = 0.5, 1.0
    np.save(path, keypoint)
    other = ({"side", "top"} - {unsure}).pop()
    right = np.load(sequence.folder / "views" / other / "keypoint.npy")
    right[..., 2] = 0.9
    np.save(sequence.folder / "views" / other / "keypoint.npy", right)
    found = segment(type(sequence).load(sequence.folder), [Click(*disc_click())])
    for view, least in ((unsure, 0.7), (other, 0.8)):
        assert agreement(found[view], true[view], 2).mean() > least
        assert agreement(found[view], true[view], 1).mean() > 0.9


def test_a_wrist_that_keypoints_do_not_reach_is_the_hands_not_the_objects(tmp_path):
    sequence, true = write_disc(tmp_path / "short", hand=True, frames=5)
    random = np.random.default_rng(0)
    for view in sequence.views:
        keypoint = np.load(view.folder / "keypoint.npy")
        for frame, path in enumerate(view.files("color")):
            # As a detector that finds a fist: a fifth as long as the hand, at its fingertips.
            joint = joints(frame)
            short = joint[12] + 0.2 * (joint - joint[12])
            keypoint[frame, 0, :, :2] = view.camera.project(short)
            image, hand = cv2.imread(str(path)).astype(float), true[view.name][frame] == 2
            image[hand] += random.uniform(-40, 40, (hand.sum(), 3))  # Skin has many colors.
            cv2.imwrite(str(path), image.clip(0, 255).astype(np.uint8))
        np.save(view.folder / "keypoint.npy", keypoint)
    found = segment(type(sequence).load(sequence.folder), [Click(*disc_click())])
    for view, label in found.items():
        # Else a quarter of the hand is the object's.
        assert ((label == 1) & (true[view] == 2)).sum() < 0.01 * (true[view] == 2).sum()
        assert agreement(label, true[view], 2).mean() > 0.95


def write_fist_on_a_rope(folder: Path, *, knot: bool = False) -> tuple[Sequence, np.ndarray]:
    """Film a fist on a rope from above; its keypoints are on one half, the other one is shaded.

    With a knot in the rope beside it, the fist is lit all over.

    Returns:
        The recording, and its true labels.
    """
    frames, height, width, focal, eye = 3, 96, 160, 200.0, 0.6
    random = np.random.default_rng(2)
    row, column = np.mgrid[:height, :width].astype(float)
    images: dict[str, np.ndarray] = {}
    label = np.zeros((frames, height, width), dtype=np.uint8)
    keypoint = np.ones((frames, 1, 21, 3), dtype=np.float32)
    for frame in range(frames):
        color = np.array([190.0, 178, 160]) + random.normal(size=(height, width, 1)) * 4
        depth = np.full((height, width), eye)
        on_rope = (np.abs(row - 48 - 6 * np.sin(column / 30)) < 2) & (np.abs(column - 80) < 72)
        on_rope |= knot & (np.hypot(column - 60, row - 50) < 7)
        color[on_rope], depth[on_rope], label[frame][on_rope] = (190, 175, 60), eye - 0.01, 1
        middle = np.array([80.0 + frame, 40.0])
        fist = np.hypot(column - middle[0], row - middle[1]) < 15
        share = np.clip((middle[1] + 4 - row) / 8, 0, 1)[fist, None]
        color[fist] = share * (214, 150, 128) + (1 - share) * np.array(
            (214, 150, 128) if knot else (130, 95, 75)
        )
        depth[fist], label[frame][fist] = eye - 0.018 - 0.02 * share[:, 0], 2
        color[fist] += random.uniform(-25, 25, (fist.sum(), 1))
        turn = np.linspace(0, 2 * np.pi, 21)
        keypoint[frame, 0, :, 0] = middle[0] + 8 * np.cos(turn)
        keypoint[frame, 0, :, 1] = middle[1] - 8 + 4 * np.sin(turn)
        depth += 0.001 * random.normal(size=depth.shape)
        images[f"views/top/color/{frame:05d}.png"] = color.clip(0, 255).round().astype(np.uint8)
        images[f"views/top/depth/{frame:05d}.png"] = (1000 * depth).round().astype(np.uint16)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = eye
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    camera = PinholeCamera(K=K, T_world_camera=pose, width=width, height=height)
    meta = SequenceMeta(
        name=folder.name,
        frame_rate=30.0,
        frame_count=frames,
        ground_height=0.0,
        hands=("right",),
        views=(ViewMeta(name="top", camera=camera),),
    )
    arrays = {"views/top/keypoint.npy": keypoint}
    return write_sequence(folder, meta, arrays, images=images), label


def test_a_rope_is_as_thin_beside_a_hand_as_elsewhere(tmp_path, monkeypatch):
    sequence, true = write_fist_on_a_rope(tmp_path / "rope")
    click = Click("top", 0, 30, 53)
    found = segment(sequence, [click])["top"]
    assert agreement(found, true, 1).min() > 0.8
    assert agreement(found, true, 2).min() > 0.85
    monkeypatch.setattr(segmentation, "_TOO_THICK", 20.0)
    found = segment(sequence, [click])["top"]
    # Its shaded half is called the rope.
    assert agreement(found, true, 1).min() < 0.7


def test_a_knot_beside_a_hand_stays_the_ropes_by_its_colors(tmp_path):
    sequence, true = write_fist_on_a_rope(tmp_path / "knot", knot=True)
    found, again = (segment(sequence, [Click("top", 0, 30, 53)])["top"] for _ in range(2))
    assert agreement(found, true, 1).min() > 0.8
    np.testing.assert_array_equal(again, found)


@pytest.mark.parametrize("width", [2, 3, 5, 8])
def test_a_lump_hardly_changes_the_typical_width_of_a_rope(width):
    mask = np.zeros((60, 300), dtype=np.uint8)
    mask[30 : 30 + width, :280] = 1
    mask[20:40, 100:112] = 1
    found = segmentation._typical_width(mask)
    assert found is not None
    assert width <= found < width + 2
    assert segmentation._typical_width(np.ones((60, 60), np.uint8)) is None
    assert segmentation._typical_width(np.zeros((60, 60), np.uint8)) is None


def filmed_rope(turn: float, *, is_colored: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Draw a lit round rope of three pixels in a video's colors: CIELAB, and how much it covers."""
    row, column = np.mgrid[:100, :160].astype(float)
    along = (column - 80) * np.cos(turn) + (row - 50) * np.sin(turn)
    off = (row - 50) * np.cos(turn) - (column - 80) * np.sin(turn) - 4 * np.sin(along / 25)
    cover = np.clip(1.5 - np.abs(off) + 0.5, 0, 1) * (np.abs(along) < 46)
    light = np.clip(1 - 0.45 * off / 1.5, 0.4, 1.3)[..., None]
    paint = np.array([170.0, 155, 50] if is_colored else [190, 178, 160]) * light
    color = np.array([190.0, 178, 160]) * (1 - cover[..., None]) + paint * cover[..., None]
    color += np.random.default_rng(0).normal(size=color.shape)
    luma = cv2.cvtColor(color.clip(0, 255).round().astype(np.uint8), cv2.COLOR_RGB2YCrCb)
    half = cv2.resize(luma[..., 1:], (80, 50), interpolation=cv2.INTER_AREA)
    luma[..., 1:] = cv2.resize(half, (160, 100), interpolation=cv2.INTER_LINEAR)
    film = cv2.cvtColor(luma, cv2.COLOR_YCrCb2RGB)
    return cv2.cvtColor(film, cv2.COLOR_RGB2LAB), cover


@pytest.mark.parametrize("turn", [0.3, 0.7, 2.0, 2.6])
def test_a_ropes_rims_are_where_its_color_changes_most(turn):
    lab, cover = filmed_rope(turn)
    true = np.asarray(cover > 0.5)[None].astype(np.uint8)
    label = (cover > 0.1).astype(np.uint8)  # What shows any of its color.
    assert agreement(label[None], true, 1)[0] < 0.8
    patch = SimpleNamespace(lab=lab)
    found = segmentation._outlined_along(patch, label, 3.0, 0.3)
    assert agreement(found[None], true, 1)[0] > 0.89
    label[:, :70] = 2 * (label[:, :70] == 0)  # A hand beside it, which stays.
    assert (segmentation._outlined_along(patch, label, 3.0, 0.3)[label == 2] == 2).all()


@pytest.mark.parametrize("width", [3, 7, 12])
def test_the_direction_across_a_strip_and_its_width_are_found(width):
    row, column = np.mgrid[:80, :160].astype(float)
    off = 0.6 * (column - 80) - 0.8 * (row - 40)
    mask = np.abs(off) < width / 2
    normal, found, wide = segmentation._across(mask, max(3.0, 0.7 * width))
    inside = (np.abs(off) < 1.2) & (np.abs(row - 40) < 15)
    sign = np.sign(normal[..., 0])[inside]
    np.testing.assert_allclose(sign[:, None] * normal[inside], [[0.6, -0.8]] * len(sign), atol=0.05)
    np.testing.assert_allclose(sign * found[inside], off[inside], atol=0.25)
    assert np.median(wide[inside]) == pytest.approx(width, rel=0.15)


@pytest.mark.parametrize("turn", [0.3, 2.0])
def test_rims_off_which_colors_are_learned_are_not_looked_for_farther_in(turn):
    lab, cover = filmed_rope(turn)
    true = (cover > 0.5).astype(np.uint8)
    depth = np.ones(true.shape, np.float32)
    patch = SimpleNamespace(lab=lab, depth=depth, has_depth=depth > 0)
    # Pixels of 2 mm, whose colors are learned off the rim, and of 4 mm; a label that is right.
    narrow, wide = (
        segmentation._outlined(SimpleNamespace(focal=focal), patch, true) for focal in (500, 250)
    )
    assert wide.sum() < 0.9 * true.sum() < 0.97 * narrow.sum()
    assert agreement(narrow[None], true[None], 1)[0] > agreement(wide[None], true[None], 1)[0]


def test_a_rope_of_the_tables_color_keeps_its_rims():
    lab, cover = filmed_rope(0.3, is_colored=False)
    label = (cover > 0.1).astype(np.uint8)
    found = segmentation._outlined_along(SimpleNamespace(lab=lab), label, 3.0, 0.3)
    np.testing.assert_array_equal(found, label)


def test_colors_of_a_blurred_rim_are_not_learned_where_pixels_are_small(tmp_path, monkeypatch):
    sequence, true = write_disc(tmp_path / "blurred", frames=5)
    for view in sequence.views:
        for path in view.files("color"):
            cv2.imwrite(str(path), cv2.GaussianBlur(cv2.imread(str(path)), (0, 0), 1.0))
    # A pixel of these small pictures is 3.5 mm wide there: 0.957 where its rim counts.
    monkeypatch.setattr(segmentation, "_WIDEST_PIXEL", 0.004)
    found = segment(type(sequence).load(sequence.folder), [Click(*disc_click())])
    assert agreement(found["side"], true["side"], 1).mean() > 0.975


def test_without_a_click_hands_alone_are_found(held_disc):
    sequence, true = held_disc
    for view, label in segment(sequence, []).items():
        assert set(np.unique(label)) == {0, 2}
        found = (label == 2) & (true[view] == 2)
        assert found.sum() > 0.93 * (true[view] == 2).sum()
        assert agreement(label, true[view], 2).mean() > 0.6


def test_a_view_without_depth_is_judged_in_smaller_images(tmp_path, monkeypatch):
    sequence, true = write_disc(tmp_path / "held", hand=True, frames=5)
    shutil.rmtree(sequence.folder / "views" / "side" / "depth")
    blind = type(sequence).load(sequence.folder)
    sizes = []
    advance = segmentation._advance
    monkeypatch.setattr(segmentation, "_LONGEST", WIDTH // 2)
    monkeypatch.setattr(
        segmentation,
        "_advance",
        lambda seen, before, label, now: (
            sizes.append((seen.view.name, label.shape)) or advance(seen, before, label, now)
        ),
    )
    found = segment(blind, [Click(*disc_click())])
    assert set(sizes) == {("top", (HEIGHT, WIDTH)), ("side", (HEIGHT // 2, WIDTH // 2))}
    assert found["side"].shape == found["top"].shape
    # A shift by a pixel would cost both 3 points more.
    for label, least in ((1, 0.89), (2, 0.845)):
        assert agreement(found["side"], true["side"], label).mean() > least


@pytest.mark.parametrize(
    ("click", "told"),
    [
        (Click("up", 0, 5, 5), "no view 'up'. Views are: top, side"),
        (Click("top", FRAMES, 5, 5), f"from 0 to {FRAMES - 1}"),
        (Click("top", 0, WIDTH, 5), f"x goes from 0 to {WIDTH - 1}"),
        (Click("top", 0, 5, -1), "outside of the image"),
        (Click("top", 0, float("nan"), 5), "outside of the image"),
    ],
)
def test_a_click_that_is_nowhere_is_refused(disc, click, told):
    with pytest.raises(UsageError, match=told):
        segment(disc[0], [click])


def test_a_click_on_a_hand_is_refused(held_disc):
    sequence, true = held_disc
    row, column = np.argwhere(true["top"][4] == 2).mean(axis=0)
    with pytest.raises(UsageError, match=r"on the right hand\. Click on a part of the object"):
        segment(sequence, [Click("top", 4, column, row)])


def test_a_click_where_no_depth_was_measured_is_refused(tmp_path):
    sequence, _ = write_disc(tmp_path / "disc", frames=2)
    path = sequence.folder / "views" / "top" / "depth" / "00000.png"
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    view, frame, x, y = disc_click()
    depth[int(y) - 2 : int(y) + 3, int(x) - 2 : int(x) + 3] = 0
    cv2.imwrite(str(path), depth)
    with pytest.raises(UsageError, match="no depth was measured there"):
        segment(sequence, [Click(view, frame, x, y)])


def test_a_click_needs_a_view_with_depth_and_segmentation_one_with_color(tmp_path):
    sequence, _ = write_disc(tmp_path / "disc", frames=2)
    shutil.rmtree(sequence.folder / "views" / "top" / "depth")
    reopened = type(sequence).load(sequence.folder)
    with pytest.raises(UsageError, match="view 'top' has no depth"):
        segment(reopened, [Click(*disc_click())])
    for view in cameras():
        shutil.rmtree(sequence.folder / "views" / view / "color")
    with pytest.raises(MissingInputError, match="no view has color images"):
        segment(type(sequence).load(sequence.folder), [])


def test_progress_counts_all_frames_and_can_cancel(disc):
    told: list[tuple[int, int]] = []

    class Watch(Progress):
        def report(self, stage, iteration, total, loss=None, message=""):
            assert stage == "segmentation"
            told.append((iteration, total))

        def check_cancelled(self):
            if len(told) == 3:
                raise CancelledError("enough")

    with pytest.raises(CancelledError):
        segment(disc[0], [Click(*disc_click())], Watch())
    assert told == [(count, 2 * FRAMES) for count in (1, 2, 3)]


def test_a_box_around_the_object_serves_as_a_click(tmp_path):
    sequence, true = write_disc(tmp_path / "disc", frames=4)
    there = np.argwhere(true["top"][0] == 1)
    (top, left), (bottom, right) = there.min(0), there.max(0)
    middle = (float(left + right) / 2, float(top + bottom) / 2)
    box = Click("top", 0, *middle, float(right - left + 8), float(bottom - top + 6))
    masks = segment(sequence, [box])
    for view, found in masks.items():
        both = (found == 1) & (true[view] == 1)
        assert both.sum() > 0.9 * ((found == 1) | (true[view] == 1)).sum()
    assert box.to_dict() == {
        "view": "top",
        "frame": 0,
        "x": middle[0],
        "y": middle[1],
        "width": box.width,
        "height": box.height,
    }
    for width, height in ((-1.0, 40.0), (40.0, float("nan"))):
        with pytest.raises(UsageError, match="both positive"):
            segment(sequence, [Click("top", 0, *middle, width, height)])
    for width, height in ((2.0, 40.0), (190.0, 190.0)):
        with pytest.raises(UsageError, match="so that something else remains"):
            segment(sequence, [Click("top", 0, *middle, width, height)])
    with pytest.raises(UsageError, match="nothing in the box stands out"):
        segment(sequence, [Click("top", 0, 8.0, 8.0, 8.0, 8.0)])
