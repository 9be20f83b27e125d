"""Broken recordings, each given to ``physhandi reconstruct``."""

from pathlib import Path

import numpy as np
import pytest
from support.hostile.bad_input_world import (
    FILMED_FRAMES,
    Bad,
    Terminal,
    array,
    bad,
    both,
    camera,
    fields,
    film,
    image,
    put,
    removed,
    renamed,
    table,
    text,
    truncated,
)
from support.server.server_world import tiny_config

from app.cli import runs

DEPTH, MASK, VIDEO, KEYPOINT = (
    f"views/front/{part}"
    for part in ("depth/00002.png", "mask/00002.png", "color.mp4", "keypoint.npy")
)


def scaled(factor: float, *files: str):
    return both(*[array(file, lambda values: values * np.float32(factor)) for file in files])


def archive(rel: str):
    def write(folder: Path) -> None:
        with (folder / rel).open("wb") as stream:
            np.savez(stream, a=np.zeros(3))

    return write


GEOMETRY = ("control.npy", "marker.npy", "object_node.npy", "rest_node.npy")

SHEET = {
    # Files that are missing or torn
    "no sequence.yaml": bad(removed("sequence.yaml"), "sheet", "sequence.yaml", code=2),
    "no control.npy": bad(removed("control.npy"), "'sheet'", "hands or control"),
    "no object_node.npy": bad(removed("object_node.npy"), "rest_node.npy", "object_node.npy"),
    "torn control.npy": bad(truncated("control.npy"), "control.npy", "readable .npy"),
    "torn sequence.yaml": bad(truncated("sequence.yaml", 30), "sequence.yaml"),
    "archive as control.npy": bad(archive("control.npy"), "control.npy", "archive"),
    "objects as control.npy": bad(
        lambda folder: np.save(folder / "control.npy", np.array([{}]), allow_pickle=True),
        "control.npy",
        "readable .npy",
    ),
    # Wrong shapes
    "control without nodes axis": bad(
        array("control.npy", lambda control: control[:, 0]), "control.npy", "(10, 3)", "control"
    ),
    "control of zero nodes": bad(
        array("control.npy", lambda control: control[:, :0]), "control.npy", "control"
    ),
    "control of no frames": bad(
        array("control.npy", lambda control: control[:0]), "control.npy", "frame = 10"
    ),
    "no object nodes": bad(
        both(
            array("object_node.npy", lambda node: node[:0]),
            array("rest_node.npy", lambda node: node[:0]),
            removed("marker_node.npy"),
        ),
        "object_node.npy",
    ),
    "marker of a node that is not there": bad(
        put("marker_node.npy", 3, 99), "marker_node.npy", "99", "25"
    ),
    "markers nobody has seen": bad(put("marker.npy", slice(None), np.nan), "marker"),
    # NaN and infinity
    "NaN in control": bad(
        put("control.npy", (4, 1, 2), np.nan), "control.npy", "nan", "frame 4", "control 1"
    ),
    "infinity in control": bad(
        put("control.npy", (9, 0), np.inf), "control.npy", "inf", "frame 9", "control 0"
    ),
    "NaN in object_node": bad(
        put("object_node.npy", (7, 0), np.nan), "object_node.npy", "nan", "node 7"
    ),
    "NaN in rest_node": bad(put("rest_node.npy", (7, 0), np.nan), "rest_node.npy", "node 7"),
    "infinity in marker": bad(
        put("marker.npy", (2, 5, 1), np.inf), "marker.npy", "inf", "frame 2", "marker 5"
    ),
    # sequence.yaml
    "zero frames": bad(fields(frame_count=0), "frame_count is 0", "from 1 on"),
    "one frame": bad(
        both(
            fields(frame_count=1, split={"reconstruction": 1}),
            array("control.npy", lambda control: control[:1]),
            array("marker.npy", lambda marker: marker[:1]),
        ),
        "'sheet'",
        "1 frame",
    ),
    "one frame to fit": bad(fields(split={"reconstruction": 1}), "'sheet'", "split"),
    "unknown field": bad(fields(colour="red"), "sequence.yaml", "'colour'", "not known"),
    "field of a wrong kind": bad(fields(frame_rate="fast"), "frame_rate is 'fast'", "number"),
    "field twice": bad(
        text("sequence.yaml", lambda content: content + "\ngravity: 3.7\n"),
        "sequence.yaml",
        "gravity",
        "twice",
    ),
    "NaN gravity": bad(fields(gravity=float("nan")), "gravity is nan"),
    "name that is a path": bad(fields(name="../../etc"), "name is '../../etc'"),
    "tag that asks for code": bad(
        lambda folder: (folder / "sequence.yaml").write_text("!!python/object/apply:os.abort []"),
        "sequence.yaml",
        "YAML",
    ),
    "bytes that are no text": bad(
        lambda folder: (folder / "sequence.yaml").write_bytes(b"\xff\xfe\x00name"),
        "sequence.yaml",
        "YAML",
    ),
    # Units
    "millimetres": bad(scaled(1000, *GEOMETRY), "'sheet'", "millimetres", "metres"),
    "controls in millimetres": bad(scaled(1000, "control.npy"), "control.npy", "millimetres"),
    "a thousandth": bad(scaled(1e-3, *GEOMETRY), "'sheet'", "0.2", "mm", "metres"),
    # Geometry from which no simulation can be made
    "controls far away": bad(
        array("control.npy", lambda control: control + np.float32(0.5)),
        "'sheet'",
        "control",
        "m",
        "virtual_connection_radius",
    ),
    "nodes all in one place": bad(
        both(
            put("object_node.npy", slice(None), [0.0, 0.0, 0.2]),
            put("rest_node.npy", slice(None), [0.0, 0.0, 0.2]),
        ),
        "25 object nodes are in one place",
        "connection_radius",
    ),
}

