"""A rollout in a folder, on its way from a live session to the process that makes a file of it."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from app.viewer.take import Take
from physhandi.data.atomic import write_atomically, write_json
from physhandi.simulation.model import SimulationParameters, SpringMassModel

_ARRAYS, _PARAMETERS, _MODEL = "take.npz", "parameters.json", "model_"


def store_take(folder: Path, take: Take) -> None:
    """Keep the frames of a rollout that are ready.

    Args:
        folder: Where to; must exist.
        take: The rollout.
    """
    count = take.ready
    arrays: dict[str, Any] = {
        "position": np.asarray(take.position[:count]),
        "control": np.asarray(take.control[:count]),
    }
    if take.velocity is not None:
        arrays["velocity"] = np.asarray(take.velocity[:count])
    arrays |= {_MODEL + name: array for name, array in take.model.to_tensors().items()}
    write_atomically(
        folder / _ARRAYS,
        lambda stream: np.savez(stream, allow_pickle=False, **arrays),
        is_durable=False,
    )
    write_json(folder / _PARAMETERS, take.parameters.to_dict(), is_durable=False)


def load_take(folder: Path) -> Take:
    """Read what `store_take` kept."""
    with np.load(folder / _ARRAYS, allow_pickle=False) as stored:
        arrays = dict(stored)
    model = {n.removeprefix(_MODEL): a for n, a in arrays.items() if n.startswith(_MODEL)}
    parameters = json.loads((folder / _PARAMETERS).read_text())
    return Take(
        model=SpringMassModel.from_tensors(model),
        parameters=SimulationParameters.from_dict(parameters),
        control=arrays["control"],
        position=arrays["position"],
        velocity=arrays.get("velocity"),
        ready=len(arrays["position"]),
    )
