"""A card as it was driven, and the numbers that are kept of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ganlane.cards.driving import drive_from_starts, i80_beside, long_runs, say
from ganlane.cards.traffics import makers_of
from ganlane.config.realism import RealismConfig
from ganlane.evaluation.realism import Starts, card_checks, from_starts, i80_cards, rows_of, totals


@dataclass(frozen=True)
class Card:
    """What was driven for a traffic's card.

    Attributes:
        traffic: its name.
        starts: everybody from the same starts.
        site: rows of a site that no generator was fitted to, by file; empty without it.
        long_runs: by traffic, this one's first; each with a run per number of vehicles.
        resamples: of the bootstrap.
    """

    traffic: str
    starts: Starts
    site: Mapping[str, Any]
    long_runs: Mapping[str, list[dict[str, Any]]]
    resamples: int

    @property
    def runs(self) -> list[dict[str, Any]]:
        """The traffic's own long runs."""
        return self.long_runs[self.traffic]

    @cached_property
    def quantities(self) -> dict[str, Any]:
        """Its rows, by quantity."""
        return rows_of(self.starts, self.traffic, self.resamples)

    def numbers(self) -> dict[str, Any]:
        """What ``results.json`` holds."""
        starts, unseen = self.starts, self.starts.unseen
        driving = {"recorded": starts.seen, **from_starts(starts.driven)}
        return {
            "traffic": self.traffic,
            **starts.said(),
            "quantities": self.quantities,
            "quantities_held_out": rows_of(starts.only(unseen), self.traffic, self.resamples) if unseen else None,
            "driving": driving,
            "i80": self.site,
            **totals(self.runs),
            "long_runs": self.runs,
            "long_runs_against": {name: runs for name, runs in self.long_runs.items() if name != self.traffic},
            "checks": self._checks(driving[self.traffic]["quantiles"]),
        }

    def _checks(self, own: Mapping[str, Any]) -> dict[str, Any]:
        recorded, reference = self.starts.seen["quantiles"], self.starts.reference
        return card_checks(self.quantities, own, recorded, reference.rate(), reference.spread_mps, self.runs)


def drive_card(config: RealismConfig, path: Path | None) -> Card:
    """Drive everything that a card is made of.

    Args:
        config: whose card, and how much is driven.
        path: the recordings; None where there are none.

    Raises:
        UserError: recordings, weights or names that do not fit, or I-80 files that were asked for and are not there.
    """
    makers, files, traffic = makers_of(config), i80_beside(config, path), config.traffic.label()
    starts = drive_from_starts(config, makers, path)
    site = i80_cards(makers, files, starts.options, config.resamples, say)
    far = makers if config.long_against else {traffic: makers[traffic]}
    runs = {name: long_runs(config, name, make) for name, make in far.items()}
    return Card(traffic, starts, site, runs, config.resamples)
