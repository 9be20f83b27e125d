"""What is free on a device, also in a container."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from physhandi.simulation.engines import tape
from physhandi.simulation.engines.tape import container_memory, free_memory


def write(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    return folder


VERSION_2 = {"memory.current": "700\n", "memory.stat": "anon 500\ninactive_file 150\n"}
VERSION_1 = {
    "memory/memory.limit_in_bytes": "1000\n",
    "memory/memory.usage_in_bytes": "900\n",
    "memory/memory.stat": "cache 5\ninactive_file 1\ntotal_inactive_file 20\n",
}


@pytest.mark.parametrize(
    ("files", "left"),
    [
        ({"memory.max": "1000\n", **VERSION_2}, 450),
        ({"memory.max": "500\n", **VERSION_2}, 0),
        ({"memory.max": "max\n", **VERSION_2}, None),
        (VERSION_1, 120),
        ({}, None),
    ],
    ids=["version 2", "full", "no limit", "version 1", "no container"],
)
def test_a_container_leaves_its_limit_less_what_is_used(tmp_path, files, left):
    assert container_memory(write(tmp_path, files)) == left


def test_the_smaller_of_machine_and_container_counts(tmp_path, monkeypatch):
    device = SimpleNamespace(is_cuda=False)
    machine = SimpleNamespace(available=2000)
    monkeypatch.setattr("psutil.virtual_memory", lambda: machine)
    monkeypatch.setattr(tape, "_CGROUP", tmp_path)
    assert free_memory(device) == 2000
    write(tmp_path, {"memory.max": "1000\n", **VERSION_2})
    assert free_memory(device) == 450
    machine.available = 100
    assert free_memory(device) == 100


def test_a_gpu_says_itself_what_is_free():
    assert free_memory(SimpleNamespace(is_cuda=True, free_memory=77)) == 77
