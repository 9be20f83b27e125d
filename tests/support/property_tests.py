"""How property tests draw their examples."""

from hypothesis import HealthCheck, settings

SAME_EVERYWHERE = settings(
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
"""The same examples in every run, so that a failing one can be run again, and no limit of time."""
