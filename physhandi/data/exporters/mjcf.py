"""An object as a MuJoCo scene (MJCF): each node a body, each spring a tendon, hands as mocap.

A spatial tendon with stiffness Y/r, springlength r and damping c pulls exactly as a spring of the
model does: Y (L/r - 1) + c dL/dt. A flex has one stiffness for all of its edges, a fit one for each
spring.
"""

import io
from collections.abc import Iterator
from typing import Any
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import numpy as np
from numpy import ndarray

from physhandi.data.exporters.scene_data import SceneData
from physhandi.data.exporters.twin import SLIPPED, Twin

_SMALLEST_BALL = 1e-3
"""Radius of a node that touches the ground with itself [m]."""

_PLAY = (
    '''\
"""Simulates scene.xml along the hand's motion and compares it with PhysHanDI's own rollout.

pip install mujoco numpy; python play.py. In other programs: ``for position in play(): ...``
"""

import sys
from pathlib import Path

import mujoco
import numpy as np


'''
    + SLIPPED
    + '''


def play(folder=Path(__file__).parent):
    """Yield the object's nodes (node 3) [m] of frame after frame."""
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    motion = dict(np.load(folder / "motion.npz"))  # Else each use reads the file.
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    node, control = motion["node"], motion["control"]
    moved = data.qpos.reshape(-1, 3)
    stiffness, damping = motion["stiffness"], motion["damping"]
    yield node + moved
    for frame in range(1, len(control)):
        before = control[frame - 1]
        if frame == motion["restart_frame"] + 1:  # Prediction starts from an observed state.
            moved[:] = motion["restart_position"] - node
            data.qvel[:] = motion["restart_velocity"].ravel()
            rest, stiffness = motion["restart_rest_length"], motion["restart_stiffness"]
            model.tendon_lengthspring[:] = rest[:, None]
            model.geom_pos[1:, 2] = motion["restart_ball_height"]
            model.geom_friction[:, 0] *= motion["friction_share"]
            before = motion["restart_control"]
        acts = (motion["spring_first"] < frame) & (frame <= motion["spring_last"])
        model.tendon_stiffness[:] = acts * stiffness
        model.tendon_damping[:] = acts * damping
        for step in range(int(motion["substeps"])):
            part = step / motion["substeps"]
            data.mocap_pos[:] = (1 - part) * before + part * control[frame]
            mujoco.mj_step(model, data)
        if frame > motion["restart_frame"]:
            data.mocap_pos[:] = control[frame]
            mujoco.mj_fwdPosition(model, data)
            rest, stiffness = slipped(rest, stiffness, data.ten_length, acts, motion)
            model.tendon_lengthspring[:] = rest[:, None]
        # What the fit had missed, by which nodes were seen beside where springs have them.
        yield node + moved + (frame > motion["restart_frame"]) * motion["restart_node_shift"]


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    rollout = np.load(folder / "motion.npz")["rollout"]
    for frame, position in enumerate(play(folder)):
        distance = np.linalg.norm(position - rollout[frame], axis=-1).mean()
        travel = np.linalg.norm(rollout[frame] - rollout[0], axis=-1).mean()
        print(f"frame {frame}: moved by {1e3 * travel:.1f} mm, {1e3 * distance:.1f} mm from ours")
'''
)


def mjcf_files(scene: SceneData) -> Iterator[tuple[str, bytes]]:
    """Write the object, the ground and what holds the object as a MuJoCo scene that moves.

    Masses, stiffness and damping are those of an object of `scene.mass`, which moves as the model
    does; each node weighs 1 kg if nobody knows. Nodes touch the ground, not each other.

    Args:
        scene: The motion, with the parameters that it was simulated with.

    Yields:
        Names and contents: ``scene.xml``; ``motion.npz``, the hand's motion, when springs hold, and
        our rollout; ``play.py``, which simulates the one along the other.

    Raises:
        UsageError: If there is no object to simulate, or it bends as an elastic rod.
    """
    twin = Twin(scene, "MuJoCo")
    yield "scene.xml", _scene_xml(twin, scene).encode()
    content = io.BytesIO()
    arrays: dict[str, Any] = twin.motion()
    if "restart_clearance" in arrays:
        arrays["restart_ball_height"] = _ball(twin, arrays.pop("restart_clearance"))[1]
    np.savez_compressed(content, allow_pickle=False, **arrays)
    yield "motion.npz", content.getvalue()
    yield "play.py", _PLAY.encode()


