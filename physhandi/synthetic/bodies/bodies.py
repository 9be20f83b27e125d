"""The soft bodies of SynthHDI: shape, material, and how they lie in frame 0.

Everything lies on the ground ``z = 0`` about the origin, its longest side along x. Sizes and
materials are drawn from ranges that were set once, before any method was tried on them.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.random import Generator

from physhandi.errors import UsageError
from physhandi.synthetic.bodies.sheets import Sheet, make_sheet
from physhandi.synthetic.bodies.solids import Solid, make_pillow, make_plush
from physhandi.synthetic.bodies.tubes import ROUND, tube_faces, tube_vertices

BodyName = Literal["cloth", "towel", "rope", "plush", "pouch"]
"""Bodies that can be made."""
Resolution = Literal["fine", "tiny"]
"""Number of nodes of a body: 43 to 950 (``fine``) or 30 to 350 (``tiny``, for tests)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Body:
    """A soft body in its unloaded shape, which is also how it is laid down."""

    name: BodyName
    """Kind of body."""
    node: Float[ndarray, "node 3"]
    """Nodes in the world frame [m]; the first `surface_node_count` of them are on the surface."""
    elements: Int[ndarray, "element corner"]
    """Nodes of each piece of material: 2 for a rod, 3 for a shell, 4 for a solid."""
    faces: Int[ndarray, "face 3"]
    """Triangles to draw, between the vertices that `skin` gives."""
    surface_node_count: int
    """Nodes that are on the surface; all of them but in a solid."""
    size: tuple[float, float, float]
    """Extent along x, y and z [m]."""
    stiffness: float
    """Young's modulus [Pa]."""
    element_stiffness: Float[ndarray, " element"]
    """Factor on Young's modulus of each element; 1 in bodies of one material."""
    poisson: float
    """Poisson's ratio."""
    thickness: float
    """Thickness of a shell or diameter of a rod, which decides how it bends; 0 in a solid [m]."""
    radius: float
    """Contact radius around nodes and elements [m]."""
    mass: float
    """Mass [kg]."""

    @property
    def node_count(self) -> int:
        """Number of nodes."""
        return len(self.node)

    @property
    def dimension(self) -> int:
        """1 for a rod, 2 for a shell, 3 for a solid."""
        return self.elements.shape[1] - 1

    @property
    def skin_node(self) -> Int[ndarray, " vertex"]:
        """Node that each vertex of the skin belongs to."""
        if self.dimension == 1:
            return np.repeat(np.arange(self.node_count), ROUND)
        return np.arange(self.surface_node_count)

    def skin(self, position: Float[ndarray, "frame node 3"]) -> Float[ndarray, "frame vertex 3"]:
        """Compute the vertices to draw: a tube about a rod, otherwise the nodes of the surface.

        Args:
            position: Nodes in each frame [m]. A tube does not twist from one frame to the next.
        """
        if self.dimension == 1:
            return tube_vertices(position, self.radius)
        return position[:, : self.surface_node_count]


def make_body(name: BodyName, random: Generator, *, resolution: Resolution = "fine") -> Body:
    """Make a body whose size and stiffness are drawn at random.

    Args:
        name: What to make.
        random: Decides size, stiffness, mass and the places of the nodes.
        resolution: How many nodes it gets.

    Raises:
        UsageError: If there is no such body or resolution.
    """
    if name not in get_args(BodyName):
        names = ", ".join(get_args(BodyName))
        raise UsageError(f"There is no object named {name!r}. Choose one of: {names}.")
    if resolution not in get_args(Resolution):
        raise UsageError(f"There is no resolution named {resolution!r}. Choose fine or tiny.")
    is_fine = resolution == "fine"
    if name == "cloth":
        return _make_cloth(random, 29 if is_fine else 10)
    if name == "towel":
        return _make_towel(random, 27 if is_fine else 18)
    if name == "rope":
        return _make_rope(random, 42 if is_fine else 30)
    if name == "plush":
        return _make_plush(random, 0.0125 if is_fine else 0.020)
    return _make_pouch(random, 24 if is_fine else 14)


