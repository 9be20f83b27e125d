"""Exports, read back by programs that know nothing of the exporter."""

import csv
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from physhandi.data.exporters import export_run
from physhandi.data.exporters.scene_data import SceneData
from physhandi.data.exporters.table import flat, safe_cell, write_csv, write_trajectories
from physhandi.errors import RunError, UsageError
from physhandi.run import Run

FRAMES, NODES, VERTICES = 3, 4, 5
FACE = np.array([[0, 1, 2], [2, 3, 4]])
SPRINGS = np.array([[0, 1], [2, 3], [NODES + 1, 0], [NODES + 4, 3]], np.int32)


def make_run(folder: Path, *, controls: str = "hand", **changes: Any) -> Run:
    rng = np.random.default_rng(4)
    rollout = rng.normal(size=(FRAMES, NODES, 3)).astype(np.float32)
    vertex = rng.normal(size=(FRAMES, VERTICES, 3)).astype(np.float32)
    run = Run.create(
        folder,
        name="=SUM(A1)",
        kind="reconstruction",
        sequences=["/data/lift", "/data/fold"],
        config={"radius": 0.02},
    )
    with run.begin_attempt() as attempt:
        base = "sequences/lift"
        attempt.save_yaml(f"{base}/meta.yaml", {"frame_rate": 30.0, "frame_count": len(rollout)})
        if changes.get("has_motion", True):
            attempt.save_array(f"{base}/rollout.npy", rollout)
            control = vertex if controls == "hand" else vertex[:, :2] + 1
            attempt.save_array(f"{base}/control.npy", control)
            attempt.save_array(f"{base}/hand_right_vertex.npy", vertex)
            attempt.save_array(f"{base}/hand_right_face.npy", FACE)
        springs = SPRINGS if controls == "hand" else SPRINGS[:3]
        attempt.save_tensors(
            f"{base}/model.safetensors",
            {
                "spring_nodes": springs,
                "stiffness": np.linspace(1e3, 1e4, len(springs), dtype=np.float32),
                "object_spring_count": np.array([2], np.int32),
            },
        )
        attempt.save_yaml("object/parameters.yaml", {"drag": 3.0, "label": "-cmd"})
        attempt.save_json("metrics.json", {"lift": {"future": {"track_error": 0.0125}}})
        attempt.finish_stage("first_order", {"before": 2.0, "after": 0.5})
        attempt.publish()
    return run


def read_edges(content: bytes) -> np.ndarray:
    """Read the edges of a PLY file by the PLY specification, as trimesh leaves them out."""
    header, body = content.split(b"end_header\n", 1)
    counts = {
        line.split()[1]: int(line.split()[2])
        for line in header.decode().splitlines()
        if line.startswith("element")
    }
    start = counts["vertex"] * 15 + counts["face"] * 13
    return np.frombuffer(body[start:], "<i4").reshape(counts["edge"], 2)


def load_mesh(path: Path) -> Any:
    import trimesh

    mesh = trimesh.load(path, process=False)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def test_a_frame_can_be_read_by_trimesh(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    path = export_run(run, "ply", tmp_path / "x" / "f.ply", frame=2)
    mesh = load_mesh(path)
    expected = np.concatenate(
        [
            run.array("sequences/lift/rollout.npy")[2],
            run.array("sequences/lift/hand_right_vertex.npy")[2],
        ]
    )
    np.testing.assert_array_equal(mesh.vertices.astype(np.float32), expected)
    np.testing.assert_array_equal(mesh.faces, FACE + NODES)
    colors = np.asarray(mesh.visual.vertex_colors)
    assert (colors[:NODES, 2] > colors[:NODES, 0]).all()  # Object nodes are blue, controls red.
    assert (colors[NODES:, 0] > colors[NODES:, 2]).all()
    assert read_edges(path.read_bytes()).tolist() == SPRINGS[2:].tolist()
    assert b"comment world z-up, lengths in m\n" in path.read_bytes()


@dataclass
class Triangle:
    """A surface that follows the first three nodes, and remembers where it was placed."""

    face = np.array([[0, 2, 1]], np.int32)
    color = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], np.uint8)
    seen: list[np.ndarray] = field(default_factory=list)

    def place(self, node: np.ndarray) -> np.ndarray:
        self.seen.append(node)
        return node[:3] + np.float32(0.5)


