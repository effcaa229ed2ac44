"""``env=...``: the road, who drives on it, and when an episode ends."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ganlane.config.checks import above, at_least, below, between, check, one_of, speed_range
from ganlane.config.plain import plain_copy
from ganlane.errors import UserError

if TYPE_CHECKING:
    from ganlane.sim.ego import EgoParameters
    from ganlane.sim.episode import EpisodeParameters
    from ganlane.sim.idm import IdmParameters
    from ganlane.sim.lanes import Visibility
    from ganlane.sim.mobil import MobilParameters
    from ganlane.sim.scenes import Scenes
    from ganlane.sim.spawn import SpawnParameters

VISIBILITIES = ("centre", "body", "signalled")


@dataclass
class IdmConfig:
    """``env.idm``: car following, Table V (:class:`ganlane.sim.IdmParameters`). m, s, m/s2."""

    min_gap_m: float = 2.0
    headway_s: float = 1.6
    comfortable_deceleration: float = 1.7
    min_acceleration: float = -20.0
    max_acceleration: float = 0.7

    def __post_init__(self) -> None:
        positive = dict.fromkeys(("comfortable_deceleration", "max_acceleration"), above(0))
        check(self, "env.idm", min_gap_m=at_least(0), headway_s=at_least(0), min_acceleration=below(0), **positive)

    def parameters(self) -> IdmParameters:
        """As the simulator takes it."""
        from ganlane.sim.idm import IdmParameters

        return plain_copy(self, IdmParameters)


@dataclass
class MobilConfig:
    """``env.mobil``: lane changes, Table IV (:class:`ganlane.sim.MobilParameters`). m, m/s2."""

    threshold: float = 0.1
    politeness_rear: float = 0.5
    politeness_side: float = 1.0
    safe_deceleration: float = 4.0
    exclusive_m: float = 60.0

    def __post_init__(self) -> None:
        names = ("threshold", "politeness_rear", "politeness_side", "exclusive_m")
        check(self, "env.mobil", safe_deceleration=above(0), **dict.fromkeys(names, at_least(0)))

    def parameters(self) -> MobilParameters:
        """As the simulator takes it."""
        from ganlane.sim.mobil import MobilParameters

        return plain_copy(self, MobilParameters)


@dataclass
class EgoConfig:
    """``env.ego``: how the ego takes commands and is seen (:class:`ganlane.sim.ego.EgoParameters`). s, m."""

    abort_lane_change: bool = False
    visibility: str = "body"
    soft_crash_ttc_s: float = 1.5
    soft_crash_gap_m: float = 2.0

    def __post_init__(self) -> None:
        limits = dict.fromkeys(("soft_crash_ttc_s", "soft_crash_gap_m"), at_least(0))
        check(self, "env.ego", visibility=one_of(VISIBILITIES), **limits)

    def parameters(self) -> EgoParameters:
        """As the environment takes it."""
        from ganlane.sim.ego import EgoParameters
        from ganlane.sim.lanes import Visibility

        return plain_copy(self, EgoParameters, visibility=Visibility(VISIBILITIES.index(self.visibility)))


@dataclass
class EnvConfig:
    """``env=highway``: the paper's highway (section IV, Tables II, IV and V). m, s, m/s."""

    vehicles: int = 9
    lanes: int = 3
    lane_width_m: float = 4.0
    spread_m: float = 200.0
    min_spacing_m: float = 25.0
    front_speed_mps: list[float] = field(default_factory=lambda: [10.0, 12.0])
    rear_speed_mps: list[float] = field(default_factory=lambda: [15.0, 25.0])
    ego_speed_mps: list[float] = field(default_factory=lambda: [10.0, 15.0])
    desired_speed_mps: list[float] = field(default_factory=lambda: [18.0, 26.0])
    ego_desired_speed_mps: float = 25.0
    length_m: float = 4.5
    width_m: float = 2.5
    truck_share: float = 0.0
    truck_length_m: float = 12.0
    truck_width_m: float = 2.5
    truck_desired_speed_mps: list[float] = field(default_factory=lambda: [22.0, 25.0])
    decision_period_s: float = 1.0
    goal_m: float = 5000.0
    timeout_s: float = 1000.0
    recycle: bool = False
    compile: bool = False
    ego: EgoConfig = field(default_factory=EgoConfig)
    idm: IdmConfig = field(default_factory=IdmConfig)
    mobil: MobilConfig = field(default_factory=MobilConfig)

    def __post_init__(self) -> None:
        check(
            self,
            "env",
            # At least one other vehicle: Table III has no entry otherwise.
            vehicles=between(2, 1000),
            lanes=between(1, 20),
            lane_width_m=above(0),
            spread_m=above(0),
            min_spacing_m=above(0),
            ego_desired_speed_mps=above(0),
            length_m=above(0),
            width_m=above(0),
            truck_share=between(0, 1),
            truck_length_m=above(0),
            truck_width_m=above(0),
            decision_period_s=above(0),
            goal_m=above(0),
            timeout_s=above(0),
            **dict.fromkeys(("front_speed_mps", "rear_speed_mps", "ego_speed_mps"), speed_range()),
            **dict.fromkeys(("desired_speed_mps", "truck_desired_speed_mps"), speed_range()),
        )
        self._check_together()

    def _check_together(self) -> None:
        for name in ("desired_speed_mps", "truck_desired_speed_mps"):
            speeds = getattr(self, name)
            if speeds[0] <= 0:
                raise UserError(
                    f"env.{name}={speeds}: expected speeds above 0; a driver that wants to stand still is no driver."
                )
        for name in ("width_m", "truck_width_m") if self.truck_share > 0 else ("width_m",):
            width = getattr(self, name)
            if self.lane_width_m <= width:
                raise UserError(
                    f"env.lane_width_m={self.lane_width_m:g}: expected more than env.{name}={width:g}, or vehicles "
                    "in neighbouring lanes touch; widen the lanes."
                )
        if self.timeout_s < self.decision_period_s:
            raise UserError(
                f"env.timeout_s={self.timeout_s:g}: expected at least env.decision_period_s="
                f"{self.decision_period_s:g}, or every episode ends in its first step."
            )
        self.episode_parameters().check()
        self._check_start()

    def _check_start(self) -> None:
        """Refuse first scenes that do not fit on the road, or from which nobody could drive on."""
        self.spawn_parameters().check(self.vehicles, self.lanes, self.idm.parameters())

    def scenes(self, others_visibility: int | None = None) -> Scenes | None:
        """Where an episode's vehicles start: None for Table II; ``others_visibility`` is the traffic's."""
        return None

    def spawn_parameters(self) -> SpawnParameters:
        """Table II as the simulator takes it."""
        from ganlane.sim.spawn import SpawnParameters

        return plain_copy(self, SpawnParameters)

    def episode_parameters(self) -> EpisodeParameters:
        """Decision period, goal and time-out as the environment takes them."""
        from ganlane.sim.episode import EpisodeParameters

        return plain_copy(self, EpisodeParameters)


@dataclass
class DenseEnvConfig(EnvConfig):
    """``env=dense``: more vehicles, with a spread that grows with their number at the paper's density."""

    vehicles: int = 30
    #: Metres of road per vehicle; Table II has 200 m for 9.
    metres_per_vehicle: float = 22.3

    def __post_init__(self) -> None:
        check(self, "env", metres_per_vehicle=above(0), vehicles=between(2, 1000))
        self.spread_m = max(self.spread_m, self.metres_per_vehicle * self.vehicles)
        super().__post_init__()
