"""Child processes get our packages, text in UTF-8, few threads and no secret."""

import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from waiting import until

from app.child import PACKAGE_ROOT, start_module

SECONDS = 150.0
ECHO = ("json.tool", "--compact", "--no-ensure-ascii")


def environment_of(process: psutil.Process) -> dict[str, str]:
    return until(process.environ)  # The kernel may just be replacing the program.


def test_a_child_gets_our_packages_and_few_threads_and_no_secret(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PHYSHANDI_TOKEN", "do-not-tell-anybody")
    monkeypatch.setenv("PHYSHANDI_DEVICE", "cpu")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    settings = {"threads": 3, "environment": {"MARK": "of the run"}}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with start_module(*ECHO, **settings, **pipes) as child:
        about = psutil.Process(child.pid)
        told, folder = environment_of(about), about.cwd()
        child.communicate("1", timeout=SECONDS)
    assert "do-not-tell-anybody" not in told.values()
    assert (told["PHYSHANDI_DEVICE"], told["MARK"]) == ("cpu", "of the run")
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    assert [told[name] for name in names] == ["3", "3", "3"]
    assert folder == str(PACKAGE_ROOT)
    with start_module(*ECHO, **pipes) as child:
        assert environment_of(psutil.Process(child.pid))["OMP_NUM_THREADS"] == "7"
        child.communicate("1", timeout=SECONDS)


def test_what_is_said_to_a_child_arrives_in_every_locale(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LC_ALL", "POSIX")
    monkeypatch.setenv("PYTHONCOERCECLOCALE", "0")
    monkeypatch.setenv("PYTHONUTF8", "0")
    with start_module(*ECHO, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        answer, _ = child.communicate('{"δ": "Hände"}', timeout=SECONDS)
    assert answer == '{"δ":"Hände"}\n'


def test_a_folder_of_the_user_s_named_like_a_package_is_not_run(tmp_path: Path) -> None:
    for package in ("app", "physhandi"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("raise SystemExit('not ours')")
    code = (
        "from app.viewer.live.client import LiveSimulation\n"
        "import queue\n"
        "heard = queue.Queue()\n"
        "live = LiveSimulation()\n"
        "live.subscribe('a', lambda message: heard.put(message.kind))\n"
        "print(heard.get(timeout=140))\n"
        "live.close()\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(PACKAGE_ROOT)},
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    assert (done.stdout, done.returncode) == ("ready\n", 0), done.stderr
