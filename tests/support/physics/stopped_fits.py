"""Stops a loop of a fit at a chosen report, lets it go on in another attempt, and compares bits."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from torch import Tensor

from physhandi.data import checkpoint
from physhandi.data.checkpoint import Checkpointer, FileCheckpointer
from physhandi.errors import CancelledError
from physhandi.progress import Progress

ORIGIN = {"settings": "those of the test"}
Report = tuple[str, int, float | None, str]
Fit = Callable[[Progress, Checkpointer | None], Any]


class Stopper(Progress):
    """Keeps stage, iteration, loss and message of all reports, and stops at one of them."""

    def __init__(self, at: int | None = None, *, stage: str = "") -> None:
        """Prepare.

        Args:
            at: Number of the report at which the user cancels, counted from 1; None is never.
            stage: Only reports of this stage count; empty for all.
        """
        self.reports: list[Report] = []
        self._at, self._stage = at, stage

    def report(
        self, stage: str, iteration: int, total: int, loss: float | None = None, message: str = ""
    ) -> None:
        if self._stage not in {"", stage}:
            return
        self.reports.append((stage, iteration, loss, message))
        if len(self.reports) == self._at:
            raise CancelledError(f"stopped at {iteration} of {total}")


def write_always(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every state that is offered be written."""
    monkeypatch.setattr(checkpoint, "CHECKPOINT_INTERVAL_S", 0.0)
    monkeypatch.setattr(checkpoint, "CHECKPOINT_SHARE", np.inf)


def same_bits(first: Any, second: Any, where: str = "result") -> None:
    """Require two results to be the same to the last bit, whatever they are made of."""
    assert type(first) is type(second), where
    if isinstance(first, Tensor):
        first, second = first.numpy(), second.numpy()
    if isinstance(first, np.ndarray):
        assert (first.dtype, first.shape) == (second.dtype, second.shape), where
        assert first.tobytes() == second.tobytes(), where
    elif is_dataclass(first):
        for field in fields(first):
            name = field.name
            same_bits(getattr(first, name), getattr(second, name), f"{where}.{name}")
    elif isinstance(first, dict):
        ours, others = cast("dict[Any, Any]", first), cast("dict[Any, Any]", second)
        assert list(ours) == list(others), where
        for key, value in ours.items():
            same_bits(value, others[key], f"{where}[{key!r}]")
    elif isinstance(first, list | tuple):
        ours, others = cast("list[Any]", first), cast("list[Any]", second)
        assert len(ours) == len(others), where
        for number, pair in enumerate(zip(ours, others, strict=True)):
            same_bits(*pair, f"{where}[{number}]")
    else:
        assert first == second or first != first, where  # noqa: PLR0124  (NaN)


def check_resumed(fit: Fit, folder: Path, stops: tuple[int, ...]) -> list[Report]:
    """Stop a loop at some of its reports, one attempt after the other, and let it end.

    Args:
        fit: Makes the whole fit.
        folder: Where checkpoints go.
        stops: Number of each attempt's last report, counted from 1.

    Returns:
        The reports of the last attempt; the first of them says after which iteration it went on.
    """
    whole = Stopper()
    expected = fit(whole, None)
    heard: dict[tuple[str, int, str], float | None] = {}
    for at in stops:
        stopper = Stopper(at)
        with pytest.raises(CancelledError):
            fit(stopper, FileCheckpointer(folder, ORIGIN))
        heard |= {(s, i, m): loss for s, i, loss, m in stopper.reports if "Resumed" not in m}
    last = Stopper()
    same_bits(fit(last, FileCheckpointer(folder, ORIGIN)), expected)
    heard |= {(s, i, m): loss for s, i, loss, m in last.reports if "Resumed" not in m}
    # No attempt told anything that the undisturbed one did not, and together they told all of it.
    told = {(s, i, m): loss for s, i, loss, m in whole.reports}
    same_bits(dict(sorted(heard.items())), dict(sorted(told.items())))
    assert "Resumed after iteration" in last.reports[0][3]
    assert len(last.reports) < len(whole.reports)
    return last.reports
