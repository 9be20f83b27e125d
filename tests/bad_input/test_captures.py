"""Broken raw recordings: each is refused with a message that names what is wrong, or mended."""

import json
import os
import pickle
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from support.hostile.header_bombs import exr
from support.hostile.hostile_pickles import Hostile
from support.inputs.raw_capture import (
    BOARD,
    CAMERAS,
    FOCAL,
    FRAMES,
    RawCapture,
    camera_at,
    find_no_hand,
    intrinsics,
    picture,
)

from physhandi.data.camera import PinholeCamera
from physhandi.data.importers import recorded_stream
from physhandi.data.importers.capture import CaptureOptions, import_capture, survey_capture
from physhandi.data.untrusted.media import MediaDecoder
from physhandi.errors import PhysHandiError, UsageError
from physhandi.perception import segmentation
from physhandi.perception.annotation import annotate
from physhandi.perception.segmentation import Click

Damage = Callable[[RawCapture], object]


def bomb(rel: str) -> Damage:
    """A PNG of a few hundred bytes that announces 100,000 x 100,000 pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + check

    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0)
    data = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    return lambda raw: (raw.folder / rel).write_bytes(b"\x89PNG\r\n\x1a\n" + data)


def array_bomb(raw: RawCapture) -> None:
    """Depth as .npy, of which frame 2 announces 40 GB."""
    arrays(raw, lambda depth, _: depth)
    with (raw.folder / "left/depth/00002.npy").open("wb") as stream:
        np.lib.format.write_array_header_1_0(
            stream, {"descr": "<f4", "fortran_order": False, "shape": (100_000, 100_000)}
        )


def arrays(raw: RawCapture, change: Callable[[np.ndarray, int], np.ndarray]) -> None:
    """Write the left camera's depth as .npy in metres, changed."""
    for frame in range(FRAMES):
        depth = picture(CAMERAS["left"], frame)[1]
        np.save(raw.folder / f"left/depth/{frame:05d}.npy", change(depth, frame))
        (raw.folder / f"left/depth/{frame:05d}.png").unlink()


def exrs(change: Damage) -> Damage:
    """Write the left camera's depth as OpenEXR in metres, and damage that."""

    def damage(raw: RawCapture) -> None:
        for frame in range(FRAMES):
            path = raw.folder / f"left/depth/{frame:05d}.png"
            depth = picture(CAMERAS["left"], frame)[1]
            OpenEXR.File({}, {"Z": depth}).write(str(path.with_suffix(".exr")))
            path.unlink()
        change(raw)

    return damage


def written(rel: str, content: bytes) -> Damage:
    return lambda raw: (raw.folder / rel).write_bytes(content)


def renamed_array(path: Path) -> None:
    with path.open("wb") as stream:
        np.save(stream, np.zeros((72, 96, 3), np.uint8))


def painted_exr(raw: RawCapture) -> None:
    color = picture(CAMERAS["left"], 4)[0].astype(np.float32)
    OpenEXR.File({}, {"RGB": color}).write(str(raw.folder / "left/depth/00004.exr"))


def images(rel: str, change: Callable[[np.ndarray], np.ndarray], *frames: int) -> Damage:
    def damage(raw: RawCapture) -> None:
        for frame in frames or range(FRAMES):
            path = raw.folder / rel / f"{frame:05d}.png"
            cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))

    return damage


def text(rel: str, content: str) -> Damage:
    return lambda raw: (raw.folder / rel).write_text(content)


def torn(rel: str, share: float) -> Damage:
    def damage(raw: RawCapture) -> None:
        content = (raw.folder / rel).read_bytes()
        (raw.folder / rel).write_bytes(content[: int(share * len(content))])

    return damage


def video(raw: RawCapture, share: float = 1.0, name: str = "color.avi") -> None:
    """Replace the left camera's images by a video, of which only a part is there."""
    path = raw.folder / "left" / name
    code = cv2.VideoWriter.fourcc(*("MJPG" if name.endswith("avi") else "mp4v"))
    writer = cv2.VideoWriter(str(path), code, 30, (96, 72))
    for frame in range(FRAMES):
        writer.write(picture(CAMERAS["left"], frame)[0])
    writer.release()
    shutil.rmtree(raw.folder / "left/color")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])


