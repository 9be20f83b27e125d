"""A take of steered hands as a run stores it, and from where in another run it was steered."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from physhandi.data.arrays import read_tensors
from physhandi.data.files import named_fields, write_bytes
from physhandi.data.run import RunFolder
from physhandi.data.run_folder import reading
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.steering import SteeredMotion

TAKE_FILE = "take.safetensors"
"""File of a run's folder that holds its take."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredTake:
    """A take, and from where in a run it was steered."""

    take: SteeredMotion
    """The take."""
    sequence: str
    """Sequence of the run that the object was fitted in."""
    frame: int
    """Frame of that sequence from which the hands were steered."""

    def save(self, folder: Path) -> None:
        """Store its arrays in a run's folder."""
        tensors = {
            name: np.ascontiguousarray(value) for name, value in self.take.to_tensors().items()
        }
        write_bytes(folder / TAKE_FILE, save(tensors))

    def to_dict(self) -> dict[str, Any]:
        """Describe it in plain data, but for its arrays, for ``take`` of a run's configuration."""
        parameters = self.take.parameters.to_dict()
        return {
            "sequence": self.sequence,
            "frame": self.frame,
            "is_edited": self.take.is_edited,
            "parameters": parameters,
        }

    @classmethod
    def load(cls, run: RunFolder) -> "StoredTake | None":
        """Read the take of a run; None if it has none.

        Raises:
            RunError: If it is damaged; names the file.
        """
        about = named_fields(run.config.get("take"))
        if about is None:
            return None
        with reading(run.folder / TAKE_FILE):
            parameters = SimulationParameters.from_dict(about["parameters"])
            take = SteeredMotion.from_tensors(read_tensors(run.folder / TAKE_FILE), parameters)
            return cls(take=take, sequence=str(about["sequence"]), frame=int(about["frame"]))


def keeps_springs(run: RunFolder) -> bool:
    """Whether a run's object was edited before it was steered, so that its springs must stay."""
    return bool((named_fields(run.config.get("take")) or {}).get("is_edited"))
