"""The id by which addresses name a sequence, a run, a profile or a live scene."""

from typing import Annotated

from pydantic import Field

ItemId = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