def with_index_first(content: bytes) -> bytes:
    """Put an MP4's index before its frames, as for streaming: what is cut off then is frames."""
    at, boxes = 0, []
    while at < len(content):
        size = struct.unpack(">I", content[at : at + 4])[0]
        boxes.append(content[at : at + size])
        at += size
    order = {b"ftyp": 0, b"moov": 1}
    boxes.sort(key=lambda box: order.get(box[4:8], 2))
    index = boxes[1]
    shift, place = len(index), index.index(b"stco") + 4
    count = struct.unpack(">I", index[place + 4 : place + 8])[0]
    old = struct.unpack(f">{count}I", index[place + 8 : place + 8 + 4 * count])
    new = struct.pack(f">{count}I", *[offset + shift for offset in old])
    boxes[1] = index[: place + 8] + new + index[place + 8 + 4 * count :]
    return b"".join(boxes)


def table(view: str, **changes: object) -> Damage:
    return lambda raw: raw.table(view, **changes)


def exchanged_poses(raw: RawCapture) -> None:
    raw.table("left", T_world_camera=CAMERAS["right"].T_world_camera.tolist())
    raw.table("right", T_world_camera=CAMERAS["left"].T_world_camera.tolist())


def lens(camera: PinholeCamera, focal: float, x: float, y: float) -> PinholeCamera:
    """The same camera with another focal length, and its middle moved [px]."""
    K = camera.K + np.array([[focal - FOCAL, 0, x], [0, focal - FOCAL, y], [0, 0, 0]])
    return PinholeCamera(K, camera.T_world_camera, camera.width, camera.height)


def exchanged_intrinsics(right: PinholeCamera, *, tells_size: bool = True) -> Damage:
    """The right camera is another one, and each camera has the intrinsics of the other one."""

    def damage(raw: RawCapture) -> None:
        shutil.rmtree(raw.folder)
        raw.cameras = {"left": CAMERAS["left"], "right": right}
        raw.write()
        for view, other in (("left", right), ("right", CAMERAS["left"])):
            size = {} if tells_size else {"width": None, "height": None}
            raw.table(view, **{**intrinsics(other), **size})

    return damage


def unnumbered(raw: RawCapture) -> None:
    """Color of the left camera has names without numbers, and is three images short."""
    for frame in range(FRAMES):
        path = raw.folder / f"left/color/{frame:05d}.png"
        if frame < 3:
            path.unlink()
        else:
            path.rename(path.with_name("abcdefgh"[frame] + ".png"))


def removed(*rels: str) -> Damage:
    def damage(raw: RawCapture) -> None:
        for rel in rels:
            path = raw.folder / rel
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    return damage


def both(*damages: Damage) -> Damage:
    return lambda raw: [damage(raw) for damage in damages]


def stamps(*times: float) -> str:
    return "\n".join(f"{time:.4f}" for time in times)


def listed_poses(raw: RawCapture) -> None:
    """Poses of both cameras, of which one has recorded nothing."""
    poses = {name: camera.T_world_camera.tolist() for name, camera in CAMERAS.items()}
    (raw.folder / "extrinsics.json").write_text(json.dumps([*poses.values()]))
    shutil.rmtree(raw.folder / "right")


