"""Scores and parameters as a run's page lists them."""

from pathlib import Path
from typing import Any

import pytest
from support.server.run_world import make_run

from app.pages.metrics import about_quantity, tabulate
from app.pages.parameters import meaning_of, parameter_rows
from physhandi.run import Run
from physhandi.simulation.parameters import SimulationParameters

DASH = "\N{EN DASH}"


def cells(row: dict[str, Any]) -> list[tuple[str, bool]]:
    return [(cell["text"], cell["is_best"]) for cell in row["cells"]]


def test_lengths_are_millimetres_and_the_lowest_error_is_the_best() -> None:
    shown = tabulate(
        {
            "unit": "m",
            "substituted_frames": 0,
            "future": {
                "frames": [7, 10],
                "rollout": {"chamfer_l2": 0.01, "track_error": None, "marker_error": None},
                "static": {"chamfer_l2": 0.0355, "track_error": 0.2, "marker_error": None},
            },
        }
    )
    assert shown["notes"] == [("substituted frames", "0")]
    (table,) = shown["tables"]
    assert (table["name"], table["note"]) == ("future", "frames 7 to 9")
    assert [column["name"] for column in table["columns"]] == ["rollout", "static"]
    assert all(column["about"] for column in table["columns"])
    chamfer, track = table["rows"]
    assert (chamfer["name"], chamfer["unit"]) == ("chamfer_l2", "mm")
    assert cells(chamfer) == [("10.00", True), ("35.50", False)]
    assert cells(track) == [(DASH, False), ("200.0", False)]


def test_of_shares_the_highest_is_the_best_and_they_are_percent() -> None:
    scores = {
        "contact": {
            "rollout": {"accuracy_5mm": 0.5, "f1": 0.25, "contact_count": 3, "psnr": 20.0},
            "static": {"accuracy_5mm": 0.75, "f1": 0.25, "contact_count": 9, "psnr": 30.0},
        }
    }
    accuracy, f1, count, psnr = tabulate(scores)["tables"][0]["rows"]
    assert (accuracy["unit"], accuracy["is_higher_better"]) == ("%", True)
    assert cells(accuracy) == [("50.00", False), ("75.00", True)]
    assert cells(f1) == [("25.00", True), ("25.00", True)]
    assert cells(count) == [("3", False), ("9", False)]
    assert (psnr["unit"], cells(psnr)) == ("dB", [("20.00", False), ("30.00", True)])


def test_scores_of_pictures_have_rows_of_their_own_and_their_look_a_table() -> None:
    scores = {
        "photometric": {"frame": 0, "proper": {"psnr": 27.5, "iou": 0.95, "ssim": None}},
        "future": {
            "rollout": {
                "chamfer_l2": 0.01,
                "photometric": {
                    "phystwin": {"psnr": 31.0, "ssim": 0.9, "iou": 0.5, "lpips": 0.25},
                    "held_out": {"psnr": 20.0, "ssim": 0.8, "iou": 0.75},
                },
            },
            "static": {"chamfer_l2": 0.02},
        },
    }
    look, future = tabulate(scores)["tables"]
    assert (look["note"], [column["name"] for column in look["columns"]]) == ("frame 0", ["proper"])
    assert [(row["name"], row["unit"], cells(row)) for row in look["rows"]] == [
        ("psnr", "dB", [("27.50", False)]),
        ("iou", "%", [("95.00", False)]),
    ]
    rows = {row["name"]: row for row in future["rows"]}
    assert cells(rows["photometric_phystwin_psnr"]) == [("31.00", False), (DASH, False)]
    assert cells(rows["photometric_held_out_iou"]) == [("75.00", False), (DASH, False)]
    assert rows["photometric_held_out_iou"]["unit"] == "%"
    assert rows["photometric_phystwin_iou"]["about"].startswith("As PhysTwin")
    lpips = rows["photometric_phystwin_lpips"]
    assert (lpips["unit"], lpips["is_higher_better"]) == ("", False)
    assert cells(lpips) == [("0.2500", False), (DASH, False)]
    assert "no fit saw" in rows["photometric_held_out_iou"]["about"]
    assert about_quantity("photometric.phystwin.psnr").startswith("As PhysTwin")
    assert cells(rows["chamfer_l2"]) == [("10.00", True), ("20.00", False)]


