"""The images of a PhysTwin case: each way in which one can be wrong is named."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from support.hostile.header_bombs import png
from support.inputs.phystwin_case import (
    FRAMES,
    HEIGHT,
    WIDTH,
    Case,
    edit_json,
    write_case,
    write_video,
)
from support.inputs.phystwin_damage import Damage, array_file, image_file, moved, refuse, tracks


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Case:
    return write_case(tmp_path_factory.mktemp("cases") / "single_lift_sloth")


def _extra_camera(folder: Path) -> None:
    (folder / "depth/3").mkdir()


def _blank_video(folder: Path) -> None:
    """Keep the video's tables and its first pictures, but not the last ones."""
    path = write_video(folder, 2)
    content = path.read_bytes()
    end = content.index(b"moov") - 4
    start = (content.index(b"mdat") + end) // 2
    path.write_bytes(content[:start] + bytes(end - start) + content[end:])


GREY = np.zeros((HEIGHT, WIDTH), np.uint8)
WRONG: dict[str, tuple[Damage, str]] = {
    "a camera too many": (_extra_camera, "depth/3: is of camera 3, but"),
    "a missing color image": (
        lambda f: (f / "color/1/3.png").unlink(),
        r"color/1/3\.png: is missing",
    ),
    "frames with leading zeros": (moved("color/0/2.png", "color/0/002.png"), "no zeros"),
    "an image that is none": (
        lambda f: (f / "color/2/0.png").write_bytes(b"no") and None,
        r"color/2/0\.png: cannot be decoded",
    ),
    "an image that announces more than there is memory": (
        lambda f: (f / "color/2/0.png").write_bytes(png(100_000, 100_000)) and None,
        r"color/2/0\.png: cannot be decoded as an image: it announces 100000x100000 px",
    ),
    "an image of another size": (
        image_file("color/1/2.png", GREY[:-2]),
        r"color/1/2\.png: is 96x70 px, but WH in metadata\.json is 96x72",
    ),
    "frames that were not cut": (moved("depth/0/4.npy", "depth/0/7.npy"), r"7\.npy: is frame 7"),
    "depth in metres": (
        array_file("depth/1/2.npy", np.ones((HEIGHT, WIDTH), np.float32)),
        r"depth/1/2\.npy: holds float32\(72, 96\); expected uint16",
    ),
    "depth of another size": (
        array_file("depth/0/1.npy", np.ones((9, 9), np.uint16)),
        r"depth/0/1\.npy: is 9x9 px",
    ),
    "depth that is torn": (
        lambda f: (f / "depth/0/0.npy").write_bytes(b"\x93NUMPY") and None,
        r"depth/0/0\.npy: is not a readable",
    ),
    "no mask labels": (
        lambda f: (f / "mask/mask_info_1.json").unlink(),
        r"mask_info_1\.json: is missing",
    ),
    "two objects": (
        lambda f: edit_json(f / "mask/mask_info_1.json", **{"10": "rope"}),
        r"mask_info_1\.json: must label exactly one mask .* 2: 'sloth', 10: 'rope'",
    ),
    "no object": (
        lambda f: edit_json(f / "mask/mask_info_0.json", **{"2": "hand"}),
        r"mask_info_0\.json: must label exactly one mask .* found none",
    ),
    "odd labels": (
        lambda f: edit_json(f / "mask/mask_info_0.json", sloth="2"),
        r"mask_info_0\.json: field 'sloth' is '2'",
    ),
    "a missing mask": (lambda f: (f / "mask/2/0/1.png").unlink(), r"mask/2/0/1\.png: is missing"),
    "a mask in color": (
        image_file("mask/2/0/1.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8)),
        r"mask/2/0/1\.png: is uint8\(72, 96, 3\)",
    ),
    "a mask of ones": (image_file("mask/2/0/1.png", GREY + 1), "has other values than 0 and 255"),
    "tracks of other frames": (
        tracks(tracks=np.zeros((4, 26, 2))),
        r"cotracker/1\.npz: tracks has shape \(4, 26, 2\); expected \(5, track, 2\)",
    ),
    "other visibilities": (
        tracks(visibility=np.zeros((5, 2), bool)),
        r"cotracker/1\.npz: visibility has shape \(5, 2\); expected \(5, 26\)",
    ),
    "visible tracks that are NaN": (
        tracks(tracks=np.full((5, 26, 2), np.nan)),
        r"cotracker/1\.npz: tracks: frame 0, track 0 is not finite",
    ),
    "tracks of objects": (
        tracks(tracks=np.array([{}], dtype=object)),
        r"cotracker/1\.npz: is not a readable",
    ),
    "a short video": (
        lambda f: write_video(f, 1, FRAMES - 1),
        r"color/1\.mp4: has 4 frames, but the case has 5",
    ),
    "a video whose end is lost": (_blank_video, r"makes no valid sequence: .*view 'view2': color"),
    "tracks that are no archive": (
        lambda f: (f / "cotracker/0.npz").write_bytes(b"PK") and None,
        r"cotracker/0\.npz: is not a readable",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named_and_nothing_is_written(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    damage, message = WRONG[name]
    folder = Path(shutil.copytree(case.folder, tmp_path / "case"))
    refuse(folder, damage, message, monkeypatch)
