"""Request for a comparison of two runs: one model for addresses, orders and live scenes."""

from typing import Annotated, Literal, Self
from urllib.parse import parse_qsl, urlencode

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from app.ids import ItemId
from app.wrong_fields import wrong_fields
from physhandi.errors import UsageError

Mode = Literal["side", "overlay", "wipe"]
"""Beside each other, one over the other, or A on one side of a line and B on the other."""
Tint = Literal["side", "difference", "parts"]
"""Nodes in the color of their side or of their difference, or parts as in the paper's figure."""


class CompareAsk(BaseModel):
    """Request for a comparison; the fields are those of an address ``/compare?…``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    a: ItemId
    """Id of run A."""
    b: ItemId
    """Id of run B."""
    sequence: Annotated[str | None, Field(min_length=1, max_length=200)] = None
    """A sequence of both; None for the first that both have."""
    mode: Mode = "side"
    """Arrangement of both."""
    color: Tint = "side"
    """Meaning of the nodes' colors."""
    f: Annotated[int, Field(ge=0, le=10_000_000)] = 0
    """Tick of the common clock: the frame, if both have one frame rate."""

    @model_validator(mode="after")
    def _differ(self) -> Self:
        if self.a == self.b:
            raise ValueError(
                f"A and B are both run '{self.a}'; to compare two parameter sets of one run, open "
                "it and keep one of them as A."
            )
        return self

    @property
    def query(self) -> str:
        """Query of the address ``/compare?…``; default values are left out."""
        return urlencode(self.model_dump(exclude_defaults=True, exclude={"kind"}))

    @classmethod
    def parse(cls, query: str) -> Self:
        """Read what stands behind ``/compare?``.

        Raises:
            UsageError: If a field is missing, unknown or makes no sense; names the field.
        """
        try:
            return cls.model_validate(dict(parse_qsl(query, keep_blank_values=True)))
        except ValidationError as error:
            place, why = wrong_fields(error.errors())[0]
            raise UsageError(f"{place or 'a, b'}: {why}") from None


class NewComparison(CompareAsk):
    """A live scene to open that shows two runs together."""

    kind: Literal["comparison"]
