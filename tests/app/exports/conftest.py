"""A finished run to export, and a workshop that works in this process."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from server_world import World

from app.exports.making import make
from app.exports.order import Order
from app.exports.workshop import Work, Workshop
from physhandi.data.run import Run


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Order]:
    """Has files made in this process; the orders that were carried out."""
    orders: list[Order] = []

    def run(_: Workshop, order: Order, work: Work) -> None:
        again = Order.from_text(order.to_text())
        orders.append(again)
        make(again, work.path)

    monkeypatch.setattr(Workshop, "_run", run)
    return orders


@pytest.fixture
def run(world: World) -> Run:
    return world.catalog.run("fitted")


@pytest.fixture
def workshop(tmp_path: Path) -> Iterator[Workshop]:
    workshop = Workshop(tmp_path / "cache")
    yield workshop
    workshop.close()
