"""Servers, queues and workers, whole or with made-up fits."""