def _log_uniform(random: Generator, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def _extent(node: Float[ndarray, "node 3"]) -> tuple[float, float, float]:
    x, y, z = np.ptp(node, axis=0)
    return float(x), float(y), float(z)


def _make_cloth(random: Generator, columns: int) -> Body:
    """A thin square cloth."""
    side = random.uniform(0.25, 0.30)
    radius = 0.0025
    return _of_sheet(
        "cloth",
        make_sheet(side, side, side / columns, random, height=radius),
        stiffness=_log_uniform(random, 1.5e5, 5e5),
        thickness=random.uniform(0.0008, 0.0012),
        radius=radius,
        mass=random.uniform(0.15, 0.25) * side * side,
    )


def _make_towel(random: Generator, columns: int) -> Body:
    """A small, thick and heavy towel."""
    length, width = random.uniform(0.27, 0.33), random.uniform(0.18, 0.22)
    radius = 0.002  # Pieces that do not share a node must not touch at rest.
    return _of_sheet(
        "towel",
        make_sheet(length, width, length / columns, random, height=radius),
        stiffness=_log_uniform(random, 3e4, 8e4),
        thickness=random.uniform(0.002, 0.003),
        radius=radius,
        mass=random.uniform(0.35, 0.5) * length * width,
    )


def _of_sheet(
    name: BodyName, sheet: Sheet, *, stiffness: float, thickness: float, radius: float, mass: float
) -> Body:
    """Make a sheet of one material, which already lies on the ground."""
    return Body(
        name=name,
        node=sheet.node,
        elements=sheet.faces,
        faces=sheet.faces,
        surface_node_count=len(sheet.node),
        size=_extent(sheet.node),
        stiffness=stiffness,
        element_stiffness=np.ones(len(sheet.faces)),
        poisson=0.25,
        thickness=thickness,
        radius=radius,
        mass=mass,
    )


def _make_rope(random: Generator, segments: int) -> Body:
    """A soft rope that lies in a flat wave."""
    length, radius = random.uniform(0.55, 0.65), random.uniform(0.005, 0.006)
    phase = np.linspace(0.0, 2 * np.pi, 20 * segments + 1)
    wave = random.uniform(0.01, 0.02)
    # Pieces shorter than the rope is thick would touch the next but one.
    x = length * (phase / (2 * np.pi) - 0.5)
    path = np.column_stack([x, wave * np.sin(phase), np.full(len(x), radius)])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    place = np.linspace(0.0, along[-1], segments + 1)
    node = np.column_stack([np.interp(place, along, path[:, axis]) for axis in range(3)])
    node *= [length / along[-1], length / along[-1], 1.0]
    order = np.arange(segments)
    return Body(
        name="rope",
        node=node,
        elements=np.column_stack([order, order + 1]),
        faces=tube_faces(segments + 1),
        surface_node_count=segments + 1,
        size=_extent(node),
        stiffness=_log_uniform(random, 2e5, 8e5),
        element_stiffness=np.ones(segments),
        poisson=0.3,
        thickness=2 * radius,
        radius=radius,
        mass=random.uniform(0.06, 0.10) * length,
    )


def _make_plush(random: Generator, spacing: float) -> Body:
    """A stuffed animal on its back, head towards +x: soft limbs about a stiffer core."""
    length = random.uniform(0.20, 0.24)
    solid, softness = make_plush(length, spacing, random)
    core = random.uniform(2.0, 3.0)
    return _of_solid(
        "plush",
        solid,
        stiffness=_log_uniform(random, 1.2e4, 3e4),
        element_stiffness=core + (1.0 - core) * softness,
        poisson=0.3,
        thickness=0.0,
        radius=0.002,
        mass=random.uniform(80.0, 140.0) * solid.volume(),
    )


def _make_pouch(random: Generator, columns: int) -> Body:
    """A closed, empty pouch of a material stiff enough to keep its shape."""
    size = random.uniform(0.18, 0.22), random.uniform(0.12, 0.15), random.uniform(0.04, 0.055)
    shell = make_pillow(size, columns)
    return _of_solid(
        "pouch",
        shell,
        stiffness=_log_uniform(random, 6e5, 1.5e6),
        element_stiffness=np.ones(len(shell.elements)),
        poisson=0.3,
        thickness=random.uniform(0.0028, 0.0038),
        radius=0.0018,
        mass=random.uniform(0.4, 0.6) * shell.area(),
    )


def _of_solid(
    name: BodyName,
    solid: Solid,
    *,
    stiffness: float,
    element_stiffness: Float[ndarray, " element"],
    poisson: float,
    thickness: float,
    radius: float,
    mass: float,
) -> Body:
    """Lay a solid or a closed shell on the ground."""
    node = solid.node - [0.0, 0.0, solid.node[:, 2].min() - radius]
    return Body(
        name=name,
        node=node,
        elements=solid.elements,
        faces=solid.faces,
        surface_node_count=solid.surface_node_count,
        size=_extent(node),
        stiffness=stiffness,
        element_stiffness=element_stiffness,
        poisson=poisson,
        thickness=thickness,
        radius=radius,
        mass=mass,
    )
