"""ROS 1 and ROS 2 bags, and bags with the topics of RealSense cameras, become sequences."""

import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.inputs.raw_capture import BOARD, CAMERAS, RawCapture, camera_at, picture
from support.inputs.recorded_bag import (
    TREE,
    Recorder,
    jpeg,
    png,
    shown,
    time_of,
    write_realsense_bag,
)

from physhandi.data.camera import PinholeCamera
from physhandi.data.importers import bag as bag_reader
from physhandi.data.importers.capture import CaptureOptions, import_capture, survey_capture
from physhandi.errors import CancelledError, ImportFailedError, UsageError
from physhandi.progress import NullProgress, Progress

FRAMES = 3


def beside(camera: PinholeCamera) -> PinholeCamera:
    """A depth camera 4 cm to the side of a color camera."""
    shift = np.eye(4)
    shift[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.02, 0.0]))[0]
    shift[:3, 3] = [0.04, 0.0, 0.005]
    K = np.array([[80.0, 0, 50], [0, 80, 36], [0, 0, 1]])
    return PinholeCamera(K, camera.T_world_camera @ shift, 100, 74)


def assert_depth_fits(found: np.ndarray, true: np.ndarray, is_ball: np.ndarray) -> None:
    known = found > 0
    assert known[10:-10, 10:-20].mean() > 0.9
    assert np.median((found - true)[known & is_ball]) == pytest.approx(0.0, abs=4e-3)
    assert np.median(np.abs(found - true)[known]) < 5e-3


def test_a_bag_with_realsense_topics(tmp_path):
    color = camera_at(30, 2)
    depth = beside(color)
    reference = camera_at(33, 2).T_world_camera  # Neither of both: transforms must be chained.
    write_realsense_bag(tmp_path / "take.bag", color, depth, reference, range(FRAMES))
    sequence = import_capture(tmp_path / "take.bag", tmp_path / "out")
    assert [view.name for view in sequence.views] == ["device_0"]
    assert sequence.frame_count == FRAMES
    assert sequence.frame_rate == pytest.approx(30.0, abs=0.01)
    assert sequence.provenance["depth_scale"] == {"device_0": pytest.approx(0.0001)}
    view = sequence.views[0]
    true_color, true_depth = picture(color, 2)
    assert np.array_equal(view.color(2), true_color)
    assert_depth_fits(view.depth(2), true_depth, true_color[..., 0] == 200)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "take.bag"]


def test_two_realsense_bags_are_placed_by_pictures_of_a_board_beside_them(tmp_path):
    cameras = {"left": camera_at(30, 4), "right": camera_at(110, 4)}
    raw = RawCapture(tmp_path / "fold", cameras)
    raw.photograph_board()
    frames = {"left": range(12), "right": [1, *range(3, 13)]}  # Begins later, and drops one.
    for name, camera in cameras.items():
        bag = raw.folder / f"{name}.bag"
        write_realsense_bag(bag, camera, beside(camera), camera.T_world_camera, frames[name])
    options = CaptureOptions(board=BOARD)
    sequence = import_capture(raw.folder, tmp_path / "out", options=options)
    assert [view.name for view in sequence.views] == ["left", "right"]
    assert sequence.frame_count == 11
    for view in sequence.views:
        assert np.array_equal(view.color(4), picture(cameras[view.name], 5)[0])
    left, right = (view.camera.T_world_camera for view in sequence.views)
    true = cameras["left"].T_camera_world @ cameras["right"].T_world_camera
    np.testing.assert_allclose(np.linalg.inv(left) @ right, true, atol=4e-3)
    notes = sequence.provenance["notes"]
    assert "right/depth has no image for frame 1." in notes
    assert "right/color has no image for frame 1; its neighbour is repeated." in notes
    again = import_capture(raw.folder, tmp_path / "out", options=options, keeps_same=True)
    assert again.provenance == sequence.provenance


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_ros_2_bag_of_two_cameras(tmp_path, storage):
    """Color as JPEG, aligned depth as floats, and unaligned depth, which is not used."""
    folder = tmp_path / "take"
    with Recorder(folder, ros=2, storage=storage) as bag:
        for name, camera in CAMERAS.items():
            bag.info(f"/{name}/color/camera_info", camera)
            bag.info(f"/{name}/aligned_depth_to_color/camera_info", camera)
            bag.info(f"/{name}/depth/camera_info", camera)
        for frame in range(FRAMES):
            for number, (name, camera) in enumerate(CAMERAS.items()):
                color, depth = shown(camera, frame)
                time = time_of(frame, 2_000_000 * number)
                bag.coded(f"/{name}/color/image_raw/compressed", jpeg(color), "rgb8; jpeg", time)
                aligned = f"/{name}/aligned_depth_to_color/image_raw"
                bag.image(aligned, picture(camera, frame)[1], "32FC1", time)
                bag.image(f"/{name}/depth/image_rect_raw", np.zeros_like(depth), "16UC1", time)
    outer = tmp_path / "source"
    outer.mkdir()
    folder.rename(outer / "take")
    # Their poses are told beside the bag.
    poses = {name: camera.T_world_camera.tolist() for name, camera in CAMERAS.items()}
    (outer / "extrinsics.json").write_text(str(poses).replace("'", '"'))
    sequence = import_capture(outer, tmp_path / "out")
    assert [view.name for view in sequence.views] == ["left", "right"]
    for view in sequence.views:
        color, depth = picture(CAMERAS[view.name], 1)
        assert np.abs(view.color(1).astype(int) - color).mean() < 8
        assert np.abs(view.depth(1) - depth).max() < 6e-4
        assert np.allclose(view.camera.T_world_camera, CAMERAS[view.name].T_world_camera)
    assert sequence.provenance["pairing"]["right/depth"]["largest_error"] == pytest.approx(
        0.002, abs=1e-4
    )


