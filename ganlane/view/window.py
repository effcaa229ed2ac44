"""The window through which a frame shows the road: metres to pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ganlane.errors import UserError

HEADER_HEIGHT = 56
FOOTER_HEIGHT = 24
#: Below these the header and the road have no room, pixels.
MIN_WIDTH, MIN_HEIGHT = 600, 160


@dataclass(frozen=True)
class WindowParameters:
    """Size of the picture in pixels and how much road it shows.

    Across the road the scale is up to ``lateral_exaggeration`` times that along it (less where many lanes
    need the room): vehicles and lateral movements look wider than they are, overlaps stay overlaps.
    """

    width: int = 1280
    height: int = 320
    #: Length of road in the picture, m.
    length_m: float = 160.0
    #: Share of it that lies behind the ego.
    behind: float = 0.38
    lateral_exaggeration: float = 1.5

    def __post_init__(self) -> None:
        """Check the sizes."""
        if self.width < MIN_WIDTH or self.height < MIN_HEIGHT:
            raise UserError(
                f"picture of {self.width} x {self.height} pixels: at least {MIN_WIDTH} x {MIN_HEIGHT} are needed; "
                "draw it larger and scale the film down."
            )
        if not (self.length_m > 0 and 0 <= self.behind <= 1 and self.lateral_exaggeration > 0):
            raise UserError(
                f"picture of {self.length_m:g} m of road, {self.behind:g} behind, {self.lateral_exaggeration:g} "
                "times wider across: expected a length and a factor above 0 and a share from 0 to 1."
            )


@dataclass(frozen=True)
class Window:
    """The scale of a picture for a road of ``lanes`` lanes; ``y`` of the picture points down."""

    parameters: WindowParameters
    lanes: int
    lane_width_m: float

    @property
    def along(self) -> float:
        """Pixels per metre along the road."""
        return self.parameters.width / self.parameters.length_m

    @property
    def across(self) -> float:
        """Pixels per metre across the road: exaggerated, but never more than the picture has room for."""
        room = self.parameters.height - HEADER_HEIGHT - FOOTER_HEIGHT
        wanted = self.along * self.parameters.lateral_exaggeration
        return min(wanted, room / (self.lanes * self.lane_width_m + 2.0))

    @property
    def middle(self) -> float:
        """Row of the road's middle."""
        return HEADER_HEIGHT + (self.parameters.height - HEADER_HEIGHT - FOOTER_HEIGHT) / 2

    def row(self, y_m: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Picture rows of lateral positions, m."""
        centre = 0.5 * (self.lanes - 1) * self.lane_width_m
        return self.middle - (np.asarray(y_m, dtype=np.float64) - centre) * self.across

    def column(self, x_m: npt.ArrayLike, ego_x_m: float) -> npt.NDArray[np.float64]:
        """Picture columns of positions along the road, m, with the ego at ``ego_x_m``."""
        start = ego_x_m - self.parameters.behind * self.parameters.length_m
        return (np.asarray(x_m, dtype=np.float64) - start) * self.along

    @property
    def edges(self) -> tuple[float, float]:
        """Rows of the left (upper) and right (lower) edge of the road."""
        upper, lower = self.row([(self.lanes - 0.5) * self.lane_width_m, -0.5 * self.lane_width_m])
        return float(upper), float(lower)
