"""Importing motion capture: a made-up rope whose every value is known."""

from pathlib import Path

import numpy as np
import pytest

from physhandi.data.importers.mocap import (
    held_point,
    import_mocap,
    refine,
    resample,
    straight_chain,
    turned_up,
)
from physhandi.errors import CancelledError, ImportFailedError, UsageError
from physhandi.progress import Progress

SEGMENT = 0.08


def make_rope(samples: int = 500, markers: int = 13) -> np.ndarray:
    """A half circle that swings: every chord is SEGMENT long."""
    angle = np.linspace(0, np.pi, markers)
    radius = SEGMENT / (2 * np.sin(np.pi / (2 * (markers - 1))))
    shape = radius * np.stack([np.cos(angle), np.zeros(markers), -np.sin(angle)], axis=1)
    time = np.arange(samples) / 100
    shift = np.stack([0.3 * np.sin(4 * time), 0.2 * np.cos(3 * time), 1 + 0.1 * time], axis=1)
    return (shape[None] + shift[:, None]).astype(np.float32)


def test_a_trajectory_becomes_a_sequence(tmp_path: Path) -> None:
    rope = make_rope()
    np.save(tmp_path / "swing_01.npy", rope)
    (sequence,) = import_mocap(tmp_path / "swing_01.npy", tmp_path / "out")
    sequence.validate()
    assert sequence.folder == tmp_path / "out" / "swing_01"
    assert (sequence.frame_count, sequence.frame_rate) == (150, 30.0)
    assert (sequence.ground_height, sequence.gravity, sequence.metric) == (None, 9.81, True)
    assert sequence.controlled_markers == (0, 1, 11, 12)
    assert sequence.shape == "rope"
    assert sequence.missing("object", "control", "held_point", "marker_node", "rest_node") == []
    marker, control, node = sequence.marker, sequence.control, sequence.object_node
    assert marker is not None
    assert control is not None
    assert node is not None
    assert sequence.marker_node is not None
    assert marker.shape == (150, 13, 3)
    np.testing.assert_array_equal(control, marker[:, [0, 1, 11, 12]])
    # Frames 0, 3, 6, … of 30 Hz fall on samples 0, 10, 20, … of 100 Hz.
    np.testing.assert_allclose(marker[::3], rope[::10], atol=1e-6)
    assert node.shape == (13, 3)
    np.testing.assert_array_equal(sequence.marker_node, np.arange(13))
    np.testing.assert_allclose(node[sequence.marker_node], marker[0], atol=1e-6)
    assert sequence.rest_node is not None
    assert np.diff(sequence.rest_node[:, 0]) == pytest.approx(SEGMENT, abs=1e-6)
    assert sequence.rest_node[-1] == pytest.approx([12 * SEGMENT, 0, 0], abs=1e-5)


def test_the_held_point_stands_across_the_rope_as_steeply_as_it_can(tmp_path: Path) -> None:
    np.save(tmp_path / "swing.npy", make_rope(60, markers=5))
    (sequence,) = import_mocap(
        tmp_path / "swing.npy", tmp_path / "out", controlled_markers=(0, 1, 4)
    )
    assert sequence.marker is not None
    # The half circle leaves its end downwards, and inwards by half the angle of a segment.
    arm = SEGMENT / 2 * np.array([-np.cos(np.pi / 8), 0.0, np.sin(np.pi / 8)])
    assert sequence.held_point is not None
    offset = sequence.held_point - sequence.marker[:, 0]
    np.testing.assert_allclose(offset, np.repeat(arm[None], len(offset), axis=0), atol=1e-5)


