"""Processes of a run are found by their mark, whatever they are doing at that moment."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from app.jobs import processes
from app.jobs.processes import (
    COOKIE,
    cookie_of,
    end_processes,
    has_memory,
    is_loading,
    processes_of,
)

SLEEPER = [sys.executable, "-c", "import time; print(flush=True); time.sleep(300)"]


@contextmanager
def marked(folder: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """Start a process of a run, which has its whole environment."""
    environment = os.environ | {COOKIE: cookie_of(folder, "1")}
    with subprocess.Popen(SLEEPER, env=environment, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield process
        finally:
            process.kill()


def test_a_process_whose_program_is_only_being_loaded_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with marked(tmp_path) as process:
        real = psutil.Process.environ
        looks = {"environ": 0, "loading": 0}

        def environ(asked: psutil.Process) -> dict[str, str]:
            if asked.pid != process.pid:
                return {}
            looks["environ"] += 1
            return real(asked) if looks["environ"] > 3 else {}

        def loading(stat: str) -> bool:
            looks["loading"] += 1
            # At the third look it has an environment, which the reading before did not see.
            return stat.startswith(f"{process.pid} ") and looks["environ"] < 3

        monkeypatch.setattr(psutil.Process, "environ", environ)
        monkeypatch.setattr(processes, "is_loading", loading)
        assert [found.pid for found in processes_of(tmp_path)] == [process.pid]
        assert looks["environ"] == 4


def test_a_program_is_being_loaded_while_it_has_memory_and_no_place_of_its_environment() -> None:
    own = Path("/proc/self/stat").read_text()
    assert not is_loading(own)
    name, _, rest = own.rpartition(")")
    field = rest.split()
    field[46:50] = ["0"] * 4  # Where arguments end, where the environment begins and ends …
    assert is_loading(f"{name}) {' '.join(field)}")
    field[20] = "0"  # … which the kernel's own processes have neither, nor memory.
    assert not is_loading(f"{name}) {' '.join(field)}")
    assert has_memory(own)
    with subprocess.Popen([*SLEEPER], env={}, stdout=subprocess.PIPE) as bare:
        assert bare.stdout is not None
        bare.stdout.readline()
        assert not is_loading(Path(f"/proc/{bare.pid}/stat").read_text())
        bare.kill()


def test_what_never_gets_an_environment_is_asked_for_it_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with marked(tmp_path) as process, subprocess.Popen([sys.executable, "-c", ""]) as ended:
        # A zombie has no memory, like the kernel's own processes, which containers have not.
        os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)
        asked: list[int] = []
        real = psutil.Process.environ

        def environ(one: psutil.Process) -> dict[str, str]:
            asked.append(one.pid)
            return {} if one.pid == ended.pid else real(one)

        monkeypatch.setattr(psutil.Process, "environ", environ)
        assert [found.pid for found in processes_of(tmp_path)] == [process.pid]
        assert asked.count(ended.pid) == asked.count(process.pid) == 1


def test_a_process_with_the_number_of_an_earlier_one_is_ended(tmp_path: Path) -> None:
    list(psutil.process_iter())
    with marked(tmp_path) as process:
        earlier = psutil.Process(process.pid)
        earlier._ident = (process.pid, 1.0)
        psutil._pmap[process.pid] = earlier
        assert end_processes(tmp_path, grace_s=0.0) == 1
        assert process.wait() == -9
