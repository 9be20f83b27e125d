"""Devices that simulate: starting Warp without a word, and choosing one by name."""

import ctypes
import os
import platform
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from physhandi.errors import UsageError


@cache
def start_warp() -> None:
    """Start Warp, once a process, without its greeting.

    Where there is no CUDA driver, its native library writes a warning to standard error that no
    setting switches off; nobody asked for a GPU, so it is not shown.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    if has_cuda_driver():
        wp.init()
        return
    with _native_errors_held():
        wp.init()


def has_cuda_driver() -> bool:
    """Tell whether NVIDIA's driver is installed."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


def pick_device(name: str) -> str:
    """Turn ``auto`` into the fastest Warp device of this machine, and ``cuda`` into its first GPU.

    Raises:
        UsageError: If the named device does not exist here.
    """
    if name == "cpu" or (name == "auto" and not has_cuda_driver()):
        return "cpu"  # Known without Warp, which takes half a second to import and start.
    import warp as wp

    start_warp()
    if name == "auto":
        return "cuda:0" if wp.is_cuda_available() else "cpu"
    if name == "cuda":
        name = "cuda:0"
    names = [str(device) for device in wp.get_devices()]
    if name not in names:
        raise UsageError(f"There is no device '{name}' here. There is: {', '.join(names)}.")
    return name


def pick_devices(names: str) -> tuple[str, ...]:
    """Turn names of devices, separated by commas, into Warp devices of this machine.

    ``all`` names every GPU, or the CPU where there is none; each name may be one of `pick_device`.

    Raises:
        UsageError: If a device does not exist here, one is named twice, or a CPU beside GPUs.
    """
    if names == "all" and not has_cuda_driver():
        return ("cpu",)
    if names == "all":
        import warp as wp

        start_warp()
        return tuple(str(device) for device in wp.get_cuda_devices()) or ("cpu",)
    named = [name.strip() for name in names.split(",")]
    if len(named) > 1 and "cpu" in named:
        raise UsageError(f"'{names}' names the CPU beside a GPU, which is faster; leave it out.")
    devices = tuple(pick_device(name) for name in named)
    if len(set(devices)) < len(devices):
        raise UsageError(f"'{names}' names a device twice.")
    return devices


def card_of(name: str) -> str | None:
    """Give the identity of a Warp device's graphics card, as `nvidia-smi` tells it; None for a CPU.

    Numbers of devices do not tell: CUDA may count the cards in another order.
    """
    import warp as wp

    start_warp()
    device = wp.get_device(name)
    return str(device.uuid) if device.is_cuda else None


ONLY_CARD = "cuda:0"
"""Name of the one graphics card that a process sees; see `only_card`."""


def only_card(card: str | None) -> dict[str, str]:
    """Give the environment variables of a process that is to see one graphics card alone.

    Args:
        card: See `card_of`; None leaves it what there is.
    """
    return {} if card is None else {"CUDA_VISIBLE_DEVICES": card}


@cache
def processor_name() -> str:
    """Give what the processor calls itself; empty if it does not tell."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def describe_device(name: str) -> str:
    """Give the model of a Warp device, as its driver names it; of a CPU, as it calls itself."""
    if name == "cpu":
        return processor_name()  # Known without Warp, as above.
    import warp as wp

    start_warp()
    return str(wp.get_device(name).name)


@contextmanager
def _native_errors_held() -> Generator[None]:
    """Keep what native code writes to standard error, and pass it on if this fails."""
    try:
        original = os.dup(2)
    except OSError:  # Standard error is closed, so nothing would be seen of it anyway.
        yield
        return
    with tempfile.TemporaryFile() as held:
        sys.stderr.flush()
        os.dup2(held.fileno(), 2)
        try:
            yield
        except BaseException:
            os.dup2(original, 2)
            held.seek(0)
            os.write(2, held.read())
            raise
        finally:
            os.dup2(original, 2)
            os.close(original)
