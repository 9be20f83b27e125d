"""Checks that this machine can run the demo."""

import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from app.cli.commands import open_catalog, read_settings
from physhandi.devices import pick_device


def examine(data_dir: Path | None) -> tuple[bool, list[str]]:
    """Check what the demo needs; returns whether all is well and what was found."""
    checks = [_check(name, probe) for name, probe in _probes(data_dir)]
    return all(ok for ok, _ in checks), [line for _, line in checks]


def _check(name: str, probe: Callable[[], str]) -> tuple[bool, str]:
    try:
        return True, f"ok    {name}: {probe()}"
    except Exception as error:  # noqa: BLE001  # whatever is wrong here is what doctor is to tell
        return False, f"FAIL  {name}: {error}"


def _probes(data_dir: Path | None) -> Iterator[tuple[str, Callable[[], str]]]:
    def python() -> str:
        return sys.version.split()[0]

    def torch_build() -> str:
        import torch

        return torch.__version__

    def simulation() -> str:
        import numpy as np

        from physhandi.simulation.parameters import SimulationParameters
        from physhandi.simulation.simulator import Simulator
        from physhandi.simulation.topology import build_model

        device = pick_device("auto")
        parameters = SimulationParameters(ground_height=None, drag=0.0, substeps_per_frame=100)
        model = build_model(np.zeros((1, 3)), np.zeros((0, 3)), parameters)
        control = np.zeros((2, 0, 3), np.float32)
        fall = float(Simulator(model, parameters, device=device).rollout(control).position[1, 0, 2])
        # Symplectic Euler falls g t² / 2 · (1 + 1/substeps) in the first frame.
        expected = -0.5 * 9.81 / 900 * 1.01
        if abs(fall - expected) > 1e-5:
            raise RuntimeError(
                f"a free fall of one frame gave {fall:.6f} m, expected {expected:.6f} m"
            )
        return f"Warp on {device}, a falling node lands where it should"

    def bundled() -> str:
        catalog = open_catalog(data_dir)
        entries = list(catalog.sequences())
        if not entries:
            raise RuntimeError("no sequence is bundled; reinstall the package")
        return ", ".join(entry.id for entry in entries)

    def hand() -> str:
        from physhandi.hand.loading import load_hand_model
        from physhandi.hand.mano import hands_folder

        found = [f"{s} hand {load_hand_model(s).vertex_count} vertices" for s in ("right", "left")]
        mano = [s for s in ("right", "left") if (hands_folder() / f"mano_{s}.npz").is_file()]
        return ", ".join([*found, f"MANO: {' and '.join(mano) or 'not imported'}"])

    def space() -> str:
        folder = read_settings(data_dir=data_dir).data_dir
        existing = next(place for place in (folder, *folder.parents) if place.exists())
        free = shutil.disk_usage(existing).free
        if free < 500e6:
            raise RuntimeError(f"only {free / 1e6:.0f} MB free; 500 MB are needed")
        return f"{free / 1e9:.0f} GB free"

    yield "python", python
    yield "torch", torch_build
    yield "simulation", simulation
    yield "hand", hand
    yield "sequences", bundled
    yield "disk", space
