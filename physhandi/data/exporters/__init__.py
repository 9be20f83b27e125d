"""Runs as files that other programs read."""

from physhandi.data.exporters.export import FORMATS as FORMATS
from physhandi.data.exporters.export import PLY as PLY
from physhandi.data.exporters.export import export_run as export_run
from physhandi.data.exporters.export import export_scene as export_scene
