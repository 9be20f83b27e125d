"""Settings of the fit of splats."""

from typing import Annotated, Literal

from msgspec import Meta

from physhandi.settings import Settings

APPEARANCE = "appearance"
"""Name of the stage."""
_Share = Annotated[float, Meta(ge=0.0, le=1.0)]
_Rate = Annotated[float, Meta(ge=1e-9, le=1.0)]
_Weight = Annotated[float, Meta(ge=0.0, le=1e6)]


class AppearanceConfig(Settings, frozen=True, kw_only=True):
    """Settings of the stage that fits splats to frame 0."""

    enabled: bool = False
    """Whether splats are fitted at all."""
    splat_count: Annotated[int, Meta(ge=1, le=1_000_000)] = 5000
    """Most splats."""
    iterations: Annotated[int, Meta(ge=0, le=100_000)] = 300
    """Updates, each by one view in turn."""
    center_rate: _Rate = 0.015
    """First step of their middles, in typical distances of splats; it falls to a hundredth."""
    scale_rate: _Rate = 0.01
    """Step of the logarithms of their standard deviations."""
    color_rate: _Rate = 0.01
    """First step of their colors, from 0 to 1; it falls to a tenth."""
    opacity_rate: _Rate = 0.05
    """Step of their opacities, before the logistic function."""
    similarity: _Share = 0.2
    """Share of structural similarity (SSIM) in the comparison of colors, beside their mean absolute
    difference."""
    first_color_weight: _Weight = 0.5
    """Of the mean squared difference to the colors with which splats began, so that those which few
    pixels show do not take on whatever makes up for an error of others."""
    alpha_weight: _Weight = 0.5
    """Of the mean absolute difference between what splats cover and the object's mask."""
    depth_weight: _Weight = 10.0
    """Of the mean absolute difference to the measured depth [1/m]."""
    hand_margin: Annotated[int, Meta(ge=0, le=100)] = 3
    """Pixels around hands that are left out like hands, since masks end a little early [px]."""
    renewal_interval: Annotated[int, Meta(ge=1, le=100_000)] = 100
    """Updates after which splats that cover next to nothing are moved to where the picture is
    wrong."""
    rasteriser: Literal["auto", "built_in"] = "auto"
    """What draws: ``auto`` takes gsplat on a GPU where it is installed, with which a fit does not
    end with the same bits, and the built-in one elsewhere; ``built_in`` takes that everywhere."""
