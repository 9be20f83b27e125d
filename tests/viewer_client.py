"""A viewer client for tests: the one that the benchmark of the viewer works with."""

from app.benchmarks.viewer_client import PROTOCOL as PROTOCOL
from app.benchmarks.viewer_client import ViewerClient as ViewerClient