def _ball(twin: Twin, clearance: ndarray) -> tuple[ndarray, ndarray]:
    """Give the balls of nodes that touch the ground at their clearances.

    Returns:
        Radii, which stay what they are at frame 0, and heights of the middles above the nodes
        [m].
    """
    radius = np.maximum(twin.clearance, _SMALLEST_BALL)
    return radius, radius - clearance


def _scene_xml(twin: Twin, scene: SceneData) -> str:
    parameters = twin.parameters
    root = Element("mujoco", model=scene.sequence or "object")
    root.append(Comment(f" {twin.about} "))
    # Nodes may be lighter than what MuJoCo takes for the least sensible mass.
    SubElement(root, "compiler", boundmass="0", boundinertia="0")
    gravity = f"0 0 {-parameters['gravity']:.9g}"
    SubElement(root, "option", timestep=_number(scene.dt), gravity=gravity)
    default = SubElement(root, "default")
    friction = f"{parameters['friction']:.9g} 0.005 0.0001"
    SubElement(default, "geom", contype="0", conaffinity="1", mass="0", friction=friction)
    world = SubElement(root, "worldbody")
    _add_ground(world, parameters["ground_height"])
    _add_bodies(world, twin)
    _add_tendons(SubElement(root, "tendon"), twin)
    SubElement(SubElement(root, "keyframe"), "key", name="start", qvel=_numbers(twin.velocity))
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def _add_ground(world: Element, height: float | None) -> None:
    if height is not None:
        place = _numbers([0.0, 0.0, height])
        SubElement(
            world,
            "geom",
            name="ground",
            type="plane",
            size="1 1 0.01",
            pos=place,
            contype="1",
            conaffinity="0",
        )


def _add_bodies(world: Element, twin: Twin) -> None:
    drag = _number(twin.mass * twin.parameters["drag"])
    radius, height = _ball(twin, twin.clearance)
    for index, place in enumerate(twin.node):
        body = SubElement(world, "body", name=f"node{index}", pos=_numbers(place))
        inertia = _numbers(np.full(3, twin.mass))
        SubElement(body, "inertial", pos="0 0 0", mass=_number(twin.mass), diaginertia=inertia)
        for axis in ("1 0 0", "0 1 0", "0 0 1"):
            SubElement(body, "joint", type="slide", axis=axis, damping=drag)
        middle = _numbers([0.0, 0.0, height[index]])
        SubElement(body, "geom", type="sphere", size=_number(float(radius[index])), pos=middle)
        SubElement(body, "site", name=f"end{index}")
    for index, place in enumerate(twin.control[0]):
        name = f"hand{index}"
        body = SubElement(world, "body", name=name, mocap="true", pos=_numbers(place))
        SubElement(body, "site", name=f"end{len(twin.node) + index}", rgba="1 0 0 1")


def _add_tendons(tendons: Element, twin: Twin) -> None:
    columns = (twin.stiffness, twin.damping, twin.rest_length)
    for ends, *values in zip(twin.ends, *columns, strict=True):
        stiffness, damping, length = (_number(float(value)) for value in values)
        tendon = SubElement(
            tendons,
            "spatial",
            width="0.0003",
            stiffness=stiffness,
            damping=damping,
            springlength=length,
        )
        for end in ends:
            SubElement(tendon, "site", site=f"end{end}")


def _number(value: float) -> str:
    return f"{value:.9g}"


def _numbers(values: Any) -> str:
    return " ".join(_number(float(value)) for value in np.ravel(values))
