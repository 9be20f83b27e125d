"""A mesh of the whole object: laid onto what half of it shows, colored, and given nodes."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from support.inputs.half_seen_body import (
    EYES,
    TURN,
    UNIT,
    body,
    colors,
    mesh_in_its_own_axes,
    write_half_seen,
    write_mesh,
)

from physhandi.data.sequence import Sequence
from physhandi.errors import FitError, MissingInputError, SequenceError, UsageError
from physhandi.perception.lifting import observe_object
from physhandi.perception.mesh_completion import RoughPose, complete_shape
from physhandi.perception.shape import object_shape, shape_of_observation
from physhandi.triangles import sample_surface

SPACING = 0.012


@pytest.fixture(scope="module")
def half_seen(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    return write_half_seen(tmp_path_factory.mktemp("half") / "half_seen")


@pytest.fixture(scope="module")
def completed(half_seen: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    folder = tmp_path_factory.mktemp("whole") / "completed"
    shutil.copytree(half_seen.folder, folder)
    found = complete_shape(folder, write_mesh(folder.parent / "body.glb", *body()))
    assert found.scale == pytest.approx(UNIT, rel=0.01)
    assert np.rad2deg((Rotation.from_matrix(found.rotation) * TURN).magnitude()) < 1.0
    assert found.coverage > 0.97
    assert found.residual < 0.002
    return Sequence.load(folder)


@pytest.fixture
def folder(half_seen: Sequence, tmp_path: Path) -> Path:
    return Path(shutil.copytree(half_seen.folder, tmp_path / "copy"))


def about_right() -> RoughPose:
    """The true rotation, wrong by 15 degrees."""
    return RoughPose(Rotation.from_rotvec(np.deg2rad([10.0, -8.0, 8.0])) * TURN.inv())


def test_half_a_body_tells_where_all_of_it_is(completed: Sequence) -> None:
    completed.validate()
    assert completed.mesh is not None
    vertex, faces = completed.mesh
    truth = body()[0]
    assert len(faces) == len(body()[1])
    distance = KDTree(truth).query(vertex)[0]
    assert distance.mean() < 0.002
    assert distance.max() < 0.004
    about = completed.provenance["mesh"]
    assert about["source"] == "body.glb"
    assert len(about["sha256"]) == 64
    assert about["outside"] < 0.02


def test_its_corners_get_the_colors_that_views_see(completed: Sequence) -> None:
    assert completed.mesh is not None
    assert completed.mesh_color is not None
    vertex, _ = completed.mesh
    truth, _ = body()
    true_color = colors(truth)[KDTree(truth).query(vertex)[1]]
    towards = np.array(EYES).mean(axis=0) - vertex
    normal = trimesh.Trimesh(*completed.mesh, process=False).vertex_normals
    is_seen = (towards * normal).sum(axis=1) > 0.8 * np.linalg.norm(towards, axis=1)
    error = np.abs(completed.mesh_color.astype(float) - true_color)
    assert is_seen.sum() > 50
    assert np.median(error[is_seen]) < 8
    assert completed.mesh_color[~is_seen].std() > 10


def test_what_no_view_sees_gets_nodes(half_seen: Sequence, completed: Sequence) -> None:
    before, after = (
        shape_of_observation(observe_object(sequence), SPACING, sequence)
        for sequence in (half_seen, completed)
    )
    surface = sample_surface(*body(), 6000)
    is_back = surface.normal[:, 1] > 0.3
    reach = [KDTree(shape.node).query(surface.point[is_back])[0] for shape in (before, after)]
    assert np.percentile(reach[0], 90) > 2 * SPACING
    assert np.percentile(reach[1], 99) < 1.3 * SPACING
    for shape in (before, after):
        assert shape.kind == "solid"
    is_out = np.abs(surface.winding_number(after.node.astype(float))) < 0.5
    away = KDTree(surface.point).query(after.node)[0]
    assert (away[is_out] < 0.006).all()
    inside = away > SPACING
    assert inside.sum() > 20
    assert KDTree(after.node).query(after.node, k=2)[0][:, 1].min() > 0.2 * SPACING


def test_a_body_in_the_air_is_solid_because_its_mesh_is(completed: Sequence) -> None:
    cloud = observe_object(completed).cloud[0]
    assert object_shape(cloud, SPACING).kind == "sheet"
    shape = object_shape(cloud, SPACING, mesh=completed.mesh)
    assert shape.kind == "solid"
    assert "mesh encloses" in shape.reason
    given = object_shape(cloud, SPACING, mesh=completed.mesh, kind="shell")
    away = KDTree(sample_surface(*body(), 6000).point).query(given.node)[0]
    assert away.max() < 0.006
    assert len(given.node) < len(shape.node)


def test_a_rough_pose_and_a_size_are_taken(folder: Path) -> None:
    path = write_mesh(folder.parent / "body.ply", *body())
    found = complete_shape(folder, path, scale=UNIT, pose=about_right())
    assert found.scale == UNIT
    assert np.rad2deg((Rotation.from_matrix(found.rotation) * TURN).magnitude()) < 1.0
    vertex = found.apply(mesh_in_its_own_axes(body()[0]))
    assert np.linalg.norm(vertex - body()[0], axis=1).max() < 0.004


def test_a_mesh_of_something_else_is_refused(folder: Path) -> None:
    box = trimesh.creation.box((0.2, 0.15, 0.1))
    path = write_mesh(folder.parent / "box.obj", np.asarray(box.vertices), np.asarray(box.faces))
    before = sorted(folder.iterdir())
    with pytest.raises(FitError, match=r"'half_seen', mesh .*box\.obj: .*does not fit.*--pose"):
        complete_shape(folder, path, pose=about_right())
    with pytest.raises(FitError, match="of its surface are where views see nothing"):
        complete_shape(
            folder,
            write_mesh(folder.parent / "body.ply", *body()),
            scale=2.5 * UNIT,
            pose=about_right(),
        )
    assert sorted(folder.iterdir()) == before
    assert Sequence.load(folder).mesh is None


def test_what_cannot_be_used_is_named(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "body.stp"
    for name, content, told in (
        ("body.stp", b"", "only .glb, .gltf, .ply"),
        ("body.glb", b"glTF nothing", "cannot be read"),
        ("body.obj", b"v 0 0 0\nv 0 0 1\nv 0 1 0\n", "export"),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(UsageError, match=told) as error:
            complete_shape(folder, path)
        assert name in str(error.value)
    with pytest.raises(UsageError, match="is not there"):
        complete_shape(folder, tmp_path / "none.ply")
    with pytest.raises(UsageError, match="makes no sense"):
        complete_shape(folder, path, scale=0.0)
    for pose in ("1,2", "a,b,c", "0,0,nan"):
        with pytest.raises(UsageError, match="three turns in degrees"):
            RoughPose.parse(pose)
    assert RoughPose.parse("90,0,0,1,2,3").middle == pytest.approx([1, 2, 3])
    assert RoughPose.parse("0,90,90").rotation.apply([1, 0, 0]) == pytest.approx([0, 0, -1])
    shutil.rmtree(folder / "views/v0/mask")
    shutil.rmtree(folder / "views/v1/mask")
    with pytest.raises(MissingInputError, match="physhandi annotate"):
        complete_shape(folder, path)


def test_half_a_mesh_is_no_sequence(folder: Path) -> None:
    vertex, faces = body()
    np.save(folder / "mesh_vertex.npy", vertex.astype(np.float32))
    with pytest.raises(SequenceError, match=r"mesh_face\.npy is missing"):
        Sequence.load(folder)
    np.save(folder / "mesh_face.npy", faces + 1)
    with pytest.raises(SequenceError, match=r"mesh_face\.npy names corners 1 to"):
        Sequence.load(folder)
    np.save(folder / "mesh_face.npy", faces)
    Sequence.load(folder).validate()
    np.save(folder / "mesh_color.npy", np.zeros((5, 3), np.uint8))
    with pytest.raises(SequenceError, match=r"mesh_color\.npy has shape"):
        Sequence.load(folder)
