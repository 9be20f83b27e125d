"""Two small sheets that tell their object, and what is asked of methods on them."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from physhandi.data.sequence import Sequence
from physhandi.data.sequence_meta import SequenceMeta
from physhandi.data.sequence_writer import write_sequence
from physhandi.synthetic.code_version import generator_version
from physhandi.synthetic.suite.evaluation import Order
from support.inputs.sheet_sequence import FRAMES, NODE, write_sheet

SETTINGS = {
    "object_.search.generations": 1,
    "object_.search.population": 2,
    "object_.first_order.iterations": 1,
    "object_.first_order.window": None,
    "simulation.connection_radius": 0.08,
    "simulation.virtual_connection_radius": 0.02,
    "simulation.stiffness": 400.0,
    "simulation.virtual_stiffness": 2000.0,
    "object_.search.variables.friction": None,
    "object_.search.variables.connection_radius": {"low": 0.06, "high": 0.12, "scale": "linear"},
    "object_.search.variables.virtual_connection_radius": {
        "low": 0.01,
        "high": 0.04,
        "scale": "linear",
    },
}
METHODS = ("static", "rigid_follow", "quick", "quick+last_residual")


def write_told(folder: Path, lift: float, action: str = "squeeze", seed: int = 0) -> Sequence:
    """A sheet that tells its object, and by labels that two of its nodes are held."""
    plain = write_sheet(folder / "plain", lift=lift)
    names = ("control", "marker", "marker_node", "object_node", "rest_node")
    arrays = {f"{name}.npy": np.load(plain.folder / f"{name}.npy") for name in names}
    held = np.zeros((FRAMES, len(NODE)), bool)
    held[:, [0, 4]] = True
    arrays |= {"truth/contact_point.npy": NODE.astype(np.float32), "truth/contact.npy": held}
    made = {"object": "sheet", "action": action, "seed": seed, "preset": "clean"}
    provenance = {"synthesize": made, "generator": generator_version()}
    meta: SequenceMeta = replace(plain.meta, name=folder.name, provenance=provenance)
    return write_sequence(folder / folder.name, meta, arrays)


def order_of(recordings: tuple[Sequence, ...], **changes: Any) -> Order:
    fields = {"methods": METHODS, "settings": SETTINGS, "protocols": ("main", "unseen")}
    return Order(title="Two sheets", recordings=recordings, **(fields | changes))


def table(out: Path) -> dict[tuple[str, str, str], dict[str, str]]:
    with (out / "table.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    return {(row["method"], row["split"], row["metric"]): row for row in rows}