def test_the_held_point_turns_with_the_gripper_but_not_about_the_rope() -> None:
    turn = np.linspace(0.0, 3.0, 200)
    along = np.stack([np.cos(turn), 0 * turn, np.sin(turn)], axis=1)
    marker = 0.1 * np.arange(4)[None, :, None] * along[:, None]
    held = held_point(marker, (0, 1, 3))
    assert held is not None
    across = np.stack([-np.sin(turn), 0 * turn, np.cos(turn)], axis=1)
    np.testing.assert_allclose(held, 0.05 * across, atol=1e-12)
    assert held_point(marker, (0, 3)) is None
    assert held_point(marker[:, :3], (0, 1)) is None
    upright = held_point(marker[..., [1, 2, 0]], (0, 1))
    assert upright is not None
    np.testing.assert_allclose(upright[0], [0.05, 0.0, 0.0], atol=1e-12)


def test_resampling_is_exact_for_cubic_motion() -> None:
    time = np.arange(100) / 100
    marker = np.stack([time**3, 1 - time**2, 2 * time], axis=1)[:, None]
    frames = resample(marker, 100.0, 30.0)
    at = np.arange(30) / 30
    assert len(frames) == 30
    assert frames[:, 0] == pytest.approx(np.stack([at**3, 1 - at**2, 2 * at], axis=1), abs=1e-12)


def test_nodes_lie_evenly_on_the_curve() -> None:
    angle = np.linspace(0, np.pi, 13)
    circle = np.stack([np.cos(angle), np.zeros(13), np.sin(angle)], axis=1)
    node, _ = refine(circle, 4)
    assert np.linalg.norm(node, axis=1) == pytest.approx(1.0, abs=2e-4)
    step = np.linalg.norm(np.diff(node, axis=0), axis=1)
    assert step[4:-4] == pytest.approx(np.pi / 48, rel=2e-3)


def test_the_rest_shape_has_the_median_segment_lengths() -> None:
    marker = np.zeros((3, 3, 3))
    marker[:, 1, 2] = [0.1, 0.2, 0.9]
    marker[:, 2, 2] = marker[:, 1, 2] + 0.4
    rest = straight_chain(marker, 2)
    assert rest[:, 0] == pytest.approx([0, 0.1, 0.2, 0.4, 0.6])
    assert not rest[:, 1:].any()


def test_a_folder_of_trajectories_becomes_sequences(tmp_path: Path) -> None:
    for name in ("b", "a", "with space"):
        np.save(tmp_path / f"{name}.npy", make_rope(60))
    (tmp_path / "README.md").write_text("three ropes")
    sequences = import_mocap(tmp_path, tmp_path / "out")
    assert [sequence.name for sequence in sequences] == ["a", "b", "with_space"]
    with pytest.raises(Exception, match="exists already"):
        import_mocap(tmp_path, tmp_path / "out")
    assert len(import_mocap(tmp_path, tmp_path / "out", overwrite=True)) == 3


def test_rate_spacing_rest_shape_unit_and_up_axis_are_options(tmp_path: Path) -> None:
    rope = make_rope(120)
    # In centimetres, y up: what was z is y, and the axes keep their handedness.
    np.save(tmp_path / "swing.npy", 100 * rope[..., [1, 2, 0]])
    (sequence,) = import_mocap(
        tmp_path / "swing.npy",
        tmp_path / "out",
        controlled_markers=(0, 12),
        recording_rate=50.0,
        frame_rate=25.0,
        node_spacing=SEGMENT / 2,
        rest_shape="first_frame",
        up="y",
        unit="cm",
    )
    assert (sequence.frame_rate, sequence.frame_count) == (25.0, 60)
    assert sequence.marker is not None
    np.testing.assert_allclose(sequence.marker, rope[::2], atol=1e-5)
    assert sequence.controlled_markers == (0, 12)
    assert sequence.object_node is not None
    assert sequence.object_node.shape == (25, 3)
    np.testing.assert_array_equal(sequence.rest_node, sequence.object_node)
    assert sequence.provenance["nodes_per_segment"] == 2


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_turning_a_recording_up_is_a_rotation(up: str) -> None:
    axes = turned_up(np.eye(3)[None], up)[0]  # type: ignore[arg-type]
    assert np.linalg.det(axes) == pytest.approx(1.0)
    direction = np.eye(3)["xyz".index(up[-1])] * (-1 if up.startswith("-") else 1)
    np.testing.assert_array_equal(turned_up(direction[None, None], up)[0, 0], [0, 0, 1])  # type: ignore[arg-type]


