"""``env=cut_in`` and the others: environments whose episodes start in a scene that somebody set."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

from ganlane.config.checks import above, at_least, between, check, optional, text
from ganlane.config.env import VISIBILITIES, EnvConfig
from ganlane.errors import UserError

if TYPE_CHECKING:
    from ganlane.sim.fixed_scene import FixedScene, SceneVehicle
    from ganlane.sim.lanes import Visibility
    from ganlane.sim.road import Road

#: Keys of Table II, which a scene set by hand does not have.
TABLE_II_KEYS = (
    "spread_m",
    "min_spacing_m",
    "front_speed_mps",
    "rear_speed_mps",
    "ego_speed_mps",
    "desired_speed_mps",
    "length_m",
    "width_m",
)


@dataclass
class SceneOptions:
    """``env.scene``: how much the scene varies from episode to episode, m and m/s to either side."""

    jitter_m: float = 0.0
    jitter_mps: float = 0.0

    def __post_init__(self) -> None:
        check(self, "env.scene", jitter_m=at_least(0), jitter_mps=at_least(0))


@dataclass
class SceneEnvConfig(EnvConfig):
    """What all scenes have in common. ``vehicles`` follows from the scene; 0 says so."""

    vehicles: int = 0
    scene: SceneOptions = field(default_factory=SceneOptions)

    def __post_init__(self) -> None:
        self._refuse_table_ii()
        check(self, "env", lane_width_m=above(0), lanes=between(1, 20), ego_desired_speed_mps=above(0))
        self._count_vehicles()
        super().__post_init__()

    def _refuse_table_ii(self) -> None:
        """A key that would be silently without effect is a mistake."""
        default = EnvConfig()
        for name in TABLE_II_KEYS:
            if getattr(self, name) != getattr(default, name):
                raise UserError(
                    f"env.{name}={getattr(self, name)}: has no effect on a scene set by hand; leave it out, or take "
                    "env=highway."
                )

    def _count_vehicles(self) -> None:
        there = self.fixed_scene().vehicles
        if self.vehicles not in (0, there):
            raise UserError(
                f"env.vehicles={self.vehicles}: the scene has {there}, the ego included; leave this key out."
            )
        self.vehicles = there

    def _check_start(self) -> None:
        self.fixed_scene().check(self._road(), self.idm.parameters())

    def scenes(self, others_visibility: Visibility | None = None) -> FixedScene:
        """The scene as the environment takes it, see :meth:`EnvConfig.scenes`."""
        return self.fixed_scene(others_visibility)

    def fixed_scene(self, others_visibility: Visibility | None = None) -> FixedScene:
        """The scene; ``others_visibility`` is the traffic's."""
        from ganlane.sim.fixed_scene import FixedScene

        return FixedScene(self.rows(), self._road(), name=self.name(), **self._scene_options(others_visibility))

    def _scene_options(self, others_visibility: Visibility | None) -> dict[str, Any]:
        from ganlane.sim.lanes import Visibility

        return {
            "jitter_m": self.scene.jitter_m,
            "jitter_mps": self.scene.jitter_mps,
            "ego_visibility": Visibility(VISIBILITIES.index(self.ego.visibility)),
            "others_visibility": Visibility.SIGNALLED if others_visibility is None else others_visibility,
        }

    def _road(self) -> Road:
        from ganlane.sim.road import Road

        return Road(self.lanes, self.lane_width_m)

    def name(self) -> str:
        """The option's name."""
        return "env.scene"

    def rows(self) -> tuple[SceneVehicle, ...]:
        """The vehicles of the scene."""
        raise UserError("env.scene: no vehicles; choose one of the scenarios or env=scene with env.scene.path=FILE.")

    def numbers(self) -> dict[str, Any]:
        """The scene's own numbers by name, without the jitter."""
        jitter = {field.name for field in fields(SceneOptions)}
        return {
            field.name: getattr(self.scene, field.name) for field in fields(self.scene) if field.name not in jitter
        }


@dataclass
class CutInOptions(SceneOptions):
    """``env.scene`` of ``env=cut_in``. m, m/s."""

    jitter_m: float = 1.0
    jitter_mps: float = 0.5
    gap_m: float = 20.0
    speed_mps: float = 20.0
    cutter_speed_mps: float = 17.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "env.scene", gap_m=above(0), speed_mps=above(0), cutter_speed_mps=above(0))


@dataclass
class CutInEnvConfig(SceneEnvConfig):
    """``env=cut_in``: a slower vehicle changes into the ego's lane, close ahead."""

    goal_m: float = 1000.0
    timeout_s: float = 120.0
    scene: CutInOptions = field(default_factory=CutInOptions)

    def name(self) -> str:
        """The option's name."""
        return "env=cut_in"

    def rows(self) -> tuple[SceneVehicle, ...]:
        """See :func:`ganlane.sim.scenarios.cut_in`."""
        from ganlane.sim.scenarios import cut_in

        return cut_in(**self.numbers(), lanes=self.lanes, desired_speed_mps=self.ego_desired_speed_mps)


