"""Environments whose episodes start in a given scene: the scenarios that ship, and a scene of your own.

``env=cut_in, stalled_car, blocked_lane, stop_and_go`` are made, and ``env=scene`` is read from a file, by
:mod:`ganlane.sim.scenarios`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Annotated, Any

from ganlane.config.env import EnvConfig
from ganlane.config.targets import call_with
from ganlane.errors import ParameterError, as_typed
from ganlane.parameters.checks import NotNegative, Positive, Record, Text, assign, between
from ganlane.parameters.driving import Visibility
from ganlane.parameters.episode import SpawnParameters

if TYPE_CHECKING:
    from ganlane.sim.scenes import FixedScene, SceneVehicle

#: Keys of Table II, which do not apply to a given scene.
TABLE_II_KEYS = tuple(field.name for field in fields(SpawnParameters) if field.name != "ego_desired_speed_mps")


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
        """The scene as the environment takes it, see :meth:`EnvConfig.scenes`."""
        from ganlane.sim.scenes import FixedScene
        from ganlane.sim.state import Road

        return FixedScene(
            self.rows(),
            Road(self.lanes, self.lane_width_m),
            jitter_m=self.scene.jitter_m,
            jitter_mps=self.scene.jitter_mps,
            ego_visibility=Visibility.named(self.ego.visibility),
            others_visibility=Visibility.SIGNALLED if others_visibility is None else others_visibility,
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
        return call_with(getattr(scenarios, self.scenario), offered, self.numbers(), self.name())

    def numbers(self) -> dict[str, Any]:
        """The scene's own numbers by name, without the jitter."""
        jitter = {field.name for field in fields(SceneOptions)}
        return {
            field.name: getattr(self.scene, field.name) for field in fields(self.scene) if field.name not in jitter
        }


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
    """``env=cut_in`` (:func:`ganlane.sim.scenarios.cut_in`); what matters is over in seconds, hence the near goal.

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
    """``env=stalled_car`` (:func:`ganlane.sim.scenarios.stalled_car`); who does not pass in two minutes never will.

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
        from ganlane.sim.scenarios import read_scene, with_ego_speed

        if self.scene.path is None:
            raise ParameterError("{scene.path}: no file; give one, env=scene {scene.path}=my_scene.csv.")
        scene = read_scene(self.scene.path, self.lanes or None, self.lane_width_m or None)
        speed = self.ego_desired_speed_mps
        return with_ego_speed(scene, speed) if speed else scene

    def name(self) -> str:
        """The file."""
        return str(self.scene.path)

    def rows(self) -> tuple[SceneVehicle, ...]:
        """Those of the file."""
        return self._read().rows
