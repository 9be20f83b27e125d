"""Keypoint networks on a photograph with known answers, and what follows hands through a video."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.inputs.recordings import recording

from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.errors import CancelledError, MissingInputError
from physhandi.hand.loading import load_hand_model
from physhandi.hand.open_hand import KEYPOINT_OFFSET, OpenHand
from physhandi.perception.keypoints import (
    DetectedHand,
    KeypointDetector,
    Region,
    assign_hands,
    detect_sequence,
    landmark_region,
    overlap,
)
from physhandi.progress import Progress
from physhandi.rendering.renderer import render
from physhandi.rendering.shapes import Surface


@pytest.fixture(scope="module")
def detector() -> KeypointDetector:
    return KeypointDetector(threads=1)


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    return np.ascontiguousarray(cv2.imread(str(recording("hand_photo") / "hands.jpg"))[..., ::-1])


def _expected() -> np.ndarray:
    return np.array(
        json.loads((recording("hand_photo") / "expected.json").read_text())["hands"], dtype=float
    )


def _errors(found: list[DetectedHand], expected: np.ndarray) -> list[np.ndarray]:
    """Distance of each expected hand's keypoints from the nearest found hand's."""
    distance = [
        [np.linalg.norm(hand.keypoint - truth, axis=1) for hand in found] for truth in expected
    ]
    return [min(of_hand, key=np.mean) for of_hand in distance]


def test_both_hands_of_the_photograph_are_found(
    detector: KeypointDetector, photo: np.ndarray
) -> None:
    found, expected = detector.detect(photo), _expected()
    assert len(found) == 2
    for error, truth in zip(_errors(found, expected), expected, strict=True):
        assert error.max() <= 20
        assert error.mean() <= 0.03 * np.ptp(truth, axis=0).max()
    # Both show their backs: fingers up with the thumb right, fingers down with the thumb left.
    assert [hand.side for hand in found] == ["left", "left"]
    assert min(hand.confidence for hand in found) > 0.9


def test_a_mirrored_photograph_shows_right_hands(
    detector: KeypointDetector, photo: np.ndarray
) -> None:
    found = detector.detect(np.ascontiguousarray(photo[:, ::-1]))
    assert [hand.side for hand in found] == ["right", "right"]
    expected = _expected() * [-1, 1] + [photo.shape[1] - 1, 0]
    assert max(error.max() for error in _errors(found, expected)) <= 20


def test_hands_are_followed_without_searching(
    detector: KeypointDetector, photo: np.ndarray
) -> None:
    before = detector.detect(photo)
    shifted = np.roll(photo, 6, axis=0)
    after = detector.follow(shifted, before)
    assert len(after) == 2
    moved = np.array([b.keypoint - a.keypoint for a, b in zip(before, after, strict=True)])
    np.testing.assert_allclose(np.median(moved, axis=(0, 1)), [0, 6], atol=1.5)
    assert detector.detect(shifted, after) == after
    assert detector.follow(np.full_like(photo, 255), before) == []


def test_an_empty_image_shows_no_hand(detector: KeypointDetector) -> None:
    empty = np.full((120, 200, 3), 90, np.uint8)
    assert detector.detect(empty) == detector.detect(empty, finds_small=True) == []


def test_hands_that_are_small_in_the_whole_image_are_found(
    tmp_path: Path, photo: np.ndarray
) -> None:
    one = photo.copy()
    one[:, 360:] = 255
    scale = 64 / max(photo.shape[:2])
    little = cv2.resize(one, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    image = np.full((400, 640, 3), 255, np.uint8)
    image[250 : 250 + little.shape[0], 70 : 70 + little.shape[1]] = little
    detector = KeypointDetector()
    assert detector.detect(image) == []
    keypoint = detect_sequence(_sequence(tmp_path / "far", [image, image], hands=("left",)))
    assert np.isfinite(keypoint).all()
    (near,) = detector.detect(one)
    expected = near.keypoint * scale + [70, 250]
    error = np.linalg.norm(keypoint[0, :, 0, :, :2] - expected, axis=2)
    assert error.mean() < 0.08 * np.ptp(expected, axis=0).max()


def test_a_region_maps_its_corners_to_the_image() -> None:
    region = Region(np.array([100.0, 50.0]), 20.0, np.pi / 2)
    corners = np.array([[0, 0], [1, 0], [0.5, 0.5]]) @ region.to_image()[:, :2].T
    np.testing.assert_allclose(
        corners + region.to_image()[:, 2], [[110, 40], [110, 60], [100, 50]], atol=1e-9
    )


def test_the_region_of_an_upright_hand_is_twice_its_box() -> None:
    pixel = np.zeros((21, 2))
    pixel[:, 0] = np.linspace(-10, 10, 21)
    pixel[[5, 9, 13], 0] = 0
    pixel[:, 1] = -np.linspace(0, 40, 21)
    pixel[0] = 0
    region = landmark_region(pixel)
    part = pixel[[0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18]]
    assert region.angle == pytest.approx(0)
    assert region.size == pytest.approx(2 * np.ptp(part[:, 1]))
    middle = (part[:, 1].min() + part[:, 1].max()) / 2
    assert region.center[1] == pytest.approx(middle - 0.1 * np.ptp(part[:, 1]))


def test_the_overlap_of_shifted_boxes_is_a_third() -> None:
    first = np.array([[0.0, 0], [2, 1], *[[1, 0.5]] * 19])
    assert overlap(first, first + np.array([1, 0])) == pytest.approx(1 / 3)
    assert overlap(first, first + np.array([5, 0])) == 0


def _hand(right: float) -> DetectedHand:
    return DetectedHand("right" if right > 0.5 else "left", np.zeros((21, 2)), 0.9, right)


def test_hands_are_told_apart_by_their_side() -> None:
    sure, unsure = _hand(0.9), _hand(0.6)
    assert assign_hands([unsure, sure], ("right", "left")) == {0: sure, 1: unsure}
    assert assign_hands([unsure, sure], ("left", "right")) == {1: sure, 0: unsure}
    assert assign_hands([unsure, sure], ("left",)) == {0: unsure}
    assert assign_hands([sure], ("left",)) == {0: sure}
    assert assign_hands([_hand(0.2)], ("right", "left")).keys() == {1}
    assert assign_hands([], ("right",)) == {}


def _sequence(folder: Path, images: list[np.ndarray], **fields: object) -> Sequence:
    height, width = images[0].shape[:2]
    camera = PinholeCamera(
        K=np.array([[500.0, 0, width / 2], [0, 500, height / 2], [0, 0, 1]]),
        T_world_camera=np.eye(4),
        width=width,
        height=height,
    )
    meta = SequenceMeta(
        name=folder.name,
        frame_rate=30.0,
        frame_count=len(images),
        views=(ViewMeta(name="a", camera=camera),),
        **fields,
    )
    with SequenceWriter(folder) as writer:
        for frame, image in enumerate(images):
            writer.save_image(f"views/a/color/{frame:05d}.png", image)
        return writer.finish(meta)


def test_a_sequence_keeps_frames_without_a_hand(tmp_path: Path, photo: np.ndarray) -> None:
    one = photo.copy()
    one[:, 360:] = 255
    images = [one, np.roll(one, 4, axis=1), np.full_like(one, 255), one]
    seen = []

    class Seen(Progress):
        def report(self, stage, iteration, total, loss=None, message=""):
            seen.append((stage, iteration, total))

    keypoint = detect_sequence(_sequence(tmp_path / "one", images, hands=("left",)), Seen())
    assert keypoint.shape == (1, 4, 1, 21, 3)
    assert np.isfinite(keypoint[0, [0, 1, 3]]).all()
    assert np.isnan(keypoint[0, 2]).all()
    moved = np.median((keypoint[0, 1] - keypoint[0, 0])[0, :, :2], axis=0)
    np.testing.assert_allclose(moved, [4, 0], atol=1.5)
    assert seen[-1] == ("keypoint_detection", 4, 4)


def test_hands_are_followed_back_from_where_they_were_found(
    tmp_path: Path, photo: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = photo.copy()
    one[:, 360:] = 255
    blank = np.full_like(one, 255)
    images = [one, blank, *(np.roll(one, 4 * step, axis=1) for step in range(4))]
    calls: list[int] = []
    find = KeypointDetector.detect

    def find_late(self, image, existing=(), *args, **more):
        calls.append(1)
        late = len(calls) > 5  # In the last frame alone.
        return find(self, image, existing, *args, **more) if late else list(existing)

    monkeypatch.setattr(KeypointDetector, "detect", find_late)
    monkeypatch.setattr("physhandi.perception.keypoints._CHUNK", 2)
    keypoint = detect_sequence(_sequence(tmp_path / "late", images, hands=("left",)))[0, :, 0]
    assert np.isnan(keypoint[:2]).all()  # It is lost where an image shows nothing.
    step = np.median(np.diff(keypoint[2:, :, :2], axis=0), axis=1)
    np.testing.assert_allclose(step, [[4, 0]] * 3, atol=1.5)
    assert keypoint[2:, :, 2].min() > 0.9


def test_a_sequence_without_hands_or_color_says_so(tmp_path: Path) -> None:
    grey = np.zeros((8, 8, 3), np.uint8)
    with pytest.raises(MissingInputError, match=r"'none': no hand is named"):
        detect_sequence(_sequence(tmp_path / "none", [grey]))
    sequence = _sequence(tmp_path / "blind", [grey], hands=("right",))
    (sequence.folder / "views/a/color/00000.png").unlink()
    (sequence.folder / "views/a/color").rmdir()
    with pytest.raises(MissingInputError, match=r"view 'a' has no color"):
        detect_sequence(Sequence.load(sequence.folder))


def test_detection_stops_when_asked(tmp_path: Path) -> None:
    class Stop(Progress):
        def check_cancelled(self):
            raise CancelledError("stop")

    sequence = _sequence(tmp_path / "stop", [np.zeros((8, 8, 3), np.uint8)], hands=("right",))
    with pytest.raises(CancelledError):
        detect_sequence(sequence, Stop())


def test_the_open_hands_keypoints_are_where_the_networks_see_them(
    detector: KeypointDetector,
) -> None:
    hand = load_hand_model("right")
    assert isinstance(hand, OpenHand)
    vertex, keypoint = hand.template, hand.keypoint_position
    ours, joints = [], []
    for azimuth in (-0.4, 0.0, 0.4, 2.74, 3.14, 3.54):
        toward = np.array([np.cos(azimuth), 0, np.sin(azimuth)])
        right = np.cross(-toward, [0, -1, 0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(-toward, right), -toward], axis=1)
        pose[:3, 3] = keypoint.mean(0) + 0.6 * toward
        camera = PinholeCamera(
            K=np.array([[900.0, 0, 240], [0, 900, 240], [0, 0, 1]]),
            T_world_camera=pose,
            width=480,
            height=480,
        )
        skin = np.array([[225.0, 172.0, 140.0]])
        surface = Surface(vertex=vertex, faces=hand.faces, color=skin, shading=0.65)
        grey = (120, 120, 120)
        picture = render(camera, [surface], background=grey, light=toward, samples=1)
        image = np.ascontiguousarray(picture[..., :3])
        (found,) = detector.detect(cv2.GaussianBlur(image, (5, 5), 1.2))
        assert found.side == "right"
        for point, errors in ((keypoint, ours), (keypoint - KEYPOINT_OFFSET, joints)):
            errors.append(np.linalg.norm(camera.project(point) - found.keypoint, axis=-1))
    assert np.median(ours) < 4.5, "1.5 px are one millimetre"
    assert np.median(np.array(ours)[:, 0]) < 0.5 * np.median(np.array(joints)[:, 0])
