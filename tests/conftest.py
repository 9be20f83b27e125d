"""Fixtures that all tests share."""

import pytest
import warp as wp
from recordings import recording

DEVICES = ["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)]


@pytest.fixture(params=DEVICES)
def device(request):
    """A Warp device; what this machine does not have is skipped."""
    if request.param == "cpu":
        if not wp.is_cpu_available():
            pytest.skip("this Warp has no CPU device")
    elif not wp.is_cuda_available():
        pytest.skip("needs a CUDA device")
    return request.param


@pytest.fixture
def shared_array():
    """Load a recorded `.npz` file from beside the repository, or skip the test."""
    import numpy as np

    def load(name):
        with np.load(recording(name)) as data:
            return dict(data)

    return load
