"""Who drives in a card, and from which scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path

from ganlane.build import make_traffic
from ganlane.config.env import EnvConfig
from ganlane.config.realism import RealismConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.errors import UserError
from ganlane.evaluation.realism import Factory, Fold, check_cover, fold_weights
from ganlane.generator import HELD_OUT
from ganlane.parameters.records import assign
from ganlane.sim.random import Stream
from ganlane.sim.road import Road
from ganlane.traffic import TrafficModule

#: Preset of the weights that a traffic drives with.
PRESETS = {"gan": "paper", "gan_calibrated": "calibrated"}


def makers_of(config: RealismConfig, weights: Mapping[str, Path] | None = None) -> dict[str, Factory]:
    """Traffic of any road, by name: the one that the card is of, then its rivals.

    Args:
        config: names them.
        weights: of a fold, by preset; None takes those that the traffics name themselves.

    Raises:
        UserError: a generated traffic, and no weights of its preset.
    """
    every = {config.traffic.label(): config.traffic, **config.rivals()}
    if weights is not None:
        every = {name: _with_weights(name, traffic, weights) for name, traffic in every.items()}
    return {name: _maker(traffic, config.env) for name, traffic in every.items()}


def _maker(traffic: TrafficConfig, env: EnvConfig) -> Factory:
    def make(road: Road) -> TrafficModule:
        # A copy that is not checked again: a recorded road need not fit Table II's vehicles.
        own = copy(env)
        assign(own, lanes=int(road.lanes), lane_width_m=float(road.lane_width_m))
        return make_traffic(traffic, own, Stream.REPORT)

    return make


def _with_weights(name: str, traffic: TrafficConfig, weights: Mapping[str, Path]) -> TrafficConfig:
    """A generated traffic with the weights of a fold; others as they are."""
    if name not in PRESETS:
        return traffic
    if PRESETS[name] not in weights:
        raise UserError(
            f"fold_weights: traffic {name} needs the preset {PRESETS[name]}, and a fold has no such file; give one "
            "for every fold."
        )
    return replace(traffic, path=str(weights[PRESETS[name]]))  # type: ignore[call-arg]


def folds_of(config: RealismConfig, scenes: Sequence[str]) -> list[Fold]:
    """Who starts from which of ``scenes``: the held-out ones (or all), or all by folds."""
    if not config.fold_weights:
        held_out = config.data.held_out_scenes(scenes, HELD_OUT)
        return [Fold(makers_of(config), scenes if config.scenes == "all" else held_out, held_out)]
    folds = fold_weights([Path(path) for path in config.fold_weights])
    check_cover(list(folds), scenes)
    return [Fold(makers_of(config, weights), held_out, held_out) for held_out, weights in folds.items()]
