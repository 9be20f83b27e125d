"""Fixtures that all tests share."""

import atexit
import dataclasses
import functools
import gc
import inspect
import itertools
import os
import sys
from pathlib import Path

import beartype
import jaxtyping
import pytest
import warp as wp
from support.inputs.recordings import recording

BROWSERS = ("tests/e2e/", "tests/app/benchmarks/test_viewer_benchmark.py")
"""Files whose tests start browsers."""

CHECKED_FIRST, CHECKED_EVERY, MADE_EVERY = 20, 64, 8
"""Calls of each function, in each process, whose arguments and results have shapes checked: the
first 20, and then each 64th; of constructors each eighth."""


def pytest_configure(config):
    """Spare test processes and their children what costs time and proves nothing."""
    # Several processes with a thread for every processor wait for each other longer than they work.
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    # Servers and workers start by the hundred; each would compile all modules again.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
    # What a disk keeps through a power failure no test can see, and many wait for it.
    os.fsync = lambda _descriptor: None
    # When all is over, nothing is gained by a search for garbage.
    atexit.register(gc.freeze)


def _checked_at_times(jaxtyped):
    """Check shapes in some of a function's calls: fits call some a hundred thousand times.

    What checks them is made at the first call, since most functions are called by few tests. It is
    one wrapper of beartype, which sees arguments and result; jaxtyping by itself makes two.
    Functions that state no shapes are left as they are.
    """
    wrong = beartype.BeartypeConf(violation_type=jaxtyping.TypeCheckError)
    calls_of = {}

    def decorator(function=None, **options):
        if function is None:
            return functools.partial(decorator, **options)
        if inspect.isclass(function):
            made = vars(function).get("__init__")
            if dataclasses.is_dataclass(function) and not hasattr(made, "__wrapped__"):
                function.__init__ = limited(made, MADE_EVERY)
            return function
        if not inspect.isfunction(function):
            return jaxtyped(function, **options)
        return limited(function, CHECKED_EVERY)

    def limited(function, every):
        if not any("jaxtyping." in repr(stated) for stated in function.__annotations__.values()):
            return function
        checked = functools.cache(
            lambda: jaxtyped(beartype.beartype(function, conf=wrong), typechecker=None)
        )
        # A function in another one is made anew by each call of that, and counts on.
        calls = calls_of.setdefault((function.__module__, function.__code__), itertools.count())

        @functools.wraps(function)
        def call(*args, **kwargs):
            number = next(calls)
            is_checked = number < CHECKED_FIRST or number % every == 0
            return (checked() if is_checked else function)(*args, **kwargs)

        return call

    return decorator


# Here, since fixtures of the folders below, which come before any hook, import what is checked.
jaxtyping.jaxtyped = _checked_at_times(jaxtyping.jaxtyped)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Look for no garbage among modules and tests, which stay: a sixth of what collecting takes.

    Later look for it more rarely: each search goes through all that a test holds.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000, 20, 20)
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Begin with the browsers, go on with the files that take long."""
    marks = {mark: set[Path]() for mark in ("e2e", "slow")}
    for item in items:
        for mark in marks.keys() & {mark.name for mark in item.iter_markers()}:
            marks[mark].add(item.path)
    items.sort(key=lambda item: (item.path not in marks["e2e"], item.path not in marks["slow"]))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give processes whole files, and all browsers to one process.

    Two browsers without a graphics card hold each other up; beside one of them the other process
    computes. (Groups of `--dist loadgroup` are silently ignored by pytest 9.2.)
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            file = nodeid.split("::", 1)[0]
            return "browser" if file.startswith(BROWSERS) else file

    return ByFile(config, log)


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


@pytest.fixture(scope="session")
def live_process():
    """Let every `Sessions` of the tests simulate in the same process."""
    from support.viewer.shared_live import shared_live

    with shared_live():
        yield


@pytest.fixture(scope="session")
def sheet_folder(tmp_path_factory):
    """A recording of `sheet_sequence`, to copy."""
    from support.inputs.sheet_sequence import write_sheet

    return write_sheet(tmp_path_factory.mktemp("sheets") / "sheet").folder


@pytest.fixture(scope="session")
def fitted_folder(tmp_path_factory, sheet_folder):
    """A finished run of that recording, to copy."""
    from support.server.server_world import fit_sheet

    return fit_sheet(tmp_path_factory.mktemp("fits") / "fitted", sheet_folder).folder


@pytest.fixture(scope="session")
def mano_folder(tmp_path_factory):
    """Import a made-up MANO of both sides into a folder."""
    from support.inputs.mano_file import write_mano

    from physhandi.data.importers.mano import import_mano

    folder = tmp_path_factory.mktemp("hands")
    for side in ("right", "left"):
        import_mano(write_mano(folder / "source", side), folder)
    return folder


@pytest.fixture
def mano(mano_folder, monkeypatch):
    """Let `load_hand_model` find the made-up MANO."""
    monkeypatch.setenv("PHYSHANDI_HANDS", str(mano_folder))
    return mano_folder


@pytest.fixture
def shared_array():
    """Load a recorded `.npz` file from beside the repository, or skip the test."""
    import numpy as np

    def load(name):
        with np.load(recording(name)) as data:
            return dict(data)

    return load
