"""Pictures of a square that moves, against what cameras above it recorded."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from physhandi.appearance.scoring import add_picture_scores, mean_scores, picture_curves, rebound
from physhandi.appearance.splats import Splats
from physhandi.data.camera import PinholeCamera
from physhandi.data.files import write_yaml
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import SequenceMeta, ViewMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import CancelledError
from physhandi.progress import Progress

FRAMES = 3
STEP = np.array([0.05, 0.0, 0.0])
"""Way of the square in a frame: 10 px, for cameras 1 m above it [m]."""
RED, GREEN = (200, 40, 0), (0, 120, 40)
CAMERA = PinholeCamera(
    K=np.array([[200.0, 0, 60], [0, 200.0, 40], [0, 0, 1]]),
    T_world_camera=np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]]),
    width=120,
    height=80,
)


def moved_aside(camera: PinholeCamera, offset: float) -> PinholeCamera:
    pose = camera.T_world_camera.copy()
    pose[0, 3] += offset
    return replace(camera, T_world_camera=pose)


def square(spacing: float) -> np.ndarray:
    """Points in the middle of every tile of a square of 20 cm."""
    axis = np.arange(-0.1 + spacing / 2, 0.1, spacing)
    x, y = np.meshgrid(axis, axis)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(np.float32)


def red_square() -> Splats:
    center = square(0.01)
    return Splats(
        center=center,
        scale=np.full(len(center), 0.006, np.float32),
        color=np.tile(np.array(RED, np.float32) / 255, (len(center), 1)),
        opacity=np.full(len(center), 0.98, np.float32),
        rest_node=square(0.02),
    )


def recorded(camera: PinholeCamera, color: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """Images of the square on white, by their names, with a hand over its lower right corner."""
    images: dict[str, np.ndarray] = {}
    for frame in range(FRAMES):
        corner = camera.project(np.array([[-0.1, 0.1, 0], [0.1, -0.1, 0]]) + frame * STEP)
        (left, top), (right, low) = np.rint(corner).astype(int)
        mask = np.zeros((80, 120), np.uint8)
        mask[top:low, left:right] = 1
        mask[low - 5 : low + 3, right - 20 :] = 2
        image = np.full((80, 120, 3), 255, np.uint8)
        image[mask == 1] = color
        images[f"mask/{frame:05d}.png"] = mask
        images[f"color/{frame:05d}.png"] = image
    return images


@pytest.fixture
def seen(tmp_path: Path) -> Sequence:
    """Two cameras that see the square red, and a third, that is held out, that sees it green."""
    views = {"a": CAMERA, "b": moved_aside(CAMERA, 0.02)}
    meta = SequenceMeta(
        name="square",
        frame_rate=30.0,
        frame_count=FRAMES,
        reconstruction=2,
        views=tuple(ViewMeta(name=name, camera=camera) for name, camera in views.items()),
    )
    images = {
        f"views/{name}/{file}": image
        for name, camera in views.items()
        for file, image in recorded(camera, RED).items()
    }
    sequence = write_sequence(tmp_path / "square", meta, images=images)
    aside = moved_aside(CAMERA, -0.04)
    folder = sequence.folder / "truth/views/aside"
    for file, image in recorded(aside, GREEN).items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / file), image[..., ::-1] if image.ndim == 3 else image)
    write_yaml(folder / "camera.yaml", aside.to_dict())
    return Sequence.load(sequence.folder)


def rollout(step: np.ndarray, node: np.ndarray) -> np.ndarray:
    return (node + np.arange(FRAMES)[:, None, None] * step).astype(np.float32)


def test_pictures_of_the_right_motion_are_what_was_recorded(seen: Sequence) -> None:
    still, moved = (
        picture_curves(seen, rollout(step, square(0.02)), red_square()) for step in (0 * STEP, STEP)
    )
    assert list(moved) == ["phystwin", "proper", "held_out"]
    assert min(moved["proper"]["iou"]) > 0.93
    # A hand covers 5 of 40 rows of half of the square: 40 x 40 px less 5 x 20.
    area = 40 * 40 - 5 * 20
    for frame in (1, 2):
        # What moves out of the square is as wide as what it leaves behind; of the latter nothing is
        # under the hand that moves along, of the former the corner is.
        shift = 10 * frame
        drawn = 40 * 40 - 5 * max(0, 20 - shift)
        both = (40 - shift) * 40 - 5 * (20 - min(shift, 20))
        expected = both / (area + drawn - both)
        assert still["proper"]["iou"][frame] == pytest.approx(expected, abs=0.04)
        assert moved["phystwin"]["psnr"][frame] > still["phystwin"]["psnr"][frame] + 4.0
        assert moved["proper"]["ssim"][frame] > still["proper"]["ssim"][frame] + 0.05
    # The square is green where nobody looked, so red is wrong by that much; green by 80 of 255.
    error = np.mean((np.array(RED) - np.array(GREEN)) ** 2) / 255**2
    assert moved["held_out"]["psnr"][1] == pytest.approx(-10 * np.log10(error), abs=0.5)
    assert still["proper"]["iou"][0] == moved["proper"]["iou"][0]


def test_proper_scores_are_the_mean_over_all_views_and_phystwins_those_of_the_first(
    seen: Sequence, tmp_path: Path
) -> None:
    node, look = rollout(STEP, square(0.02)), red_square()
    whole = picture_curves(seen, node, look)
    alone = {}
    for name in ("a", "b"):
        (view,) = (view for view in seen.meta.views if view.name == name)
        meta = replace(seen.meta, name=name, views=(view,))
        files = recorded(view.camera, RED)
        images = {f"views/{name}/{file}": image for file, image in files.items()}
        one = write_sequence(tmp_path / name, meta, images=images)
        alone[name] = picture_curves(one, node, look)
        assert list(alone[name]) == ["phystwin", "proper"]
    for score in ("psnr", "ssim", "iou"):
        parts = [alone["a"]["proper"], alone["b"]["proper"], whole["held_out"]]
        expected = np.mean([part[score] for part in parts], axis=0)
        np.testing.assert_allclose(whole["proper"][score], expected, rtol=1e-9)
        np.testing.assert_array_equal(whole["phystwin"][score], alone["a"]["phystwin"][score])
    differs = whole["held_out"]["psnr"] - alone["b"]["proper"]["psnr"]
    assert np.abs(differs).min() > 3.0


def test_splats_go_along_with_the_nodes_of_any_method(seen: Sequence) -> None:
    fine = square(0.01)
    found = picture_curves(seen, rollout(STEP, fine), rebound(red_square(), fine))
    coarse = picture_curves(seen, rollout(STEP, square(0.02)), red_square())
    np.testing.assert_allclose(found["proper"]["psnr"], coarse["proper"]["psnr"], atol=1e-3)


def test_a_network_adds_its_own_score_beside_the_others(seen: Sequence) -> None:
    def network(one: np.ndarray, other: np.ndarray, where: np.ndarray | None) -> float:
        return float(np.abs(one - other)[slice(None) if where is None else where].mean())

    node = rollout(STEP, square(0.02))
    without = picture_curves(seen, node, red_square())
    found = picture_curves(seen, node, red_square(), perceptual=network)
    for name, by_score in found.items():
        assert list(by_score) == ["psnr", "ssim", "iou", "lpips"]
        for score, curve in without[name].items():
            np.testing.assert_array_equal(by_score[score], curve)
    # Red where it is green: 200, 80 and 40 of 255 off, as the mean of three channels.
    assert found["held_out"]["lpips"][1] == pytest.approx(320 / 3 / 255, abs=0.03)
    assert found["phystwin"]["lpips"][1] < 0.02


def test_reports_have_frame_0_by_itself_and_the_mean_of_each_split(seen: Sequence) -> None:
    curves = picture_curves(seen, rollout(0 * STEP, square(0.02)), red_square())
    report = {"reconstruction": {"rollout": {}}, "future": {"rollout": {}}}
    add_picture_scores(report, curves, {"reconstruction": range(2), "future": range(2, 3)})
    for name, by_score in curves.items():
        for score, curve in by_score.items():
            assert report["photometric"][name][score] == pytest.approx(curve[0])
            for split, frame in (("reconstruction", 1), ("future", 2)):
                mean = report[split]["rollout"]["photometric"][name][score]
                assert mean == pytest.approx(curve[frame])
    unknown = {"proper": {"psnr": np.array([1.0, np.nan, 3.0]), "iou": np.full(3, np.nan)}}
    assert mean_scores(unknown, range(3)) == {"proper": {"psnr": 2.0, "iou": None}}
    nothing: dict[str, dict[str, dict[str, float]]] = {"future": {"rollout": {}}}
    add_picture_scores(nothing, {}, {"future": range(2)})
    assert nothing == {"future": {"rollout": {}}}


def test_drawing_tells_its_frames_and_can_be_stopped(seen: Sequence) -> None:
    class Impatient(Progress):
        def __init__(self) -> None:
            self.told: list[tuple[str, int, int]] = []

        def report(
            self,
            stage: str,
            iteration: int,
            total: int,
            loss: float | None = None,
            message: str = "",
        ) -> None:
            self.told.append((stage, iteration, total))

        def check_cancelled(self) -> None:
            if len(self.told) == 2:
                raise CancelledError("enough")

    progress = Impatient()
    node = rollout(STEP, square(0.02))
    with pytest.raises(CancelledError):
        picture_curves(seen, node, red_square(), progress, stage="evaluation")
    assert progress.told == [("evaluation", 1, 3), ("evaluation", 2, 3)]


def test_a_recording_without_masks_is_not_compared(tmp_path: Path) -> None:
    meta = SequenceMeta(
        name="bare",
        frame_rate=30.0,
        frame_count=FRAMES,
        reconstruction=2,
        views=(ViewMeta(name="a", camera=CAMERA),),
    )
    files = recorded(CAMERA, RED)
    images = {f"views/a/{f}": image for f, image in files.items() if f.startswith("color")}
    bare = write_sequence(tmp_path / "bare", meta, images=images)
    assert picture_curves(bare, rollout(STEP, square(0.02)), red_square()) == {}
