"""The load of the machine against what the kernel tells, and graphics cards that are made up."""

import os
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import psutil
import pytest
from support.waiting import LIMIT_S, until

from app.jobs import machine as cards_module
from app.jobs.machine import Cards, Machine, ask_driver
from app.jobs.processes import end_processes

BUSY = """
import subprocess, sys, time
from pathlib import Path
from app.jobs.processes import claim_supervision
claim = claim_supervision(Path(sys.argv[1]))
child = subprocess.Popen([sys.executable, "-c", "x = b'x' * (80 * 2**20)\\nwhile True: pass"])
print(child.pid, flush=True)
child.wait()
"""
TWO_CARDS = {
    "--query-gpu": "0, NVIDIA H200, 50, 1024, 143771, 41, GPU-a\n"
    "1, NVIDIA H200, [N/A], 0, 9, [N/A], GPU-b\n",
    "--query-compute-apps": "4711, 900\n4712, 100\n4711, 24\n",
}


def made_up(arguments: list[str]) -> str:
    assert arguments[1] == "--format=csv,noheader,nounits"
    return TWO_CARDS[arguments[0].partition("=")[0]]


def test_the_load_is_what_the_kernel_tells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: dict[str, Any] = {}

    def hear(name: str) -> None:
        """Remember an answer: others take and give back all the time, so the next is another."""
        ask = getattr(psutil, name)
        monkeypatch.setattr(psutil, name, lambda *about: told.setdefault(name, ask(*about)))

    machine = Machine(tmp_path, Cards(made_up))
    for name in ("virtual_memory", "disk_usage", "cpu_percent"):
        hear(name)
    load = machine.load()
    (memory_total,) = re.findall(r"MemTotal: +(\d+) kB", Path("/proc/meminfo").read_text())
    disk_total = shutil.disk_usage(tmp_path).total
    memory, disk = told["virtual_memory"], told["disk_usage"]
    used = memory.total - memory.available
    assert 0 < used < memory.total == int(memory_total) * 1024
    assert load["memory"] == {
        "used": used,
        "total": memory.total,
        "share": pytest.approx(used / memory.total, abs=6e-4),
    }
    assert 0 < disk.free < disk_total
    assert load["disk"] == {
        "used": disk_total - disk.free,
        "free": disk.free,
        "total": disk_total,
        "share": pytest.approx(1 - disk.free / disk_total, abs=6e-4),
    }
    assert load["processor"]["count"] == os.cpu_count()
    assert load["processor"]["share"] == pytest.approx(told["cpu_percent"] / 100, abs=6e-4)
    assert 0.0 <= load["processor"]["share"] <= 1.0


def test_a_folder_that_is_not_made_yet_has_a_disk_all_the_same(tmp_path: Path) -> None:
    assert Machine(tmp_path / "later").load()["disk"]["total"] > 0


def test_a_run_takes_what_all_its_processes_take(tmp_path: Path) -> None:
    machine = Machine(tmp_path, Cards(made_up))
    assert machine.of_run(tmp_path) is None
    environment = os.environ | {"PHYSHANDI_RUN": f"{tmp_path}:1"}
    command = [sys.executable, "-c", BUSY, str(tmp_path)]
    supervisor = subprocess.Popen(
        command, stdout=subprocess.PIPE, env=environment, cwd=Path(__file__).parents[3]
    )
    try:
        assert supervisor.stdout is not None
        supervisor.stdout.readline()
        first = machine.of_run(tmp_path)
        assert first is not None
        assert first["processes"] == 2
        # More than one processor is told if something came between two looks at two clocks.
        found: dict[str, Any] = {}

        def is_whole() -> bool:
            found.update(machine.of_run(tmp_path) or {})
            return 0.02 <= found["processors"] < 1.5 and found["memory"] > 85 * 2**20

        until(is_whole, lambda: found)
        assert found["card_memory"] is None
    finally:
        end_processes(tmp_path, grace_s=0.0)
        supervisor.communicate()
    assert machine.of_run(tmp_path) is None


def test_cards_are_read_as_their_driver_tells_and_held_by_process() -> None:
    cards = Cards(made_up)
    assert cards.memory_of([4711]) is None
    cards.refresh()
    first, second = cards.read()
    assert first == {
        "index": 0,
        "name": "NVIDIA H200",
        "share": 0.5,
        "memory": 1024 * 2**20,
        "memory_total": 143771 * 2**20,
        "temperature": 41.0,
        "uuid": "GPU-a",
    }
    assert cards.free_memory("GPU-a") == (143771 - 1024) * 2**20
    assert cards.free_memory("GPU-c") is None
    assert (second["share"], second["temperature"]) == (None, None)
    assert cards.memory_of([4711, 1]) == 924 * 2**20
    assert cards.memory_of([1]) == 0


def test_without_a_card_or_an_answer_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: list[str]) -> str:
        raise OSError("Unable to determine the device handle")

    for ask in (broken, lambda _: "No devices were found\n", lambda _: "x, y, 1, 2, 3, 4\n"):
        cards = Cards(ask)
        cards.refresh()
        assert cards.read() == []
        assert cards.memory_of([1]) is None
    monkeypatch.setattr(cards_module.shutil, "which", lambda _: None)
    with pytest.raises(FileNotFoundError):
        ask_driver(["--version"])
    monkeypatch.setattr(cards_module.shutil, "which", lambda _: "/bin/false")
    with pytest.raises(OSError, match="non-zero"):
        ask_driver(["--version"])


def test_nobody_waits_for_a_slow_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cards_module, "_KEPT_S", float("inf"))
    asked: list[list[str]] = []
    answer = threading.Event()

    def slow(arguments: list[str]) -> str:
        asked.append(arguments)
        assert answer.wait(LIMIT_S)
        return made_up(arguments)

    cards = Cards(slow)
    assert [cards.read() for _ in range(50)] == [[]] * 50
    assert len(asked) <= 1
    answer.set()
    until(cards.read)
    assert len(asked) == 2
