"""``env=...``: road, vehicles, initial scenes, and the end of an episode.

``env=highway`` and ``env=dense`` start with random scenes.
``env=cut_in, stalled_car, blocked_lane, stop_and_go`` start with a scene made by
:mod:`ganlane.sim.scenarios`, ``env=scene`` with one from a file (:mod:`ganlane.sim.scenarios`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Annotated, TypeAlias

from ganlane.arguments import call_with
from ganlane.errors import ParameterError, as_typed
from ganlane.parameters import (
    NotNegative,
    Positive,
    Record,
    Share,
    Text,
    assign,
    between,
    one_of,
    part_of,
)
from ganlane.parameters.driving import EgoParameters, IdmParameters, MobilParameters, Visibility
from ganlane.parameters.episode import KERNELS, EpisodeParameters, SpawnParameters
from ganlane.parameters.observation import RewardParameters

if TYPE_CHECKING:
    from ganlane.sim.scenes import FixedScene, Scenes, SceneVehicle

Vehicles: TypeAlias = Annotated[int, between(2, 1000)]
#: Keys of Table II, which do not apply to a given scene.
TABLE_II_KEYS = tuple(
    field.name for field in fields(SpawnParameters) if field.name != "ego_desired_speed_mps"
)


@dataclass(frozen=True)
class EnvConfig(SpawnParameters, EpisodeParameters):
    """``env=highway``: the paper's highway (section IV, Tables II, IV and V); m, s, m/s.

    Attributes:
        vehicles: M, the ego included, 2 (Table III has no entry for fewer) to 1000.
        lanes: 1 to 20.
        lane_width_m: above the vehicles' width; the paper gives none. In narrower lanes noise alone
            makes cars of 2.5 m touch.
        recycle: true: vehicles that the ego leaves 200 m behind return ahead of it, and the
            reverse.
        recycle_share: share of the episodes in which they do, 0 to 1.
        compile: true: physics, traffic and the agent's update as compiled graphs (needs a C++
            compiler); faster, after a minute or so of compiling, and the same up to rounding
            (docs/performance.md).
        kernel: what drives a decision: the tensor code (torch), the native kernel (native), which
            does the same up to rounding for traffic=idm and idm_mobil on a CPU, or the kernel where
            it can (auto).
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
            if self.lane_width_m <= getattr(self, name):
                raise ParameterError(
                    f"{{lane_width_m}}={self.lane_width_m:g}: expected more than {{{name}}}={getattr(self, name):g}, "
                    "or vehicles in neighbouring lanes touch; widen the lanes."
                )
        if self.timeout_s < self.decision_period_s:
            raise ParameterError(
                f"{{timeout_s}}={self.timeout_s:g}: expected at least {{decision_period_s}}="
                f"{self.decision_period_s:g}, or every episode ends in its first step."
            )
        self._check_start()

    def _check_start(self) -> None:
        """Raise an error if initial scenes do not fit on the road, or make a crash unavoidable."""
        # The check imports torch. The defaults are valid, so a mistake elsewhere is reported
        # without it.
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
    """Raise an error unless the ego's desired speed, where the speed reward is 1, is above its base
    speed (0).
    """
    if env.ego_desired_speed_mps <= reward.base_speed_mps:
        raise ParameterError(
            f"{{env.ego_desired_speed_mps}}={env.ego_desired_speed_mps:g}: expected more than "
            f"{{reward.base_speed_mps}}={reward.base_speed_mps:g}, where the speed reward is 0; raise the one or "
            "lower the other."
        )


@dataclass(frozen=True)
class DenseEnvConfig(EnvConfig):
    """``env=dense``: more vehicles, with a spread that grows with their number at the paper's
    density.

    Attributes:
        metres_per_vehicle: spread_m is at least this times vehicles, m; Table II has 200 m for 9.
    """

    vehicles: Vehicles = 30
    metres_per_vehicle: Positive = 22.3

    def __post_init__(self) -> None:
        self.check_ranges("metres_per_vehicle", "vehicles")
        assign(self, spread_m=max(self.spread_m, self.metres_per_vehicle * self.vehicles))
        super().__post_init__()


@dataclass(frozen=True)
class SceneOptions(Record):
    """``env.scene``: how much the scene varies from episode to episode.

    Attributes:
        jitter_m: positions vary by up to so much to either side from episode to episode, m.
        jitter_mps: and speeds, m/s; standing vehicles remain standing.
    """

    jitter_m: NotNegative = 0.0
    jitter_mps: NotNegative = 0.0


