"""The tables of a PhysTwin case: each way in which one can be wrong is named."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.inputs.phystwin_case import Case, edit_json, edit_pickle, save_pickle, write_case
from support.inputs.phystwin_damage import (
    Damage,
    final,
    load,
    metadata,
    pickle_file,
    put,
    refuse,
    split,
)


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return write_case(tmp_path_factory.mktemp("cases") / "single_lift_sloth")


class _Hostile:
    def __init__(self, folder: Path) -> None:
        self.path = str(folder.parent / "was_executed")

    def __reduce__(self) -> Any:
        return open, (self.path, "w")


def _hostile(folder: Path) -> None:
    save_pickle(folder / "final_data.pkl", _Hostile(folder))


def _torn(folder: Path) -> None:
    path = folder / "final_data.pkl"
    path.write_bytes(path.read_bytes()[:-200])


def _raw(folder: Path) -> None:
    (folder / "final_data.pkl").unlink()
    edit_json(folder / "metadata.json", frame_num=None, recording={"0": {"17": 1.5}})


def _unnumbered(folder: Path) -> None:
    (folder / "final_data.pkl").unlink()
    (folder / "color/2/4.png").unlink()
    edit_json(folder / "metadata.json", frame_num=None)


def _flat(folder: Path) -> None:
    path = folder / "final_data.pkl"
    points = load(path)["object_points"]
    points[:, ::2, 2] *= -1
    edit_pickle(path, object_points=points)
    pose = load(folder / "calibrate.pkl")
    pose[1][2, 3] *= -1
    save_pickle(folder / "calibrate.pkl", pose)


def _scaled_pose(folder: Path) -> None:
    pose = load(folder / "calibrate.pkl")
    pose[1][:3, :3] *= 1.1
    save_pickle(folder / "calibrate.pkl", pose)


FINAL = r"final_data\.pkl: "
WRONG: dict[str, tuple[Damage, str]] = {
    "a torn pickle": (_torn, r"final_data\.pkl: refused"),
    "a pickle that executes": (_hostile, r"final_data\.pkl: refused, because it asks for .*open"),
    "a list in place of fields": (pickle_file("final_data.pkl", [1]), FINAL + "holds list"),
    "no visibilities": (
        lambda f: edit_pickle(f / "final_data.pkl", object_visibilities=None),
        FINAL + r"field 'object_visibilities' \(5, 26\) is missing; it has",
    ),
    "ragged points": (
        lambda f: edit_pickle(f / "final_data.pkl", object_points=[[[0, 1, 2]], [[0, 1]]]),
        FINAL + "object_points is ragged",
    ),
    "fewer flags": (
        final("object_motions_valid", lambda a: a[:, 1:]),
        FINAL + r"object_motions_valid has shape \(5, 25\); expected \(5, 26\)",
    ),
    "flags of other values": (
        final("object_visibilities", lambda a: a * 2),
        FINAL + "object_visibilities holds other values",
    ),
    "planar points": (
        final("object_points", lambda a: a[..., :2]),
        FINAL + r"object_points has shape \(5, 26, 2\)",
    ),
    "controllers of other frames": (
        final("controller_points", lambda a: a[1:]),
        FINAL + r"controller_points has shape \(4, 2, 3\); expected \(5, controller, 3\)",
    ),
    "no controller": (final("controller_points", lambda a: a[:, :0]), FINAL + ".*is empty"),
    "a visible point that is NaN": (
        final("object_points", put(0, 3, 1, value=np.nan)),
        FINAL + r"object_points: frame 0, point 3 is \[.*nan",
    ),
    "a node at the mark of invisible points": (
        final("object_points", put(0, 3, value=0.0)),
        FINAL + r"object_points: frame 0, point 3 is \[0.0, 0.0, 0.0\]. That stands for",
    ),
    "a lost controller": (
        final("controller_points", put(2, 1, value=0.0)),
        FINAL + "controller_points: frame 2, point 1",
    ),
    "millimetres": (
        final("object_points", lambda a: a * 1000),
        FINAL + r"object_points: frame 0, point 0 is .* Convert it to metres",
    ),
    "an infinite interior": (
        final("interior_points", put(4, 0, value=np.inf)),
        FINAL + "interior_points: frame 0, point 4",
    ),
    "text for points": (
        final("surface_points", lambda _: [["a", "b", "c"]]),
        FINAL + "surface_points holds <U1; expected numbers",
    ),
    "flags of the other convention": (
        final("object_motions_valid", lambda a: np.roll(a, 1, axis=0)),
        FINAL + "object_motions_valid: frame 1, point 7 trusts the motion to frame",
    ),
    "other frames than the metadata": (
        metadata(frame_num=6),
        FINAL + "object_points has 5 frames, but frame_num in metadata.json is 6",
    ),
    "sides that contradict": (
        final("object_points", lambda a: a * [1, 1, -1]),
        r"calibrate\.pkl: puts every camera on the other side",
    ),
    "no side at all": (_flat, FINAL + "does not tell which side"),
    "no metadata for images": (
        lambda f: (f / "metadata.json").unlink(),
        r"metadata\.json: is missing",
    ),
    "metadata that is no JSON": (
        lambda f: (f / "metadata.json").write_text("{") and None,
        r"metadata\.json: is no JSON",
    ),
    "no intrinsics": (metadata(intrinsics=None), "metadata.json: field 'intrinsics' is missing"),
    "an odd rate": (metadata(fps="fast"), "metadata.json: fps is 'fast'"),
    "an odd frame number": (metadata(frame_num=2.5), "metadata.json: frame_num is 2.5"),
    "an odd size": (metadata(WH=[96.5, 72]), "metadata.json: WH is"),
    "another number of serials": (metadata(serial_numbers=["a"]), "serial_numbers is"),
    "two intrinsics for three cameras": (
        metadata(intrinsics=[np.eye(3).tolist()] * 2, serial_numbers=None),
        r"calibrate\.pkl: has 3 cameras, but metadata\.json has 2 intrinsics",
    ),
    "a raw recording": (_raw, "has no 'frame_num': this is the recorder's own folder"),
    "unequal cameras without a number": (_unnumbered, "has no 'frame_num', and color/ has"),
    "a pose that is no rotation": (
        _scaled_pose,
        r"calibrate\.pkl: camera 1 .*must hold a rotation",
    ),
    "a camera far away": (
        pickle_file("calibrate.pkl", [np.eye(4), np.eye(4), np.diag([1, 1, 1, 2e3])]),
        r"calibrate\.pkl: camera 2 is not finite or farther",
    ),
    "a split of another length": (split(frame_len=9), r"split\.json: frame_len is 9"),
    "a split with a hole": (split(test=[4, 5]), r"split\.json: train is \[0, 3\] and test is"),
    "a split of text": (split(train="all"), r"split\.json: train is 'all'"),
    "annotations of other frames": (
        pickle_file("gt_track_3d.pkl", np.ones((4, 2, 3))),
        r"gt_track_3d\.pkl: content has shape \(4, 2, 3\); expected \(5, track, 3\)",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named_and_nothing_is_written(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    damage, message = WRONG[name]
    folder = Path(shutil.copytree(case.folder, tmp_path / "case"))
    refuse(folder, damage, message, None if "pickle" in name else monkeypatch)
