"""``env=highway`` and ``env=dense``: road, vehicles, random initial scenes, and the end of an episode."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, TypeAlias

from ganlane.errors import ParameterError
from ganlane.parameters import Positive, Share, assign, between, one_of, part_of
from ganlane.parameters.driving import EgoParameters, IdmParameters, MobilParameters
from ganlane.parameters.episode import KERNELS, EpisodeParameters, SpawnParameters
from ganlane.parameters.observation import RewardParameters

if TYPE_CHECKING:
    from ganlane.sim.scenes import Scenes

Vehicles: TypeAlias = Annotated[int, between(2, 1000)]


@dataclass(frozen=True)
class EnvConfig(SpawnParameters, EpisodeParameters):
    """``env=highway``: the paper's highway (section IV, Tables II, IV and V); m, s, m/s.

    Attributes:
        vehicles: M, the ego included, 2 (Table III has no entry for fewer) to 1000.
        lanes: 1 to 20.
        lane_width_m: above the vehicles' width; the paper gives none. In narrower lanes noise alone makes cars of
            2.5 m touch.
        recycle: true: vehicles that the ego leaves 200 m behind return ahead of it, and the reverse.
        recycle_share: share of the episodes in which they do, 0 to 1.
        compile: true: physics, traffic and the agent's update as compiled graphs (needs a C++ compiler); faster,
            after a minute or so of compiling, and the same up to rounding (docs/performance.md).
        kernel: what drives a decision: the tensor code (torch), the native kernel (native), which does the same up to
            rounding for traffic=idm and idm_mobil on a CPU, or the kernel where it can (auto).
        ego: how the ego drives.
        idm: how all follow, Table V.
        mobil: how the others change lanes, Table IV.
    """

    vehicles: Vehicles = 9
    lanes: Annotated[int, between(1, 20)] = 3
    lane_width_m: Positive = 4.0
    recycle: bool = False
    recycle_share: Share = 1.0
    compile: bool = False
    kernel: Annotated[str, one_of(KERNELS)] = "auto"
    ego: EgoParameters = field(default_factory=EgoParameters)
    idm: IdmParameters = field(default_factory=IdmParameters)
    mobil: MobilParameters = field(default_factory=MobilParameters)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("width_m", "truck_width_m") if self.truck_share > 0 else ("width_m",):
            width = getattr(self, name)
            if self.lane_width_m <= width:
                raise ParameterError(
                    f"{{lane_width_m}}={self.lane_width_m:g}: expected more than {{{name}}}={width:g}, or vehicles "
                    "in neighbouring lanes touch; widen the lanes."
                )
        if self.timeout_s < self.decision_period_s:
            raise ParameterError(
                f"{{timeout_s}}={self.timeout_s:g}: expected at least {{decision_period_s}}="
                f"{self.decision_period_s:g}, or every episode ends in its first step."
            )
        self._check_start()

    def _check_start(self) -> None:
        """Raise an error if initial scenes do not fit on the road, or make a crash unavoidable."""
        # The check imports torch. The defaults are valid, so a mistake elsewhere is reported without it.
        asked = (self.spawn_parameters(), self.vehicles, self.lanes, self.idm)
        if asked == (SpawnParameters(), EnvConfig.vehicles, EnvConfig.lanes, IdmParameters()):
            return
        from ganlane.sim.spawn import check_start

        check_start(*asked)

    def scenes(self, others_visibility: int | None = None) -> Scenes | None:
        """Initial scenes of episodes; None: Table II. ``others_visibility`` is the traffic's."""
        return None

    def spawn_parameters(self) -> SpawnParameters:
        """The parameters of Table II."""
        return part_of(self, SpawnParameters)

    def episode_parameters(self) -> EpisodeParameters:
        """Decision period, goal and time-out."""
        return part_of(self, EpisodeParameters)


def check_reward(env: EnvConfig, reward: RewardParameters) -> None:
    """Raise an error unless the ego's desired speed, where the speed reward is 1, is above its base speed (0)."""
    if env.ego_desired_speed_mps <= reward.base_speed_mps:
        raise ParameterError(
            f"{{env.ego_desired_speed_mps}}={env.ego_desired_speed_mps:g}: expected more than "
            f"{{reward.base_speed_mps}}={reward.base_speed_mps:g}, where the speed reward is 0; raise the one or "
            "lower the other."
        )


@dataclass(frozen=True)
class DenseEnvConfig(EnvConfig):
    """``env=dense``: more vehicles, with a spread that grows with their number at the paper's density.

    Attributes:
        metres_per_vehicle: spread_m is at least this times vehicles, m; Table II has 200 m for 9.
    """

    vehicles: Vehicles = 30
    metres_per_vehicle: Positive = 22.3

    def __post_init__(self) -> None:
        self.check_ranges("metres_per_vehicle", "vehicles")
        assign(self, spread_m=max(self.spread_m, self.metres_per_vehicle * self.vehicles))
        super().__post_init__()
