"""Describes a body, the ground and hands of capsules in MuJoCo's format.

Each bone is a free body that is welded to a target without mass. A hand of targets alone moves as
prescribed whatever it touches, and never holds anything by friction: it has no velocity that the
contacts could know.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from physhandi.data.sequence_meta import Side
from physhandi.synthetic.bodies.bodies import Body
from physhandi.synthetic.engines.truth import CapsuleHand
from physhandi.synthetic.hands.true_hand import Capsule

# A contact pushes as hard as its node is heavy. A node may bear many others, so it must be firm.
_FIRM = "0.002 1"
_FIRM_IMPEDANCE = "0.99 0.999 0.0005"
# Newton's method is exact in few steps, but takes 2.5 s a frame at 900 nodes; 300 steps of
# conjugate gradients take 0.7 s there and hold as well. With 100 of them a cloth begins to slip.
_MANY_NODES = 400


@dataclass(frozen=True, kw_only=True)
class FlexParameters:
    """Parameters of time steps, hands and contact."""

    substeps_per_frame: int = 20
    """Steps in one frame of 1/30 s."""
    hand_friction: float = 1.2
    """Friction between skin and body."""
    ground_friction: float = 0.5
    """Friction between ground and body."""
    self_friction: float = 0.4
    """Friction of the body with itself."""
    bone_mass: float = 0.15
    """Mass of each bone of a hand; heavier bones follow their path more firmly [kg]."""
    weld_time: float = 0.02
    """Time in which a bone returns to its prescribed way [s]. With its mass it makes a fingertip
    give way by 1 mm for about 0.75 N; a stiff one would crush what lies on the ground."""
    damping: float = 0.004
    """Time by which the material's stress follows its rate of strain [s]."""
    settling_time: float = 0.3
    """Time in which the body comes to rest before the hands begin [s]."""


@dataclass(frozen=True, eq=False)
class Bone:
    """A bone of a hand as a body of the engine."""

    side: Side
    """Hand that it belongs to."""
    index: int
    """Number of the bone in its hand."""
    center: Float[ndarray, " 3"]
    """Where the body's frame is in the rest pose [m]."""

    @property
    def name(self) -> str:
        """Name of the body."""
        return f"{self.side}_{self.index}"


def list_bones(hands: Mapping[Side, CapsuleHand]) -> tuple[Bone, ...]:
    """Find the bones of all hands that carry a capsule."""
    return tuple(
        Bone(side, bone, np.mean([(c.start + c.end) / 2 for c in _of_bone(hand, bone)], axis=0))
        for side, hand in hands.items()
        for bone in sorted({capsule.bone for capsule in hand.capsules})
    )


def write_scene(
    body: Body, hands: Mapping[Side, CapsuleHand], parameters: FlexParameters, frame_rate: float
) -> str:
    """Describe a scene in MuJoCo's format.

    The bodies of bones are named ``right_3``, their targets ``right_3_target``; equality ``i`` of
    the first nodes is an inactive one between node i and the first bone, for `hold` by attachment.

    Args:
        body: What lies on the ground.
        hands: Hands by their side, at the origin at first.
        parameters: Time, friction and firmness.
        frame_rate: Frames per second [Hz].
    """
    root = Element("mujoco")
    SubElement(root, "compiler", autolimits="true", angle="radian")
    option = SubElement(
        root,
        "option",
        timestep=repr(1.0 / (frame_rate * parameters.substeps_per_frame)),
        integrator="discrete",
        solver="Newton" if body.node_count < _MANY_NODES else "CG",
        cone="elliptic",
        impratio="100",
        iterations="300",
        tolerance="1e-8",
    )
    # A restart would hide that the simulation has failed.
    SubElement(option, "flag", autoreset="disable")
    SubElement(root, "size", memory="1G")
    world = SubElement(root, "worldbody")
    SubElement(
        world,
        "geom",
        name="ground",
        type="plane",
        size="5 5 0.1",
        contype="1",
        conaffinity="0",
        priority="1",
        friction=f"{parameters.ground_friction} 0.005 0.0001",
        solref=_FIRM,
        solimp=_FIRM_IMPEDANCE,
    )
    _add_body(world, body, parameters)
    equality = SubElement(root, "equality")
    bones = list_bones(hands)
    for node in range(body.surface_node_count if bones else 0):
        SubElement(
            equality,
            "connect",
            body1=bones[0].name,
            body2=f"body_{node}",
            anchor="0 0 0",
            active="false",
            solref="0.01 1",
        )
    for bone in bones:
        _add_bone(world, bone, _of_bone(hands[bone.side], bone.index), parameters)
        SubElement(
            equality,
            "weld",
            body1=f"{bone.name}_target",
            body2=bone.name,
            relpose="0 0 0 1 0 0 0",
            solref=f"{parameters.weld_time} 1",
            solimp="0.5 0.5 0.001",
        )
    return ElementTree.tostring(root, encoding="unicode")


def _of_bone(hand: CapsuleHand, bone: int) -> Sequence[Capsule]:
    return [capsule for capsule in hand.capsules if capsule.bone == bone]


def _numbers(values: ndarray) -> str:
    return " ".join(repr(value) for value in values.ravel().tolist())


def _add_body(world: Element, body: Body, parameters: FlexParameters) -> None:
    flex = SubElement(
        world,
        "flexcomp",
        name="body",
        type="direct",
        dim=str(body.dimension),
        point=_numbers(body.node),
        element=_numbers(body.elements),
        radius=repr(body.radius),
        mass=repr(body.mass),
        inertiabox="0.005",
    )
    material = {
        "young": repr(body.stiffness),
        "poisson": repr(body.poisson),
        "damping": repr(parameters.damping),
    }
    if body.dimension == 2:
        material |= {"thickness": repr(body.thickness), "elastic2d": "both"}
    SubElement(flex, "elasticity", material)
    if body.dimension == 1:
        # The engine's rods only bend and twist, so their length is a constraint.
        SubElement(flex, "edge", equality="true", solref="0.005 1")
    SubElement(
        flex,
        "contact",
        contype="1",
        conaffinity="1",
        condim="3",
        friction=f"{parameters.self_friction} 0.005 0.0001",
        solref=_FIRM,
        solimp=_FIRM_IMPEDANCE,
        selfcollide="none" if body.dimension == 3 else "auto",
    )


def _add_bone(
    world: Element, bone: Bone, capsules: Sequence[Capsule], parameters: FlexParameters
) -> None:
    SubElement(world, "body", name=f"{bone.name}_target", mocap="true")
    body = SubElement(world, "body", name=bone.name, gravcomp="1")
    SubElement(body, "freejoint")
    inertia = repr(parameters.bone_mass * 0.035**2)
    SubElement(
        body,
        "inertial",
        pos="0 0 0",
        mass=repr(parameters.bone_mass),
        diaginertia=f"{inertia} {inertia} {inertia}",
    )
    for capsule in capsules:
        ends = np.concatenate([capsule.start - bone.center, capsule.end - bone.center])
        SubElement(
            body,
            "geom",
            type="capsule",
            fromto=_numbers(ends),
            size=repr(float(capsule.radius)),
            contype="1",
            conaffinity="0",
            condim="4",
            priority="2",
            friction=f"{parameters.hand_friction} 0.01 0.0001",
            solref=_FIRM,
            solimp=_FIRM_IMPEDANCE,
        )
