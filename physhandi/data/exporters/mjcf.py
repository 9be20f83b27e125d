"""An object as a MuJoCo scene (MJCF): each node a body, each spring a tendon, hands as mocap.

A spatial tendon with stiffness Y/r, springlength r and damping c pulls exactly as a spring of the
model does: Y (L/r - 1) + c dL/dt. A flex has one stiffness for all of its edges, a fit one for each
spring.
"""

import io
from collections.abc import Iterator, Mapping
from typing import Any
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.exporters.scene_data import SceneData
from physhandi.errors import UsageError

_SMALLEST_BALL = 1e-3
"""Radius of a node that touches the ground with itself [m]."""

_PLAY = '''\
"""Simulates scene.xml along the hand's motion and compares it with PhysHanDI's own rollout.

pip install mujoco numpy; python play.py. In other programs: ``for position in play(): ...``
"""

import sys
from pathlib import Path

import mujoco
import numpy as np


def play(folder=Path(__file__).parent):
    """Yield the object's nodes (node 3) [m] of frame after frame."""
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    motion = np.load(folder / "motion.npz")
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
            model.tendon_lengthspring[:] = motion["restart_rest_length"][:, None]
            stiffness = motion["restart_stiffness"]
            model.geom_pos[1:, 2] = motion["restart_ball_height"]
            before = motion["restart_control"]
        acts = (motion["spring_first"] < frame) & (frame <= motion["spring_last"])
        model.tendon_stiffness[:] = acts * stiffness
        model.tendon_damping[:] = acts * damping
        for step in range(int(motion["substeps"])):
            part = step / motion["substeps"]
            data.mocap_pos[:] = (1 - part) * before + part * control[frame]
            mujoco.mj_step(model, data)
        yield node + moved


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    rollout = np.load(folder / "motion.npz")["rollout"]
    for frame, position in enumerate(play(folder)):
        distance = np.linalg.norm(position - rollout[frame], axis=-1).mean()
        travel = np.linalg.norm(rollout[frame] - rollout[0], axis=-1).mean()
        print(f"frame {frame}: moved by {1e3 * travel:.1f} mm, {1e3 * distance:.1f} mm from ours")
'''


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
    if "rod_node" in scene.model:
        raise UsageError(
            f"The rope of sequence '{scene.sequence}' bends as an elastic rod, which tendons of a "
            "MuJoCo scene do not. Export its motion (gltf, usd, npz), or fit it with springs "
            "alone (object_.bends_ropes: false)."
        )
    if not scene.model or not scene.parameters:
        raise UsageError(f"Sequence '{scene.sequence}' has no object that MuJoCo could simulate.")
    twin = _Twin(scene)
    yield "scene.xml", twin.xml().encode()
    content = io.BytesIO()
    arrays: dict[str, Any] = twin.motion()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    yield "motion.npz", content.getvalue()
    yield "play.py", _PLAY.encode()


