"""Small scenes for the oracle, and the same scenes as models for the simulator."""

from dataclasses import replace

import numpy as np
from reference.spring_mass import Scene
from scipy.spatial.transform import Rotation

from physhandi.simulation.model import SpringMassModel
from physhandi.simulation.parameters import SimulationParameters


def cube_scene(**changes):
    """Throw a soft, well damped cube at the ground while five springs pull it by four controls.

    All numbers are representable in float32, so that oracle and simulator see the same scene.
    """
    rng = np.random.default_rng(0)
    corner = np.array([[x, y, z] for x in (0, 0.03) for y in (0, 0.03) for z in (0, 0.03)])
    node = corner + rng.normal(0, 0.002, (8, 3))
    node[:, 2] += 0.004 - node[:, 2].min()
    control_0 = node[4:] + np.array([0.012, 0.0, 0.012])
    object_springs = [(i, j) for i in range(8) for j in range(i + 1, 8)]
    springs = np.array([*object_springs, (4, 8), (9, 5), (6, 10), (7, 11), (5, 8)])
    ends = np.vstack([node, control_0])[springs]
    path = np.linspace(0, 1, 4)[:, None, None] ** 2 * np.array([0.02, 0.01, -0.015])
    scene = Scene(
        node=node,
        velocity=rng.normal(0, 0.05, (8, 3)) + np.array([0.3, 0.0, -0.4]),
        springs=springs,
        rest=np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) * rng.uniform(0.9, 1.1, len(springs)),
        stiffness=rng.uniform(20, 40, len(springs)),
        damping=rng.uniform(1, 3, len(springs)),
        control=control_0 + path + rng.normal(0, 0.001, (4, 4, 3)),
        substeps=40,
    )
    return in_float32(replace(scene, **changes))


def held_in_turns(**changes):
    """Give the cube's five virtual springs to other frames each: two of them to all."""
    scene = cube_scene(**changes)
    attached = np.tile([[0, 99]], (len(scene.springs), 1))
    attached[-5:] = [[0, 1], [1, 2], [1, 99], [0, 99], [2, 3]]
    return replace(scene, attached=attached)


def bare_scene(
    node, velocity=None, springs=(), rest=(), stiffness=(), damping=(), frames=2, **changes
):
    """Describe a few nodes without control nodes, drag, gravity or ground, unless given."""
    node = np.asarray(node, dtype=float)
    scene = Scene(
        node=node,
        velocity=np.zeros_like(node) if velocity is None else np.asarray(velocity, dtype=float),
        springs=np.asarray(springs, dtype=np.int64).reshape(-1, 2),
        rest=np.asarray(rest, dtype=float),
        stiffness=np.asarray(stiffness, dtype=float),
        damping=np.asarray(damping, dtype=float),
        control=np.zeros((frames, 0, 3)),
        drag=0.0,
        gravity=0.0,
        ground=None,
    )
    return in_float32(replace(scene, **changes))


def star_scene():
    """Let one node hang on five hundred springs, whose other ends drift."""
    rng = np.random.default_rng(2)
    direction = rng.normal(size=(500, 3))
    node = np.vstack([np.zeros(3), 0.1 * direction / np.linalg.norm(direction, axis=1)[:, None]])
    return bare_scene(
        node,
        velocity=rng.normal(0, 0.2, node.shape),
        springs=[(0, i) for i in range(1, 501)],
        rest=np.full(500, 0.09),
        stiffness=np.full(500, 2.0),
        damping=np.full(500, 0.05),
        frames=3,
        substeps=60,
    )


def tiny_scene():
    """Let a tangle of nodes move whose springs are a tenth of a millimetre long."""
    rng = np.random.default_rng(4)
    node = np.cumsum(rng.normal(0, 6e-5, (40, 3)), axis=0)
    return bare_scene(
        node,
        velocity=rng.normal(0, 1e-3, node.shape),
        springs=[(i, i + 1) for i in range(39)] + [(i, i + 2) for i in range(38)],
        rest=np.full(77, 1e-4),
        stiffness=np.full(77, 1e-3),
        damping=np.full(77, 0.01),
        frames=3,
        substeps=200,
    )


def loose_scene(count):
    """Let nodes without springs fall to the ground and slide; there is nothing else."""
    rng = np.random.default_rng(count)
    return bare_scene(
        rng.uniform(0, 0.02, (count, 3)) * [1.0, 1.0, 0.1] + [0.0, 0.0, 0.006],
        velocity=rng.normal(0, 0.02, (count, 3)) + np.array([0.3, -0.2, -0.4]),
        frames=4,
        substeps=80,
        drag=2.0,
        gravity=9.81,
        ground=0.0,
    )