EVEN = [100 + frame / 30 for frame in range(FRAMES)]
POSE = CAMERAS["left"].T_world_camera
REFUSED: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "no folder": (removed("."), ("raw does not exist",)),
    "empty folder": (removed("left", "right"), ("holds no recording", "color/00000.png")),
    "a camera is missing": (listed_poses, ("extrinsics.json", "2 cameras", "has 1", "missing")),
    "video without its end": (
        lambda raw: video(raw, 0.6, "color.mp4"),
        ("color.mp4", "cannot be decoded", "cut off"),
    ),
    "video that ends early": (
        lambda raw: video(raw, 0.5),
        ("left/color.avi", "frame", "cut off", "--stop"),
    ),
    "color twice": (
        lambda raw: (raw.folder / "left/color.mp4").write_bytes(b"x"),
        ("left", "color twice", "color.mp4"),
    ),
    "cut PNG of color": (torn("left/color/00003.png", 0.7), ("color/00003.png", "cut off")),
    "cut PNG of depth": (torn("right/depth/00002.png", 0.7), ("depth/00002.png", "cut off")),
    "empty image": (torn("right/color/00000.png", 0.0), ("right/color/00000.png",)),
    "no image": (text("left/color/00001.png", "hello"), ("color/00001.png", "neither PNG")),
    "bomb in color": (bomb("left/color/00004.png"), ("00004.png", "100000x100000", "bytes")),
    "bomb in depth": (bomb("left/depth/00000.png"), ("depth/00000.png", "100000x100000")),
    "bomb in .npy": (array_bomb, ("depth/00002.npy",)),
    "bomb in OpenEXR": (
        exrs(written("left/depth/00004.exr", exr(100_000, 100_000))),
        ("depth/00004.exr", "100000x100000", "bytes"),
    ),
    "many channels in OpenEXR": (
        exrs(written("left/depth/00004.exr", exr(7_000, 7_000, names=("R", "G", "B")))),
        ("depth/00004.exr", "3 channels of 7000x7000"),
    ),
    "cut OpenEXR": (exrs(torn("left/depth/00003.exr", 0.7)), ("depth/00003.exr", "cut off")),
    "OpenEXR without pixels": (
        exrs(written("left/depth/00003.exr", exr(96, 72))),
        ("depth/00003.exr", "cut off"),
    ),
    "a picture in OpenEXR": (exrs(painted_exr), ("depth/00004.exr", "3 channels")),
    "cut .npy": (
        lambda raw: (
            arrays(raw, lambda depth, _: depth),
            torn("left/depth/00005.npy", 0.7)(raw),
        ),
        ("depth/00005.npy", "whole .npy"),
    ),
    "an array called .png": (
        lambda raw: renamed_array(raw.folder / "left/color/00004.png"),
        ("color/00004.png", "holds .npy in spite of its name"),
    ),
    "OpenEXR called .png": (
        written("left/color/00004.png", exr(96, 72)),
        ("color/00004.png", "holds OpenEXR in spite of its name"),
    ),
    "images of two sizes": (
        images("left/color", lambda image: image[:50], 4),
        ("color/00004.png", "96x50", "96x72"),
    ),
    "8-bit depth": (
        images("left/depth", lambda image: (image >> 8).astype(np.uint8)),
        ("left/depth/00000.png", "8 bits", "16-bit"),
    ),
    "a picture of depth": (
        images("left/depth", lambda image: np.repeat(image[..., None], 3, axis=2)),
        ("left/depth/00000.png", "3 channels"),
    ),
    "depth of zeros": (images("left/depth", np.zeros_like), ("left/depth", "no distance at all")),
    "NaN depth": (
        lambda raw: arrays(raw, lambda depth, _: np.full_like(depth, np.nan)),
        ("left/depth", "no distance at all", "not finite"),
    ),
    "negative depth": (
        lambda raw: arrays(raw, lambda depth, _: -depth),
        ("left/depth", "no distance at all", "negative", "change its sign"),
    ),
    "depth in tenths of millimetres": (
        images("left/depth", lambda image: image * 10),
        ("left/depth", "m away", "--depth-scale", "0.0001"),
    ),
    "depth in metres, called millimetres": (
        both(
            lambda raw: arrays(raw, lambda depth, _: depth),
            table("left", depth_scale=0.001),
        ),
        ("left/depth", "m away", "--depth-scale"),
    ),
    "depth of another size": (
        images("left/depth", lambda image: image[::2, ::2].copy()),
        ("left/depth", "48x36", "96x72", "depth_intrinsics"),
    ),
    "intrinsics missing": (removed("left/intrinsics.json"), ("left", "no intrinsics", "fx")),
    "intrinsics are no JSON": (
        text("left/intrinsics.json", '{"fx": 1,'),
        ("left/intrinsics.json", "neither JSON nor YAML"),
    ),
    "intrinsics of another mode": (
        table("right", width=640, height=480),
        ("right/intrinsics.json", "640x480", "96x72"),
    ),
    "intrinsics in another order": (
        table("left", fx=47.5, fy=35.5, cx=90.0, cy=90.0),
        ("left/intrinsics.json", "(90, 90)", "order"),
    ),
    "intrinsics of two modes exchanged": (
        exchanged_intrinsics(camera_at(110, scale=2)),
        ("left/intrinsics.json", "192x144", "96x72"),
    ),
    "the same without sizes": (
        exchanged_intrinsics(camera_at(110, scale=2), tells_size=False),
        ("left/intrinsics.json", "(95.5, 71.5)"),
    ),
    "intrinsics of two lenses exchanged": (
        exchanged_intrinsics(lens(CAMERAS["right"], 110.0, 0, 0)),
        ("left", "right", "contradict", "two intrinsics exchanged"),
    ),
    "intrinsics of two middles exchanged": (
        exchanged_intrinsics(lens(CAMERAS["right"], FOCAL, 8, -6)),
        ("left", "right", "contradict", "two intrinsics exchanged"),
    ),
    "normalized intrinsics": (
        table("left", fx=0.9, fy=1.2, cx=0.5, cy=0.5),
        ("left/intrinsics.json", "fx = 0.9", "pixels"),
    ),
    "no numbers in intrinsics": (table("left", fx="wide"), ("left/intrinsics.json", "fx", "wide")),
    "unknown lens": (
        table("left", distortion=[0.1, 0, 0, 0], distortion_model="spline"),
        ("left/intrinsics.json", "spline", "fisheye"),
    ),
    "pose in millimetres": (
        table(
            "left", T_world_camera=(POSE @ np.diag([1, 1, 1, 1.0]) + 700 * np.eye(4, k=3)).tolist()
        ),
        ("left/intrinsics.json", "T_world_camera", "millimetres"),
    ),
    "pose that is not rigid": (
        table("left", T_world_camera=np.diag([1.0, 1.0, -1.0, 1.0]).tolist()),
        ("left/intrinsics.json", "T_world_camera", "rigid"),
    ),
    "no pose": (table("left", T_world_camera=None), ("'left'", "--charuco", "extrinsics.json")),
    "poses exchanged": (exchanged_poses, ("left", "right", "contradict")),
    "hostile calibrate.pkl": (
        lambda raw: (raw.folder / "calibrate.pkl").write_bytes(
            pickle.dumps(Hostile(os.system, "true"))
        ),
        ("calibrate.pkl", "refused"),
    ),
    "timestamps backwards": (
        text("left/timestamps.txt", stamps(*EVEN[:3], EVEN[1], *EVEN[4:])),
        ("left/timestamps.txt", "backwards", "entry 3"),
    ),
    "too few timestamps": (
        text("left/timestamps.txt", stamps(*EVEN[:-1])),
        ("left/timestamps.txt", "5 times", "6 images"),
    ),
    "a timestamp that is none": (
        text("left/timestamps.txt", stamps(*EVEN[:2]) + "\nnan\n" + stamps(*EVEN[3:])),
        ("left/timestamps.txt", "line 3"),
    ),
    "timestamps of one camera alone": (
        text("left/timestamps.txt", stamps(*EVEN)),
        ("right", "no timestamps", "left"),
    ),
    "clocks that do not meet": (
        both(
            text("left/timestamps.txt", stamps(*EVEN)),
            text("right/timestamps.txt", stamps(*[time + 50 for time in EVEN])),
        ),
        ("right", "after", "left", "clocks"),
    ),
    "unequal counts without numbers": (unnumbered, ("left/color 3", "left/depth 6", "numbers")),
    "too many images missing": (
        removed("left/color/00001.png", "left/color/00002.png"),
        ("left/color", "lacks 2 of 6 frames", "1, 2"),
    ),
    "a frame number twice": (
        lambda raw: shutil.copy(
            raw.folder / "left/color/00001.png", raw.folder / "left/color/1.png"
        ),
        ("left/color", "same frame number"),
    ),
    "one frame": (
        removed(
            *[
                f"{v}/{k}/{f:05d}.png"
                for v in CAMERAS
                for k in ("color", "depth")
                for f in range(1, 6)
            ]
        ),
        ("1 common frame", "at least 2"),
    ),
}
"""What is broken, and what the message must name."""


