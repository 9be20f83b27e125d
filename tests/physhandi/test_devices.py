"""Choosing a device, and starting Warp without a word."""

import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from physhandi.devices import (
    card_of,
    describe_device,
    has_cuda_driver,
    pick_device,
    pick_devices,
    processor_name,
)
from physhandi.errors import UsageError


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=False,
    )


def test_warp_starts_without_a_word() -> None:
    code = "from physhandi.devices import start_warp; start_warp(); start_warp()\n"
    done = run(code + "import sys; sys.stderr.write('still heard')")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "still heard")


def test_what_was_written_before_a_failed_start_is_shown() -> None:
    done = run(
        "import os, warp\n"
        "from physhandi import devices\n"
        "devices.has_cuda_driver = lambda: False\n"
        "def fail():\n"
        "    os.write(2, b'native words; ')\n"
        "    raise RuntimeError('no start')\n"
        "warp.init = fail\n"
        "devices.start_warp()\n"
    )
    assert done.returncode == 1
    assert "native words; " in done.stderr
    assert "RuntimeError: no start" in done.stderr


def test_a_device_is_picked_by_name() -> None:
    assert pick_device("auto") == ("cuda:0" if wp.is_cuda_available() else "cpu")
    assert pick_device("cpu") == "cpu"
    assert describe_device("cpu") == processor_name() != ""
    with pytest.raises(UsageError, match="There is no device 'tpu' here"):
        pick_device("tpu")
    assert pick_devices("auto") == (pick_device("auto"),)
    assert card_of("cpu") is None
    with pytest.raises(UsageError, match="the CPU beside a GPU"):
        pick_devices("cuda:0, cpu")
    if not has_cuda_driver():
        assert pick_devices("all") == ("cpu",)
        with pytest.raises(UsageError, match="no device 'cuda:0'"):
            pick_device("cuda")


def test_the_cpu_is_picked_and_named_without_warp_where_nothing_else_is() -> None:
    done = run(
        "import sys\n"
        "sys.modules['warp'] = None\n"
        "from physhandi import devices\n"
        "devices.has_cuda_driver = lambda: False\n"
        "print(devices.pick_devices('all'), devices.pick_devices('auto'))\n"
        "devices.has_cuda_driver = lambda: True\n"
        "print(devices.pick_device('cpu'), devices.describe_device('cpu'))\n"
    )
    assert done.stdout == f"('cpu',) ('cpu',)\ncpu {processor_name()}\n"
    assert done.stderr == ""


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")
def test_all_means_every_gpu_and_each_has_a_card() -> None:
    devices = pick_devices("all")
    assert devices[0] == "cuda:0"
    assert len(devices) == wp.get_cuda_device_count() == len({card_of(name) for name in devices})
    with pytest.raises(UsageError, match="names a device twice"):
        pick_devices("cuda:0, cuda")