@dataclass(frozen=True)
class SceneEnvConfig(EnvConfig):
    """Base of the environments with a given scene.

    Attributes:
        vehicles: 0: as many as the scene has.
        scene: the scene's own numbers.
    """

    #: Function of :mod:`ganlane.sim.scenarios` that makes the vehicles.
    scenario = ""

    vehicles: int = 0
    goal_m: float = 1000.0
    timeout_s: float = 120.0
    scene: SceneOptions = field(default_factory=SceneOptions)

    def __post_init__(self) -> None:
        self.check_ranges(*TABLE_II_KEYS, "lane_width_m", "lanes", "ego_desired_speed_mps")
        for name in TABLE_II_KEYS:
            if getattr(self, name) != getattr(SpawnParameters, name):
                raise ParameterError(
                    f"{{{name}}}={as_typed(getattr(self, name))}: has no effect on a scene set by hand; "
                    "leave it out, or take env=highway."
                )
        there = self.scenes().vehicles
        if self.vehicles not in (0, there):
            raise ParameterError(
                f"{{vehicles}}={self.vehicles}: the scene has {there}, the ego included; leave this key out."
            )
        assign(self, vehicles=there)
        super().__post_init__()

    def _check_start(self) -> None:
        scene = self.scenes()
        scene.check(scene.road, self.idm)

    def scenes(self, others_visibility: int | None = None) -> FixedScene:
        """As in :class:`EnvConfig`."""
        from ganlane.sim.scenes import FixedScene
        from ganlane.sim.state import Road

        return FixedScene(
            self.rows(),
            Road(self.lanes, self.lane_width_m),
            jitter_m=self.scene.jitter_m,
            jitter_mps=self.scene.jitter_mps,
            ego_visibility=Visibility.named(self.ego.visibility),
            others_visibility=Visibility.SIGNALLED
            if others_visibility is None
            else others_visibility,
            name=self.name(),
        )

    def name(self) -> str:
        """The option, for messages."""
        return f"env={self.scenario}"

    def rows(self) -> tuple[SceneVehicle, ...]:
        """The vehicles of the scene, the ego first."""
        from ganlane.sim import scenarios

        offered = {
            "lanes": self.lanes,
            "desired_speed_mps": self.ego_desired_speed_mps,
            "lane_width_m": self.lane_width_m,
            "idm": self.idm,
        }
        numbers = {
            field.name: getattr(self.scene, field.name)
            for field in fields(self.scene)
            if field.name not in ("jitter_m", "jitter_mps")
        }
        return call_with(getattr(scenarios, self.scenario), offered, numbers, self.name())


@dataclass(frozen=True)
class CutInOptions(SceneOptions):
    """``env.scene`` of ``env=cut_in``.

    Attributes:
        gap_m: from the ego's bumper to the other's when it cuts in, m.
        speed_mps: of the ego and the others, m/s.
        cutter_speed_mps: of the vehicle that cuts in, and its desired speed, m/s.
    """

    jitter_m: NotNegative = 1.0
    jitter_mps: NotNegative = 0.5
    gap_m: Positive = 20.0
    speed_mps: Positive = 20.0
    cutter_speed_mps: Positive = 17.0


@dataclass(frozen=True)
class CutInEnvConfig(SceneEnvConfig):
    """``env=cut_in`` (:func:`ganlane.sim.scenarios.cut_in`); what matters is over in seconds, hence
    the near goal.

    Attributes:
        vehicles: 0: as many as the scene has (6).
        lanes: 2 or more; the ego starts in the last but one from the left.
    """

    scenario = "cut_in"
    scene: CutInOptions = field(default_factory=CutInOptions)


@dataclass(frozen=True)
class StalledCarOptions(SceneOptions):
    """``env.scene`` of ``env=stalled_car``.

    Attributes:
        distance_m: from the ego's centre to the stalled car's, m.
        speed_mps: of the ego and the others, m/s.
        spacing_m: centre to centre, of those in the next lane, m.
    """

    jitter_m: NotNegative = 1.0
    jitter_mps: NotNegative = 0.5
    distance_m: Positive = 200.0
    speed_mps: Positive = 20.0
    spacing_m: Positive = 120.0


@dataclass(frozen=True)
class StalledCarEnvConfig(SceneEnvConfig):
    """``env=stalled_car`` (:func:`ganlane.sim.scenarios.stalled_car`); who does not pass in two
    minutes never will.

    Attributes:
        vehicles: 0: as many as the scene has (8; 3 on a road of one lane).
    """

    scenario = "stalled_car"
    scene: StalledCarOptions = field(default_factory=StalledCarOptions)


