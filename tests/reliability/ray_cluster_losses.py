"""Nodes and heads of a real Ray cluster; see `ray_cluster`."""

import sys
from collections.abc import Callable
from pathlib import Path

from support.server.ray_cluster import RAY, RealCluster, real_cluster

from physhandi.run import Run
from reliability import Case, Report
from reliability.jobs import disturb


def _disturb_cluster(count: int, folder: Path, deed: Callable[[RealCluster], None]) -> Report:
    with real_cluster() as cluster:
        cluster.start_node()

        def lose(_: Run) -> None:
            deed(cluster)
            cluster.start_node()

        settings = {
            "engine": cluster.address,
            "engine_token": cluster.token,
            "cluster_python": sys.executable,
        }
        return disturb(count, folder, lose, **settings)


def lose_nodes(count: int, folder: Path) -> Report:
    return _disturb_cluster(count, folder, RealCluster.lose_node)


def lose_heads(count: int, folder: Path) -> Report:
    def lose(cluster: RealCluster) -> None:
        cluster.lose_head()
        cluster.start_head()

    return _disturb_cluster(count, folder, lose)


CASES = (
    {
        "R19 nodes": Case("The node of a Ray cluster that runs a fit is killed", 5, 0, lose_nodes),
        "R19 heads": Case(
            "The head of a Ray cluster is killed, and started again", 5, 0, lose_heads
        ),
    }
    if RAY.exists()
    else {}
)
