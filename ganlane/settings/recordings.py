"""Configurations of the commands that read recordings.

``ganlane prepare``, ``train_generator``, ``realism``.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from ganlane.errors import UserError
from ganlane.settings.commands import CpuConfig
from ganlane.settings.env import EnvConfig
from ganlane.settings.generator import DataConfig, FitConfig, PaperConfig
from ganlane.settings.record import CountOrZero, NotNegative, assign, at_least, between, one_of
from ganlane.settings.traffic import IdmMobilTrafficConfig, TrafficConfig, traffics_of

#: Names of the card's own references.
_REFERENCES = ("random", "constant_velocity")
#: Traffics that cannot have a card, with the reason.
_WITHOUT_CARD = {
    "replay": "it is the recordings themselves; choose a traffic that drives",
    "mixed": "a card is of one traffic; make one of each of its parts",
    **dict.fromkeys(
        ("sumo", "highway_env"),
        "a foreign simulator drives around an ego only, and a card has none; choose one of our own",
    ),
}
#: What a quick card drives at most: a check that it runs, no measurement.
_QUICK_KM = 5.0
_QUICK_S = 30.0


@dataclass(frozen=True)
class PrepareConfig(CpuConfig):
    """Recordings, and where their Parquet goes. Nothing is drawn at random; polars takes its own
    number of threads.

    Attributes:
        seed: of no effect.
        threads: of no effect (POLARS_MAX_THREADS).
        out: folder to make for the Parquet files; null: 'scenes' in the run folder.
        scene_s: cut recordings into scenes of so many seconds, so that some can be held out.
    """

    data: DataConfig = DataConfig()
    out: str | None = None
    scene_s: Annotated[float, at_least(1)] | None = None


@dataclass(frozen=True)
class TrainGeneratorConfig(CpuConfig):
    """Recordings, what is fitted to them, and how it is measured.

    Attributes:
        folds: fit this many more, each without the scenes of its fold, and pool their errors; 0:
            none.
        resume: folder of an earlier run: what was fitted there is not fitted again.
    """

    data: DataConfig = DataConfig()
    generator: FitConfig = PaperConfig()
    folds: CountOrZero = 0
    resume: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.folds == 1:
            raise UserError(
                "folds=1: one fold leaves nothing to fit to; use 2 or more, or 0 for none."
            )
        # Found out now, not after minutes of fitting.
        if self.resume is not None and not Path(self.resume).is_dir():
            raise UserError(
                f"resume={self.resume}: no such folder; give the folder of an earlier run."
            )


@dataclass(frozen=True)
class RealismConfig(CpuConfig):
    """A traffic, what it is compared with, the recordings, and how much is driven.

    Attributes:
        against: further traffics from the same starts, as traffics of ganlane evaluate; []: none.
        scenes: starts: held_out (data.held_out) or all, those that the generator was fitted to too.
        repeats: times that every scene is driven, with other random numbers.
        desired_above_mps: mean excess of desired speeds over the speed at entry, m/s; null: fitted
            per traffic.
        long_vehicles: long runs without an ego, with so many vehicles each.
        vehicle_km: at least so many in every long run; 0 leaves them out.
        long_s: no episode of a long run lasts longer, s.
        long_against: true: long runs of the traffics of against, too.
        i80: whether the files of one lane (I-80, I-24) beside the scenes are used; null: if they
            are there.
        resamples: of the bootstrap over scenes.
        quick: true: a check that it runs, in seconds.
    """

    traffic: TrafficConfig = IdmMobilTrafficConfig()
    against: dict[str, TrafficConfig] = field(
        default_factory=lambda: traffics_of(["idm_mobil"], "")
    )
    # how much is driven from recorded starts
    scenes: Annotated[str, one_of(("held_out", "all"))] = "held_out"
    repeats: Annotated[int, between(1, 1000)] = 4
    desired_above_mps: NotNegative | None = None
    # long runs without an ego
    long_vehicles: list[Annotated[int, between(1, 1000)]] = field(default_factory=lambda: [9, 30])
    vehicle_km: NotNegative = 3000.0
    long_s: Annotated[float, between(10, 3600)] = 600.0
    long_against: bool = False
    # what else is measured, and what is written
    i80: bool | None = None
    resamples: Annotated[int, between(100, 100_000)] = 2000
    quick: bool = False
    env: EnvConfig = EnvConfig()
    data: DataConfig = DataConfig()

    def __post_init__(self) -> None:
        # One name stands for a list of one.
        against: Any = [self.against] if isinstance(self.against, str) else self.against
        for name in _REFERENCES:
            if isinstance(against, Collection) and name in against:
                raise UserError(f"against={name}: every card holds it anyway; leave it out.")
        assign(self, against=traffics_of(against, "against") if against else {})
        super().__post_init__()
        if self.traffic.label() in _WITHOUT_CARD:
            raise UserError(
                f"traffic={self.traffic.label()}: {_WITHOUT_CARD[self.traffic.label()]}."
            )
        if self.data.format != "scenes":
            raise UserError(
                f"data={self.data.format}: the card reads scenes; run ganlane prepare "
                f"data={self.data.format} first, "
                "and give data=scenes data.path=FOLDER with what it wrote."
            )

    def rivals(self) -> dict[str, TrafficConfig]:
        """The traffics to compare with, by name; the traffic itself is left out."""
        label = self.traffic.label()
        return {name: traffic for name, traffic in self.against.items() if name != label}

    def shortened(self) -> RealismConfig:
        """With ``quick``, a check that it runs.

        One repeat, nothing fitted, few vehicle-km, I-80 if asked for.
        """
        if not self.quick:
            return self
        return replace(
            self,
            repeats=1,
            # A plausible number in place of the fit.
            desired_above_mps=4.5 if self.desired_above_mps is None else self.desired_above_mps,
            vehicle_km=min(self.vehicle_km, _QUICK_KM),
            long_s=min(self.long_s, _QUICK_S),
            i80=bool(self.i80),
            resamples=min(self.resamples, 200),
        )
