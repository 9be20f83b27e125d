"""YAML: what is read, and how what is not is told."""

from datetime import date

import pytest

from physhandi.data.files import parse_yaml


def test_plain_data_is_read() -> None:
    text = "a: [1, 2.5, true, null, text]\nb: {c: 2020-01-02, d: &x [1]}\ne: *x\n"
    content = parse_yaml(text)
    assert content["a"] == [1, 2.5, True, None, "text"]
    assert content["b"]["d"] == content["e"] == [1]
    assert parse_yaml("base: &b {k: 1}\nmine:\n  <<: *b\n  k: 2\n")["mine"] == {"k": 2}
    assert parse_yaml("- {a: 1}\n- {a: 2}\n") == [{"a": 1}, {"a": 2}]
    assert parse_yaml("") is None


def test_what_a_reader_changes_no_other_reader_sees() -> None:
    text = "a: {b: [1, {c: 2020-01-02}]}\n"
    first = parse_yaml(text)
    first["a"]["b"][1]["c"] = 3
    first["a"]["b"].append(4)
    first["a"]["d"] = first["e"] = 5
    assert parse_yaml(text, reads_dates=False) == {"a": {"b": [1, {"c": "2020-01-02"}]}}
    assert parse_yaml(text) == {"a": {"b": [1, {"c": date(2020, 1, 2)}]}}


def test_a_wrong_text_is_refused_each_time() -> None:
    for _ in range(2):
        with pytest.raises(ValueError, match="line 3, column 1: field 'a' is there twice"):
            parse_yaml("a: 1\nb: 2\na: 3\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3\n", "line 3, column 1: field 'a' is there twice"),
        ("x:\n  - {k: 1, k: 1}\n", "line 2, column 12: field 'k' is there twice"),
        ("a: [1\nb: 2", "line 2"),
        ("!!python/object/apply:os.abort []", "line 1, column 1: could not determine"),
        ("a: !!int ''", "not what its tag says"),
        ("a: 2001-99-99", "not what its tag says"),
        ("a: \x00", "not allowed"),
        ("[" * 700, "nested too deeply"),
        ("? [1]\n: 2", "unhashable"),
    ],
)
def test_the_rest_is_told_by_its_line(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_yaml(text)


def test_what_looks_like_a_date_is_text_where_no_dates_are_read() -> None:
    text = "a: 2020-01-02\nb: 2001-99-99\nc: !!timestamp 2020-01-02\nd: 7\n"
    content = parse_yaml(text, reads_dates=False)
    expected = {"a": "2020-01-02", "b": "2001-99-99", "c": date(2020, 1, 2), "d": 7}
    assert content == expected
