"""What a generator's weights say of the recordings and the fit that they come from, as the traffic takes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ganlane.data import DrivingStatistics
from ganlane.errors import UserError
from ganlane.generator import ANCHOR, AnchorParameters
from ganlane.traffic.acceleration import SuddenAccelerations
from ganlane.traffic.lane_change import LiteralChanges


def literal_changes(statistics: DrivingStatistics, source: object) -> LiteralChanges:
    """Equations 9 to 11 with the numbers of all recordings that were given to the fit, held-out scenes too."""
    changes = statistics.lane_changes
    numbers = (changes.t_m_srlc_steps, changes.lateral_speed.mean, changes.lateral_speed.sd)
    if None in numbers:
        raise UserError(
            f"{source}: its recordings hold no complete lane change, so equations 9 to 11 have no numbers; "
            "fit the generator to recordings with lane changes."
        )
    mean_steps, speed, sd = (float(number) for number in numbers if number is not None)
    return LiteralChanges(mean_steps, speed, sd)


def sudden_accelerations(statistics: DrivingStatistics) -> SuddenAccelerations:
    """Gaussian of the recorded accelerations over one second, of all scenes."""
    recorded = statistics.acceleration_smoothed
    told = {name: getattr(recorded, name) for name in ("mean", "sd") if getattr(recorded, name) is not None}
    return SuddenAccelerations(**told)


def fitted_anchor(anchor: AnchorParameters, metadata: Mapping[str, Any], source: object) -> AnchorParameters:
    """``anchor`` with the washout and the further inputs that the weights were fitted with.

    Weights whose metadata names neither were fitted with those of :data:`ganlane.generator.ANCHOR`.

    Args:
        anchor: the anchor of the simulation.
        metadata: of the weights (:func:`ganlane.generator.load_generator`).
        source: their file, for the message.

    Raises:
        UserError: fitted without traits, which this traffic always draws; or values that no fit can have.
    """
    config = metadata["config"] if isinstance(metadata.get("config"), Mapping) else {}
    washout_s = config.get("washout_s", ANCHOR.washout_s)
    further_inputs = config.get("further_inputs", ANCHOR.further_inputs)
    if config.get("traits", True) is not True:
        raise UserError(
            f"{source}: fitted with traits={config['traits']}, but every driver of gan_calibrated has a headway "
            "and a desired speed of its own; give weights fitted with generator.traits=true."
        )
    # Not in one comparison with 0: NaN has to fail, and True is no number of seconds.
    if type(washout_s) not in (int, float) or not washout_s > 0 or type(further_inputs) is not bool:
        raise UserError(
            f"{source}: its config says washout_s={washout_s!r} and further_inputs={further_inputs!r}, expected "
            "seconds above 0 and true or false; fit it again."
        )
    return replace(anchor, washout_s=float(washout_s), further_inputs=further_inputs)
