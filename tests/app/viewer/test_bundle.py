"""The archive of a view, read back and compared with what the scene shows."""

import csv
import io
import json
import zipfile
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from support.viewer.viewer_world import FRAMES, PARAMETERS, content_of, controls, look_at

from app.viewer.content.layers import Layers
from app.viewer.content.session_state import Pose
from app.viewer.export.bundle import Screenshot, bundle
from app.viewer.export.snapshot import Snapshot


class Recorded:
    """A view of a recording whose image tells its frame."""

    name = "view0"
    camera = look_at((0.5, 0.1, 0.3))
    has_color = True

    def color(self, frame: int) -> np.ndarray:
        return np.full((48, 64, 3), (10 * frame, 0, 0), np.uint8)


@pytest.fixture
def snapshot() -> Snapshot:
    rng = np.random.default_rng(5)
    vertex, face = rng.normal(size=(30, 3)).astype(np.float32), np.array([[0, 1, 2]], np.int32)
    view: Any = Recorded()
    content = content_of({"right": (vertex, face)}, controls((0.0, 0.0, 1.0)), (view,))
    assert content.fitted is not None
    position = content.fitted.position + rng.normal(0, 0.002, content.fitted.position.shape)
    rollout = replace(content.fitted, position=position.astype(np.float32))
    return Snapshot(
        content=content,
        frame=4,
        rollout=rollout,
        rollout_frame=4,
        layers=Layers(),
        link="/runs/x/view?f=4",
    )


def picture() -> Screenshot:
    image = np.zeros((30, 40, 3), np.uint8)
    pose = Pose(
        position=np.array([1.0, -2.0, 0.5]),
        look_at=np.array([0.0, 0.0, 0.1]),
        up=np.array([0.0, 0.0, 1.0]),
        fov=0.8,
    )
    return Screenshot.of(cv2.imencode(".png", image)[1].tobytes(), pose)


def unpack(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert archive.testzip() is None
        return {name: archive.read(name) for name in archive.namelist()}


def rows(content: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(content.decode())))


def column(table: list[dict[str, str]], *names: str) -> np.ndarray:
    return np.array([[float(row[name]) for name in names] for row in table])


def test_the_archive_holds_every_number_of_the_frame(snapshot: Snapshot) -> None:
    files = unpack(bundle(snapshot, picture()))
    assert next(iter(files)) == "README.txt"
    rollout = snapshot.rollout
    assert rollout is not None
    model, first = rollout.model, rollout.model.object_spring_count
    nodes = rows(files["nodes.csv"])
    place = column(nodes, "x_m", "y_m", "z_m")
    np.testing.assert_allclose(place, rollout.position[4], atol=1e-7)
    np.testing.assert_allclose(
        column(nodes, "force_x_N", "force_y_N", "force_z_N"),
        rollout.forces(4),
        rtol=1e-6,
        atol=1e-9,
    )
    control = column(rows(files["controls.csv"]), "x_m", "y_m", "z_m")
    springs = rows(files["springs.csv"])
    assert [row["kind"] for row in springs].count("virtual") == model.virtual_spring_count > 0
    for row, length in zip(springs, column(springs, "length_m", "rest_length_m"), strict=True):
        other = control if row["kind"] == "virtual" else place
        ends = place[int(row["node"])] - other[int(row["other_node_or_control"])]
        assert np.linalg.norm(ends) == pytest.approx(length[0], rel=1e-5)
        assert float(row["strain"]) == pytest.approx(length[0] / length[1] - 1, abs=1e-6)
    forces = rows(files["forces.csv"])
    assert [int(row["spring"]) for row in forces] == list(range(first, len(springs)))
    total = np.zeros_like(place)
    np.add.at(
        total,
        [int(row["node"]) for row in forces],
        column(forces, "force_x_N", "force_y_N", "force_z_N"),
    )
    np.testing.assert_allclose(total, rollout.forces(4), rtol=1e-5, atol=1e-6)
    assert np.abs(total).max() > 0.1
    with np.load(io.BytesIO(files["frame.npz"])) as arrays:
        np.testing.assert_array_equal(arrays["position"], rollout.position[4])
        np.testing.assert_array_equal(arrays["spring_nodes"], model.spring_nodes)
        hand = snapshot.content.hands[0]
        np.testing.assert_array_equal(arrays["hand_right_vertex"], hand.vertex[4])
    assert yaml.safe_load(files["parameters.yaml"]) == PARAMETERS.to_dict()
    assert files["permalink.txt"] == b"/runs/x/view?f=4\n"


def test_cameras_and_images_are_those_of_the_frame(snapshot: Snapshot) -> None:
    files = unpack(bundle(snapshot, picture()))
    seen = cv2.imdecode(np.frombuffer(files["views/view0.png"], np.uint8), cv2.IMREAD_COLOR)
    assert seen[0, 0].tolist() == [0, 0, 40]
    cameras = json.loads(files["camera.json"])
    own, recorded = cameras["picture"], cameras["views"]["view0"]
    np.testing.assert_allclose(recorded["T_world_camera"], Recorded.camera.T_world_camera)
    assert (own["width"], own["height"]) == (40, 30)
    pose, K = np.array(own["T_world_camera"]), np.array(own["K"])
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    local = np.linalg.inv(pose) @ [0.0, 0.0, 0.1, 1.0]
    pixel = K @ local[:3]
    np.testing.assert_allclose(pixel[:2] / pixel[2], [19.5, 14.5], atol=1e-9)
    above = np.linalg.inv(pose) @ [0.0, 0.0, 0.4, 1.0]
    assert (K @ above[:3])[1] / above[2] < 14.5
    top = np.array([0, 15 / K[1, 1], 1.0])
    assert 2 * np.arctan(top[1]) == pytest.approx(0.8)


def test_both_halves_of_a_figure_are_told_apart(snapshot: Snapshot) -> None:
    rollout = snapshot.rollout
    assert rollout is not None
    other = replace(rollout, position=rollout.position + np.float32(1.0))
    compared = {"ours": (rollout, 4), "phystwin": (other, 5)}
    files = unpack(bundle(replace(snapshot, compared=compared), picture()))
    table = rows(files["nodes.csv"])
    shown = column([row for row in table if row["side"] == "phystwin"], "x_m", "y_m", "z_m")
    np.testing.assert_allclose(shown, other.position[5], atol=1e-6)
    with np.load(io.BytesIO(files["frame.npz"])) as arrays:
        np.testing.assert_array_equal(arrays["phystwin_position"], other.position[5])
        np.testing.assert_array_equal(arrays["ours_position"], rollout.position[4])
    assert set(yaml.safe_load(files["parameters.yaml"])) == {"ours", "phystwin"}


def test_the_readme_explains_each_file_that_is_there_and_no_other(snapshot: Snapshot) -> None:
    files = unpack(bundle(snapshot, picture()))
    readme = files["README.txt"].decode()
    for name in set(files) - {"README.txt"}:
        assert name.split("/")[0] in readme
    assert "frame 4" in readme
    assert "views/" in readme
    recording = replace(
        snapshot, rollout=None, link="", content=replace(snapshot.content, fitted=None, hands=())
    )
    few = unpack(bundle(recording, picture()))
    assert set(few) == {"README.txt", "picture.png", "views/view0.png", "camera.json", "frame.ply"}
    assert "springs.csv" not in few["README.txt"].decode()
    assert bundle(snapshot, picture()) == bundle(snapshot, picture())
    assert FRAMES > 5
