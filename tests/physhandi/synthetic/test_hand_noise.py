"""Disturbed hands: how wrong they are, and that this happens once, whatever stops the work."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file
from support.inputs.sheet_sequence import FRAMES, write_sheet

from physhandi import pipeline
from physhandi.data.camera import PinholeCamera
from physhandi.data.run import RunFolder
from physhandi.data.sequence import Sequence, ViewMeta
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.errors import CancelledError
from physhandi.hand.loading import load_hand_model
from physhandi.hand.motion import HandMotion
from physhandi.progress import NullProgress, Progress
from physhandi.synthetic.bodies.sheets import fold_motion
from physhandi.synthetic.suite import methods
from physhandi.synthetic.suite.cells import Bench
from physhandi.synthetic.suite.methods import METHODS, HandNoise, disturbed, execute, parse_method

NOISE = HandNoise(error=0.010, seed=5)
HAND = "sequences/scene/hand_right.safetensors"


def fitted(config: Any = None) -> HandMotion:
    """Where the hand is; other settings of the fit put it elsewhere."""
    iterations = 500 if config is None else config.iterations
    motion = fold_motion(load_hand_model("right"), FRAMES, 30.0, np.random.default_rng(0))
    aside = np.array([iterations / 1000, 0.0, 0.0], np.float32)
    return replace(motion, wrist_translation=motion.wrist_translation + aside)


def error_of(run: RunFolder, true: HandMotion) -> float:
    """Mean distance of the joints of a run's hand from those of another one [m]."""
    model = load_hand_model("right")
    found = HandMotion.from_tensors(load_file(run.out / HAND))
    gap = np.linalg.norm(found.keypoints(model) - true.keypoints(model), axis=2)
    return float(gap.mean())


@pytest.fixture
def recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sequence:
    """A sheet with a hand in place of controllers, whose fit is at hand."""

    def fit(_sequence: Sequence, config: Any, _progress: Progress, **_: Any) -> SimpleNamespace:
        keypoint = np.full((1, FRAMES, 1, 21, 3), 30.0, np.float32)
        return SimpleNamespace(
            motions=(fitted(config),),
            keypoint=keypoint,
            loss_before=2.0,
            loss_after=1.0,
            curve=[],
            left_out={},
        )

    monkeypatch.setattr(pipeline, "reconstruct_hands", fit)
    plain = write_sheet(tmp_path / "plain")
    names = ("marker", "marker_node", "object_node", "rest_node")
    arrays = {f"{name}.npy": np.load(plain.folder / f"{name}.npy") for name in names}
    arrays["views/a/keypoint.npy"] = np.full((FRAMES, 1, 21, 3), (30.0, 30.0, 0.9), np.float32)
    pose = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
    K = np.array([[100.0, 0, 40], [0, 100.0, 30], [0, 0, 1]])
    camera = PinholeCamera(K=K, T_world_camera=pose, width=80, height=60)
    views = (ViewMeta(name="a", camera=camera),)
    meta: SequenceMeta = replace(plain.meta, name="scene", hands=("right",), views=views)
    return write_sequence(tmp_path / "scene", meta, arrays)


class Stopper(Progress):
    """Stops as soon as the object is looked at, when the hands are finished."""

    def report(self, stage: str, *rest: Any, **more: Any) -> None:
        if stage == pipeline.OBSERVATION:
            raise CancelledError("enough")


def run_of(
    recording: Sequence, folder: Path, progress: Progress | None = None, **more: Any
) -> RunFolder:
    return execute(
        METHODS["rigid_follow"],
        recording,
        folder,
        title="test",
        common={},
        progress=progress or NullProgress(),
        **more,
    )


