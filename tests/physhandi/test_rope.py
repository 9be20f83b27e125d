"""A real rope: fitted on the first quarter of a trajectory, it predicts two it never saw."""

from pathlib import Path

import numpy as np
import pytest
from support.inputs.recordings import recording

from physhandi import pipeline
from physhandi.data.importers.mocap import import_mocap
from physhandi.fitting.config import load_profile
from physhandi.run import Run


@pytest.mark.slow
@pytest.mark.no_cover  # Quick tests of each stage go through the same lines.
def test_a_rope_predicts_trajectories_it_was_not_fitted_on(tmp_path: Path) -> None:
    folder = recording("rope_mocap")
    for number, frames in ((48, 125), (52, 200), (53, 200)):
        part = tmp_path / f"trajectory_{number:03d}.npy"
        np.save(part, np.load(folder / part.name)[:frames])
        import_mocap(part, tmp_path / "sequences")
    config = load_profile("default")
    config = config.replace(object_=config.object_.replace(rope_steps=1))
    run = Run.create(
        tmp_path / "fit",
        name="rope",
        kind="reconstruction",
        sequences=[str(tmp_path / "sequences/trajectory_048")],
        config={"profile": config.to_dict()},
    )
    pipeline.run_job(run)
    errors = []
    for number in (52, 53):
        name = f"trajectory_{number:03d}"
        prediction = Run.create(
            tmp_path / f"predict_{number}",
            name="prediction",
            kind="simulation",
            sequences=[str(tmp_path / "sequences" / name)],
            config={"source": str(run.folder), "parameters": {}},
        )
        pipeline.run_job(prediction)
        scores = prediction.json("metrics.json")[name]["reconstruction"]
        marker = np.load(tmp_path / "sequences" / name / "marker.npy")[:, 2:11]
        rollout = prediction.array(f"sequences/{name}/rollout.npy")[:, 2:11]
        recount = np.linalg.norm(rollout - marker, axis=2)[1:].mean()
        assert scores["rollout"]["marker_error"] == pytest.approx(recount, rel=1e-5)
        assert scores["static"]["marker_error"] > 0.1
        errors.append(recount)
    # It is 14 mm, and 18 mm with a fiftieth of the natural curvature.
    assert np.mean(errors) < 0.016