def test_a_ros_1_bag_with_compressed_depth_and_a_tree_of_frames(tmp_path):
    """It lies in the folder of its camera, and its pose is told beside that."""
    source = tmp_path / "takes"
    color = camera_at(80, 2)
    depth = beside(color)
    (source / "one").mkdir(parents=True)
    with Recorder(source / "one" / "take.bag", ros=1) as bag:
        bag.info("/camera/color/camera_info", color)
        bag.info("/camera/depth/camera_info", depth)
        link = depth.T_camera_world @ color.T_world_camera
        make = bag.kind("geometry_msgs/msg/TransformStamped")
        stamped = [
            make(bag.header(1, "/depth_optical"), "color_frame", bag.transform(link)),
            make(bag.header(1, "color_frame"), "color_optical", bag.transform(np.eye(4))),
            make(bag.header(1, "base"), "depth_optical", bag.transform(reference())),
        ]
        tree = bag.kind(TREE)(stamped)
        bag.write("/tf_static", TREE, tree)
        for frame in range(FRAMES):
            image, measured = shown(color, frame)[0], shown(depth, frame)[1]
            time = time_of(frame)
            bag.image("/camera/color/image_raw", image[..., ::-1], "bgr8", time, "color_optical")
            bag.coded(
                "/camera/depth/image_rect_raw/compressedDepth",
                bytes(12) + png(measured),
                "16UC1; compressedDepth png",
                time,
                "depth_optical",
            )
    poses = {"one": color.T_world_camera.tolist()}
    (source / "extrinsics.json").write_text(str(poses).replace("'", '"'))
    sequence = import_capture(source, tmp_path / "out")
    (view,) = sequence.views
    assert view.name == "one"
    assert np.allclose(view.camera.T_world_camera, color.T_world_camera)
    true_color, true_depth = picture(color, 2)
    assert np.array_equal(view.color(2), true_color)
    assert_depth_fits(view.depth(2), true_depth, true_color[..., 0] == 200)


LAYOUTS: dict[str, tuple[str, dict[str, str]]] = {
    "one": ("rec.bag", {"rec.bag": ""}),
    "one in a folder": (".", {"rec.bag": ""}),
    "two": (".", {"left.bag": "left", "right.db3": "right"}),
    "one in the folder of its camera": (".", {"left/rec.bag": "left"}),
    "called alike": (".", {"cam 1/rec.bag": "cam_1", "cam2/rec.bag": "cam2"}),
    "two of a folder": (
        ".",
        {"left/1.mcap": "left_1", "left/2.mcap": "left_2", "right/1.mcap": "right"},
    ),
    "an older one in a folder": (".", {"left.bag": "left", "right.bag": "right", "old/a.bag": "?"}),
    "pictures of the board": (".", {"left.bag": "", "calibration/right.bag": "-"}),
    "ROS 2": (".", {"left/metadata.yaml": "left", "right/metadata.yaml": "right"}),
    "ROS 2 in the folder of its camera": (".", {"left/rec/metadata.yaml": "left"}),
    "images made of bags": (
        ".",
        {"left/rec.bag": "?", "right/rec.bag": "-", "right/depth/0.npy": "-"},
    ),
}
"""The source, and the files there with the name that each gives its camera.

Those with - or ? are not read, and those with ? are told.
"""


@pytest.mark.parametrize("kind", LAYOUTS)
def test_cameras_are_called_after_their_bags_or_folders(tmp_path, kind):
    source, files = LAYOUTS[kind]
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        np.save(tmp_path / file, np.ones((2, 2))) if "npy" in file else (tmp_path / file).touch()
    bags = bag_reader.find_bags(tmp_path / source)
    places = {file.removesuffix("/metadata.yaml"): name for file, name in files.items()}
    expected = {tmp_path / file: name for file, name in places.items() if name not in ("-", "?")}
    names = bag_reader.name_bags(tmp_path / source, bags)
    assert dict(zip(bags, names, strict=True)) == expected
    told = [note.split()[0] for note in bag_reader.left_out_bags(tmp_path / source)]
    assert told == [file for file, name in files.items() if name == "?"]
    if bags:
        found = [str(path.relative_to(tmp_path)) for path in bags]
        assert list(survey_capture(tmp_path / source).bags) == found


