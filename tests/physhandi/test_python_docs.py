"""The code that users are shown: docs/python.md, README.md and the notebooks, executed."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.inputs.sheet_sequence import FRAMES, NODE, sheet_config, write_sheet

import physhandi as ph
from physhandi import pipeline
from physhandi.fitting.config import load_profile

ROOT = Path(__file__).parents[2]
SMALL = sheet_config(generations=2, population=6, iterations=2)


def blocks(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", (ROOT / page).read_text(), re.M | re.S)


def cells(notebook: Path) -> list[str]:
    content = json.loads(notebook.read_text())
    return ["".join(c["source"]) for c in content["cells"] if c["cell_type"] == "code"]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two recordings, and with the run that the pages ask for, fitted cheaply."""
    folder = tmp_path_factory.mktemp("desk")
    for name, lift in (("towel_fold", 0.12), ("towel_pull", 0.2)):
        write_sheet(folder / "sequences" / name, lift=lift)
    sequence = ph.load(folder / "sequences" / "towel_fold")
    run = ph.Run.create(
        folder / "runs" / "towel",
        name="towel",
        kind="reconstruction",
        sequences=[str(sequence.folder)],
        config={"profile": load_profile("quick").to_dict()},
    )
    with run.begin_attempt() as attempt:
        pipeline.run_reconstruction([sequence], SMALL, attempt, attempt.progress())
        attempt.publish()
    return folder


def execute(texts: list[str]) -> None:
    names: dict[str, object] = {}
    for text in texts:
        exec(compile(text, "documentation", "exec"), names)  # noqa: S102  # our own pages


def fitting_the_sheet(page: str) -> list[str]:
    """The code of a page; the sheet's nodes are farther apart than a towel's, its frames ten."""
    return [
        text.replace("radius=0.035", "radius=0.085").replace("forces(10)", "forces(6)")
        for text in blocks(page)
    ]


def test_the_code_of_the_page_on_python_runs(desk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(desk)
    texts = fitting_the_sheet("docs/python.md")
    assert len(texts) > 3
    execute(texts)
    assert (desk / "towel.glb").is_file()


def test_the_first_page_s_example_is_all_that_an_interpreter_needs(desk: Path) -> None:
    (example,) = fitting_the_sheet("README.md")
    shown = "import physhandi\nphyshandi.Run.show = lambda run: print('shown:', run.id)\n"
    (desk / "softer.glb").unlink(missing_ok=True)
    done = subprocess.run(
        [sys.executable, "-c", shown + example],
        cwd=desk,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{(FRAMES, len(NODE), 3)} {(len(NODE), 3)}\nshown: towel\n"
    assert (desk / "softer.glb").read_bytes()[:4] == b"glTF"


@pytest.mark.parametrize("notebook", sorted((ROOT / "docs/notebooks").glob("*.ipynb")), ids=str)
def test_a_notebook_runs(
    notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    texts = cells(notebook)
    assert texts
    execute(texts)
    assert "mm at most from the fit" in capsys.readouterr().out


def test_every_public_name_is_documented() -> None:
    page = (ROOT / "docs/python.md").read_text()
    for name in set(dir(ph)) - {"__version__"}:
        assert f"ph.{name}" in page or f"`{name}`" in page, name
