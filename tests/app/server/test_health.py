"""What probes, scrapers and readers of the log are told, and what they are not."""

import json
import logging
import re
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient
from support.server.server_world import TOKEN, World

from app import health
from app.logs import write_logs
from app.settings import ServerSettings


def figures(client: TestClient) -> dict[tuple[str, tuple[str, ...]], float]:
    """Read the figures as Prometheus does: by name and values of labels."""
    told = client.get("/metrics")
    assert told.headers["content-type"].startswith("text/plain")
    return {
        (sample.name, tuple(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(told.text)
        for sample in family.samples
    }


def test_probes_answer_everybody_and_tell_nothing(world: World) -> None:
    nobody = world.client()
    assert nobody.get("/healthz").json() == {"status": "ok"}
    assert set(world.script().get("/healthz").json()) == {"status", "version"}
    assert nobody.post("/healthz").status_code == 401
    assert nobody.get("/healthz/..%2fruns").status_code == 401
    assert world.client(Host="evil.example").get("/healthz").status_code == 400


def test_a_server_is_ready_while_its_queue_works_and_the_disk_has_room(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = world.client()
    before = asked.get("/readyz")
    assert before.status_code == 503
    assert before.json() == {
        "status": "not ready",
        "reasons": ["The queue does not work: the server starts or ends."],
    }
    with asked:
        ready = asked.get("/readyz")
        assert (ready.status_code, ready.json()) == (200, {"status": "ready", "reasons": []})
        monkeypatch.setattr(health, "LEAST_DISK", sys.maxsize)
        full = asked.get("/readyz")
        assert full.status_code == 503
        (reason,) = full.json()["reasons"]
        assert re.fullmatch(r"The disk has \d+ MiB left; free some space\.", reason)
    assert asked.get("/readyz").status_code == 503


def test_figures_count_runs_scenes_and_requests_by_their_routes(world: World) -> None:
    client = world.script()
    before = figures(client)
    runs = len(client.get("/api/v1/runs").json()["runs"])
    assert sum(value for (name, _), value in before.items() if name == "physhandi_runs") == runs > 0
    assert before["physhandi_fit_slots", ()] == 1
    assert before["physhandi_live_scenes", ()] == 0
    assert before["physhandi_disk_total_bytes", ()] > before["physhandi_disk_used_bytes", ()] > 0
    assert before["process_resident_memory_bytes", ()] > 1e7
    for run in ("nobody", "neither"):
        client.get(f"/api/v1/runs/{run}")
    world.client().get("/api/v1/runs")
    after = figures(client)
    counted = "physhandi_http_requests_total"
    assert after[counted, ("GET", "/api/v1/runs/{run_id}", "404")] == 2
    assert after[counted, ("GET", "/api/v1/runs", "200")] == 1
    assert after[counted, ("GET", "none", "401")] == 1
    assert after["physhandi_http_request_seconds_count", ("/api/v1/runs/{run_id}",)] == 2
    assert not any("nobody" in label for _, labels in after for label in labels)


def test_figures_need_the_token(world: World) -> None:
    assert world.client().get("/metrics").status_code == 401
    assert world.client(Authorization="Bearer wrong").get("/metrics").status_code == 401


def refuse() -> None:
    raise OSError(f"Bearer {TOKEN} was refused")


@pytest.fixture
def logged(capfd: pytest.CaptureFixture[str]) -> Iterator[Any]:
    """Set up the log, and read what was written by now."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level

    def lines(**settings: Any) -> list[str]:
        write_logs(ServerSettings(**settings))
        log = logging.getLogger("app.trial")
        log.info("opened http://127.0.0.1/?token=%s&x=1 by %s", TOKEN, "Ångström")
        try:
            refuse()
        except OSError:
            log.exception("it failed:\n%s", f"physhandi_8080=visitor.{TOKEN}")
        return capfd.readouterr().err.splitlines()

    yield lines
    root.handlers[:] = handlers
    root.setLevel(level)


def test_a_log_of_objects_has_one_a_line_and_no_secret(logged: Any) -> None:
    opened, failed = map(json.loads, logged(log_format="json", log_level="info"))
    assert opened["message"] == "opened http://127.0.0.1/?token=…&x=1 by Ångström"
    assert (opened["level"], opened["logger"]) == ("info", "app.trial")
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT[\d:.]{12}\+00:00", opened["time"])
    assert failed["message"] == "it failed:\nphyshandi_8080=…"
    assert failed["error"].endswith("OSError: Bearer … was refused")
    assert TOKEN not in str(failed)


def test_a_log_for_people_has_no_secret_either(logged: Any) -> None:
    lines = logged()
    assert lines[0] == "ERROR app.trial: it failed:"
    assert lines[-1] == "OSError: Bearer … was refused"
    assert TOKEN not in "\n".join(lines)


def test_requests_are_logged_without_their_query(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "app.health"):
        world.script().get("/api/v1/runs/a%0Ab?q=private")
    (line,) = [record.getMessage() for record in caplog.records if record.name == "app.health"]
    assert re.fullmatch(r"GET /api/v1/runs/a%0Ab 422 [\d.]+ ms", line)
