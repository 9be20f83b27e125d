"""Pictures of a sequence: rows are methods, columns moments, colors errors."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.inputs.sheet_sequence import FACES, FITTED, FRAMES, NODE
from support.server.suite_world import write_told

from physhandi.data.camera import PinholeCamera
from physhandi.data.run import RunFolder
from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import ViewMeta
from physhandi.data.sequence_writer import SequenceWriter
from physhandi.errors import MissingInputError
from physhandi.synthetic.suite.pictures import (
    HEIGHT,
    WIDTH,
    moments,
    motion_picture,
    write_motion_pictures,
)

# One metre above the sheet, looking down.
ABOVE = np.array([[1, 0, 0, 0.1], [0, -1, 0, 0.1], [0, 0, -1, 1.2], [0, 0, 0, 1]], np.float64)
CAMERA = PinholeCamera(
    K=np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]),
    T_world_camera=ABOVE,
    width=320,
    height=240,
)
LABEL = 22


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return write_told(tmp_path_factory.mktemp("plain") / "low", 0.12)


@pytest.fixture(scope="module")
def recording(plain: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """A sheet whose markers are its true surface, seen by a camera above it."""
    with SequenceWriter(tmp_path_factory.mktemp("told") / "low") as writer:
        for path in plain.folder.rglob("*.npy"):
            writer.copy(path.relative_to(plain.folder).as_posix(), path)
        writer.save_array("truth/object_point.npy", np.load(plain.folder / "marker.npy"))
        writer.save_array("truth/object_face.npy", FACES.astype(np.int32))
        writer.make_folder("views/above")
        return writer.finish(replace(plain.meta, views=(ViewMeta(name="above", camera=CAMERA),)))


def run_of(folder: Path, recording: Sequence, rollout: np.ndarray) -> RunFolder:
    run = RunFolder.create(
        folder,
        name=folder.name,
        kind="reconstruction",
        sequences=[str(recording.folder)],
        config={"profile": {}},
    )
    with run.begin_attempt() as attempt:
        attempt.save_array(f"sequences/{recording.name}/rollout.npy", rollout.astype(np.float32))
        attempt.publish()
    return RunFolder.open(folder)


def cell(picture: np.ndarray, row: int, column: int) -> np.ndarray:
    top = LABEL + row * HEIGHT
    return picture[top : top + HEIGHT, column * WIDTH : (column + 1) * WIDTH].astype(int)


def purple(image: np.ndarray) -> int:
    red, green, blue = image[..., 0], image[..., 1], image[..., 2]
    return int(np.count_nonzero((blue > red) & (red > green + 20)))


def yellow(image: np.ndarray) -> int:
    red, green, blue = image[..., 0], image[..., 1], image[..., 2]
    return int(np.count_nonzero((red > blue + 60) & (green > blue + 60)))


def test_moments_are_the_start_the_last_fitted_frame_and_predicted_ones(
    recording: Sequence,
) -> None:
    assert moments(recording) == [0, FITTED - 1, 8, FRAMES - 1]


def test_nodes_have_the_color_of_their_distance_from_the_true_motion(
    recording: Sequence, tmp_path: Path, device: str
) -> None:
    marker = np.asarray(recording.marker)
    late = marker.copy()
    late[FITTED:, :, 0] += 0.04
    runs = {
        "exact": run_of(tmp_path / "exact", recording, marker),
        "late": run_of(tmp_path / "late", recording, late),
    }
    picture = motion_picture(recording, runs, device)
    assert picture.shape == (2 * LABEL + 3 * HEIGHT, 4 * WIDTH, 3)
    for column in range(4):
        surface = cell(picture, 0, column)
        # The sheet itself, in its own color, in the first row.
        assert np.count_nonzero(surface[..., 2] > surface[..., 0] + 30) > 2000
        assert yellow(cell(picture, 1, column)) == 0
        assert purple(cell(picture, 1, column)) > 300
        is_late = moments(recording)[column] >= FITTED
        assert (yellow(cell(picture, 2, column)) > 300) is is_late
        assert (purple(cell(picture, 2, column)) > 300) is not is_late


def test_a_suite_gets_a_picture_of_every_sequence_that_tells_its_surface(
    plain: Sequence, recording: Sequence, tmp_path: Path
) -> None:
    marker = np.asarray(recording.marker)
    run_of(tmp_path / "cells/a", recording, marker)
    run_of(tmp_path / "cells/b", recording, np.repeat(NODE[None], FRAMES, axis=0))
    common = {"protocol": "main", "case": recording.name, "error": ""}
    cells = [
        common | {"method": "quick", "run": "a"},
        common | {"method": "static", "run": "b"},
        common | {"method": "quick@refinement.iterations=0", "run": "b"},
        common | {"method": "phystwin", "run": "", "error": "It diverged."},
    ]
    (name,) = write_motion_pictures(tmp_path / "charts", [recording], cells, {})
    image = cv2.imread(str(tmp_path / "charts" / name))
    # The truth and one method: rules, variants and failures are left out.
    assert image.shape[0] == 2 * LABEL + 2 * HEIGHT
    assert list(write_motion_pictures(tmp_path / "more", [plain], cells, {})) == []

    seeds = {"quick@object_.search.seed=7": "quick", "quick@object_.search.seed=1": "quick"}
    searched = [
        common | {"method": method, "run": run} for method, run in zip(seeds, "ab", strict=True)
    ]
    (tmp_path / "charts" / name).unlink()
    list(write_motion_pictures(tmp_path / "charts", [recording], searched, seeds))
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "charts" / name)), image)
    with pytest.raises(MissingInputError, match="'low' tells no true surface"):
        motion_picture(plain, {})
