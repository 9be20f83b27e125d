"""What stages need is told before a fit, and the pipeline goes by the same answer."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.hostile.bad_input_world import FILMED_FRAMES, write_filmed
from support.inputs.sheet_sequence import write_sheet

from physhandi.data.sequence import Sequence
from physhandi.fitting.checks.readiness import nothing_to_fit, readiness, shows_palm, skipped_object
from physhandi.fitting.config import (
    APPEARANCE,
    EVALUATION,
    HANDS,
    OBSERVATION,
    REFINEMENT,
    SEARCH,
    SPRINGS,
    STAGES,
    load_profile,
)

OF_OBJECT = (OBSERVATION, SEARCH, SPRINGS, REFINEMENT)


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_filmed(tmp_path_factory.mktemp("films") / "filmed").folder


@pytest.fixture(scope="module")
def sheets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sheet(tmp_path_factory.mktemp("sheets") / "sheet").folder


@pytest.fixture
def without(films: Path, tmp_path: Path) -> Callable[..., Sequence]:
    """Make a copy of the filmed recording that lacks files of its view, or has other fields."""

    def remove(*files: str, **fields: object) -> Sequence:
        folder = shutil.copytree(films, tmp_path / "filmed", dirs_exist_ok=True)
        for file in files:
            path = folder / "views/front" / file
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        meta = yaml.safe_load((folder / "sequence.yaml").read_text())
        (folder / "sequence.yaml").write_text(yaml.safe_dump(meta | fields))
        return Sequence.load(folder)

    return remove


def missing(sequence: Sequence) -> dict[str, tuple[str, ...]]:
    return {name: stage.missing for name, stage in readiness(sequence).items()}


def test_a_whole_recording_is_ready_for_every_stage(without: Callable[..., Sequence]) -> None:
    assert missing(without()) == dict.fromkeys(STAGES, ())
    assert list(readiness(without())) == list(STAGES)
    assert missing(without("color.mp4")) == dict.fromkeys(STAGES, ())
    # Keypoints are found in color, so these need not be stored.
    assert missing(without("keypoint.npy")) == dict.fromkeys(STAGES, ())


def test_without_masks_the_object_is_skipped_and_hands_are_not(
    without: Callable[..., Sequence],
) -> None:
    found = readiness(without("mask"))
    assert {name: stage.missing for name, stage in found.items()} == {
        HANDS: (),
        **dict.fromkeys(OF_OBJECT, ("mask",)),
        EVALUATION: (),
    }
    assert "'filmed' lacks mask" in str(found[SEARCH])
    assert "views/<view>/mask/" in str(found[SEARCH])
    assert found[SEARCH].state == "missing"
    told = skipped_object([without("mask")])
    assert told is not None
    assert "Only the hands" in told
    assert "lacks mask" in told
    # Without depth nobody expects an object.
    assert skipped_object([without("depth", "mask")]) is None


def test_hands_need_a_view_that_shows_them(without: Callable[..., Sequence]) -> None:
    blind = without("color.mp4", "keypoint.npy")
    found = missing(blind)
    assert set(found.values()) == {("color or keypoint",)}
    assert list(found) == list(STAGES)
    told = nothing_to_fit([blind])
    assert "'filmed' lacks color or keypoint for the object" in told
    assert "keypoint.npy" in told
    assert missing(without("keypoint.npy", hands=[]))[HANDS] == ("hands",)
    assert missing(without("keypoint.npy", hands=[]))[OBSERVATION] == ("hands or control",)


def test_depth_and_masks_must_be_of_one_view(without: Callable[..., Sequence]) -> None:
    folder = without("mask").folder
    meta = yaml.safe_load((folder / "sequence.yaml").read_text())
    meta["views"].append(meta["views"][0] | {"name": "side"})
    (folder / "sequence.yaml").write_text(yaml.safe_dump(meta))
    mask = folder.parent / "mask"
    shutil.copytree(folder / "views/front", folder / "views/side")
    shutil.copytree(folder / "views/side/depth", mask)
    shutil.rmtree(folder / "views/side/depth")
    mask.rename(folder / "views/side/mask")  # Never decoded here.
    assert missing(Sequence.load(folder))[OBSERVATION] == ("depth and mask in one view",)


def test_point_controllers_need_no_hands(sheets: Path, tmp_path: Path) -> None:
    found = readiness(Sequence.load(sheets))
    states = {name: stage.state for name, stage in found.items()}
    assert states == {
        HANDS: "not needed",
        OBSERVATION: "ready",
        SEARCH: "ready",
        SPRINGS: "ready",
        REFINEMENT: "not needed",
        EVALUATION: "ready",
    }
    assert skipped_object([Sequence.load(sheets)]) is None
    bare = shutil.copytree(sheets, tmp_path / "bare")
    for file in ("object_node.npy", "rest_node.npy", "marker_node.npy"):
        (bare / file).unlink()
    assert missing(Sequence.load(bare))[OBSERVATION] == ("object_node",)


def test_all_recordings_of_a_fit_must_show_the_object(
    without: Callable[..., Sequence], sheets: Path
) -> None:
    sheet, bare = Sequence.load(sheets), without("mask")
    both = readiness([sheet, bare])
    # The sheet shows no hands and the film no object: no stage could do both.
    assert not any(stage.is_ready for stage in both.values())
    assert "'filmed' lacks mask" in both[EVALUATION].why
    assert "'sheet' lacks hands" in both[EVALUATION].why
    assert "'sheet'" in nothing_to_fit([sheet, bare])


def test_settings_can_leave_out_the_refinement(without: Callable[..., Sequence]) -> None:
    config = load_profile("quick")
    left_out = config.replace(refinement=config.refinement.replace(iterations=0))
    assert readiness(without(), config)[REFINEMENT].is_ready
    refinement = readiness(without(), left_out)[REFINEMENT]
    assert (refinement.is_ready, refinement.state) == (False, "not needed")


def test_a_look_is_asked_for_and_needs_color_with_masks(without: Callable[..., Sequence]) -> None:
    config = load_profile("quick")
    asked = config.replace(appearance=config.appearance.replace(enabled=True))
    assert APPEARANCE not in readiness(without(), config)
    found = readiness(without(), asked)
    assert list(found) == [*STAGES[:-1], APPEARANCE, EVALUATION]
    assert found[APPEARANCE].is_ready
    dark = readiness(without("color.mp4"), asked)
    assert {name for name, stage in dark.items() if not stage.is_ready} == {APPEARANCE}
    assert str(dark[APPEARANCE]) == (
        "will be skipped: 'filmed' lacks color and mask in one view; "
        "add masks to a view that has color, or color to one that has masks"
    )
    bare = readiness(without("mask"), asked)
    assert bare[APPEARANCE].missing == bare[OBSERVATION].missing


def test_a_palm_is_shown_by_four_of_its_keypoints() -> None:
    keypoint = np.full((FILMED_FRAMES, 21, 3), np.nan)
    keypoint[0] = 1.0
    keypoint[1, [0, 5, 9]] = 1.0  # Three of the palm,
    keypoint[1, [2, 3, 4, 6]] = 1.0  # and fingers.
    keypoint[2, [0, 1, 13, 17]] = 1.0
    keypoint[3] = [1.0, 1.0, 0.0]  # Seen without any confidence.
    assert shows_palm(keypoint).tolist() == [True, False, True, False]
