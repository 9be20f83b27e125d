"""What a run notes of the program and the machine."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from physhandi.data.environment import commit_of, describe_environment
from physhandi.devices import processor_name


def test_the_device_and_the_versions_are_noted() -> None:
    told = describe_environment("cuda:0", "A fast one")
    assert (told["device"], told["device_name"]) == ("cuda:0", "A fast one")
    assert told["packages"]["numpy"] == np.__version__
    assert told["started"].endswith("+00:00")
    assert describe_environment("cpu", "CPU")["device_name"] == processor_name()


def test_the_commit_is_the_one_that_git_names(tmp_path: Path) -> None:
    assert commit_of(tmp_path) is None

    def git(*arguments: str) -> str:
        who = ("-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false")
        command = ["git", "-C", str(tmp_path), *who, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "--quiet", "--initial-branch=work")
    assert commit_of(tmp_path) is None
    git("commit", "--quiet", "--allow-empty", "--message=first")
    first = git("rev-parse", "HEAD")
    assert commit_of(tmp_path) == first
    git("pack-refs", "--all")
    assert commit_of(tmp_path) == first
    git("commit", "--quiet", "--allow-empty", "--message=second")
    assert commit_of(tmp_path) == git("rev-parse", "HEAD") != first
    git("checkout", "--quiet", "--detach", first)
    assert commit_of(tmp_path) == first


@pytest.mark.parametrize("head", ["ref: refs/heads/none\n", "ref: refs/heads/ü\n"])
def test_a_damaged_checkout_names_no_commit(tmp_path: Path, head: str) -> None:
    (tmp_path / ".git").mkdir()
    (tmp_path / ".git" / "HEAD").write_text(head)
    assert commit_of(tmp_path) is None