def test_options_out_of_range_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", make_rope(20))
    zero = {"recording_rate": 0.0, "frame_rate": 0.0, "nodes_per_segment": 0, "node_spacing": 0.0}
    for option, value in zero.items():
        with pytest.raises(UsageError, match=f"{option.split('_')[0]}.* must be positive, not 0"):
            import_mocap(tmp_path / "a.npy", tmp_path / "out", **{option: value})
    assert not (tmp_path / "out").exists()


def branched() -> np.ndarray:
    """Two arms of one tree, listed one after the other, that swing against each other."""
    rope = make_rope(100)
    rope[:, 7:, 0] += 0.3 * np.sin(np.arange(100) / 9)[:, None]
    return rope


def far_branch() -> np.ndarray:
    """A second arm that keeps its distance, a long way off."""
    rope = make_rope(100)
    rope[:, 7:, 0] += 2.0
    return rope


def one_axis_in_another_unit() -> np.ndarray:
    """A rope that turns about the vertical, one of whose axes is twice as long as it should be."""
    rope, angle = make_rope(100), np.arange(100) / 20
    turn = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None]
    rope[..., :2] = rope[..., :1] * turn
    return rope * [2.0, 1.0, 1.0]


def with_value(value: object, *place: int) -> np.ndarray:
    rope = make_rope(20)
    rope[place] = value
    return rope


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((20, 13)), r"bad.npy holds float64 \(20, 13\); expected"),
        (np.zeros((20, 13, 3), int), "bad.npy holds int64"),
        (make_rope(20)[:5], "bad.npy has 5 frames; at least 8"),
        (make_rope(20)[:, :9], r"bad.npy has 9 markers, but markers \[0, 1, 11, 12\]"),
        (with_value(np.nan, 7, 4, 1), "bad.npy: frame 7, marker 4 is"),
        (with_value(np.inf, 19, 0, 2), "bad.npy: frame 19, marker 0 is"),
        (make_rope(20) * 1000, r"bad.npy: frame 0, marker 0 is \d+ m from the origin"),
        (with_value(make_rope(20)[3, 5], 3, 6), "frame 3: markers 5 and 6 are at one place"),
        (branched(), r"bad.npy: from marker 6 to 7 it is \d+ to \d+ mm, but .* without branches"),
        (far_branch(), r"bad.npy: from marker 6 to 7 it is \d+ mm, but 80 mm from marker"),
        (one_axis_in_another_unit(), "bad.npy: from marker .* all axes in one unit"),
        (make_rope(20) * 12, r"bad.npy: the markers make a rope of 11\.5 m, read in m. .*--unit"),
        (np.array([None, 3], dtype=object), "bad.npy is not a readable .npy file"),
    ],
)
def test_bad_recordings_are_named(tmp_path: Path, array: np.ndarray, message: str) -> None:
    np.save(tmp_path / "a_good.npy", make_rope(20))
    np.save(tmp_path / "bad.npy", array)
    with pytest.raises(ImportFailedError, match=message):
        import_mocap(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_absent_recordings_are_named(tmp_path: Path) -> None:
    with pytest.raises(ImportFailedError, match="neither a file nor a folder"):
        import_mocap(tmp_path / "nothing", tmp_path / "out")
    with pytest.raises(ImportFailedError, match=r"holds no \.npy file"):
        import_mocap(tmp_path, tmp_path / "out")
    (tmp_path / "text.npy").write_text("no array")
    with pytest.raises(ImportFailedError, match=r"text\.npy is not a readable"):
        import_mocap(tmp_path / "text.npy", tmp_path / "out")


class Impatient(Progress):
    def check_cancelled(self) -> None:
        raise CancelledError("enough")


def test_an_import_can_be_cancelled(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", make_rope(20))
    with pytest.raises(CancelledError):
        import_mocap(tmp_path / "a.npy", tmp_path / "out", Impatient())
