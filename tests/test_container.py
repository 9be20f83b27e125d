"""The Dockerfile and compose file name what there is; `make container` follows them for real."""

import json
import re
from pathlib import Path

import yaml
from container_check import steps

from app.security import PROBES
from app.settings import ServerSettings

ROOT = Path(__file__).parents[1]
SAID = list(steps((ROOT / "Dockerfile").read_text()))


def named(variables: list[str]) -> None:
    """See that these variables set something of the server."""
    prefix = "PHYSHANDI_"
    ours = [name.removeprefix(prefix).lower() for name in variables if name.startswith(prefix)]
    assert ours
    assert set(ours) <= set(ServerSettings.model_fields)


def test_the_image_has_what_the_server_needs_and_runs_without_rights() -> None:
    copied = {name for word, rest in SAID if word == "COPY" for name in rest.split()[:-1]}
    assert {"physhandi", "app", "web_assets", "sequences", "pyproject.toml"} <= copied
    assert all((ROOT / name).exists() for name in copied)
    words = [word for word, _ in SAID]
    assert words.index("USER") > max(i for i, word in enumerate(words) if word == "RUN")
    last = dict(SAID)
    assert last["USER"] not in {"root", "0"}
    assert last["VOLUME"] == "/data"
    (asked,) = re.findall(r"http://127\.0\.0\.1:8080(/\w+)", last["HEALTHCHECK"])
    assert asked in PROBES
    assert json.loads(last["ENTRYPOINT"])[-1] == "physhandi"
    named([rest.partition("=")[0] for word, rest in SAID if word == "ENV"])


def test_the_compose_file_builds_it_for_gpus_and_without() -> None:
    read = yaml.safe_load((ROOT / "docs" / "container" / "compose.yaml").read_text())
    gpu, cpu = read["services"]["gpu"], read["services"]["cpu"]
    for service in (gpu, cpu):
        place = ROOT / "docs" / "container" / service["build"]["context"]
        assert (place / "Dockerfile").samefile(ROOT / "Dockerfile")
        assert service["ports"] == ["127.0.0.1:8080:8080"]
        named(list(service["environment"]))
    arguments = {rest.partition("=")[0] for word, rest in SAID if word == "ARG"}
    assert set(cpu["build"]["args"]) == arguments
    (device,) = gpu["deploy"]["resources"]["reservations"]["devices"]
    assert device["capabilities"] == ["gpu"]
