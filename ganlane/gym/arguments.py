"""What users hand to reset and step: actions, seeds and options, checked."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ganlane.errors import UserError
from ganlane.transforms.mask import ACTIONS

#: Unseeded environments draw their seed below this.
SEEDS: Final = 2**31


def actions_of(given: Any, rows: int) -> Tensor:
    """Actions [rows] int64 from what a user handed over.

    Raises:
        UserError: another shape, or none of the three.
    """
    array = np.asarray(given)
    if array.shape != (rows,) or array.dtype.kind not in "iu" or not np.isin(array, range(ACTIONS)).all():
        raise UserError(
            f"action {array.tolist()}: expected {rows} whole number(s), 0 (keep), 1 (left) or 2 (right); give one "
            "for every environment."
        )
    return torch.as_tensor(array.astype(np.int64))


def seed_number(seed: Any) -> int:
    """A seed, checked: the counters of the environment hold 63 bits."""
    if not hasattr(seed, "__index__") or not 0 <= int(seed) < 2**63:
        raise UserError(f"seed={seed}: expected a whole number from 0 to 2**63 - 1; give for instance seed=0.")
    return int(seed)


def known_options(options: dict[str, Any] | None, names: tuple[str, ...]) -> dict[str, Any]:
    """The options of a reset, checked for names that nobody reads."""
    unknown = sorted(set(options or {}) - set(names))
    if unknown:
        raise UserError(f"options: {', '.join(unknown)} unknown; a reset takes {', '.join(names)}.")
    return dict(options or {})


def episode_numbers(episode: Any) -> npt.NDArray[np.int64]:
    """The option ``episode``, checked: whole numbers from 0, one or several."""
    numbers = np.asarray(episode)
    if numbers.dtype.kind not in "iu" or (numbers < 0).any():
        raise UserError(f"options: episode={episode!r}: expected whole numbers from 0; give for instance 3.")
    return numbers.astype(np.int64)


def row_mask(mask: Any, rows: int) -> npt.NDArray[np.bool_]:
    """The option ``reset_mask``, checked: a boolean array [rows]."""
    array = np.asarray(mask)
    if array.shape != (rows,) or array.dtype != np.bool_:
        raise UserError(
            f"options: reset_mask: expected a boolean array of shape ({rows},); give one flag for every row."
        )
    return array
