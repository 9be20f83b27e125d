"""Every kernel compiles for a graphics card, which takes none: NVRTC comes with Warp."""

import importlib
import pkgutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import warp as wp

import physhandi.appearance.kernels
import physhandi.rendering.kernels
import physhandi.simulation.kernels
from physhandi.devices import start_warp
from physhandi.simulation.kernels.batch.frame import make_batch_frame_kernel
from physhandi.simulation.kernels.batch.substep import make_batch_kernel
from physhandi.simulation.kernels.cuda_adjoint import make_adjoint_kernel
from physhandi.simulation.kernels.cuda_frame import make_frame_kernel
from physhandi.simulation.kernels.cuda_large_frame import make_large_frame_kernel

HOPPER = 90


def modules_with_kernels() -> dict[str, ModuleType]:
    simulation = physhandi.simulation.kernels
    found = [
        importlib.import_module(each.name)
        for each in pkgutil.walk_packages(simulation.__path__, f"{simulation.__name__}.")
    ]
    found += [physhandi.appearance.kernels, physhandi.rendering.kernels]
    has_kernel = {
        module.__name__: module
        for module in found
        if any(isinstance(value, wp.Kernel) for value in vars(module).values())
        and not module.__name__.rpartition(".")[2].startswith("cpu_")
    }
    assert len(has_kernel) > 10
    return has_kernel


def compiled_for_cuda(module: wp.Module, folder: Path) -> str:
    wp.compile_aot_module(module, arch=HOPPER, module_dir=folder, use_ptx=True)
    (written,) = folder.glob("*.ptx")
    return written.read_text()


@pytest.mark.parametrize("name", sorted(modules_with_kernels()))
def test_kernels_compile_for_cuda(name: str, tmp_path: Path) -> None:
    start_warp()
    module = wp.get_module(name)
    written = compiled_for_cuda(module, tmp_path)
    for kernel in module.kernels:
        assert f"{kernel}_" in written


@pytest.mark.parametrize(
    "make",
    [
        lambda: make_frame_kernel(16, 3),
        lambda: make_adjoint_kernel(16, 3),
        lambda: make_large_frame_kernel(8, 6, 768, 1024),
        lambda: make_batch_kernel(2, 1),
        lambda: make_batch_kernel(1, 8),
        lambda: make_batch_frame_kernel(768, 9_000),
    ],
    ids=["frame", "adjoint", "large frame", "batch", "batch in parts", "batch in blocks"],
)
def test_kernels_that_are_made_for_a_size_compile_for_cuda(
    make: Callable[[], wp.Kernel], tmp_path: Path
) -> None:
    start_warp()
    kernel = make()
    assert f"{kernel.key}_" in compiled_for_cuda(kernel.module, tmp_path)


def test_an_error_in_code_for_cuda_alone_is_found(tmp_path: Path) -> None:
    snippet = "#if defined(__CUDA_ARCH__)\n    no_such_function();\n#endif\n"

    @wp.func_native(snippet=snippet)
    def call_nothing() -> None: ...

    def call() -> None:
        call_nothing()

    wrong = wp.Kernel(func=call, module=wp.get_module("made_wrong"))
    start_warp()
    with pytest.raises(Exception, match="CUDA kernel build failed"):
        compiled_for_cuda(wrong.module, tmp_path)
