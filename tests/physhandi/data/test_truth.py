"""The optional truth of a sequence: read as written, and checked like everything else."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import physhandi
from physhandi.data.camera import PinholeCamera
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import SequenceWriter, write_sequence
from physhandi.data.truth import read_truth
from physhandi.errors import SequenceError

META = SequenceMeta(name="s", frame_rate=30.0, frame_count=3, hands=("right", "left"))
WHOLE = {
    "truth/hand_right_keypoint.npy": np.arange(189.0).reshape(3, 21, 3),
    "truth/hand_right_vertex.npy": np.ones((3, 5, 3)),
    "truth/hand_left_vertex.npy": np.ones((3, 7, 3)),
    "truth/contact_point.npy": np.eye(3),
    "truth/contact.npy": np.eye(3, dtype=bool),
    "truth/object_point.npy": np.arange(27.0).reshape(3, 3, 3),
    "truth/object_face.npy": np.array([[0, 1, 2]]),
}


def test_truth_is_read_as_it_was_written(tmp_path: Path) -> None:
    sequence = write_sequence(tmp_path / "s", META, WHOLE)
    sequence.validate()
    truth = read_truth(sequence.folder)
    assert set(truth.hand_keypoint) == {"right"}
    assert truth.hand_keypoint["right"].tolist() == WHOLE["truth/hand_right_keypoint.npy"].tolist()
    assert {side: v.shape[1] for side, v in truth.hand_vertex.items()} == {"right": 5, "left": 7}
    assert truth.contact is not None
    assert truth.contact.tolist() == np.eye(3).astype(bool).tolist()
    assert truth.object_point is not None
    assert truth.object_point[2].tolist() == [[18, 19, 20], [21, 22, 23], [24, 25, 26]]
    assert truth.object_face is not None
    assert truth.object_face.tolist() == [[0, 1, 2]]


def test_most_sequences_have_none(tmp_path: Path) -> None:
    truth = read_truth(write_sequence(tmp_path / "s", META).folder)
    assert not truth.hand_keypoint
    assert not truth.hand_vertex
    assert truth.contact is truth.contact_point is None
    assert truth.object_point is truth.object_face is None


def held_out_files() -> dict[str, np.ndarray]:
    """Depth and masks of a view that is held out, 6 px wide and 4 px high."""
    depth, mask = np.full((4, 6), 700, np.uint16), np.ones((4, 6), np.uint8)
    folder = "truth/views/side"
    return {
        f"{folder}/{kind}/{frame:05d}.png": image
        for kind, image in (("depth", depth), ("mask", mask))
        for frame in range(3)
    }


def write_held_out(folder: Path, camera: dict[str, Any] | None) -> Sequence:
    with SequenceWriter(folder) as writer:
        for rel, image in held_out_files().items():
            writer.save_image(rel, image)
        if camera is not None:
            writer.save_yaml("truth/views/side/camera.yaml", camera)
        return writer.finish(META)


CAMERA = PinholeCamera(
    K=np.array([[5.0, 0, 2.5], [0, 5.0, 1.5], [0, 0, 1]]),
    T_world_camera=np.eye(4),
    width=6,
    height=4,
)


def test_a_held_out_view_is_read_with_its_camera_and_is_no_view_of_the_sequence(
    tmp_path: Path,
) -> None:
    sequence = write_held_out(tmp_path / "s", CAMERA.to_dict())
    assert sequence.views == ()
    assert sequence.missing("views", "depth", "mask") == ["views", "depth", "mask"]
    (view,) = sequence.held_out_views
    assert view.name == "side"
    assert view.camera.to_dict() == CAMERA.to_dict()
    np.testing.assert_allclose(view.depth(2), 0.7, atol=1e-6)
    assert (view.mask(0) == 1).all()


@pytest.mark.parametrize(
    ("camera", "told"),
    [
        (None, r"truth/views/side/camera\.yaml is missing"),
        ({"width": 6}, r"truth/views/side/camera\.yaml is not the calibration of a camera"),
        ({**CAMERA.to_dict(), "width": 7}, "view 'side': mask of frame 0 is 6x4 px"),
    ],
)
def test_a_wrong_held_out_view_is_refused(tmp_path: Path, camera: Any, told: str) -> None:
    with pytest.raises(SequenceError, match=told):
        write_held_out(tmp_path / "s", camera)


def test_no_stage_of_a_fit_can_name_what_is_held_out() -> None:
    library = Path(physhandi.__file__).parent
    stages = [library / "pipeline.py", library / "fitted_object.py", library / "object_rollout.py"]
    for part in ("fitting", "perception", "hand", "simulation"):
        stages += sorted((library / part).rglob("*.py"))
    assert len(stages) > 40
    for path in stages:
        assert "held_out_views" not in path.read_text(), path


@pytest.mark.parametrize(
    ("file", "array", "reason"),
    [
        ("hand_right_keypoint", np.zeros((2, 21, 3)), "expected frame = 3"),
        ("hand_right_keypoint", np.zeros((3, 20, 3)), "expected axes"),
        ("contact", np.zeros((3, 4), bool), "expected point = 3"),
        ("contact", np.zeros((3, 3)), "expected boolean"),
        ("object_point", np.zeros((3, 4, 3)), "expected point = 3"),
        ("object_face", np.zeros((1, 3)), "expected integer"),
    ],
)
def test_wrong_truth_is_refused(tmp_path: Path, file: str, array: np.ndarray, reason: str) -> None:
    with pytest.raises(SequenceError, match=rf"truth/{file}\.npy.*{reason}"):
        write_sequence(tmp_path / "s", META, WHOLE | {f"truth/{file}.npy": array})


def test_truth_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "s", META, WHOLE).folder
    broken = np.zeros((3, 21, 3))
    broken[2, 4] = np.nan
    np.save(folder / "truth" / "hand_right_keypoint.npy", broken)
    with pytest.raises(SequenceError, match=r"hand_right_keypoint\.npy is nan at frame 2, joint 4"):
        Sequence.load(folder).validate()
