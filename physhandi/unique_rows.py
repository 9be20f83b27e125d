"""Equal rows of whole numbers: voxels, springs and faces of triangles."""

import numpy as np
from jaxtyping import Int
from numpy import ndarray


def unique_rows(
    rows: Int[ndarray, "row column"],
) -> tuple[
    Int[ndarray, "unique column"],
    Int[ndarray, " unique"],
    Int[ndarray, " row"],
    Int[ndarray, " unique"],
]:
    """Find the different rows, as `numpy.unique` with ``axis=0`` does, in a sixth of the time.

    Each row becomes one number, since rows take several times as long to sort.

    Args:
        rows: Whole numbers.

    Returns:
        The different rows in order (first column slowest), where each of them is first, which of
        them each row is, and how many rows each of them is.
    """
    if len(rows) == 0:
        nothing = np.zeros(0, np.intp)
        return rows, nothing, nothing, nothing
    place = rows.astype(np.int64)
    place -= place.min(axis=0)
    if np.prod(place.max(axis=0) + 1.0) > 2.0**62:  # Their order alone takes smaller numbers.
        place = np.stack([np.unique(axis, return_inverse=True)[1] for axis in place.T], axis=1)
    number = np.ravel_multi_index(tuple(place.T), tuple(place.max(axis=0) + 1))
    _, first, owner, count = np.unique(
        number, return_index=True, return_inverse=True, return_counts=True
    )
    return rows[first], first, owner, count
