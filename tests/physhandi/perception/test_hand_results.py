import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.inputs.clicked_disc import FRAMES, HEIGHT, WIDTH, cameras, joints, write_disc
from support.inputs.mano_file import mano_arrays, posed_mano

from physhandi.data.sequence import Sequence
from physhandi.errors import ImportFailedError, MissingInputError, UsageError
from physhandi.fitting.hand_reconstruction import observed_keypoints
from physhandi.perception import hand_results
from physhandi.perception.hand_results import HANDS_FORMAT, import_hands
from physhandi.progress import Progress


@pytest.fixture(scope="module")
def bare(tmp_path_factory) -> Sequence:
    """A hand over a disc, without keypoints."""
    made, _ = write_disc(tmp_path_factory.mktemp("made") / "disc", hand=True)
    for view in made.views:
        (view.folder / "keypoint.npy").unlink()
    return Sequence.load(made.folder)


@pytest.fixture
def sequence(bare, tmp_path) -> Sequence:
    """A copy of it that may be changed."""
    return Sequence.load(Path(shutil.copytree(bare.folder, tmp_path / "disc")))


def write(folder: Path, *, ending: str = "json", **fields: object) -> Path:
    """Write a file of results; a field that is None is left out."""
    content = {"format": HANDS_FORMAT, "source": "wilor", **fields}
    content = {name: value for name, value in content.items() if value is not None}
    path = folder / f"hands.{ending}"
    if ending == "npz":
        np.savez(path, **{name: np.asarray(value) for name, value in content.items()})
    else:
        listed = {n: v.tolist() if isinstance(v, np.ndarray) else v for n, v in content.items()}
        path.write_text(json.dumps(listed))
    return path


def in_camera(name: str, frame: int) -> np.ndarray:
    """The hand's joints in a camera's axes [m]."""
    pose = cameras()[name].T_world_camera
    return (joints(frame) - pose[:3, 3]) @ pose[:3, :3]


def pixels(point: np.ndarray, focal: float = 140.0) -> np.ndarray:
    return focal * point[:, :2] / point[:, 2:] + [WIDTH / 2, HEIGHT / 2]


def test_pixels_of_a_view_become_its_keypoints(tmp_path, sequence):
    shown = np.random.default_rng(0).uniform(10, 80, (3, 21, 2))
    path = write(
        tmp_path,
        frame=[5, 2, 5],
        side=["right"] * 3,
        view=["side"] * 3,
        keypoint=shown,
        confidence=[0.4, 0.7, 0.9],
    )
    done = import_hands(sequence.folder, path)
    done.validate()
    top, side = done.views
    assert top.keypoint is None
    expected = np.full((FRAMES, 1, 21, 3), np.nan)
    expected[2, 0] = np.c_[shown[1], np.full(21, 0.7)]
    expected[5, 0] = np.c_[shown[2], np.full(21, 0.9)]  # The surer one of two.
    np.testing.assert_allclose(side.keypoint, expected, rtol=1e-6)
    about = done.provenance["keypoints"]
    assert (about["source"], about["views"], about["gaps_filled"]) == ("wilor", ["side"], False)
    assert len(about["file_sha256"]) == 64
    shutil.rmtree(top.folder / "color")  # Networks would look for hands in it.
    fitted = observed_keypoints(Sequence.load(done.folder), Progress())
    assert np.isnan(fitted[0]).all()
    np.testing.assert_array_equal(fitted[1], side.keypoint)


def test_every_keypoint_may_have_its_own_confidence_or_none(tmp_path, sequence):
    shown = np.random.default_rng(0).uniform(0.1, 0.9, (1, 21, 3)) * [90, 80, 1]
    shown[0, 4] = np.nan
    path = write(tmp_path, ending="npz", frame=[3], side=["right"], view="top", keypoint=shown)
    found = import_hands(sequence.folder, path).views[0].keypoint
    np.testing.assert_allclose(found[3, 0], shown[0], rtol=1e-6)


@pytest.mark.parametrize("focal", [None, 500.0])
def test_joints_of_a_camera_are_projected_into_it(tmp_path, sequence, focal):
    joint = np.stack([in_camera("side", frame) for frame in range(FRAMES)])
    if (
        focal is not None
    ):  # As seen by a camera that looks from farther away, through a longer lens.
        joint[..., :2] *= 1.2
        joint[..., 2] *= 1.2 * focal / 140
    path = write(
        tmp_path,
        frame=list(range(FRAMES)),
        side="right",
        view="side",
        joint=joint - [0.0, 0.0, 0.1],
        translation=[[0.0, 0.0, 0.1]] * FRAMES,
        focal_length=None if focal is None else [focal] * FRAMES,
    )
    done = import_hands(sequence.folder, path)
    expected = [pixels(in_camera("side", frame)) for frame in range(FRAMES)]
    np.testing.assert_allclose(done.views[1].keypoint[:, 0, :, :2], expected, atol=1e-3)
    assert (done.views[1].keypoint[..., 2] == 1).all()


