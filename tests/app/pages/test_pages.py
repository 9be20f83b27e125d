import base64
import hashlib
import json
import re
from types import SimpleNamespace

from starlette.requests import Request

from app.jobs.views import thin
from app.pages.render import Pages, duration, short, words
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
        text = re.sub(r"<a [^>]*>", "", path.read_text())  # Nobody follows a link but the user.
        assert not re.search(r"(src|href|url\(|fetch\()\s*=?\s*[\"'(]?https?:", text), path


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
    told = [duration(s) for s in (None, 0, 0.44, 9.94, 9.96, 59.9, 61, 3599, 7322.0)]
    expected = ["", "0 s", "0.4 s", "9.9 s", "9 s", "59 s", "1 min 1 s", "59 min 59 s", "2 h 2 min"]
    assert told == expected


def test_numbers_keep_four_digits_and_names_become_words() -> None:
    shown = [short(v) for v in (None, 7, "x", 2230.745, 0.0316404, 1e4, 9.47015e-5, 0.0, 2.5e9)]
    assert shown == ["none", "7", "x", "2231", "0.03164", "10000", "9.470e-5", "0", "2.5e+09"]
    assert words("chamfer_dynamic_l1") == "chamfer dynamic L1"


def test_a_page_that_is_missing_leads_to_the_lists() -> None:
    asked = Request({"type": "http", "app": SimpleNamespace(state=SimpleNamespace(root_path=""))})
    page = bytes(Pages().error(asked, 404, "There is no run '<b>'.").body).decode()
    assert all(f'href="{address}"' in page for address in (".", "runs", "sequences"))
    assert "&#39;&lt;b&gt;&#39;" in page