class _Twin:
    """The arrays of a scene in the order and the units of MuJoCo."""

    def __init__(self, scene: SceneData) -> None:
        self._scene, self._model = scene, scene.model
        self._parameters: Mapping[str, Any] = scene.parameters
        self._node = np.asarray(scene.model["object_node"], np.float64)
        count = len(self._node)
        self._factor = 1.0 if scene.mass is None else scene.mass.force_factor(count)
        springs = np.sort(scene.spring_nodes, axis=1)
        self._object_springs = scene.object_spring_count
        # Of a hand's many vertices few hold anything.
        self._held, place = np.unique(
            springs[self._object_springs :, 1] - count, return_inverse=True
        )
        self._ends = springs.copy()
        self._ends[self._object_springs :, 1] = count + place

    def _stiffness(self, rest_length: Float[ndarray, " spring"]) -> Float[ndarray, " spring"]:
        """Stiffness of the tendons [N/m]."""
        force = self._parameters["stiffness_scale"] * self._model["stiffness"].astype(np.float64)
        return self._factor * force / rest_length

    def _ball(self, clearance: ndarray) -> tuple[ndarray, ndarray]:
        """Give the balls of nodes that touch the ground at their clearances.

        Returns:
            Radii, which stay what they are at frame 0, and heights of the middles above the nodes
            [m].
        """
        radius = np.maximum(self._model["clearance"].astype(np.float64), _SMALLEST_BALL)
        return radius, radius - clearance.astype(np.float64)

    def xml(self) -> str:
        """Write the scene."""
        parameters = self._parameters
        root = Element("mujoco", model=self._scene.sequence or "object")
        root.append(Comment(self._about()))
        # Nodes may be lighter than what MuJoCo takes for the least sensible mass.
        SubElement(root, "compiler", boundmass="0", boundinertia="0")
        gravity = f"0 0 {-parameters['gravity']:.9g}"
        SubElement(root, "option", timestep=_number(self._scene.dt), gravity=gravity)
        default = SubElement(root, "default")
        friction = f"{parameters['friction']:.9g} 0.005 0.0001"
        SubElement(default, "geom", contype="0", conaffinity="1", mass="0", friction=friction)
        world = SubElement(root, "worldbody")
        self._add_ground(world)
        self._add_bodies(world)
        self._add_tendons(SubElement(root, "tendon"))
        start = self._model["initial_velocity"].astype(np.float64)
        SubElement(SubElement(root, "keyframe"), "key", name="start", qvel=_numbers(start))
        indent(root)
        return tostring(root, encoding="unicode") + "\n"

    def _about(self) -> str:
        mass, scene = self._scene.mass, self._scene
        weight = (
            "nobody knows what the object weighs, so each node weighs 1 kg, as in the model"
            if mass is None
            else f"the object weighs {mass.text} ({mass.source}), so masses, stiffness and damping "
            f"are those of the model times {self._factor:.6g}"
        )
        run = f" of run {scene.run}" if scene.run else ""
        return f" Sequence {scene.sequence}{run}, in metres, z up: {weight}. "

    def _add_ground(self, world: Element) -> None:
        height = self._parameters["ground_height"]
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

    def _add_bodies(self, world: Element) -> None:
        drag = _number(self._factor * self._parameters["drag"])
        radius, height = self._ball(self._model["clearance"])
        for index, place in enumerate(self._node):
            body = SubElement(world, "body", name=f"node{index}", pos=_numbers(place))
            inertia = _numbers(np.full(3, self._factor))
            SubElement(
                body, "inertial", pos="0 0 0", mass=_number(self._factor), diaginertia=inertia
            )
            for axis in ("1 0 0", "0 1 0", "0 0 1"):
                SubElement(body, "joint", type="slide", axis=axis, damping=drag)
            middle = _numbers([0.0, 0.0, height[index]])
            SubElement(body, "geom", type="sphere", size=_number(float(radius[index])), pos=middle)
            SubElement(body, "site", name=f"end{index}")
        for index, place in enumerate(self._scene.control[0][self._held]):
            name = f"hand{index}"
            body = SubElement(world, "body", name=name, mocap="true", pos=_numbers(place))
            SubElement(body, "site", name=f"end{len(self._node) + index}", rgba="1 0 0 1")

    def _add_tendons(self, tendons: Element) -> None:
        rest = self._model["rest_length"].astype(np.float64)
        columns = (self._stiffness(rest), self._factor * self._model["damping"], rest)
        for ends, *values in zip(self._ends, *columns, strict=True):
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

    def motion(self) -> dict[str, ndarray]:
        """Collect what changes over time: control nodes, springs that hold, and the restart."""
        scene, model = self._scene, self._model
        rest = model["rest_length"].astype(np.float64)
        # Springs of the object act in every frame.
        first = np.full(len(rest), -1)
        last = np.full(len(rest), scene.frame_count)
        first[self._object_springs :], last[self._object_springs :] = model["attached"].T
        control = scene.control[:, self._held].astype(np.float64)
        arrays = {
            "node": self._node,
            "control": control,
            "spring_first": first,
            "spring_last": last,
            "stiffness": self._stiffness(rest),
            "damping": self._factor * model["damping"].astype(np.float64),
            "substeps": np.array(self._parameters["substeps_per_frame"]),
            "frame_rate": np.array(scene.frame_rate),
            "rollout": np.asarray(scene.rollout, np.float32),
            "restart_frame": np.array(scene.frame_count),
        }
        if "restart_rest_length" not in model:
            return arrays
        frame = int(model["restart_frame"][0])
        shift = model.get("restart_hand_shift", np.zeros((1, 3)))
        after = model["restart_rest_length"].astype(np.float64)
        held = (scene.control + shift)[:, self._held].astype(np.float64)
        control[frame + 1 :] = held[frame + 1 :]
        return arrays | {
            "restart_frame": np.array(frame),
            "restart_control": held[frame],
            "restart_position": model["restart_position"].astype(np.float64),
            "restart_velocity": model["restart_velocity"].astype(np.float64),
            "restart_rest_length": after,
            "restart_stiffness": self._stiffness(after),
            "restart_ball_height": self._ball(model["restart_clearance"])[1],
        }


def _number(value: float) -> str:
    return f"{value:.9g}"


def _numbers(values: Any) -> str:
    return " ".join(_number(float(value)) for value in np.ravel(values))
