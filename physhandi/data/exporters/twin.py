"""An object as another physics engine needs it: in units of its own mass, held by what holds it.

In the model each node weighs 1 kg; a twin weighs what the object weighs, and moves alike, since
masses, stiffness, damping and drag are all scaled by the same factor.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from physhandi.data.exporters.scene_data import SceneData
from physhandi.errors import UsageError

SLIPPED = '''def slipped(rest, stiffness, length, holds, motion):
    """Let springs slip that are pulled or pressed harder than they hold: they go on with that."""
    force = stiffness * rest  # For a strain of 1.
    strain, strength = length / rest - 1, motion["grip_strength"]
    slips = holds & (force * np.abs(strain) > strength)
    borne = np.divide(strength, force, out=np.zeros_like(rest), where=slips) * np.sign(strain)
    after = np.maximum(length / (1 + borne), motion["shortest_rest_length"])
    rest = np.where(slips, after, rest)
    return rest, force / rest'''
"""Source of what `Restart.slipped` computes, for the programs that play a twin."""


class Twin:
    """Nodes, springs and control nodes of a scene, and what changes of them over time."""

    node: Float[ndarray, "node 3"]
    """Nodes in frame 0 [m]."""
    velocity: Float[ndarray, "node 3"]
    """Their velocities in frame 0 [m/s]."""
    mass: float
    """Mass of each node [kg]: the factor on masses, stiffness, damping and drag of the model."""
    ends: Int[ndarray, "spring 2"]
    """The two ends of each spring: nodes, and after them the control nodes that hold something."""
    rest_length: Float[ndarray, " spring"]
    """Length at which a spring pulls with no force, until a restart [m]."""
    stiffness: Float[ndarray, " spring"]
    """Stiffness, until a restart [N/m]."""
    damping: Float[ndarray, " spring"]
    """Dashpot along the spring [N·s/m]."""
    held: Int[ndarray, " held"]
    """Which control nodes hold something: few of a hand's many vertices."""
    clearance: Float[ndarray, " node"]
    """Height above the ground at which each node touches it, until a restart [m]."""
    parameters: Mapping[str, Any]
    """Simulation parameters of the object by name."""

    def __init__(self, scene: SceneData, program: str) -> None:
        """Collect what a scene has.

        Args:
            scene: The motion, with the parameters that it was simulated with.
            program: Name of the other engine, for errors.

        Raises:
            UsageError: If there is no object to simulate, or it bends as an elastic rod.
        """
        model = scene.model
        if "rod_node" in model:
            raise UsageError(
                f"The rope of sequence '{scene.sequence}' bends as an elastic rod, which springs "
                f"of {program} do not. Export its motion (gltf, usd, npz), or fit it with springs "
                "alone (object_.bends_ropes: false)."
            )
        if not model or not scene.parameters:
            raise UsageError(
                f"Sequence '{scene.sequence}' has no object that {program} could simulate."
            )
        self._scene, self._model = scene, model
        self.parameters = scene.parameters
        self.node = np.asarray(model["object_node"], np.float64)
        self.velocity = model["initial_velocity"].astype(np.float64)
        self.clearance = model["clearance"].astype(np.float64)
        count = len(self.node)
        self.mass = 1.0 if scene.mass is None else scene.mass.force_factor(count)
        self.ends = np.sort(scene.spring_nodes, axis=1)
        virtual = self.ends[scene.object_spring_count :, 1]
        self.held, place = np.unique(virtual - count, return_inverse=True)
        virtual[:] = count + place
        self.rest_length = model["rest_length"].astype(np.float64)
        self.stiffness = self._stiffness(self.rest_length)
        self.damping = self.mass * model["damping"].astype(np.float64)

    def _stiffness(self, rest_length: Float[ndarray, " spring"]) -> Float[ndarray, " spring"]:
        force = self.parameters["stiffness_scale"] * self._model["stiffness"].astype(np.float64)
        return self.mass * force / rest_length

    @property
    def about(self) -> str:
        """Description of the object and its mass, in a sentence for people."""
        mass, scene = self._scene.mass, self._scene
        weight = (
            "nobody knows what the object weighs, so each node weighs 1 kg, as in the model"
            if mass is None
            else f"the object weighs {mass.text} ({mass.source}), so masses, stiffness and damping "
            f"are those of the model times {self.mass:.6g}"
        )
        run = f" of run {scene.run}" if scene.run else ""
        return f"Sequence {scene.sequence}{run}, in metres, z up: {weight}."

    @property
    def control(self) -> Float[ndarray, "frame held 3"]:
        """Where the control nodes that hold something are in every frame [m]."""
        control = self._scene.control[:, self.held].astype(np.float64)
        if "restart_rest_length" in self._model:
            frame = int(self._model["restart_frame"][0])
            control[frame + 1 :] += self._shift
        return control

    @property
    def _shift(self) -> ndarray:
        """What a restart adds to the control nodes [m]."""
        shift = self._model.get("restart_hand_shift")
        return np.zeros(3) if shift is None else shift[self.held]

    def motion(self) -> dict[str, ndarray]:
        """Collect what changes over time: control nodes, springs that hold, and the restart.

        Returns:
            Arrays by their names, as docs/formats.md describes them.
        """
        scene, model = self._scene, self._model
        # Springs of the object act in every frame.
        first = np.full(len(self.ends), -1)
        last = np.full(len(self.ends), scene.frame_count)
        virtual = slice(scene.object_spring_count, None)
        first[virtual], last[virtual] = model["attached"].T
        arrays = {
            "node": self.node,
            "control": self.control,
            "spring_first": first,
            "spring_last": last,
            "stiffness": self.stiffness,
            "damping": self.damping,
            "substeps": np.array(self.parameters["substeps_per_frame"]),
            "frame_rate": np.array(scene.frame_rate),
            "rollout": np.asarray(scene.rollout, np.float32),
            "restart_frame": np.array(scene.frame_count),
            "restart_node_shift": np.zeros(3),
        }
        if "restart_rest_length" not in model:
            return arrays
        frame = int(model["restart_frame"][0])
        after = model["restart_rest_length"].astype(np.float64)
        strength = np.full(len(self.ends), np.inf)
        if model["restart_grip_strength"][0] > 0.0:
            strength[virtual] = self.mass * float(model["restart_grip_strength"][0])
        beside = model.get("restart_node_shift", np.zeros(3)).astype(np.float64)
        return arrays | {
            "restart_frame": np.array(frame),
            "restart_control": scene.control[frame, self.held].astype(np.float64) + self._shift,
            "restart_position": model["restart_position"].astype(np.float64) - beside,
            "restart_node_shift": beside,
            "restart_velocity": model["restart_velocity"].astype(np.float64),
            "restart_rest_length": after,
            "restart_stiffness": self._stiffness(after),
            "grip_strength": strength,
            "friction_share": np.array(float(model["restart_friction_share"][0])),
            "shortest_rest_length": model.get("restart_shortest", after).astype(np.float64),
            "restart_clearance": model["restart_clearance"].astype(np.float64),
        }
