"""Small runs for tests."""

from pathlib import Path

import numpy as np

from physhandi.run import Run


def make_run(folder: Path, **changes: object) -> Run:
    options = {
        "name": "My fit",
        "kind": "reconstruction",
        "sequences": ["/data/lift"],
        "config": {"radius": 0.02, "search": {"iterations": 3}},
    }
    return Run.create(folder, **(options | changes))


def fill(run: Run, value: float = 1.5) -> None:
    with run.begin_attempt() as attempt:
        attempt.save_array("sequences/lift/rollout.npy", np.full((4, 2, 3), value, np.float32))
        attempt.save_tensors("object/material.safetensors", {"stiffness": np.arange(5.0)[::2]})
        attempt.save_yaml("object/parameters.yaml", {"drag": np.float64(3.0)})
        attempt.save_json("metrics.json", {"track": np.float32(0.5), "bad": float("nan")})
        attempt.finish_stage("first_order", {"before": 2.0, "after": 0.5, "curve": [[0, 2.0]]})
        attempt.publish()
