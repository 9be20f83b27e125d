"""Pieces of work that follow each other at once."""

import sys
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from support.waiting import LIMIT_S, until

from app.jobs.recordings import background
from app.jobs.recordings.background import BackgroundTask, BackgroundTasks, Work


class FakeChild:
    """A process that ends by itself at once, or when it is cancelled."""

    may_start = threading.Event()
    requests: list[tuple[str, object]]

    def __init__(self, module: str, **_: object) -> None:
        if module == "second":
            assert self.may_start.wait(LIMIT_S)
        self.module = module
        self.is_cancelled = threading.Event()

    def __enter__(self) -> "FakeChild":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def send(self, request: object) -> None:
        self.requests.append((self.module, request))
        if request == "cancel":
            self.is_cancelled.set()

    def messages(self) -> Iterator[dict[str, Any]]:
        if self.module == "second":
            assert self.is_cancelled.wait(LIMIT_S)
        yield from ()


def waits(thread: threading.Thread) -> bool:
    """Whether a thread waits for an event, or has ended."""
    frame = sys._current_frames().get(thread.ident or 0)
    return not thread.is_alive() or (frame is not None and frame.f_code.co_name == "wait")


def test_a_cancel_reaches_work_that_began_when_that_before_it_was_called_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    has_ended, may_leave = threading.Event(), threading.Event()

    class SlowTask(BackgroundTask):
        """Keeps whoever calls the first work ended from going on."""

        def __setattr__(self, name: str, value: object) -> None:
            super().__setattr__(name, value)
            if name == "state" and value == "done" and not has_ended.is_set():
                has_ended.set()
                assert may_leave.wait(LIMIT_S)

    FakeChild.may_start, FakeChild.requests = threading.Event(), []
    monkeypatch.setattr(background, "BackgroundTask", SlowTask)
    monkeypatch.setattr(background, "Child", FakeChild)
    tasks = BackgroundTasks()
    tasks.start(Work("import", "a", "A is imported."), "first", {})
    assert has_ended.wait(LIMIT_S)
    first = tasks._listener
    assert first is not None
    second = tasks.start(Work("import", "b", "B is imported."), "second", {})
    may_leave.set()
    first.join(LIMIT_S)
    cancelling = threading.Thread(target=tasks.cancel, args=("import", "b"))
    cancelling.start()
    until(lambda: waits(cancelling))
    FakeChild.may_start.set()
    cancelling.join(LIMIT_S)
    assert FakeChild.requests == [("first", {}), ("second", {}), ("second", "cancel")]
    until(lambda: second.state == "done")