@dataclass(frozen=True)
class BlockedLaneOptions(SceneOptions):
    """``env.scene`` of ``env=blocked_lane``.

    Attributes:
        distance_m: from the ego's centre to the first standing vehicle's, m.
        standing: vehicles that close the lane, 1 to 100.
        speed_mps: of the ego and the others, m/s.
        spacing_m: centre to centre, of those in the other lanes, m; from 100 on MOBIL finds a gap.
    """

    jitter_m: NotNegative = 0.5
    jitter_mps: NotNegative = 0.5
    distance_m: Positive = 250.0
    standing: Annotated[int, between(1, 100)] = 3
    speed_mps: Positive = 15.0
    spacing_m: Positive = 60.0


@dataclass(frozen=True)
class BlockedLaneEnvConfig(SceneEnvConfig):
    """``env=blocked_lane`` (:func:`ganlane.sim.scenarios.blocked_lane`).

    Attributes:
        vehicles: 0: as many as the scene has (11: 2 + standing + 6 in each other lane).
        lanes: 2 or more.
        timeout_s: s; an ego without a gap for two minutes has stopped at the closure.
    """

    scenario = "blocked_lane"
    lanes: int = 2
    scene: BlockedLaneOptions = field(default_factory=BlockedLaneOptions)


@dataclass(frozen=True)
class StopAndGoOptions(SceneOptions):
    """``env.scene`` of ``env=stop_and_go``.

    Attributes:
        waves: queues in a lane, 1 to 50.
        per_wave: vehicles in a queue, and in the group behind it, 2 to 50.
        speed_mps: of those that flow, m/s.
    """

    jitter_m: NotNegative = 0.5
    jitter_mps: NotNegative = 0.5
    waves: Annotated[int, between(1, 50)] = 2
    per_wave: Annotated[int, between(2, 50)] = 5
    speed_mps: Positive = 10.0


@dataclass(frozen=True)
class StopAndGoEnvConfig(SceneEnvConfig):
    """``env=stop_and_go`` (:func:`ganlane.sim.scenarios.stop_and_go`).

    Attributes:
        vehicles: 0: as many as the scene has (44: 2 + 2 waves x 2 x per_wave in each lane).
        timeout_s: s; a kilometre at 10 m/s takes 100 s, and the queues their time.
    """

    scenario = "stop_and_go"
    lanes: int = 2
    timeout_s: float = 180.0
    scene: StopAndGoOptions = field(default_factory=StopAndGoOptions)


@dataclass(frozen=True)
class FileSceneOptions(SceneOptions):
    """``env.scene`` of ``env=scene``.

    Attributes:
        path: the file; its first vehicle is the ego.
    """

    path: Text | None = None


@dataclass(frozen=True)
class FileSceneEnvConfig(SceneEnvConfig):
    """``env=scene env.scene.path=FILE``: a scene of one's own.

    Attributes:
        vehicles: 0: as many as the file has.
        lanes: 0: as the file says (JSON), or just enough for its vehicles.
        lane_width_m: 0: as the file says (JSON), or 4 m.
        ego_desired_speed_mps: 0: as the file says.
    """

    lanes: Annotated[int, between(0, 20)] = 0
    lane_width_m: NotNegative = 0.0
    ego_desired_speed_mps: NotNegative = 0.0
    timeout_s: float = 300.0
    scene: FileSceneOptions = field(default_factory=FileSceneOptions)

    def __post_init__(self) -> None:
        self.check_ranges("lanes", "lane_width_m", "ego_desired_speed_mps")
        scene = self._read()
        assign(
            self,
            lanes=int(scene.road.lanes),
            lane_width_m=float(scene.road.lane_width_m),
            ego_desired_speed_mps=scene.rows[0].desired_speed_mps,
        )
        super().__post_init__()

    def _read(self) -> FixedScene:
        from ganlane.sim.scene_files import read_scene, with_ego_speed

        if self.scene.path is None:
            raise ParameterError(
                "{scene.path}: no file; give one, env=scene {scene.path}=my_scene.csv."
            )
        scene = read_scene(self.scene.path, self.lanes or None, self.lane_width_m or None)
        speed = self.ego_desired_speed_mps
        return with_ego_speed(scene, speed) if speed else scene

    def name(self) -> str:
        """The file."""
        return str(self.scene.path)

    def rows(self) -> tuple[SceneVehicle, ...]:
        """Those of the file."""
        return self._read().rows
