import json
import zipfile

import cv2
import lzfse
import numpy as np
import pytest
from support.inputs.raw_capture import camera_at, picture

from physhandi.data.importers.capture import import_capture
from physhandi.data.importers.record3d import unpack_record3d
from physhandi.errors import ImportFailedError
from physhandi.progress import Progress

FRAMES = 3
CAMERA = camera_at(30, 2)
DEPTH_SCALE = 2
"""Depth images are that much smaller."""


def write(path, **damage):
    """Write a recording as the app exports it; `damage` changes metadata, or members by name."""
    width, height = CAMERA.width, CAMERA.height
    dw, dh = width // DEPTH_SCALE, height // DEPTH_SCALE
    K = CAMERA.K
    meta = {
        "w": width,
        "h": height,
        "dw": dw,
        "dh": dh,
        "fps": 30,
        "K": [K[0, 0], 0, 0, 0, K[1, 1], 0, K[0, 2], K[1, 2], 1],
        "poses": [[0, 0, 0, 1, 0.001 * frame, 0, 0] for frame in range(FRAMES)],
        "frameTimestamps": [5.0 + frame / 15 for frame in range(FRAMES)],
    }
    members = {}
    for frame in range(FRAMES):
        color, depth = picture(CAMERA, frame)
        code = cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])[1]
        small = cv2.resize(depth, (dw, dh), interpolation=cv2.INTER_NEAREST)
        sure = np.full((dh, dw), 2, np.uint8)
        sure[:10] = 0
        members[f"rgbd/{frame}.jpg"] = code.tobytes()
        members[f"rgbd/{frame}.depth"] = lzfse.compress(small.astype("<f4").tobytes())
        members[f"rgbd/{frame}.conf"] = lzfse.compress(sure.tobytes())
    meta |= {name: value for name, value in damage.items() if "/" not in name}
    members["metadata"] = json.dumps({k: v for k, v in meta.items() if v is not None}).encode()
    members |= {name: value for name, value in damage.items() if "/" in name}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            if content is not None:
                archive.writestr(name, content)
    return path


def test_a_recording_of_a_phone_becomes_a_sequence(tmp_path):
    sequence = import_capture(write(tmp_path / "take.r3d"), tmp_path / "out")
    (view,) = sequence.views
    assert (sequence.frame_count, sequence.frame_rate) == (FRAMES, pytest.approx(15, abs=0.01))
    np.testing.assert_allclose(view.camera.K, CAMERA.K, atol=1e-6)
    color, depth = picture(CAMERA, 2)
    assert np.abs(view.color(2).astype(int) - color).mean() < 4
    found = view.depth(2)
    known = found > 0
    assert not known[: 10 * DEPTH_SCALE - 2].any()  # It was not sure there.
    assert known[10 * DEPTH_SCALE + 2 : -4, 4:-4].mean() > 0.9
    assert np.median(np.abs(found - depth)[known]) < 6e-3
    assert sequence.provenance["depth_scale"] == {view.name: 1.0}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "take.r3d"]


def test_several_phones_are_several_views_and_focus_may_change(tmp_path):
    source = tmp_path / "both"
    source.mkdir()
    K = [CAMERA.K[0, 0], CAMERA.K[1, 1], CAMERA.K[0, 2], CAMERA.K[1, 2]]
    for name in ("one", "two"):
        each = [[share * K[0], share * K[1], *K[2:]] for share in (0.99, 1.0, 1.2)]
        write(source / f"{name}.r3d", perFrameIntrinsicCoeffs=each, K=None)
    pose = CAMERA.T_world_camera.tolist()
    (source / "extrinsics.json").write_text(json.dumps({"one": pose, "two": pose}))
    sequence = import_capture(source, tmp_path / "out")
    assert [view.name for view in sequence.views] == ["one", "two"]
    np.testing.assert_allclose(sequence.views[0].camera.K, CAMERA.K, atol=1e-6)


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        ({"poses": [[0, 0, 0, 1, 0.05 * f, 0, 0] for f in range(3)]}, "moved by 5.0 cm"),
        ({"poses": [[0, 0, f * 0.05, 1, 0, 0, 0] for f in range(3)]}, "turned by 5.7 degrees"),
        ({"rgbd/1.depth": b"none"}, "rgbd/1.depth cannot be decoded"),
        ({"rgbd/1.depth": lzfse.compress(bytes(100))}, "rgbd/1.depth holds 100 bytes"),
        ({"rgbd/1.depth": None}, "frame 1 has only one of both"),
        ({"w": "wide"}, "metadata: w is 'wide'"),
        ({"w": 60_000, "h": 60_000}, "announces images of 60000x60000"),
        ({"K": None}, "neither K"),
    ],
)
def test_a_wrong_recording_is_refused_by_part_and_frame(tmp_path, damage, told):
    path = write(tmp_path / "take.r3d", **damage)
    with pytest.raises(ImportFailedError) as error:
        unpack_record3d(path, tmp_path / "view0", Progress())
    assert str(error.value).startswith(f"{path}: ")
    assert told in str(error.value)


@pytest.mark.parametrize(
    ("offset", "change", "told"),
    [
        (8, 1, "password required"),
        (10, 99, "compression method is not supported"),
        (None, 0xFF, "Error -3 while decompressing"),
    ],
)
def test_members_that_cannot_be_unpacked_are_refused(tmp_path, offset, change, told):
    path = tmp_path / "take.r3d"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", "{}" * 99)
        start = archive.fp.tell() - archive.getinfo("metadata").compress_size
    content = bytearray(path.read_bytes())
    # Flags and method of a member stand in its entry of the list at the end.
    content[start if offset is None else content.index(b"PK\1\2") + offset] = change
    path.write_bytes(content)
    with pytest.raises(ImportFailedError, match=rf"no whole \.r3d recording \(.*{told}"):
        unpack_record3d(path, tmp_path / "view0", Progress())


def test_a_file_that_was_cut_off_is_refused(tmp_path):
    path = write(tmp_path / "take.r3d")
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(ImportFailedError, match=r"take\.r3d: is no whole \.r3d recording"):
        import_capture(path, tmp_path / "out")
    assert [one.name for one in tmp_path.iterdir()] == ["take.r3d"]
