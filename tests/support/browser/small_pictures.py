"""Small pictures in the cache of a server that would draw them at its first page."""

import os
from itertools import product
from pathlib import Path

from PIL import Image

from app.jobs.catalog import Catalog
from app.previews.files import MOVING, STILL
from app.previews.store import Previews
from app.settings import ServerSettings

README_PICTURES = "PHYSHANDI_PICTURES"
"""Names the folder of the README's pictures, which are made anew if it is set (`make pictures`)."""


def place_pictures(data_dir: Path) -> None:
    """Give empty pictures to all sequences and runs that a server on a data folder would show.

    In the README's pictures the real ones are seen.
    """
    if os.environ.get(README_PICTURES):
        return
    settings = ServerSettings(data_dir=data_dir)
    catalog = Catalog(settings)
    previews = Previews(settings, catalog)
    for run in catalog.runs():
        previews.look("run", run.id)
    for sequence in catalog.sequences():
        previews.look("sequence", sequence.id)
    settings.preview_dir.mkdir(parents=True, exist_ok=True)
    for source, ending in product(previews._waiting.values(), (STILL, MOVING)):
        Image.new("RGB", (48, 30)).save(settings.preview_dir / f"{source.key}{ending}")
