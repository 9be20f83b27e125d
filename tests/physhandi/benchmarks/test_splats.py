import json

import numpy as np
import pytest

from physhandi.benchmarks import splats as benchmark
from physhandi.benchmarks.splats import benchmark_splats


def test_figures_are_of_pictures_that_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "SCENES", {"small": (300, 48, 32)})
    monkeypatch.setattr(benchmark, "_ROUNDS", 1)
    found = benchmark_splats(iterations=3)
    scene = found["scenes"]["small"]
    assert json.loads(json.dumps(found))["device"] == "cpu"
    assert (scene["splats"], scene["width"], scene["fit_iterations"]) == (300, 48, 3)
    assert scene["pictures_per_s"] == pytest.approx(
        scene["speedup"] * scene["baseline_pictures_per_s"]
    )
    assert scene["fit_ms_per_iteration"] == pytest.approx(1e3 * scene["fit_s"] / 3)
    assert scene["mean_abs_difference"] < 1e-4
    assert 5.0 < scene["unseen_psnr_db"] < 60.0


def test_the_baseline_draws_something() -> None:
    camera = benchmark._camera(3, 48, 32)
    picture = benchmark.draw_one_by_one(camera, benchmark._ball(300))
    assert picture[16, 24].max() > 0.3
    assert (picture[0, 0] == 0.0).all()
    assert np.isfinite(picture).all()
