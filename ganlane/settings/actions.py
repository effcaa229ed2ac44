"""``env.actions=...``: what the driver of the ego commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from ganlane.errors import ParameterError
from ganlane.settings.record import Positive, Record, one_of

LANE: Final = "lane"
LANE_SPEED: Final = "lane_speed"
CONTINUOUS: Final = "continuous"
#: Names of the numbered actions, in their order.
NUMBERED: Final = {
    LANE: ("keep", "left", "right"),
    LANE_SPEED: ("keep", "left", "right", "faster", "slower"),
}
#: Numbers of an action of ``continuous``: acceleration and lateral target.
CONTROLS: Final = 2


@dataclass(frozen=True)
class ActionParameters(Record):
    """What the driver of the ego commands; docs/gymnasium.md has the forms.

    Attributes:
        form: ``lane``, the paper's: 0 keep, 1 left, 2 right. ``lane_speed``: further 3 faster, 4
            slower, which change the speed that the ego's car following aims at; the speed at the
            start of an episode is the desired speed. ``continuous``: two numbers from -1 to 1, the
            acceleration (1 the strongest, -1 the strongest braking), and the line to steer to, in
            lane widths left of the centre of the lane that the ego is in. Nothing brakes then but
            the driver.
        speed_step_mps: by how much ``faster`` and ``slower`` change the speed, m/s.
        lowest_speed_mps: lowest speed that ``slower`` sets, m/s; the highest is the desired speed.
        strongest_acceleration: of ``continuous``, m/s2; it ends at the desired speed.
        strongest_braking: of ``continuous``, m/s2; about 9 is what dry asphalt allows.
    """

    alone = "form"

    form: Annotated[str, one_of((*NUMBERED, CONTINUOUS))] = LANE
    speed_step_mps: Positive = 2.5
    lowest_speed_mps: Positive = 5.0
    strongest_acceleration: Positive = 3.0
    strongest_braking: Positive = 8.0

    @property
    def names(self) -> tuple[str, ...]:
        """The numbered actions; empty for ``continuous``."""
        return NUMBERED.get(self.form, ())

    def meanings(self) -> str:
        """The numbered actions in words: ``0 (keep), 1 (left) or 2 (right)``."""
        *first, last = [f"{number} ({name})" for number, name in enumerate(self.names)]
        return f"{', '.join(first)} or {last}"

    def check_mask(self, form: str) -> None:
        """Refuse a mask of actions that are not numbered.

        Raises:
            ParameterError: for ``legal`` and ``safe`` with ``continuous``.
        """
        if form != "none" and not self.names:
            raise ParameterError(
                f"{{mask.form}}={form}: masks are of numbered actions, and env.actions="
                f"{self.form} has none; leave the mask out."
            )
