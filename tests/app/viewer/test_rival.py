import numpy as np
import pytest
import trimesh
from numpy import ndarray
from support.viewer.viewer_world import FRAMES, PARAMETERS, Recording, content_of, controls

from app.viewer.compare.phystwin_baseline import PhysTwinBaseline
from app.viewer.content.content import Content
from physhandi.run import Run


def ball(center: tuple[float, float, float], subdivisions: int = 3) -> tuple[ndarray, ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.03)
    return np.asarray(mesh.vertices + center, np.float32), np.asarray(mesh.faces, np.int32)


def rival_of(content: Content) -> PhysTwinBaseline:
    assert content.fitted is not None
    return PhysTwinBaseline.of(content, content.fitted)


def test_thirty_points_are_picked_among_those_that_a_camera_sees(recording: Recording) -> None:
    right, left = ball((0.0, 0.0, 0.08)), ball((0.1, 0.05, 0.08), subdivisions=2)
    # The recording may name the left hand first: the control nodes tell.
    vertex = np.concatenate([left[0], right[0]])
    control = np.repeat(vertex[None], 3, axis=0)
    views = recording.sequence.views[:1]
    eye = np.array([0.5, 0.1, 0.3])
    content = content_of({"right": right, "left": left}, control, views)
    rival = rival_of(content)
    centers = np.repeat(
        [[0.1, 0.05, 0.08], [0.0, 0.0, 0.08]], [len(left[0]), len(right[0])], axis=0
    )
    facing = ((eye - vertex) * (vertex - centers)).sum(axis=1)
    assert (facing[rival.controls] > -1e-4).all()
    assert (facing < -1e-4).sum() > 100
    assert len(rival.controls) == len(set(rival.controls.tolist())) == 30
    assert rival.source == "30 visible hand points"
    assert rival.note == ""
    # Each point is the farthest from those before it, of all that could have been taken.
    chosen = vertex[rival.controls]
    seen = vertex[facing > 1e-4]
    for count in range(1, 30):
        reach = np.linalg.norm(seen[:, None] - chosen[None, :count], axis=2).min(axis=1).max()
        own = np.linalg.norm(chosen[:count] - chosen[count], axis=1).min()
        assert own >= reach - 1e-6


def test_only_the_way_of_holding_differs_from_the_fit() -> None:
    rival = rival_of(content_of({}, controls((0.0, 0.0, 1.0))))
    values = rival.parameters
    assert (values.virtual_connection_radius, values.virtual_max_neighbors) == (0.04, 50)
    assert (values.use_control_velocity, values.virtual_stiffness) == (False, 500.0)
    assert PARAMETERS.virtual_stiffness == 800.0
    back = values.replace(
        virtual_connection_radius=PARAMETERS.virtual_connection_radius,
        virtual_max_neighbors=PARAMETERS.virtual_max_neighbors,
        virtual_stiffness=PARAMETERS.virtual_stiffness,
        virtual_rest_length_floor=PARAMETERS.virtual_rest_length_floor,
        use_control_velocity=True,
    )
    assert back == PARAMETERS


def test_a_run_of_thirty_points_says_that_both_sides_use_them(run: Run) -> None:
    content = content_of({}, run.array("sequences/lift/control.npy"))
    rival = rival_of(content)
    assert sorted(rival.controls) == list(range(30))
    assert rival.note == "This run moves its object by 30 points already; both sides use them."
    assert rival.source == "30 control points"


def test_of_more_points_thirty_are_used() -> None:
    control = np.repeat(controls((0.0, 0.0, 1.0)), 2, axis=1)
    control[:, 30:, 0] += 0.01
    rival = rival_of(content_of({}, control))
    assert len(set(rival.controls.tolist())) == 30
    assert rival.note == "This run moves its object by recorded points; some of them are used."


@pytest.mark.parametrize(("has_face", "missing"), [(True, "cameras"), (False, "hand surface")])
def test_it_is_said_if_nobody_knows_what_a_camera_saw(
    recording: Recording, has_face: bool, missing: str
) -> None:
    vertex, face = ball((0.0, 0.0, 0.08))
    control = np.repeat(vertex[None], FRAMES, axis=0)
    views = [] if has_face else recording.sequence.views
    rival = rival_of(content_of({"right": (vertex, face if has_face else None)}, control, views))
    assert rival.note == f"Seen or not: the run's {missing} is not known."
    assert len(rival.controls) == 30