def left_behind(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name != "raw")


@pytest.mark.parametrize("kind", REFUSED)
def test_a_broken_recording_is_refused_and_named(tmp_path, kind):
    damage, words = REFUSED[kind]
    raw = RawCapture(tmp_path / "raw").write()
    damage(raw)
    with pytest.raises(PhysHandiError) as refusal:
        import_capture(raw.folder, tmp_path / "out")
    message = str(refusal.value)
    assert [word for word in words if word not in message] == [], message
    assert left_behind(tmp_path) == []


BOARDS: dict[str, tuple[Damage, tuple[str, ...]]] = {
    "no board in the pictures": (
        images("calibration/left", lambda image: np.full_like(image, 90), 0),
        ("'left'", "no calibration picture shows the board"),
    ),
    "a picture of another size": (
        images("calibration/right", lambda image: image[:60], 0),
        ("calibration/right/00000.png", "96x60", "96x72"),
    ),
    "bomb among the pictures": (
        bomb("calibration/left/00000.png"),
        ("calibration/left/00000.png", "100000x100000"),
    ),
    "an array called .png": (
        lambda raw: renamed_array(raw.folder / "calibration/left/00000.png"),
        ("calibration/left/00000.png", "holds .npy in spite of its name"),
    ),
    "a cut picture": (
        torn("calibration/right/00000.png", 0.7),
        ("calibration/right/00000.png", "cut off"),
    ),
    "pictures of another camera": (
        lambda raw: (raw.folder / "calibration/right").rename(raw.folder / "calibration/b"),
        ("calibration/right", "is missing", "first 2 frames"),
    ),
    "no pictures": (
        removed("calibration/left/00000.png"),
        ("calibration/left", "no pictures of the board"),
    ),
}


