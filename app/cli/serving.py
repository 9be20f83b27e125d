"""`physhandi serve`, and `physhandi doctor`, which checks that this machine can run the demo."""

import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from app.cli.lookup import open_catalog, read_settings
from app.cli.output import DataDir, Several, Store, all_values
from physhandi.child import loading_modules
from physhandi.devices import pick_device, pick_devices
from physhandi.run_store import RunStore


def serve(
    *,
    host: str | None = None,
    port: int | None = None,
    data_dir: DataDir = None,
    device: str | None = None,
    root_path: str | None = None,
    engine: str | None = None,
    store: Store = None,
    captures: Several[Path] = (),
    token_file: Path | None = None,
    read_only_token_file: Path | None = None,
    demo: bool = False,
) -> None:
    """Serve the application and print the address to open, until interrupted.

    Args:
        host: Address to listen on; others reach anything but loopback (PHYSHANDI_HOST, else
            127.0.0.1).
        port: Port to listen on; 0 takes a free one (PHYSHANDI_PORT, else 8080).
        root_path: Path below which a reverse proxy serves it, such as /physhandi
            (PHYSHANDI_ROOT_PATH, else none; see docs/security.md).
        device: Warp devices of fits: all (every GPU, or the CPU where there is none), auto (the
            first of them), cpu, or names like cuda:0,cuda:1. Each is given as many fits at a time
            as the others, one by default; the first also runs live scenes (PHYSHANDI_DEVICE, else
            all).
        engine: Where fits run: local, or ray://HOST:PORT, the address of the Jobs API of a Ray
            cluster, whose token PHYSHANDI_ENGINE_TOKEN holds (PHYSHANDI_ENGINE, else local; see
            docs/operations.md).
        captures: Folders, besides `captures/` of the data folder, from which recordings may be
            imported in the browser (PHYSHANDI_CAPTURES).
        token_file: File that keeps the token, so that addresses and browsers stay valid over
            restarts; made when missing (PHYSHANDI_TOKEN_FILE, else a new token at each start).
        read_only_token_file: File with another token, made alike, for people who may look at
            everything and change nothing (PHYSHANDI_READ_ONLY_TOKEN_FILE).
        demo: Also queue a quick fit of the bundled sequence.
    """
    settings = read_settings(
        host=host,
        port=port,
        data_dir=data_dir,
        device=device,
        root_path=root_path,
        engine=engine,
        store=store,
        captures=all_values(captures) or None,
        token_file=token_file,
        read_only_token_file=read_only_token_file,
    )
    if settings.store:
        RunStore(settings.store)  # Tells a wrong address now, not at the end of the first fit.
    named = settings.device if "device" in settings.model_fields_set else "all"
    settings = settings.model_copy(update={"device": ",".join(pick_devices(named))})
    # What is wrong with the settings is told at once, before the server is loaded.
    with loading_modules():
        from app.logs import write_logs
        from app.server import serve as serve_application

    write_logs(settings)

    def announce(urls: list[str]) -> None:
        print(*urls, sep="\n", flush=True)

    serve_application(settings, on_ready=announce, queue_demo=demo)


def doctor(*, data_dir: DataDir = None) -> int:
    """Check that this machine can run the demo, and that nothing in the data folder is damaged."""
    from app.cli.data_folder import look_through

    checks = [_check(name, probe) for name, probe in _probes(data_dir)]
    checks += look_through(data_dir)
    print("\n".join(line for _, line in checks))
    return 0 if all(ok for ok, _ in checks) else 1


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

        models = [f"{s} hand {load_hand_model(s).vertex_count} vertices" for s in ("right", "left")]
        mano = [s for s in ("right", "left") if (hands_folder() / f"mano_{s}.npz").is_file()]
        return ", ".join([*models, f"MANO: {' and '.join(mano) or 'not imported'}"])

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