@dataclass
class StalledCarOptions(SceneOptions):
    """``env.scene`` of ``env=stalled_car``. m, m/s."""

    jitter_m: float = 1.0
    jitter_mps: float = 0.5
    distance_m: float = 200.0
    speed_mps: float = 20.0
    spacing_m: float = 120.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "env.scene", distance_m=above(0), speed_mps=above(0), spacing_m=above(0))


@dataclass
class StalledCarEnvConfig(SceneEnvConfig):
    """``env=stalled_car``: a broken-down vehicle in the ego's lane."""

    goal_m: float = 1000.0
    timeout_s: float = 120.0
    scene: StalledCarOptions = field(default_factory=StalledCarOptions)

    def name(self) -> str:
        """The option's name."""
        return "env=stalled_car"

    def rows(self) -> tuple[SceneVehicle, ...]:
        """See :func:`ganlane.sim.scenarios.stalled_car`."""
        from ganlane.sim.scenarios import stalled_car

        return stalled_car(
            **self.numbers(),
            lanes=self.lanes,
            desired_speed_mps=self.ego_desired_speed_mps,
            lane_width_m=self.lane_width_m,
        )


@dataclass
class BlockedLaneOptions(SceneOptions):
    """``env.scene`` of ``env=blocked_lane``. m, m/s."""

    jitter_m: float = 0.5
    jitter_mps: float = 0.5
    distance_m: float = 250.0
    standing: int = 3
    speed_mps: float = 15.0
    spacing_m: float = 60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        positive = dict.fromkeys(("distance_m", "speed_mps", "spacing_m"), above(0))
        check(self, "env.scene", standing=between(1, 100), **positive)


@dataclass
class BlockedLaneEnvConfig(SceneEnvConfig):
    """``env=blocked_lane``: the ego's lane is closed, and traffic passes beside."""

    lanes: int = 2
    goal_m: float = 1000.0
    timeout_s: float = 120.0
    scene: BlockedLaneOptions = field(default_factory=BlockedLaneOptions)

    def name(self) -> str:
        """The option's name."""
        return "env=blocked_lane"

    def rows(self) -> tuple[SceneVehicle, ...]:
        """See :func:`ganlane.sim.scenarios.blocked_lane`."""
        from ganlane.sim.scenarios import blocked_lane

        return blocked_lane(
            **self.numbers(),
            lanes=self.lanes,
            desired_speed_mps=self.ego_desired_speed_mps,
            lane_width_m=self.lane_width_m,
        )


@dataclass
class StopAndGoOptions(SceneOptions):
    """``env.scene`` of ``env=stop_and_go``. m, m/s."""

    jitter_m: float = 0.5
    jitter_mps: float = 0.5
    waves: int = 2
    per_wave: int = 5
    speed_mps: float = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "env.scene", waves=between(1, 50), per_wave=between(2, 50), speed_mps=above(0))


@dataclass
class StopAndGoEnvConfig(SceneEnvConfig):
    """``env=stop_and_go``: columns in which queues stand and groups flow."""

    lanes: int = 2
    goal_m: float = 1000.0
    timeout_s: float = 180.0
    scene: StopAndGoOptions = field(default_factory=StopAndGoOptions)

    def name(self) -> str:
        """The option's name."""
        return "env=stop_and_go"

    def rows(self) -> tuple[SceneVehicle, ...]:
        """See :func:`ganlane.sim.scenarios.stop_and_go`."""
        from ganlane.sim.scenarios import stop_and_go

        return stop_and_go(
            **self.numbers(),
            lanes=self.lanes,
            desired_speed_mps=self.ego_desired_speed_mps,
            idm=self.idm.parameters(),
        )


@dataclass
class FileSceneOptions(SceneOptions):
    """``env.scene`` of ``env=scene``: the file."""

    path: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, "env.scene", path=optional(text()))


@dataclass
class FileSceneEnvConfig(SceneEnvConfig):
    """``env=scene env.scene.path=FILE``: a scene of one's own. 0 stands for 'as the file says'."""

    lanes: int = 0
    lane_width_m: float = 0.0
    ego_desired_speed_mps: float = 0.0
    timeout_s: float = 300.0
    goal_m: float = 1000.0
    scene: FileSceneOptions = field(default_factory=FileSceneOptions)

    def __post_init__(self) -> None:
        numbers = dict.fromkeys(("lane_width_m", "ego_desired_speed_mps"), at_least(0))
        check(self, "env", lanes=between(0, 20), **numbers)
        scene = self._read()
        self.lanes, self.lane_width_m = int(scene.road.lanes), float(scene.road.lane_width_m)
        self.ego_desired_speed_mps = scene.rows[0].desired_speed_mps
        super().__post_init__()

    def _read(self) -> FixedScene:
        from ganlane.sim.scene_files import read_scene, with_ego_speed

        if self.scene.path is None:
            raise UserError("env.scene.path: no file; give one, env=scene env.scene.path=my_scene.csv.")
        scene = read_scene(self.scene.path, self.lanes or None, self.lane_width_m or None)
        speed = self.ego_desired_speed_mps
        return with_ego_speed(scene, speed) if speed else scene

    def name(self) -> str:
        """The file."""
        return str(self.scene.path)

    def rows(self) -> tuple[SceneVehicle, ...]:
        """Those of the file."""
        return self._read().rows
