"""Choosing and ordering runs, and the figures that a list shows of them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from support.server.server_world import World

from app.jobs import catalog
from app.jobs.catalog import Catalog, UnknownRunError
from app.jobs.listing import RunQuery, page_of, select_runs
from app.jobs.views import summarize_run, tags_of
from app.settings import ServerSettings
from physhandi.errors import UsageError
from physhandi.run import Run


def entry(run_id: str, **fields: Any) -> dict[str, Any]:
    return {
        "id": run_id,
        "name": run_id,
        "is_bundled": False,
        "is_published": True,
        "state": "succeeded",
        "kind": "reconstruction",
        "created": "2026-01-01",
        "sequences": ["towel"],
        "profile": "quick",
        "tags": [],
        "duration_s": None,
        "track_error_fitted": None,
        "track_error_predicted": None,
    } | fields


RUNS = [
    entry("b", name="Towel, soft", track_error_fitted=0.004, duration_s=30.0, created="2026-03-01"),
    entry("a", name="rope wide", state="failed", sequences=["rope"], is_published=False),
    entry("c", name="Rope narrow", profile="paper", sequences=["rope"], track_error_fitted=0.0391),
    entry("d", name="towel again", kind="simulation", profile="", tags=["Best", "icml"]),
    entry("e", name="Shipped", is_bundled=True, track_error_fitted=0.0039, duration_s=4.0),
]


def chosen(**fields: Any) -> str:
    return "".join(run["id"] for run in select_runs(RUNS, RunQuery(**fields)))


@pytest.mark.parametrize(
    ("words", "ids"),
    [
        ("", "bacde"),
        ("rope", "ac"),
        ("ROPE narrow", "c"),
        ("paper", "c"),
        ("is:bundled", "e"),
        ("is:mine towel", "bd"),
        ("-is:bundled -rope", "bd"),
        ("is:failed", "a"),
        ("state:failed", "a"),
        ("-is:published", "a"),
        ("kind:simulation", "d"),
        ("tag:best", "d"),
        ("icml", "d"),
        ("sequence:rope -profile:paper", "a"),
        ("sequence:ro", ""),
        ("state:", "bacde"),
        ("-", ""),
    ],
)
def test_words_and_conditions_choose(words: str, ids: str) -> None:
    assert chosen(q=words) == ids


def test_fields_choose_as_conditions_do() -> None:
    assert chosen(sequence="rope", profile="paper") == "c"
    assert chosen(state="succeeded", kind="simulation") == "d"
    assert chosen(q="towel", state="failed") == ""


@pytest.mark.parametrize("words", ["colour:red", "is:nice", "-is:nice"])
def test_an_unknown_condition_is_named_with_those_that_there_are(words: str) -> None:
    with pytest.raises(UsageError, match=r"knows no '(colour:|is:nice)'.* (profile:|bundled)"):
        chosen(q=words)


@pytest.mark.parametrize(
    ("sort", "ids"),
    [
        ("name", "caedb"),
        ("-name", "bdeac"),
        ("fitted", "ebcad"),
        ("-fitted", "cbead"),
        ("duration", "ebacd"),
        ("-created", "bacde"),
        ("state", "bcdea"),
        ("sequence", "acbde"),
        ("profile", "cbaed"),
    ],
)
def test_a_column_orders_either_way_and_what_lacks_the_figure_is_last(sort: str, ids: str) -> None:
    assert chosen(sort=sort) == ids


def test_every_column_orders_as_python_does() -> None:
    figures = np.random.default_rng(3).uniform(0, 1, 200).round(2).tolist()
    runs = [entry(str(n), name=f"n{f}", duration_s=f) for n, f in enumerate(figures)]
    for sort in ("duration", "name"):
        found = [run["duration_s"] for run in select_runs(runs, RunQuery(sort=sort))]
        assert found == sorted(figures)


def test_a_page_is_cut_out_and_an_address_tells_only_what_is_set() -> None:
    query = RunQuery(q="is:mine rope", sort="-fitted", limit=2, offset=1)
    assert [run["id"] for run in page_of(RUNS, query)] == ["a", "c"]
    assert page_of(RUNS, RunQuery()) == RUNS
    assert RunQuery().address() == "runs"
    assert query.address() == "runs?q=is%3Amine+rope&sort=-fitted&limit=2"
    assert query.address(limit=None, offset=4, q="ö&") == "runs?q=%C3%B6%26&sort=-fitted&offset=4"


@pytest.mark.parametrize(
    "fields", [{"sort": "size"}, {"limit": 0}, {"limit": 10_001}, {"offset": -1}, {"colour": "red"}]
)
def test_a_wrong_query_is_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=next(iter(fields))):
        RunQuery(**fields)


def test_tags_are_the_parts_of_a_label() -> None:
    assert tags_of(" best, icml ,best,, ") == ["best", "icml"]
    assert tags_of("") == []


def write_metrics(run: Run, metrics: dict[str, Any]) -> None:
    (run.out / "metrics.json").write_text(json.dumps(metrics))


def scores(error: float, first: int, end: int) -> dict[str, Any]:
    return {"frames": [first, end], "rollout": {"track_error": error}}


def test_a_summary_is_the_mean_over_frames_and_the_sum_over_stages(world: World) -> None:
    run = Run.open(world.settings.run_dir / "fitted")
    seconds = [stage["seconds"] for stage in run.stages()]
    write_metrics(
        run,
        {
            "one": {"reconstruction": scores(0.002, 1, 11), "future": scores(0.5, 11, 12)},
            "two": {"reconstruction": scores(0.005, 1, 21)},
            "unitless": {"unit": "board square", "reconstruction": scores(7.0, 1, 9)},
            "hand": {"hands": {"right": {"reprojection_median": 4.0, "scored_keypoints": 30}}},
            "other": {"hands": {"left": {"reprojection_median": 2.0, "scored_keypoints": 10}}},
        },
    )
    summary = summarize_run(run)
    assert summary.track_error_fitted == pytest.approx((10 * 0.002 + 20 * 0.005) / 30)
    assert summary.track_error_predicted == 0.5
    assert summary.reprojection == pytest.approx(3.5)
    assert len(seconds) > 2
    assert summary.duration_s == pytest.approx(sum(seconds))
    (run.out / "metrics.json").write_text("{")
    assert summarize_run(run).track_error_fitted is None
    assert summarize_run(run).duration_s == summary.duration_s


def test_a_simulation_of_an_unseen_sequence_is_a_prediction(world: World, tmp_path: Path) -> None:
    source = Run.open(world.settings.run_dir / "fitted")
    (seen,) = source.sequences
    for name, unseen in (("sheet", False), ("other", True)):
        folder = tmp_path / name
        run = Run.create(
            folder, name=name, kind="simulation", sequences=[seen], config={"source": source.folder}
        )
        run.sequence_names = [name]
        (folder / "attempts/1/out").mkdir(parents=True)
        write_metrics(run, {name: {"reconstruction": scores(0.25, 1, 9)}})
        summary = summarize_run(run)
        found = (summary.track_error_fitted, summary.track_error_predicted)
        assert found == ((None, 0.25) if unseen else (0.25, None))


def test_the_api_filters_sorts_and_cuts(world: World) -> None:
    client = world.script()
    everything = client.get("/api/v1/runs").json()
    assert everything["total"] == len(everything["runs"]) >= 2
    mine = client.get("/api/v1/runs?q=-is:bundled&sort=fitted&limit=1").json()
    assert (mine["total"], [run["id"] for run in mine["runs"]]) == (1, ["fitted"])
    assert 0 < mine["runs"][0]["track_error_fitted"] < 0.1
    assert mine["runs"][0]["duration_s"] > 0
    assert client.get("/api/v1/runs?offset=1").json()["runs"] == everything["runs"][1:]
    assert client.get("/api/v1/runs?state=failed").json() == {"runs": [], "total": 0}
    for wrong in ("sort=size", "limit=none", "q=is:nice", "colour=red"):
        refused = client.get(f"/api/v1/runs?{wrong}")
        assert refused.status_code == 422
        assert refused.json()["error"]["code"] == "invalid"


def test_a_run_is_found_by_its_name_only(world: World) -> None:
    assert world.catalog.run_item("fitted").folder == world.settings.run_dir / "fitted"
    for name in ("", ".", "..", "../runs/fitted", "nothing", "fitted/", "a\0b", ".hidden"):
        with pytest.raises(UnknownRunError):
            world.catalog.run_item(name)


def test_a_run_that_changed_is_described_anew(world: World) -> None:
    client = world.script()
    first = client.get("/api/v1/runs?q=is:mine").json()["runs"][0]
    assert (first["name"], first["tags"]) == ("a sheet", [])
    world.catalog.run("fitted").rename("another", label="best, of all")
    again = client.get("/api/v1/runs?q=is:mine").json()["runs"][0]
    assert (again["name"], again["tags"]) == ("another", ["best", "of all"])
    assert client.get("/api/v1/runs?q=tag:best").json()["total"] == 1


def test_runs_are_remembered_until_their_files_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(catalog, "_WORTH_SAVING", 2)
    opened: list[str] = []

    def open_run(folder: Path) -> Run:
        opened.append(folder.name)
        return real_open(folder)

    real_open = Run.open
    monkeypatch.setattr(Run, "open", open_run)
    settings = ServerSettings(data_dir=tmp_path / "data")
    for name in ("one", "two"):
        config = {"profile": {"profile": "quick", "node_spacing": 0.014}}
        folder = settings.run_dir / name
        Run.create(
            folder, name=name, kind="reconstruction", sequences=[str(tmp_path / "s")], config=config
        )

    def listed() -> dict[str, tuple[Any, ...]]:
        opened.clear()
        runs = [item.run for item in Catalog(settings, bundled=tmp_path / "none").runs()]
        assert None not in runs
        return {
            run.id: (run.name, run.sequences, run.config, run.kind, run.created) for run in runs
        }

    first = listed()
    assert sorted(opened) == ["one", "two"]
    assert first["one"][:2] == ("one", [str(tmp_path / "s")])
    kept = json.loads(settings.index_path.read_text())
    assert len(kept["runs"]) == 2
    assert list(kept["configs"].values()) == [config]
    assert listed() == first
    assert opened == []
    (settings.run_dir / "two" / "run.yaml").write_text(
        (settings.run_dir / "two" / "run.yaml").read_text().replace("name: two", "name: second")
    )
    assert listed()["two"][0] == "second"
    assert opened == ["two"]
    for damage in (
        "{",
        "[]",
        json.dumps(
            {
                "format": "physhandi-run-index/1",
                "configs": [],
                "runs": {"a": 3, "b": {"config": []}},
            }
        ),
    ):
        settings.index_path.write_text(damage)
        assert listed()["two"][0] == "second"
        assert sorted(opened) == ["one", "two"]
        settings.index_path.unlink()