@pytest.mark.parametrize("kind", BOARDS)
def test_broken_pictures_of_the_board_are_refused(tmp_path, kind):
    damage, words = BOARDS[kind]
    raw = RawCapture(tmp_path / "raw").write(2)
    raw.photograph_board()
    damage(raw)
    with pytest.raises(PhysHandiError) as refusal:
        import_capture(raw.folder, tmp_path / "out", options=CaptureOptions(board=BOARD))
    message = str(refusal.value)
    assert [word for word in words if word not in message] == [], message
    assert left_behind(tmp_path) == []


LAST = f"{FRAMES - 1:05d}"
UNDECODED: dict[str, Damage] = {
    "cut PNG": torn(f"right/depth/{LAST}.png", 0.7),
    "bomb": bomb(f"right/color/{LAST}.png"),
    "another size": images("right/depth", lambda image: image[:50], FRAMES - 1),
    "8 bits": images("right/depth", lambda image: image.astype(np.uint8), FRAMES - 1),
    "cut JPEG": lambda raw: (
        [
            cv2.imwrite(str(path.with_suffix(".jpg")), cv2.imread(str(path)))
            for path in sorted((raw.folder / "right/color").iterdir())
        ],
        [path.unlink() for path in (raw.folder / "right/color").glob("*.png")],
        torn(f"right/color/{LAST}.jpg", 0.7)(raw),
    ),
    "cut .npy": lambda raw: (
        arrays(raw, lambda depth, _: depth),
        torn(f"left/depth/{LAST}.npy", 0.7)(raw),
    ),
    "cut OpenEXR": exrs(torn(f"left/depth/{LAST}.exr", 0.7)),
    "a cut picture of the board": lambda raw: (
        raw.photograph_board(),
        torn("calibration/right/00000.png", 0.7)(raw),
    ),
}
"""What is broken in the last image of a recording."""