@pytest.mark.parametrize(
    ("files", "name"),
    [
        (["rec.bag", "rec.db3"], "rec"),
        (["cam 1/rec.bag", "cam_1/rec.bag"], "cam_1"),
        ([f"{'x' * 40}1.bag", f"{'x' * 40}2.bag"], "x" * 40),
        (["rec/metadata.yaml", "rec.bag"], "rec"),
    ],
)
def test_bags_that_name_their_cameras_alike_are_refused_before_one_is_read(tmp_path, files, name):
    for file in files:
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    with pytest.raises(ImportFailedError) as refusal:
        import_capture(tmp_path, tmp_path / "out")
    message = str(refusal.value)
    first, second = (tmp_path / file.removesuffix("/metadata.yaml") for file in files)
    assert message.startswith(f"{second}: names its camera '{name}', as {first} does. ")
    assert survey_capture(tmp_path).problems == (message,)
    assert not (tmp_path / "out").exists()


def reference() -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.4, -0.2, 1.0]))[0]
    pose[:3, 3] = [1.0, 2.0, 0.5]
    return pose


def small_bag(path, **broken: object):
    camera = CAMERAS["left"]
    with Recorder(path, ros=1) as bag:
        if not broken.get("has_no_info"):
            bag.info("/camera/color/camera_info", camera)
        for frame in range(2):
            code = str(broken.get("code", "rgb8"))
            bag.image("/camera/color/image_raw", shown(camera, frame)[0], code, time_of(frame))
    return path


def unpack(path, folder):
    """Read a bag in this process."""
    with tempfile.TemporaryDirectory() as place:
        bag_reader._unpack(path, Path(place), "", NullProgress())


def test_broken_bags_are_refused_and_named(tmp_path):
    cut = small_bag(tmp_path / "cut.bag")
    cut.write_bytes(cut.read_bytes()[:-200])
    empty = tmp_path / "empty.bag"
    with Recorder(empty, ros=1) as bag:
        bag.info("/camera/color/camera_info", CAMERAS["left"])
    blind = small_bag(tmp_path / "blind.bag", has_no_info=True)
    odd = small_bag(tmp_path / "odd.bag", code="bayer_x")
    twice = tmp_path / "twice.bag"
    with Recorder(twice, ros=1) as bag:
        for topic in ("/color", "/view0/color"):
            bag.info(f"{topic}/camera_info", CAMERAS["left"])
            bag.image(f"{topic}/image_raw", shown(CAMERAS["left"], 0)[0], "rgb8", time_of(0))
    for path, words in (
        (twice, ("twice.bag", "camera 'view0'", "already")),
        (cut, ("cut.bag", "ended properly")),
        (empty, ("empty.bag", "no color or depth images", "camera_info")),
        (blind, ("blind.bag", "no CameraInfo", "/camera/color/image_raw")),
        (odd, ("odd.bag", "/camera/color/image_raw", "image 0", "bayer_x")),
    ):
        # The way through a process of its own is the same for all of them.
        read = import_capture if path is cut else unpack
        with pytest.raises(ImportFailedError) as refusal:
            read(path, tmp_path / "out")
        assert [word for word in words if word not in str(refusal.value)] == [], refusal.value
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".bag"] * 5


def test_what_is_wrong_beside_a_bag_is_named_where_it_lies(tmp_path):
    small_bag(tmp_path / "a.bag")
    (tmp_path / "extrinsics.json").write_text("[]")
    with pytest.raises(ImportFailedError) as refusal:
        import_capture(tmp_path, tmp_path / "out")
    assert str(refusal.value).startswith(f"{tmp_path}/extrinsics.json: has 0 cameras")


class _Stops(Progress):
    def check_cancelled(self) -> None:
        raise CancelledError("stop")


def test_a_cancelled_bag_leaves_nothing(tmp_path):
    small_bag(tmp_path / "a.bag")
    with pytest.raises(CancelledError):
        import_capture(tmp_path / "a.bag", tmp_path / "out", _Stops())
    assert [path.name for path in tmp_path.iterdir()] == ["a.bag"]


def test_without_the_package_the_extra_is_named(tmp_path, monkeypatch):
    small_bag(tmp_path / "a.bag")
    monkeypatch.setattr(bag_reader, "find_spec", lambda _: None)
    with pytest.raises(UsageError, match=r"physhandi\[capture\]"):
        import_capture(tmp_path / "a.bag", tmp_path / "out")


def test_a_bag_that_crashes_its_reader_is_named(tmp_path, monkeypatch):
    small_bag(tmp_path / "a.bag")
    monkeypatch.setattr(bag_reader, "_WORKER", "a_reader_that_ends_at_once")
    with pytest.raises(ImportFailedError, match=r"a\.bag: crashed what reads it"):
        import_capture(tmp_path / "a.bag", tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["a.bag"]