def test_hands_are_no_rivals_and_pixels_stay_pixels() -> None:
    scores = {
        "unit": "m",
        "hands": {
            "left": {"reprojection_mean": 2.5, "unit": "px", "mpjpe": 0.004},
            "right": {"reprojection_mean": 3.5, "unit": "px", "mpjpe": None},
        },
    }
    (table,) = tabulate(scores)["tables"]
    reprojection = table["rows"][0]
    assert (reprojection["unit"], cells(reprojection)) == (
        "px",
        [("2.500", False), ("3.500", False)],
    )
    assert not any(cell["is_best"] for row in table["rows"] for cell in row["cells"])


def test_words_and_single_facts_stand_beside_the_numbers() -> None:
    scores = {
        "topology": {"connection_radius": 0.02, "rrd_object": 0.5},
        "hands": {"right": {"aggregation": "over all", "scored_frames": 60, "known_share": 0.5}},
    }
    topology, hands = tabulate(scores)["tables"]
    assert [column["name"] for column in topology["columns"]] == ["value"]
    assert [(row["unit"], cells(row)) for row in topology["rows"]] == [
        ("mm", [("20.00", False)]),
        ("", [("0.5000", False)]),
    ]
    assert hands["note"] == "aggregation over all"
    assert [(row["unit"], cells(row)) for row in hands["rows"]] == [
        ("", [("60", False)]),
        ("%", [("50.00", False)]),
    ]


def test_a_sequence_without_metric_scale_keeps_its_own_unit() -> None:
    scores = {"unit": "unit", "future": {"rollout": {"track_error": 0.5}, "static": {}}}
    (row,) = tabulate(scores)["tables"][0]["rows"]
    assert (row["unit"], cells(row)) == ("unit", [("0.5000", False), (DASH, False)])


@pytest.mark.parametrize("scores", ["damaged", None, [1], {}])
def test_damaged_scores_make_no_table(scores: object) -> None:
    assert tabulate(scores) == {"tables": [], "notes": []}


@pytest.mark.parametrize("frames", [[3], [], ["a", 2], {"a": [1]}, None])
def test_frames_that_are_none_are_shown_as_they_are(frames: Any) -> None:
    (table,) = tabulate({"future": {"frames": frames, "rollout": {"chamfer_l2": 0.01}}})["tables"]
    assert " to " not in table["note"]


def test_every_parameter_is_explained_where_it_is_declared() -> None:
    notes = {name: meaning_of(name) for name in SimulationParameters().to_dict()}
    assert all(about for about, _ in notes.values())
    assert notes["connection_radius"][1] == "m"
    assert notes["drag"][1] == "1/s"
    assert notes["gravity"][1] == "m/s²"
    assert notes["friction"][1] == ""


def test_what_the_fit_changed_stands_beside_its_start(tmp_path: Path) -> None:
    start = SimulationParameters().to_dict()
    run = make_run(tmp_path / "run", config={"profile": {"simulation": start}})
    found = start | {"connection_radius": 0.03164, "max_neighbors": 20, "new": 1.0}
    rows = {row["name"]: row for row in parameter_rows(run, found)}
    radius = rows["connection_radius"]
    assert (radius["start"], radius["value"], radius["unit"]) == ("20", "31.64", "mm")
    assert [name for name, row in rows.items() if row["is_changed"]] == [
        "connection_radius",
        "max_neighbors",
    ]
    assert rows["use_control_velocity"]["value"] == "yes"
    assert rows["new"]["start"] == ""


def test_a_new_simulation_is_compared_with_the_run_that_it_repeats(tmp_path: Path) -> None:
    source = make_run(tmp_path / "source")
    with source.begin_attempt() as attempt:
        attempt.save_yaml("object/parameters.yaml", {"drag": 3.0, "friction": 0.3})
        attempt.publish()
    changes = {"source": str(source.folder), "parameters": {"drag": 5.0}}
    run = make_run(tmp_path / "run", kind="simulation", config=changes)
    rows = parameter_rows(Run.open(run.folder), {"drag": 5.0, "friction": 0.3})
    assert [(row["start"], row["is_changed"]) for row in rows] == [("3", True), ("0.3", False)]
    source.delete()
    assert [row["start"] for row in parameter_rows(run, {"drag": 5.0})] == [""]
