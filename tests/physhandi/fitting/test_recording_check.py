"""A check goes on after a broken file, and tells frames, files and what to do."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.hostile.bad_input_world import (
    FILMED_FRAMES,
    both,
    image,
    put,
    removed,
    truncated,
    write_filmed,
)
from support.inputs.sheet_sequence import write_sheet

import physhandi as ph
from physhandi.errors import CancelledError
from physhandi.fitting.checks.recording_check import MOST_PROBLEMS, check_recording
from physhandi.fitting.config import HANDS, OBSERVATION, STAGES
from physhandi.progress import Progress

MASK, DEPTH = "views/front/mask/{:05d}.png", "views/front/depth/{:05d}.png"


@pytest.fixture
def filmed(tmp_path: Path) -> Path:
    folder = write_filmed(tmp_path / "filmed").folder
    # Pixels as close together as the pipeline fuses them.
    meta = folder / "sequence.yaml"
    meta.write_text(meta.read_text().replace("40.0", "400.0"))
    # And a hand that is as large as hands are there.
    keypoint = np.load(folder / "views/front/keypoint.npy")
    keypoint[:, :, 0, :2], keypoint[:, :, [5, 9, 13, 17], :2] = (1, 18), (46, 18)
    np.save(folder / "views/front/keypoint.npy", keypoint)
    for frame in range(FILMED_FRAMES):
        mask = np.zeros((36, 48), np.uint8)
        mask[4:28, 6:30] = 1
        mask[10:24, 34:46] = 2
        cv2.imwrite(str(folder / MASK.format(frame)), mask)
    return folder


def of_frames(file: str, change: Callable[[np.ndarray], Any], *frames: int) -> Any:
    return both(*[image(file.format(frame), change) for frame in frames])


def test_nothing_is_said_of_a_whole_recording(filmed: Path, tmp_path: Path) -> None:
    found = ph.check(filmed)
    assert found.problems == ()
    assert all(stage.is_ready for stage in found.stages.values())
    assert list(found.stages) == list(STAGES)
    sheet = ph.check(write_sheet(tmp_path / "sheet"))
    assert sheet.problems == ()
    assert sheet.stages[OBSERVATION].is_ready


def test_masks_whose_storing_ended_midway_are_doubted(filmed: Path) -> None:
    meta = filmed / "sequence.yaml"
    text = meta.read_text()
    about = "provenance: {masks: {source: built-in, unfinished: true}}"
    meta.write_text(text.replace("provenance: {}", about))
    (problem,) = ph.check(filmed).problems
    assert (problem.level, problem.field) == ("warning", "provenance.masks")
    assert "those of some views may be missing or older" in problem.message


def test_every_broken_file_is_listed_with_its_frame(filmed: Path) -> None:
    both(truncated(DEPTH.format(1)), truncated(DEPTH.format(3)))(filmed)
    image(MASK.format(2), lambda mask: mask + np.uint8(7))(filmed)
    put("views/front/keypoint.npy", (1, 0, 8, 0), np.inf)(filmed)
    found = check_recording(filmed)
    assert {(p.file, p.frame) for p in found.problems} == {
        ("views/front/depth/00001.png", 1),
        ("views/front/depth/00003.png", 3),
        ("views/front/mask/00002.png", 2),
        ("views/front/keypoint.npy", 1),
    }
    assert {p.level for p in found.problems} == {"error"}
    assert all(p.remedy for p in found.problems)
    assert found.error == found.problems[0].message
    assert {stage.missing for stage in found.stages.values()} == {("readable files",)}
    assert json.loads(json.dumps(found.to_dict()))["problems"][0]["frame"] == 1


def test_a_recording_that_does_not_open_is_one_problem(filmed: Path) -> None:
    removed(DEPTH.format(2))(filmed)
    found = check_recording(filmed)
    (problem,) = found.problems
    assert (problem.file, problem.frame) == ("views/front/depth/00002.png", 2)
    assert "lower frame_count" in problem.remedy
    assert not any(stage.is_ready for stage in found.stages.values())
    text = (filmed / "sequence.yaml").read_text()
    (filmed / "sequence.yaml").write_text(text.replace("frame_rate: 30.0", "frame_rate: fast"))
    (problem,) = check_recording(filmed).problems
    assert (problem.file, problem.field) == ("sequence.yaml", "frame_rate")


def test_broken_color_stops_a_fit_only_if_keypoints_are_found_in_it(filmed: Path) -> None:
    video = filmed / "views/front/color.mp4"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"mp4v"), 30, (40, 30))
    for _ in range(FILMED_FRAMES):
        writer.write(np.zeros((30, 40, 3), np.uint8))
    writer.release()
    found = check_recording(filmed)
    assert [p.frame for p in found.problems] == list(range(FILMED_FRAMES))
    assert all("40x30 px" in p.message for p in found.problems)
    assert all(stage.is_ready for stage in found.stages.values())
    assert check_recording(filmed, reads_color=False).problems == ()
    removed("views/front/keypoint.npy")(filmed)
    assert not any(stage.is_ready for stage in check_recording(filmed).stages.values())


def test_frames_without_the_object_are_told_in_rows(filmed: Path) -> None:
    of_frames(MASK, lambda mask: np.where(mask == 1, 0, mask).astype(np.uint8), 1, 2)(filmed)
    of_frames(DEPTH, lambda depth: np.where(np.arange(48) < 22, 0, depth), 3)(filmed)
    unseen, lost = check_recording(filmed).problems
    assert (unseen.level, unseen.frame, unseen.last_frame) == ("warning", 1, 2)
    assert "frames 1 to 2" in unseen.message
    assert (lost.frame, lost.last_frame, lost.file) == (3, 3, "views/*/depth")
    assert all(stage.is_ready for stage in check_recording(filmed).stages.values())


def test_an_object_that_frame_0_does_not_show_stops_its_stages(filmed: Path) -> None:
    of_frames(MASK, lambda mask: np.where(mask == 1, 0, mask).astype(np.uint8), 0)(filmed)
    found = check_recording(filmed)
    assert found.stages[HANDS].is_ready
    assert found.stages[OBSERVATION].missing == ("object in frame 0",)
    assert "frame 0 shows no point" in str(found.stages[OBSERVATION])
    assert found.problems[0].frame == 0
    assert found.error is None


def test_hands_that_nobody_sees_are_named(filmed: Path) -> None:
    put("views/front/keypoint.npy", slice(1, 3), np.nan)(filmed)
    of_frames(MASK, lambda mask: np.minimum(mask, 1), *range(FILMED_FRAMES))(filmed)
    unseen, unlabelled = check_recording(filmed).problems
    assert "right hand in frames 1 to 2" in unseen.message
    assert (unseen.frame, unseen.last_frame, unseen.field) == (1, 2, "hand 0")
    assert unlabelled.message.startswith("No mask labels the right hand")
    put("views/front/keypoint.npy", slice(None), np.nan)(filmed)
    found = check_recording(filmed)
    assert {stage.missing for stage in found.stages.values()} == {("a frame that shows a hand",)}


def test_tracks_must_begin_in_frame_0(filmed: Path) -> None:
    np.save(filmed / "views/front/track.npy", np.full((FILMED_FRAMES, 3, 2), 15.0, np.float32))
    visible = np.ones((FILMED_FRAMES, 3), bool)
    np.save(filmed / "views/front/track_visible.npy", visible)
    assert check_recording(filmed).problems == ()
    visible[0] = False
    np.save(filmed / "views/front/track_visible.npy", visible)
    (problem,) = check_recording(filmed).problems
    assert (problem.frame, problem.file) == (0, "views/*/track_visible.npy")


def test_a_check_lists_no_endless_number_of_problems_and_can_be_stopped(
    filmed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("physhandi.fitting.checks.recording_check.MOST_PROBLEMS", 2)
    both(*[truncated(DEPTH.format(frame)) for frame in range(FILMED_FRAMES)])(filmed)
    found = check_recording(filmed)
    assert len(found.problems) == 3
    assert "2 further problems" in found.problems[-1].message
    assert MOST_PROBLEMS > 2

    class Stop(Progress):
        def check_cancelled(self) -> None:
            raise CancelledError("stop")

    with pytest.raises(CancelledError):
        check_recording(filmed, Stop())
