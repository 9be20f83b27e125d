"""What broken viewers may write."""

import logging

from app.viewer.viewer_log import MOST_LINES, BrokenConnections


def record(error: Exception | None) -> logging.LogRecord:
    info = None if error is None else (type(error), error, None)
    return logging.LogRecord("x", logging.ERROR, "", 0, "connection %s", ("failed",), info)


def test_a_traceback_becomes_a_line_and_few_are_written_in_a_minute() -> None:
    now = 0.0
    limit = BrokenConnections(lambda: now)
    told = [record(ValueError("100 % of\nwhat was sent")) for _ in range(MOST_LINES + 5)]
    kept = [limit.filter(one) for one in told]
    assert kept == [True] * MOST_LINES + [False] * 5
    text = "a viewer's connection failed: ValueError: '100 % of\\nwhat was sent'"
    assert (told[0].getMessage(), told[0].exc_info) == (text, None)
    now = 60.0
    late = record(ValueError("again"))
    assert limit.filter(late)
    assert late.getMessage().endswith("'again' (5 more were left out)")


def test_what_is_no_error_is_written_as_it_is() -> None:
    limit = BrokenConnections(lambda: 0.0)
    plain = record(None)
    assert all(limit.filter(plain) for _ in range(MOST_LINES + 5))
    assert plain.getMessage() == "connection failed"
