import base64
import hashlib
import json
import re

from app.jobs.describe import thin
from app.pages import duration, stage_states, tabulate
from app.settings import WEB_ASSETS


def test_vendored_files_are_those_of_their_versions() -> None:
    vendor = WEB_ASSETS / "vendor"
    entries = json.loads((vendor / "VERSIONS.json").read_text())
    assert {entry["name"] for entry in entries} == {"htmx.org", "uplot", "@picocss/pico"}
    listed = {"VERSIONS.json"}
    for entry in entries:
        assert re.fullmatch(r"\d+\.\d+\.\d+", entry["version"])
        assert entry["licence"] in {"0BSD", "MIT"}
        assert len(base64.b64decode(entry["npm_integrity"].removeprefix("sha512-"))) == 64
        for name, digest in entry["files"].items():
            assert hashlib.sha256((vendor / name).read_bytes()).hexdigest() == digest, name
            listed.add(name)
    present = {path.name for path in vendor.iterdir() if not path.name.startswith("LICENSE")}
    assert present == listed
    assert len(list(vendor.glob("LICENSE*"))) == len(entries)


def test_no_page_loads_anything_from_elsewhere() -> None:
    for path in [*(WEB_ASSETS / "templates").glob("*.html"), *WEB_ASSETS.glob("*.[jc]s*")]:
        assert not re.search(r"(src|href|url\(|fetch\()\s*=?\s*[\"'(]?https?:", path.read_text()), (
            path
        )


def test_stages_are_done_at_work_or_to_come() -> None:
    run = {"kind": "reconstruction", "state": "running", "progress": {"stage": "zeroth_order"}}
    finished = {"hand_reconstruction": {"before": 2.0, "after": 1.0}, "observation": {}}
    stages = stage_states(run, finished)
    assert [stage["state"] for stage in stages] == ["done", "done", "at-work", "to-come", "to-come"]
    assert stages[0]["after"] == 1.0
    hands_only = stage_states(run | {"state": "succeeded"}, {"hand_reconstruction": {}})
    assert [stage["name"] for stage in hands_only] == ["hand_reconstruction"]


def test_rivals_stand_side_by_side_and_the_lowest_error_is_the_best() -> None:
    scores = {
        "unit": "m",
        "future": {
            "frames": [7, 10],
            "rollout": {"chamfer": 0.01, "track_error": None},
            "static": {"chamfer": 0.03, "track_error": 0.2},
        },
        "hands": {"right": {"mean": 3.0}},
    }
    shown = tabulate(scores)
    assert shown["notes"] == [("unit", "m"), ("hands · right · mean", 3.0)]
    (table,) = shown["tables"]
    assert table["columns"] == ["rollout", "static"]
    assert table["rows"] == [
        {"name": "chamfer", "values": [0.01, 0.03], "best": 0.01},
        {"name": "track_error", "values": [None, 0.2], "best": 0.2},
    ]
    assert tabulate("damaged") == {"tables": [], "notes": []}


def test_a_thinned_curve_keeps_its_peaks() -> None:
    curve = [[float(i), float(i % 10)] for i in range(10_000)]
    curve[7001][1] = -500.0
    curve[3333][1] = 900.0
    thinned = thin(curve, 200)
    assert 100 <= len(thinned) <= 200
    assert [7001.0, -500.0] in thinned
    assert [3333.0, 900.0] in thinned
    assert [point[0] for point in thinned] == sorted(point[0] for point in thinned)
    assert thin(curve[:200], 200) == curve[:200]


def test_times_are_told_in_minutes_from_one_on() -> None:
    assert [duration(s) for s in (None, 0.4, 59.9, 61)] == ["", "0 s", "59 s", "1 min 1 s"]
