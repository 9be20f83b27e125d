"""Watching the machine and its fits, and launching fits with other settings."""

from app.monitor.routes import create_monitor as create_monitor
