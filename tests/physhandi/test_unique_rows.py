"""Equal rows against NumPy's own search, which sorts rows as they are."""

import numpy as np
import pytest

from physhandi.unique_rows import unique_rows

RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize(
    "rows",
    [
        RANDOM.integers(-3, 4, (500, 3)),
        RANDOM.integers(0, 40, (500, 2)).astype(np.int32),
        # More rows could be told apart than there are numbers.
        RANDOM.choice([-(2**40), -1, 7, 2**40], (60, 3)),
        np.array([[4, -2]]),
        np.zeros((0, 3), np.int64),
    ],
    ids=["small", "pairs", "far apart", "one", "none"],
)
def test_they_are_those_that_sorting_whole_rows_finds(rows: np.ndarray) -> None:
    found = unique_rows(rows)
    expected = np.unique(rows, True, True, True, axis=0)
    assert found[0].dtype == rows.dtype
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs.reshape(ours.shape))
    np.testing.assert_array_equal(found[0][found[2]], rows)