@pytest.mark.parametrize("kind", UNDECODED)
def test_nothing_is_decoded_before_all_files_are_looked_at(tmp_path, monkeypatch, kind):
    raw = RawCapture(tmp_path / "raw").write()
    UNDECODED[kind](raw)
    decoded: list[object] = []
    options = CaptureOptions(board=BOARD if "board" in kind else None)
    monkeypatch.setattr(MediaDecoder, "_ask", lambda *_, **request: decoded.append(request))
    monkeypatch.setattr(recorded_stream, "read_array", decoded.append)
    with pytest.raises(PhysHandiError) as refusal:
        import_capture(raw.folder, tmp_path / "out", options=options)
    monkeypatch.undo()
    assert decoded == []
    assert LAST in str(refusal.value) or "calibration/right" in str(refusal.value)
    assert left_behind(tmp_path) == []
    assert str(refusal.value) in survey_capture(raw.folder, options).problems


@pytest.mark.parametrize("name", ["color.avi", "color.mp4"])
def test_a_cut_video_is_told_before_any_image_is_decoded(tmp_path, monkeypatch, name):
    raw = RawCapture(tmp_path / "raw").write()
    video(raw, 1.0, name)
    path = raw.folder / "left" / name
    content = path.read_bytes()
    path.write_bytes(with_index_first(content) if name.endswith("mp4") else content)
    import_capture(raw.folder, tmp_path / "whole")
    path.write_bytes(path.read_bytes()[: int(0.8 * len(content))])
    asked: list[str] = []
    ask = MediaDecoder._ask

    def listen(decoder, place, **request):
        asked.append(request["do"])
        return ask(decoder, place, **request)

    monkeypatch.setattr(MediaDecoder, "_ask", listen)
    with pytest.raises(PhysHandiError, match=rf"{name}, frame \d: cannot .* --stop \d"):
        import_capture(raw.folder, tmp_path / "out")
    assert asked == ["probe", "frame"]
    assert left_behind(tmp_path) == ["whole"]


def test_broken_images_that_are_not_imported_do_no_harm(tmp_path):
    raw = RawCapture(tmp_path / "raw").write()
    torn(f"right/depth/{LAST}.png", 0.7)(raw)
    options = CaptureOptions(stop=FRAMES - 1)
    sequence = import_capture(raw.folder, tmp_path / "out", options=options)
    assert sequence.frame_count == FRAMES - 1


@pytest.mark.parametrize("place", [(2, 2), (48, 66), (90, 20)])
def test_a_click_beside_the_object_gives_no_empty_masks(tmp_path, monkeypatch, place):
    monkeypatch.setattr(segmentation, "detect_view", find_no_hand)
    raw = RawCapture(tmp_path / "raw").write(3)
    sequence = import_capture(raw.folder, tmp_path / "out")
    before = {path: path.stat().st_mtime_ns for path in sequence.folder.rglob("*")}
    with pytest.raises(UsageError, match=r"Click left,1,\d+,\d+: nothing there stands out"):
        annotate(sequence.folder, [Click("left", 1, *place)])
    assert {path: path.stat().st_mtime_ns for path in sequence.folder.rglob("*")} == before


def test_depth_that_is_empty_in_a_frame_is_kept_and_told(tmp_path):
    raw = RawCapture(tmp_path / "raw").write()
    images("left/depth", np.zeros_like, 3)(raw)
    sequence = import_capture(raw.folder, tmp_path / "out")
    assert not sequence.views[0].depth(3).any()
    assert "View 'left': depth of frame 3 holds no distance." in sequence.provenance["notes"]
