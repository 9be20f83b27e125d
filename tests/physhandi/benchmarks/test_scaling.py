"""The table of sizes is complete, bounded in time, and its exponents are right."""

import json

import pytest

from physhandi.benchmarks import scaling
from physhandi.benchmarks.scaling import benchmark_scaling
from physhandi.errors import UsageError


def test_every_size_is_measured_beside_the_baseline(device):
    result = benchmark_scaling(
        device=device,
        node_counts=(60, 30),
        springs_at_node=(18, 9),
        frame_count=2,
        substeps_per_frame=100,
    )
    assert json.loads(json.dumps(result)) == result
    sizes = [(row["nodes"], row["springs_at_node"]) for row in result["table"]]
    assert sizes == [(30, 9), (30, 18), (60, 9), (60, 18)]
    for row in result["table"]:
        held = row["springs"] - row["nodes"] * row["springs_at_node"] / 2
        assert 9 <= held <= 54
        assert row["ms_per_frame"] > 0.0
        assert row["baseline_ms_per_frame"] > 0.0
        assert row["max_abs_difference_m"] < 1e-6
        assert row["motion_m"] > 1e-3
    assert result["skipped"] == []
    assert len(result["growth"]) == 4


@pytest.fixture
def law(monkeypatch):
    """Let frames take a time that is known from the size of the block."""

    def measure(scene, device, *, rounds):
        nodes, springs = scene.model.node_count, scene.model.object_spring_count
        times = {"ms_per_frame": springs**1.5, "baseline_ms_per_frame": nodes**2.0}
        return times | {"max_abs_difference_m": 0.0, "motion_m": 0.0}

    monkeypatch.setattr(scaling, "measure_rollout", measure)


def test_the_exponents_are_those_of_the_law(law, monkeypatch):
    # Virtual springs would blur the number of springs.
    monkeypatch.setattr(scaling, "_size", lambda scene: scene.model.object_spring_count)
    result = benchmark_scaling(node_counts=(100, 200, 400), springs_at_node=(10, 20))
    growth = {(g["over"], g.get("nodes"), g.get("springs_at_node")): g for g in result["growth"]}
    assert set(growth) == {
        *(("nodes", None, around) for around in (10, 20)),
        *(("springs", nodes, None) for nodes in (100, 200, 400)),
    }
    over_nodes = growth["nodes", None, 10]
    assert over_nodes["blocks"] == 3
    assert over_nodes["exponent"] == pytest.approx(1.5)
    assert over_nodes["exponent_of_last_two"] == pytest.approx(1.5)
    assert over_nodes["baseline_exponent"] == pytest.approx(2.0)
    over_springs = growth["springs", 400, None]
    assert over_springs["exponent"] == pytest.approx(1.5)
    assert over_springs["baseline_exponent"] == pytest.approx(0.0, abs=1e-12)


def test_blocks_that_would_take_too_long_are_left_out_and_named(law, monkeypatch):
    now = [0.0]

    class Clock:
        """Ten seconds pass each time that somebody looks."""

        @staticmethod
        def monotonic():
            now[0] += 10.0
            return now[0]

    monkeypatch.setattr(scaling, "time", Clock)
    result = benchmark_scaling(
        node_counts=(50, 100, 100_000), springs_at_node=(10,), time_limit_s=100.0
    )
    assert [row["nodes"] for row in result["table"]] == [50, 100]
    assert result["skipped"] == [{"nodes": 100_000, "springs_at_node": 10}]
    with pytest.raises(UsageError, match="time_limit_s of a benchmark is 0"):
        benchmark_scaling(time_limit_s=0.0)