def test_a_surface_is_laid_for_formats_that_hold_it_and_placed_in_frames_that_are_written(
    tmp_path: Path,
) -> None:
    run, laid = make_run(tmp_path / "fit"), list[Triangle]()

    def lay() -> Triangle:
        laid.append(Triangle())
        return laid[-1]

    for name in ("npz", "csv", "yaml"):
        export_run(run, name, tmp_path / f"x.{name}", surface=lay)
    assert laid == []
    rollout = run.array("sequences/lift/rollout.npy")
    written: list[tuple[str, dict[str, Any], list[int]]] = [
        ("one.ply", {"format": "ply", "frame": 2}, [2]),
        ("all.zip", {"format": "ply"}, [0, 1, 2]),
        ("all.glb", {"format": "gltf"}, [0, 1, 2]),
    ]
    for name, options, frames in written:
        export_run(run, out_path=tmp_path / name, surface=lay, **options)
        np.testing.assert_array_equal(laid[-1].seen, rollout[frames])
    assert len(laid) == len(written)


@pytest.mark.parametrize("controls", ["hand", "sparse"])
def test_the_surface_of_the_object_comes_after_all_else(tmp_path: Path, controls: str) -> None:
    run = make_run(tmp_path / "fit", controls=controls)
    plain = load_mesh(export_run(run, "ply", tmp_path / "plain.ply", frame=2))
    path = export_run(run, "ply", tmp_path / "f.ply", frame=2, surface=Triangle)
    mesh, count = load_mesh(path), len(plain.vertices)
    np.testing.assert_array_equal(mesh.vertices[:count], plain.vertices)
    vertex = run.array("sequences/lift/rollout.npy")[2, :3] + np.float32(0.5)
    np.testing.assert_array_equal(mesh.vertices[count:], vertex)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[count:, :3], Triangle.color)
    np.testing.assert_array_equal(mesh.faces, [*plain.faces, [count, count + 2, count + 1]])


