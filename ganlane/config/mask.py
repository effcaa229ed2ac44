"""``mask=...``: which actions the driver of the ego may choose."""

from __future__ import annotations

from dataclasses import dataclass

from ganlane.parameters.checks import above, check, one_of

#: As in :data:`ganlane.transforms.MASKS`; repeated here so that a wrong name is found without loading torch.
MASKS = ("none", "legal", "safe")


@dataclass
class MaskConfig:
    """``mask=none``, ``legal`` or ``safe`` (:class:`ganlane.transforms.ActionMaskTransform`).

    ``none`` is the paper's literal form. ``safe_deceleration`` (m/s2) is MOBIL's ``b_safe``, read by ``safe`` alone.
    """

    form: str = "none"
    safe_deceleration: float = 4.0

    def __post_init__(self) -> None:
        check(self, "mask", form=one_of(MASKS), safe_deceleration=above(0))