def crossing_scene(**changes):
    """Let two springy sheets of nine nodes fly through each other at an angle, above the ground.

    Their nodes come nearer than 12 mm only as they meet; neighbours in a sheet are 20 mm apart.
    One node of each sheet hangs at a control node.
    """
    rng = np.random.default_rng(3)
    plane = np.array([[0.02 * i, 0.02 * j, 0.0] for i in range(3) for j in range(3)])
    node = np.vstack([plane, plane + np.array([0.007, 0.004, 0.013])])
    node += rng.normal(0, 0.0005, node.shape) + np.array([0.0, 0.0, 0.006])
    across = [(3 * i + j, 3 * k + m) for i in range(3) for j in range(3) for k in range(3)
              for m in range(3) if (i, j) < (k, m) and abs(i - k) + abs(j - m) == 1]  # fmt: skip
    springs = np.array([*across, *((a + 9, b + 9) for a, b in across), (0, 18), (17, 19)])
    control = np.stack([node[[0, 17]] + np.array([0.0, 0.0, 0.01])] * 4)
    control += np.linspace(0, 0.004, 4)[:, None, None]
    ends = np.vstack([node, control[0]])[springs]
    velocity = np.repeat([[0.1, 0.0, 0.25], [-0.2, 0.15, -0.35]], 9, axis=0)
    scene = Scene(
        node=node,
        velocity=velocity + rng.normal(0, 0.02, node.shape),
        springs=springs,
        rest=np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1),
        stiffness=rng.uniform(2, 4, len(springs)),
        damping=rng.uniform(0.1, 0.3, len(springs)),
        control=control,
        substeps=40,
        distance=0.012,
    )
    return in_float32(replace(scene, **changes))


def ball(center, radius):
    """Give an octahedron whose sides are split once: 18 corners, 32 triangles seen from outside."""
    corners = [np.eye(3)[axis] * sign for axis in range(3) for sign in (1.0, -1.0)]
    faces = []
    for x, y, z in [(x, y, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]:
        turned = (x + y + z) % 2 == 0
        faces.append((x, y, z) if turned else (x, z, y))
    middles, split = {}, []
    for a, b, c in faces:
        ab, bc, ca = (
            middles.setdefault(frozenset(pair), 6 + len(middles))
            for pair in ((a, b), (b, c), (c, a))
        )
        split += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    points = np.array([*corners, *(np.mean([corners[i] for i in pair], 0) for pair in middles)])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return np.asarray(center) + radius * points, np.array(split)


def pressed_scene(**changes):
    """Let a turning ball push a springy sheet of sixteen nodes down to the ground.

    The ball comes from above and from the side, turns by 0.25 rad a frame and holds one node.
    """
    rng = np.random.default_rng(5)
    node = np.array([[0.012 * i, 0.012 * j, 0.0] for i in range(4) for j in range(4)])
    node += rng.normal(0, 0.0006, node.shape) + np.array([0.0, 0.0, 0.003])
    point, face = ball([0.019, 0.016, 0.0], 0.02)
    springs = [(i, j) for i in range(16) for j in range(i + 1, 16)
               if np.linalg.norm(node[i] - node[j]) < 0.019]  # fmt: skip
    control = []
    for frame in range(4):
        turn = Rotation.from_rotvec([0.1 * frame, 0.25 * frame, 0.05 * frame])
        middle = np.array([0.019, 0.016, 0.0])
        way = np.array([0.004 * frame, 0.001 * frame, 0.0215 - 0.0025 * frame])
        control.append(turn.apply(point - middle) + middle + way)
    springs = np.array([*springs, (0, 16 + 7)])
    ends = np.vstack([node, control[0]])[springs]
    scene = Scene(
        node=node,
        velocity=rng.normal(0, 0.02, node.shape),
        springs=springs,
        rest=np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1),
        stiffness=rng.uniform(2, 4, len(springs)),
        damping=rng.uniform(0.1, 0.3, len(springs)),
        control=np.array(control),
        substeps=40,
        hand=face,
        gravity=1.0,
        push_stiffness=5e4,
        hand_friction=0.4,
    )
    return in_float32(replace(scene, **changes))


def in_float32(scene):
    """Round every array to float32, but keep float64."""
    arrays = ["node", "velocity", "rest", "stiffness", "damping", "control"]
    arrays += [] if scene.clearance is None else ["clearance"]
    return replace(
        scene, **{name: np.float32(getattr(scene, name)).astype(float) for name in arrays}
    )


def as_model(scene):
    """Return the scene as the simulator's model and parameters."""
    parameters = SimulationParameters(
        drag=scene.drag,
        restitution=scene.restitution,
        friction=scene.friction,
        ground_height=scene.ground,
        gravity=scene.gravity,
        frame_rate=scene.frame_rate,
        substeps_per_frame=scene.substeps,
        use_control_velocity=scene.moves,
        self_collision=scene.distance is not None,
        collision_distance=0.005 if scene.distance is None else scene.distance,
        self_restitution=scene.self_restitution,
        self_friction=scene.self_friction,
        collides_rest_neighbors=scene.blocks_rest,
        hand_pushes=scene.hand is not None,
        push_stiffness=scene.push_stiffness,
        hand_friction=scene.hand_friction,
    )
    is_object = np.all(scene.springs < len(scene.node), axis=1)
    assert np.all(np.diff(is_object.astype(int)) <= 0), "object springs come first"
    model = SpringMassModel(
        object_node=scene.node.astype(np.float32),
        initial_velocity=scene.velocity.astype(np.float32),
        spring_nodes=scene.springs.astype(np.int32),
        rest_length=scene.rest.astype(np.float32),
        stiffness=scene.stiffness.astype(np.float32),
        damping=scene.damping.astype(np.float32),
        object_spring_count=int(is_object.sum()),
        control_count=scene.control.shape[1],
        clearance=np.float32([0.0] if scene.clearance is None else scene.clearance),
        **({} if scene.hand is None else {"hand_face": scene.hand.astype(np.int32)}),
        **({} if scene.attached is None else {"attached": np.int32(scene.attached)[~is_object]}),
    )
    return model, parameters