def test_hands_beside_sparse_controls_are_written_too(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit", controls="sparse")
    path = export_run(run, "ply", tmp_path / "f.ply", frame=0)
    mesh = load_mesh(path)
    assert len(mesh.vertices) == NODES + 2 + VERTICES
    np.testing.assert_array_equal(mesh.faces, FACE + NODES + 2)
    np.testing.assert_allclose(
        mesh.vertices[mesh.faces[1]], run.array("sequences/lift/hand_right_vertex.npy")[0][FACE[1]]
    )
    assert read_edges(path.read_bytes()).tolist() == [[NODES + 1, 0]]


def test_all_frames_go_to_a_folder(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    folder = export_run(run, "ply", tmp_path / "frames")
    names = [f"frame_{frame:05d}.ply" for frame in range(FRAMES)]
    assert sorted(path.name for path in folder.iterdir()) == names
    mesh = load_mesh(folder / names[1])
    np.testing.assert_allclose(mesh.vertices[0], run.array("sequences/lift/rollout.npy")[1, 0])
    one = export_run(run, "ply", tmp_path / "one", frame=1)
    assert (one / names[1]).read_bytes() == (folder / names[1]).read_bytes()


def test_all_frames_go_to_one_archive_that_is_the_same_every_time(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    folder = export_run(run, "ply", tmp_path / "frames")
    packed = export_run(run, "ply", tmp_path / "frames.zip")
    with zipfile.ZipFile(packed) as archive:
        assert archive.testzip() is None
        files = {name: archive.read(name) for name in archive.namelist()}
    assert files == {path.name: path.read_bytes() for path in folder.iterdir()}
    again = export_run(run, "ply", tmp_path / "again.zip")
    assert again.read_bytes() == packed.read_bytes()


def test_npz_can_be_read_without_pickle(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    path = export_run(run, "npz", tmp_path / "fit.npz")
    with np.load(path, allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["rollout"], run.array("sequences/lift/rollout.npy"))
        np.testing.assert_array_equal(archive["spring_nodes"], SPRINGS)
        np.testing.assert_array_equal(archive["hand_right_face"], FACE)
        assert archive["stiffness"][-1] == pytest.approx(1e4)
        assert str(archive["sequence"]) == "lift"
        assert float(archive["frame_rate"]) == 30.0


def test_csv_rows_bring_every_number_back(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    path = export_run(run, "csv", tmp_path / "fit.csv")
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == FRAMES * (NODES + VERTICES)
    nodes = [row for row in rows if row["kind"] == "object"]
    position = np.array([[row[axis] for axis in "xyz"] for row in nodes], np.float32)
    np.testing.assert_array_equal(
        position.reshape(FRAMES, NODES, 3), run.array("sequences/lift/rollout.npy")
    )
    assert (rows[-1]["frame"], rows[-1]["time_s"], rows[-1]["index"]) == ("2", "0.066667", "4")


def test_csv_of_a_run_without_an_object_holds_the_hands_joints(tmp_path: Path) -> None:
    joint = np.arange(2 * 21 * 3, dtype=np.float32).reshape(2, 21, 3)
    nothing = np.zeros((2, 0, 3), np.float32)
    scene = SceneData(
        sequence="wave",
        frame_rate=30.0,
        length_unit="board square",
        rollout=nothing,
        control=nothing,
        spring_nodes=np.zeros((0, 2), np.int32),
        object_spring_count=0,
        hands={},
        joints={"left": joint},
    )
    write_trajectories(tmp_path / "hand.csv", scene)
    lines = (tmp_path / "hand.csv").read_text().splitlines()
    assert len(lines) == 1 + 2 * 21
    assert lines[22] == "wave,1,0.033333,hand_left,0,63.0,64.0,65.0"


def test_csv_folder_holds_parameters_and_metrics(tmp_path: Path) -> None:
    folder = export_run(make_run(tmp_path / "fit"), "csv", tmp_path / "tables")
    assert (folder / "parameters.csv").read_text() == "name,value\ndrag,3.0\nlabel,'-cmd\n"
    assert (folder / "metrics.csv").read_text() == "name,value\nlift.future.track_error,0.0125\n"
    assert (folder / "trajectories.csv").is_file()


def test_yaml_holds_parameters_and_metrics(tmp_path: Path) -> None:
    path = export_run(make_run(tmp_path / "fit"), "yaml", tmp_path / "fit.yaml")
    content = yaml.safe_load(path.read_text())
    assert content["parameters"]["drag"] == 3.0
    assert content["metrics"]["lift"]["future"]["track_error"] == 0.0125
    assert content["losses"]["first_order"]["after"] == 0.5
    assert (content["name"], content["state"]) == ("=SUM(A1)", "succeeded")


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("=1+1", "'=1+1"),
        ("+cmd", "'+cmd"),
        ("-x", "'-x"),
        ("@SUM", "'@SUM"),
        ("\t=1", "'\t=1"),
        ("  =1", "'  =1"),
        (-1.5, -1.5),
        (None, ""),
        ("a=b", "a=b"),
    ],
)
def test_text_never_becomes_a_formula(value: Any, expected: Any) -> None:
    assert safe_cell(value) == expected


def test_csv_quotes_what_needs_quoting(tmp_path: Path) -> None:
    write_csv(tmp_path / "t.csv", ["a,b", "=c"], [['say "hi"\nnow', -2]])
    with (tmp_path / "t.csv").open(newline="") as stream:
        assert list(csv.reader(stream)) == [["a,b", "'=c"], ['say "hi"\nnow', "-2"]]


def test_nested_fields_become_rows() -> None:
    assert list(flat({"a": {"b": 1, "c": [1, 2]}, "d": None})) == [
        ("a.b", 1),
        ("a.c", "[1, 2]"),
        ("d", None),
    ]


def test_an_export_is_replaced_only_when_asked(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit")
    for format_, name in (("npz", "a.npz"), ("ply", "frames"), ("csv", "tables")):
        export_run(run, format_, tmp_path / name)
        with pytest.raises(UsageError, match="exists already"):
            export_run(run, format_, tmp_path / name)
        export_run(run, format_, tmp_path / name, overwrite=True)
    (tmp_path / "frames" / "precious.txt").write_text("data")
    with pytest.raises(UsageError, match="holds other things"):
        export_run(run, "ply", tmp_path / "frames", overwrite=True)
    with pytest.raises(UsageError, match="is a folder, which this export cannot replace"):
        export_run(run, "npz", tmp_path / "frames", overwrite=True)
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("format_", "options", "message"),
    [
        ("obj", {}, "'obj' is not a format; choose one of ply, npz, csv, yaml"),
        ("npz", {"frame": 1}, "single frame can be exported as ply only"),
        ("ply", {"frame": 3}, "has frames 0 to 2, not 3"),
        ("ply", {"frame": -1}, "has frames 0 to 2, not -1"),
        ("ply", {}, "is one file; name a folder"),
        ("ply", {"sequence": "walk"}, "has no sequence 'walk'. It has: lift, fold"),
    ],
)
def test_impossible_wishes_are_named(
    tmp_path: Path, format_: str, options: dict[str, Any], message: str
) -> None:
    run = make_run(tmp_path / "fit")
    with pytest.raises(UsageError, match=message.replace(".", r"\.")):
        export_run(run, format_, tmp_path / "x.ply", **options)
    assert not (tmp_path / "x.ply").exists()


def test_absent_motion_is_named(tmp_path: Path) -> None:
    run = make_run(tmp_path / "fit", has_motion=False)
    with pytest.raises(RunError, match="neither hands nor an object of sequence 'lift'"):
        export_run(run, "npz", tmp_path / "x.npz")
    with pytest.raises(RunError, match="has nothing of sequence 'fold'"):
        export_run(run, "npz", tmp_path / "x.npz", sequence="fold")
