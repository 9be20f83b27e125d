"""Inputs that nobody thought of: whatever is given, an entrance answers in its own words."""

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient
from support.hostile.bad_input_world import Terminal
from support.hostile.damaged_files import places
from support.property_tests import SAME_EVERYWHERE
from support.server.server_world import make_world

from app.cli.runs import OVERRIDES
from physhandi import pipeline
from physhandi.data.sequence import Sequence
from physhandi.errors import FitError, RunError, SequenceError, UsageError
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters
from physhandi.simulation.topology import build_model

QUICK = settings(SAME_EVERYWHERE, max_examples=25)
NUMBER = st.one_of(
    st.floats(), st.integers(), st.sampled_from([0, -1, 10**12, 10**400, 1e308, math.nan, math.inf])
)


def texts(**sizes: int) -> st.SearchStrategy[str]:
    """Texts of all characters but halves of surrogate pairs, which is what Hypothesis draws, too.

    It tries to encode each of a million characters to find out which those are.
    """
    return st.text(st.characters(exclude_categories=["Cs"]), **sizes)


LEAF = st.one_of(st.none(), st.booleans(), NUMBER, texts(max_size=8), st.dates(), st.binary())
ANYTHING = st.recursive(
    LEAF,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(texts(max_size=6) | st.integers(), inner, max_size=4)
    ),
    max_leaves=8,
)


class PassedError(FitError):
    """Says that the entrance let the input pass."""


@pytest.fixture
def gate(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """A command line that stops where the work would begin."""

    def stop(run: Run, *_: object, **__: object) -> None:
        shutil.rmtree(run.folder)
        raise PassedError("passed")

    monkeypatch.setattr(pipeline, "run_job", stop)
    return terminal


def answers(terminal: Terminal, *order: object) -> str:
    """Give an order; it must end with one line in plain words. Returns the line."""
    code, out, error = terminal(*order)
    line = error.splitlines()[-1]
    assert code in {1, 2}
    assert out == ""
    assert "Traceback" not in error
    # A word of the wrong kind is shown with the help of its option, in a frame.
    assert line.startswith("physhandi: ") or (code == 2 and "--help" in error)
    return line


@QUICK
@given(data=st.data(), value=ANYTHING)
def test_any_value_in_any_place_of_sequence_yaml(
    filmed: Path, data: st.DataObject, value: Any
) -> None:
    path = filmed / "sequence.yaml"
    original = path.read_text()
    content = yaml.safe_load(original)
    place = data.draw(st.sampled_from(list(places(content))))
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    try:
        path.write_text(yaml.safe_dump(content))
        Sequence.load(filmed).validate(reads_color=False)
    except SequenceError as error:
        assert "'filmed'" in str(error)  # noqa: PT017 - whether it raises depends on the value
    finally:
        path.write_text(original)


@QUICK
@example(text=b"name: &a [x, x]\nviews: [*a, *a]\n")
@example(text=b"a: " + b"9" * 5000)
@example(text=b"frame_count: 0x" + b"f" * 5000)
@example(text=b"format: physhandi-sequence/1\nframe_count: 0x" + b"f" * 5000)
@example(text=b"a: 2001-99-99")
@example(text=b"a: !!int ''")
@example(text=b"? [a]: b")
@example(text=b"[" * 700)
@example(text=b"a: &a\n  b: *a\n")
@given(text=st.one_of(st.binary(max_size=80), texts(max_size=80).map(str.encode)))
def test_any_text_as_a_description(filmed: Path, text: bytes) -> None:
    for file in ("sequence.yaml", "run.yaml", "job.yaml"):
        (filmed / file).write_bytes(text)
    with pytest.raises(SequenceError, match="'filmed'"):
        Sequence.load(filmed)
    with pytest.raises(RunError, match="filmed"):
        Run.open(filmed)


@pytest.mark.filterwarnings("ignore:Reading .* required additional header parsing")
@QUICK
@given(data=st.data())
def test_any_damage_to_an_array_or_an_image(filmed: Path, sheet: Path, data: st.DataObject) -> None:
    files = ["control.npy", "marker_node.npy", "object_node.npy"]
    images = [f"views/front/{part}/00001.png" for part in ("depth", "mask")]
    folder, rel = data.draw(
        st.sampled_from([(sheet, f) for f in files] + [(filmed, f) for f in images])
    )
    path = folder / rel
    original = path.read_bytes()
    content = bytearray(original)
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, min(len(content) - 1, 160)))
        content[place : place + data.draw(st.integers(0, 2))] = data.draw(st.binary(max_size=3))
    path.write_bytes(bytes(content))
    try:
        Sequence.load(folder).validate(reads_color=False)
    except SequenceError as error:
        assert folder.name in str(error)  # noqa: PT017 - whether it raises depends on the damage
    finally:
        path.write_bytes(original)


@QUICK
@given(
    option=st.sampled_from(OVERRIDES),
    value=st.one_of(NUMBER.map(str), texts(max_size=6), st.sampled_from(["None", "auto", ""])),
)
def test_any_value_of_any_parameter(gate: Terminal, fitted: Path, option: str, value: str) -> None:
    order = ("simulate", fitted, "--out", "out", "--device", "cpu")
    answers(gate, *order, f"--{option.replace('_', '-')}={value}")
    assert not (gate.folder / "out").exists()


@QUICK
@given(
    values=st.dictionaries(
        st.sampled_from([*SimulationParameters.__struct_fields__, "colour"]), LEAF, max_size=3
    )
)
def test_parameters_are_either_refused_or_usable(values: dict[str, Any]) -> None:
    try:
        parameters = SimulationParameters.from_dict(values)
    except UsageError:
        return
    node = np.random.default_rng(0).random((12, 3)) * 0.05
    model = build_model(node, node[:2], parameters)
    assert model.virtual_spring_count <= 2 * min(12, parameters.virtual_max_neighbors)
    assert math.isfinite(parameters.dt)


@pytest.fixture
def client(tmp_path: Path, sheet: Path) -> TestClient:
    (tmp_path / "data" / "runs").mkdir(parents=True)
    shutil.copytree(sheet, tmp_path / "data" / "sequences" / "sheet")
    return make_world(tmp_path / "data", bundled=tmp_path / "nothing").script()


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | texts(max_size=6),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["sequences", "profile", "name", "kind", "id"]) | texts(max_size=4),
            inner,
            max_size=4,
        )
    ),
    max_leaves=6,
)


@QUICK
@given(body=JSON, path=st.sampled_from(["runs", "sessions"]))
def test_any_body_of_a_request(client: TestClient, body: Any, path: str) -> None:
    import json

    headers = {"Content-Type": "application/json"}
    response = client.post(f"/api/v1/{path}", content=json.dumps(body), headers=headers)
    assert 400 <= response.status_code < 500
    assert response.json()["error"]["message"]


@QUICK
@given(id_=texts(min_size=1, max_size=12))
def test_any_id_in_an_address(client: TestClient, id_: str) -> None:
    from urllib.parse import quote

    for path in ("/api/v1/runs/{}", "/api/v1/sequences/{}", "/runs/{}", "/live/{}"):
        response = client.get(path.format(quote(id_, safe="")))
        assert response.status_code in {200, 307, 308} or 400 <= response.status_code < 500
        assert "Traceback" not in response.text