FILMED = {
    "no depth frame": bad(removed(DEPTH), "'front'", "depth of frame 2", "missing"),
    "no keypoints, hand too small": bad(removed(KEYPOINT), "'filmed'", "hand"),
    "no view folder": bad(renamed("views/front", "views/back"), "views/front", "missing"),
    "frames with a gap": bad(
        renamed("views/front/mask/00001.png", "views/front/mask/00009.png"),
        "mask of frame 1",
        "missing",
    ),
    "a frame too many": bad(
        lambda folder: (folder / "views/front/mask/00004.png").write_bytes(b"x"),
        "mask/00004",
        "only 4 frames",
    ),
    "video that ends early": bad(
        lambda folder: film(folder / VIDEO, FILMED_FRAMES - 1), "color.mp4", "3 frames", "has 4"
    ),
    "torn video": bad(truncated(VIDEO, 300), "color.mp4", "0 frames", "cut the video"),
    "torn depth": bad(truncated(DEPTH), "depth of frame 2", "decoded"),
    "torn keypoints": bad(truncated(KEYPOINT), "keypoint.npy", "readable"),
    "depth with 8 bits": bad(
        image(DEPTH, lambda depth: (depth // 16).astype(np.uint8)), "depth of frame 2", "16-bit"
    ),
    "depth in another size": bad(
        image(DEPTH, lambda depth: depth[:, :-1]), "depth of frame 2", "47x36", "48x36"
    ),
    "depth in metres": bad(
        both(
            *[
                image(f"views/front/depth/{frame:05d}.png", lambda depth: depth // 1000 + 1)
                for frame in range(FILMED_FRAMES)
            ]
        ),
        "depth",
        "millimetres",
    ),
    "mask with an unknown label": bad(
        image(MASK, lambda mask: mask + np.uint8(7)), "mask of frame 2", "label 9", "0 to 3"
    ),
    "20 joints": bad(array(KEYPOINT, lambda k: k[:, :, :20]), "keypoint.npy", "20", "21"),
    "keypoints of two hands": bad(
        array(KEYPOINT, lambda k: np.repeat(k, 2, axis=1)), "keypoint.npy", "hand = 1"
    ),
    "infinite keypoint": bad(
        put(KEYPOINT, (1, 0, 8, 0), np.inf), "keypoint.npy", "inf", "frame 1", "hand 0"
    ),
    "keypoints as parts of the image": bad(
        array(KEYPOINT, lambda k: k / np.array([48, 36, 1], np.float32)),
        "keypoint.npy",
        "frame 0, hand 0, joint 0",
        "multiply by 48 and 36",
    ),
    "keypoint far outside": bad(
        put(KEYPOINT, (2, 0, 5, 1), 4e6), "keypoint.npy", "frame 2, hand 0, joint 5", "far outside"
    ),
    "keypoints in one place": bad(
        put(KEYPOINT, (..., slice(2)), 20.0), "'filmed'", "apart from each other"
    ),
    "keypoints nobody has seen": bad(
        put(KEYPOINT, slice(None), np.nan), "'filmed'", "hand", "keypoints of its palm"
    ),
    "neither keypoints nor video": bad(
        both(removed(KEYPOINT), removed(VIDEO)), "'filmed'", "color", "keypoint.npy"
    ),
    "K of 2x2": bad(camera(K=[[1.0, 0.0], [0.0, 1.0]]), "'front'", "K", "(3, 3)", "(2, 2)"),
    "K of text": bad(camera(K="wide"), "'front'", "K", "numbers"),
    "negative focal length": bad(
        camera(K=[[-40.0, 0, 24], [0, 40, 18], [0, 0, 1]]), "'front'", "K must be"
    ),
    "NaN in the extrinsics": bad(
        camera(T_world_camera=np.full((4, 4), np.nan).tolist()), "'front'", "T_world_camera"
    ),
    "extrinsics that mirror": bad(
        camera(T_world_camera=np.diag([-1.0, 1, 1, 1]).tolist()), "T_world_camera", "rotation"
    ),
    "extrinsics in millimetres": bad(
        camera(T_world_camera=[[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 600.0], [0, 0, 0, 1]]),
        "'front'",
        "millimetres",
    ),
}


@table(SHEET)
def test_a_broken_recording_of_markers_is_refused(
    terminal: Terminal, sheet: Path, case: Bad
) -> None:
    case.damage(sheet)
    terminal.refused(case.code, case.words, "reconstruct", sheet, "--out", "out", "--device", "cpu")


@table(FILMED)
def test_a_broken_recording_of_views_is_refused(
    terminal: Terminal, filmed: Path, case: Bad
) -> None:
    case.damage(filmed)
    terminal.refused(
        case.code, case.words, "reconstruct", filmed, "--out", "out", "--device", "cpu"
    )


HANDS = {
    # What lies in the folder of hand models, and what the refusal must say.
    "no MANO": bad(lambda _: None, "MANO model is missing", "MANO_RIGHT.pkl", "import mano"),
    "torn MANO": bad(
        lambda folder: (folder / "mano_right.npz").write_bytes(b"PK\x03\x04"),
        "mano_right.npz",
        "damaged",
        "import mano",
    ),
    "another archive": bad(
        lambda folder: np.savez(folder / "mano_right.npz", f=np.zeros(3)),
        "mano_right.npz",
        "v_template",
    ),
    "a pickle": bad(
        lambda folder: np.savez(
            folder / "mano_right.npz", v_template=np.array([{}]), allow_pickle=True
        ),
        "mano_right.npz",
        "damaged",
    ),
}


@table(HANDS)
def test_a_fit_with_mano_needs_a_whole_one(
    terminal: Terminal, filmed: Path, monkeypatch: pytest.MonkeyPatch, case: Bad
) -> None:
    config = tiny_config()
    config = config.replace(hand=config.hand.replace(model="mano"))
    monkeypatch.setattr(runs, "load_profile", lambda _: config)
    monkeypatch.setenv("PHYSHANDI_HANDS", str(terminal.folder))
    case.damage(terminal.folder)
    order = ("reconstruct", filmed, "--out", "out", "--device", "cpu")
    terminal.refused(case.code, case.words, *order)