def test_a_disturbed_hand_is_wrong_by_exactly_10_mm() -> None:
    model = load_hand_model("right")
    motion = fold_motion(model, 12, 30.0, np.random.default_rng(0))
    wrong = disturbed(motion, 0.010, seed=(7, 0))
    gap = np.linalg.norm(wrong.keypoints(model) - motion.keypoints(model), axis=2)
    assert gap.mean() == pytest.approx(0.010, rel=1e-4)
    assert gap.mean(axis=1).min() > 0.002
    same = disturbed(motion, 0.010, seed=(7, 0))
    np.testing.assert_array_equal(same.wrist_translation, wrong.wrist_translation)
    for seed in ((7, 1), (8, 0)):  # The other hand, and another recording.
        other = disturbed(motion, 0.010, seed=seed)
        assert np.abs(other.wrist_translation - wrong.wrist_translation).max() > 0.002


def test_hands_are_disturbed_once_even_if_the_work_is_stopped_after_it(
    recording: Sequence, tmp_path: Path
) -> None:
    hands = run_of(recording, tmp_path / "hands")
    assert error_of(hands, fitted()) < 1e-6
    with pytest.raises(CancelledError):
        run_of(recording, tmp_path / "noisy", Stopper(), hands=hands, noise=NOISE)
    noisy = run_of(recording, tmp_path / "noisy", hands=hands, noise=NOISE)
    assert noisy.attempt == 2
    assert error_of(noisy, fitted()) == pytest.approx(0.010, rel=1e-3)
    assert noisy.stages()[0]["summary"] == hands.stages()[0]["summary"]


@pytest.mark.parametrize("is_late", [False, True])
def test_hands_are_disturbed_once_even_if_the_work_is_killed_at_it(
    recording: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_late: bool
) -> None:
    hands = run_of(recording, tmp_path / "hands")

    def killed(*arguments: Any) -> None:
        if is_late:
            disturb(*arguments)
        raise KeyboardInterrupt

    disturb = methods.disturb_hands
    with monkeypatch.context() as patch:
        patch.setattr(methods, "disturb_hands", killed)
        with pytest.raises(KeyboardInterrupt):
            run_of(recording, tmp_path / "noisy", hands=hands, noise=NOISE)
    assert RunFolder.open(tmp_path / "noisy").stages() == []
    noisy = run_of(recording, tmp_path / "noisy", hands=hands, noise=NOISE)
    assert error_of(noisy, fitted()) == pytest.approx(0.010, rel=1e-3)


@pytest.mark.parametrize("base", ["static", "rigid_follow"])
def test_a_method_with_hand_settings_of_its_own_has_its_own_hands_disturbed(
    recording: Sequence, tmp_path: Path, base: str
) -> None:
    bench = Bench(tmp_path / "suite", common={}, device="cpu", progress=NullProgress())
    for name, iterations in ((base, 500), (f"{base}@hand.iterations=7", 7)):
        outcome = bench.outcome(parse_method(name), recording, "noisy_hand")
        assert not outcome.error
        run = RunFolder.open(tmp_path / "suite/cells" / outcome.run)
        own = fitted(SimpleNamespace(iterations=iterations))
        assert error_of(run, own) == pytest.approx(0.010, rel=1e-3)


def test_recordings_are_disturbed_independently(recording: Sequence, tmp_path: Path) -> None:
    paths = list(recording.folder.rglob("*.npy"))
    arrays = {path.relative_to(recording.folder).as_posix(): np.load(path) for path in paths}
    other = write_sequence(tmp_path / "other", replace(recording.meta, name="other"), arrays)
    bench = Bench(tmp_path / "suite", common={}, device="cpu", progress=NullProgress())
    places: list[np.ndarray] = []
    for one in (recording, other):
        outcome = bench.outcome(METHODS["static"], one, "noisy_hand")
        run = RunFolder.open(tmp_path / "suite/cells" / outcome.run)
        places.append(
            run.tensors(f"sequences/{one.name}/hand_right.safetensors")["wrist_translation"]
        )
    assert np.abs(places[0] - places[1]).max() > 0.002
