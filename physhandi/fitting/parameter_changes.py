"""Changes that a user makes to fitted parameters."""

from collections.abc import Mapping
from typing import Any

from physhandi.simulation.model import SimulationParameters

AUTOMATIC = "auto"
"""Instead of a number of substeps: as few as are stable and fine enough."""


def changed_parameters(
    fitted: SimulationParameters, changes: Mapping[str, Any]
) -> tuple[SimulationParameters, bool]:
    """Apply changes to fitted parameters.

    Returns:
        The new parameters, and whether their substeps are yet to be chosen automatically.

    Raises:
        UsageError: If a parameter is unknown or out of bounds.
    """
    given = dict(changes)
    is_automatic = given.get("substeps_per_frame") == AUTOMATIC
    if is_automatic:
        del given["substeps_per_frame"]
    return SimulationParameters.from_dict(fitted.to_dict() | given), is_automatic
