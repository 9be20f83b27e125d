"""What nobody touches stays where it was seen: whole fits of bodies that lie on the ground."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import physhandi as ph
from physhandi.data.sequence_meta import SequenceMeta, ShapeClass
from physhandi.data.sequence_writer import write_sequence
from physhandi.fitting.artefacts import load_shape
from physhandi.fitting.config import load_profile
from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.simulator import Simulator
from physhandi.simulation.topology import build_model
from physhandi.synthetic.bodies.bodies import BodyName, make_body
from physhandi.triangles import sample_surface

FRAMES, FITTED = 7, 4
STILL, FALLING = 60, 20
"""Frames that an object must lie still, two seconds, and in which one must fall that can."""


def write_lying(
    folder: Path, name: BodyName, kind: ShapeClass | None, lowest_normal: float
) -> ph.Sequence:
    """Record what is seen of a body: where its normal is not more downward than a limit.

    A point comes near at last: hands that are never near an object are refused, and one that is
    there for less than `contact_detection.SHORTEST` holds nothing.
    """
    body = make_body(name, np.random.default_rng(5), resolution="tiny")
    surface = sample_surface(body.skin(body.node[None])[0], body.faces, 1500)
    seen = surface.point[surface.normal[:, 2] > lowest_normal]
    seen = seen + np.random.default_rng(0).normal(0.0, 2e-4, seen.shape)
    seen[:, 2] = np.maximum(seen[:, 2], 1e-4)
    control = np.full((FRAMES, 1, 3), 0.5)
    control[FITTED - 1 :] = seen[np.argmax(seen[:, 2])] + [0.0, 0.0, 0.004]
    is_valid = np.repeat((np.arange(FRAMES) > 0)[:, None], len(seen), axis=1)
    return write_sequence(
        folder,
        SequenceMeta(
            name=folder.name,
            frame_rate=30.0,
            frame_count=FRAMES,
            ground_height=0.0,
            reconstruction=FITTED,
            shape=kind,
        ),
        {
            "control.npy": control.astype(np.float32),
            "marker.npy": np.repeat(seen[None], FRAMES, axis=0).astype(np.float32),
            "marker_motion_valid.npy": is_valid,
        },
    )


def moved(
    model: SpringMassModel,
    parameters: SimulationParameters,
    control: np.ndarray,
    frames: int = STILL,
) -> float:
    """Farthest that a node comes from where it was seen in so many frames [m]."""
    path = np.repeat(control[None], frames + 1, axis=0)
    position = Simulator(model, parameters).rollout(path).position
    return float(np.linalg.norm(position - model.object_node, axis=2).max())


ABOVE, EVERYWHERE = -0.1, -2.0
WHOLE = {"simulation.connection_radius": 0.06, "simulation.max_neighbors": 80}
"""Springs of a shell that reach its other side; it collapses with shorter ones."""


@pytest.mark.parametrize(
    ("name", "kind", "seen", "changes", "falls", "sags"),
    [
        # Springs do not matter to what lies on the ground everywhere.
        ("rope", "rope", ABOVE, {"node_spacing": 0.014}, 5e-3, 0.0),
        ("rope", "rope", ABOVE, {"node_spacing": 0.0075}, 5e-3, 0.0),
        ("pouch", "solid", ABOVE, {"node_spacing": 0.014}, 2e-3, 1e-4),
        ("pouch", "shell", EVERYWHERE, {"node_spacing": 0.014} | WHOLE, 2e-3, 5e-5),
        ("plush", "solid", ABOVE, {"node_spacing": 0.02}, 2e-3, 5e-4),
    ],
    ids=["rope", "dense rope", "pouch", "shell", "plush"],
)
def test_a_body_lies_still_for_two_seconds(
    tmp_path: Path,
    name: BodyName,
    kind: ShapeClass,
    seen: float,
    changes: dict[str, float],
    falls: float,
    sags: float,
) -> None:
    changes = changes | {
        "simulation.stiffness": 2000.0,
        "object_.search.generations": 0,
        "object_.first_order.iterations": 0,
        "refinement.iterations": 0,
    }
    # A thousand points of a plush toy are too few to tell it from a sheet.
    told = kind if kind == "shell" or name == "plush" else None
    recording = write_lying(tmp_path / name, name, told, seen)
    run = ph.reconstruct(
        recording, profile=load_profile("quick"), overrides=changes, out=tmp_path / "fit"
    )
    assert load_shape(run.out)[0] == kind
    fitted = run.object
    model, parameters, control = fitted.model, fitted.parameters, fitted.fitted.control[0]
    assert model.virtual_spring_count == 0
    # Half a millimetre is promised; a stiff body sinks by less than that without being held.
    assert moved(model, parameters, control) < 1e-4
    # Springs as long as the distances of their nodes, above the bare ground; and with clearances.
    bare = build_model(model.object_node, control, parameters)
    assert moved(bare, parameters, control, FALLING) > falls
    clear = replace(bare, clearance=model.clearance)
    assert moved(clear, parameters, control, FALLING) >= sags
