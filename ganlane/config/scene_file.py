"""``env=scene``: episodes that start in a scene of one's own, from a file."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ganlane.config.scene import SceneEnvConfig, SceneOptions
from ganlane.errors import UserError
from ganlane.parameters.checks import at_least, between, check, optional, text
from ganlane.parameters.records import assign

if TYPE_CHECKING:
    from ganlane.sim.scenes import FixedScene, SceneVehicle


@dataclass
class FileSceneOptions(SceneOptions):
    """``env.scene`` of ``env=scene``: the file."""

    path: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self, path=optional(text()))


@dataclass(frozen=True)
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
        check(self, lanes=between(0, 20), **numbers)
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