def test_joints_in_the_world_are_projected_into_every_view(tmp_path, sequence):
    path = write(tmp_path, ending="npz", frame=[0, 8], side="right", joint=[joints(0), joints(8)])
    done = import_hands(sequence.folder, path)
    for view in done.views:
        for frame in (0, 8):
            expected = pixels(in_camera(view.name, frame))
            np.testing.assert_allclose(view.keypoint[frame, 0, :, :2], expected, atol=1e-3)
        assert np.isnan(view.keypoint[1:8]).all()


@pytest.mark.parametrize("as_matrix", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
def test_parameters_of_mano_are_posed_by_the_users_mano(
    tmp_path, sequence, mano, as_matrix, mirrored
):
    random = np.random.default_rng(1)
    side = "left" if mirrored else "right"
    if mirrored:
        text = (sequence.folder / "sequence.yaml").read_text()
        (sequence.folder / "sequence.yaml").write_text(text.replace("- right", "- left"))
    betas, turn = random.normal(size=(2, 10)), random.normal(size=(2, 3))
    pose, shift = 0.3 * random.normal(size=(2, 45)), np.array([[0.02, 0.01, 0.5], [0, 0, 0.6]])
    given_turn, given_pose = turn, pose
    if as_matrix:
        given_turn = Rotation.from_rotvec(turn).as_matrix()[:, None]
        given_pose = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix().reshape(2, 15, 3, 3)
    path = write(
        tmp_path,
        ending="npz",
        frame=[1, 4],
        side=side,
        view="top",
        global_orient=given_turn,
        hand_pose=given_pose,
        betas=betas,
        translation=shift,
        left_is_mirrored_right=mirrored,
    )
    found = import_hands(sequence.folder, path).views[0].keypoint
    for number, frame in enumerate((1, 4)):
        vertex, joint = posed_mano(
            mano_arrays("right"), betas[number], pose[number], turn[number], np.zeros(3)
        )
        # MANO has index, middle, pinky, ring, thumb; keypoints thumb first, pinky last.
        tip = vertex[[744, 320, 443, 554, 671]]
        order = ([13, 14, 15], [1, 2, 3], [4, 5, 6], [10, 11, 12], [7, 8, 9])
        fingers = [np.vstack([joint[part], tip[n]]) for n, part in enumerate(order)]
        points = np.vstack([joint[:1], *fingers]) * ([-1, 1, 1] if mirrored else 1)
        expected = pixels(points + shift[number])
        np.testing.assert_allclose(found[frame, 0, :, :2], expected, atol=2e-3)


def test_without_the_users_mano_its_parameters_are_of_no_use(tmp_path, sequence, monkeypatch):
    monkeypatch.setenv("PHYSHANDI_HANDS", str(tmp_path / "none"))
    path = write(
        tmp_path,
        frame=[0],
        side="right",
        view="top",
        global_orient=[[0, 0, 0]],
        hand_pose=[[0] * 45],
        betas=[[0] * 10],
    )
    with pytest.raises(MissingInputError, match="import mano MANO_RIGHT"):
        import_hands(sequence.folder, path)


def test_gaps_are_filled_by_the_built_in_networks_if_that_is_wanted(
    tmp_path, sequence, monkeypatch
):
    detected = np.random.default_rng(2).uniform(10, 80, (FRAMES, 1, 21, 3)).astype(np.float32)
    detected[6] = np.nan
    monkeypatch.setattr(hand_results, "detect_view", lambda *_: detected.copy())
    path = write(tmp_path, frame=[3], side="right", view="top", keypoint=np.full((1, 21, 2), 40.0))
    done = import_hands(sequence.folder, path, fills_gaps=True)
    found = done.views[0].keypoint
    assert (found[3, 0] == [40, 40, 1]).all()
    rest = np.arange(FRAMES) != 3
    np.testing.assert_array_equal(found[rest], detected[rest])
    assert done.provenance["keypoints"]["gaps_filled"]


def test_keypoints_from_elsewhere_are_only_replaced_when_that_is_asked_for(tmp_path):
    sequence, _ = write_disc(tmp_path / "disc", hand=True, frames=2)
    kept = (sequence.views[0].folder / "keypoint.npy").read_bytes()
    path = write(tmp_path, frame=[1], side="right", view="top", keypoint=np.full((1, 21, 2), 40.0))
    with pytest.raises(UsageError, match=r"view 'top' has a keypoint\.npy that did not"):
        import_hands(sequence.folder, path)
    assert (sequence.views[0].folder / "keypoint.npy").read_bytes() == kept
    import_hands(sequence.folder, path, overwrite=True)
    again = import_hands(sequence.folder, path)
    assert np.isnan(again.views[0].keypoint[0]).all()


GOOD: dict[str, object] = {
    "frame": [0, 1],
    "side": ["right", "right"],
    "view": ["top", "top"],
    "keypoint": np.full((2, 21, 2), 40.0),
}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"format": "other/1"}, "format must be 'physhandi-hands/1'"),
        ({"frame": None}, "frame is missing"),
        ({"frame": []}, "frame is empty"),
        ({"frame": [0, 9]}, "frame, detection 1 is 9; there are 0 to 8"),
        ({"frame": [0, 0.5]}, "frame, detection 1 is 0.5"),
        ({"side": ["right", "left"]}, "side, detection 1 is 'left', a hand that 'hands'"),
        ({"side": ["right", "up"]}, "detection 1 is 'up'"),
        ({"side": ["right"] * 3}, "side must be 2 texts"),
        ({"view": ["top", "front"]}, "view, detection 1 is 'front'; there are top, side"),
        ({"view": None}, "view is missing; pixels need it"),
        ({"keypoint": np.zeros((2, 20, 2))}, "keypoint has the shape"),
        ({"keypoint": [[[0, 0]] * 21, [[0, 0]] * 20]}, "keypoint must be numbers, equally many"),
        ({"keypoint": None}, "keypoint or joint, or hand_pose is needed"),
        ({"confidence": [0.5, 1.5]}, "confidence, detection 1 is 1.5"),
        ({"confidence": [0.5, None]}, "confidence, detection 1 is not a finite number"),
        ({"vertices": [1, 2]}, "vertices is not a field"),
        ({"keypoint": None, "hand_pose": np.zeros((2, 45))}, "global_orient is missing"),
        (
            {"keypoint": None, "joint": np.stack([1000 * in_camera("top", f) for f in (0, 1)])},
            "joint, detection 0 makes a palm of 50 m",
        ),
        (
            {"keypoint": None, "joint": np.stack([-in_camera("top", f) for f in (0, 1)])},
            "joint, detection 0 lies behind the camera",
        ),
        (
            {"keypoint": np.full((2, 21, 2), 4000.0)},
            "in view 'top', frame 0, keypoint 0 of the right hand is at (4000, 4000) px, far",
        ),
        (
            {
                "keypoint": None,
                "view": None,
                "joint": np.stack([joints(0), joints(1)]),
                "focal_length": [1, 1],
            },
            "a focal length belongs to a view",
        ),
    ],
)
def test_a_wrong_file_is_refused_by_field_and_detection(tmp_path, bare, changes, told):
    path = write(tmp_path, **{**GOOD, **changes})
    with pytest.raises(ImportFailedError) as error:
        import_hands(bare.folder, path)
    assert str(error.value).startswith(f"{path}: ")
    assert told in str(error.value)
    assert not any(view.has_keypoint for view in Sequence.load(bare.folder).views)


def test_files_that_are_no_plain_data_are_refused(tmp_path, bare, monkeypatch):
    objects = tmp_path / "objects.npz"
    np.savez(objects, frame=np.array([{"a": 1}], dtype=object))
    bomb = tmp_path / "bomb.npz"
    np.savez_compressed(bomb, frame=np.zeros(200_000))
    assert bomb.stat().st_size < 2_000
    monkeypatch.setattr(hand_results, "_MOST_BYTES", 1_000_000)
    broken = tmp_path / "broken.json"
    broken.write_text("[1, 2")
    for path, told in (
        (objects, "cannot be read as .npz"),
        (bomb, "unpacks to 1600128 bytes, which is no hands file"),
        (broken, "cannot be read as .json"),
        (tmp_path / "none.json", "is not a file"),
        (bare.folder / "sequence.yaml", "is neither .json nor .npz"),
    ):
        with pytest.raises(ImportFailedError, match=told):
            import_hands(bare.folder, path)
