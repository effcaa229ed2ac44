"""Root of ``ganlane realism``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from ganlane.config.data import DataConfig
from ganlane.config.env import EnvConfig
from ganlane.config.evaluate import all_traffics
from ganlane.config.run import GeneratorFile, RunConfig
from ganlane.config.traffic import TrafficConfig
from ganlane.errors import UserError
from ganlane.parameters.checks import at_least, between, check, did_you_mean, every, one_of, optional

#: Names that the ends of the scale have.
_TAKEN = ("random", "constant_velocity")
#: The traffic that is the recordings themselves.
_RECORDED = "replay"
#: Those that drive around an ego of ours only; a card has none.
_FOREIGN = ("sumo", "highway_env")
#: No traffic of its own: its parts have cards.
_MIXED = "mixed"
_QUICK_KM = 5.0
_QUICK_S = 30.0


def drivable() -> dict[str, TrafficConfig]:
    """The options of the group ``traffic`` that can have a card, by name: neither recordings nor mixtures, no ego."""
    without = (_RECORDED, _MIXED, *_FOREIGN)
    return {name: traffic for name, traffic in all_traffics().items() if name not in without}


@dataclass
class RealismConfig(RunConfig):
    """A traffic, what it is compared with, the recordings, and how much is driven."""

    traffic: TrafficConfig = field(default_factory=TrafficConfig)
    against: list[str] = field(default_factory=lambda: ["idm_mobil"])
    scenes: str = "held_out"
    repeats: int = 4
    desired_above_mps: float | None = None
    long_vehicles: list[int] = field(default_factory=lambda: [9, 30])
    vehicle_km: float = 3000.0
    long_s: float = 600.0
    long_against: bool = False
    i80: bool | None = None
    resamples: int = 2000
    quick: bool = False
    publish: bool = False
    report: str | None = None
    figures: str | None = None
    env: EnvConfig = field(default_factory=EnvConfig)
    data: DataConfig = field(default_factory=DataConfig)
    generator: GeneratorFile = field(default_factory=GeneratorFile)
    fold_weights: list[str] = field(default_factory=list)
    traffic_options: dict[str, TrafficConfig] = field(default_factory=drivable)

    def __post_init__(self) -> None:
        super().__post_init__()
        check(
            self,
            "",
            scenes=one_of(("held_out", "all")),
            repeats=between(1, 1000),
            desired_above_mps=optional(at_least(0)),
            long_vehicles=every(between(1, 1000)),
            vehicle_km=at_least(0),
            long_s=between(10, 3600),
            resamples=between(100, 100_000),
        )
        if self.device != "cpu":
            raise UserError(f"device={self.device}: the card is made on the CPU, in minutes; use device=cpu.")
        if self.traffic.label() == _RECORDED:
            raise UserError("traffic=replay: it is the recordings themselves; choose a traffic that drives.")
        if self.traffic.label() in _FOREIGN:
            raise UserError(
                f"traffic={self.traffic.label()}: a foreign simulator drives around an ego only, and a card has "
                "none; choose one of our own."
            )
        if self.traffic.label() == _MIXED:
            raise UserError("traffic=mixed: a card is of one traffic; make one of each of its parts.")
        if self.data.format != "scenes":
            raise UserError(
                f"data={self.data.format}: the card reads scenes; run ganlane prepare data={self.data.format} first, "
                "and give data=scenes data.path=FOLDER with what it wrote."
            )
        if self.publish and self.scenes != "all":
            raise UserError("publish=true: the file that ships is made from all recorded scenes; give scenes=all.")
        self.rivals()

    def card(self) -> str:
        """The card's name in a document: whose it is, and from where everybody starts."""
        return f"{self.traffic.label()} {'folds' if self.fold_weights else self.scenes}"

    def rivals(self) -> dict[str, TrafficConfig]:
        """The traffics to compare with, by name; the traffic itself is left out."""
        names = [name for name in self.against if name != self.traffic.label()]
        for name in [*names, self.traffic.label()]:
            if name in _TAKEN:
                raise UserError(f"against={name}: every card holds it anyway; leave it out.")
        for name in names:
            if name not in self.traffic_options and "." not in name:
                known = ", ".join(self.traffic_options)
                raise UserError(
                    f"against={name}: no such traffic{did_you_mean(name, self.traffic_options)}; choose among "
                    f"{known}, or give the import path of a model of your own."
                )
        return {name: self.traffic_options.get(name) or TrafficConfig(_target_=name) for name in names}

    def shortened(self) -> RealismConfig:
        """With ``quick``, a check that it runs: one repeat, nothing fitted, few vehicle-km, I-80 if asked for."""
        if not self.quick:
            return self
        return replace(
            self,
            repeats=1,
            desired_above_mps=4.5 if self.desired_above_mps is None else self.desired_above_mps,
            vehicle_km=min(self.vehicle_km, _QUICK_KM),
            long_s=min(self.long_s, _QUICK_S),
            i80=bool(self.i80),
            resamples=min(self.resamples, 200),
        )
