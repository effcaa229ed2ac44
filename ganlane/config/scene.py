"""What environments have in common whose episodes start in a scene that somebody set (``env=cut_in`` and so on)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

from ganlane.config.env import EnvConfig
from ganlane.errors import UserError, as_typed
from ganlane.parameters.checks import above, at_least, between, check
from ganlane.parameters.driving import Visibility
from ganlane.parameters.records import assign, lists_to_tuples

if TYPE_CHECKING:
    from ganlane.sim.scenes import FixedScene, SceneVehicle
    from ganlane.sim.state import Road

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
    "truck_share",
    "truck_length_m",
    "truck_width_m",
    "truck_desired_speed_mps",
)


@dataclass
class SceneOptions:
    """``env.scene``: how much the scene varies from episode to episode, m and m/s to either side."""

    jitter_m: float = 0.0
    jitter_mps: float = 0.0

    def __post_init__(self) -> None:
        check(self, jitter_m=at_least(0), jitter_mps=at_least(0))


@dataclass(frozen=True)
class SceneEnvConfig(EnvConfig):
    """What all scenes have in common. ``vehicles`` follows from the scene; 0 says so."""

    vehicles: int = 0
    scene: SceneOptions = field(default_factory=SceneOptions)

    def __post_init__(self) -> None:
        lists_to_tuples(self)
        self._refuse_table_ii()
        check(self, lane_width_m=above(0), lanes=between(1, 20), ego_desired_speed_mps=above(0))
        self._count_vehicles()
        super().__post_init__()

    def _refuse_table_ii(self) -> None:
        """A key that would be silently without effect is a mistake."""
        default = EnvConfig()
        for name in TABLE_II_KEYS:
            if getattr(self, name) != getattr(default, name):
                raise UserError(
                    f"env.{name}={as_typed(getattr(self, name))}: has no effect on a scene set by hand; "
                    "leave it out, or take env=highway."
                )

    def _count_vehicles(self) -> None:
        there = self.fixed_scene().vehicles
        if self.vehicles not in (0, there):
            raise UserError(
                f"env.vehicles={self.vehicles}: the scene has {there}, the ego included; leave this key out."
            )
        assign(self, vehicles=there)

    def _check_start(self) -> None:
        self.fixed_scene().check(self._road(), self.idm)

    def scenes(self, others_visibility: int | None = None) -> FixedScene:
        """The scene as the environment takes it, see :meth:`EnvConfig.scenes`."""
        return self.fixed_scene(others_visibility)

    def fixed_scene(self, others_visibility: int | None = None) -> FixedScene:
        """The scene; ``others_visibility`` is the traffic's."""
        from ganlane.sim.scenes import FixedScene

        return FixedScene(self.rows(), self._road(), name=self.name(), **self._scene_options(others_visibility))

    def _scene_options(self, others_visibility: int | None) -> dict[str, Any]:
        return {
            "jitter_m": self.scene.jitter_m,
            "jitter_mps": self.scene.jitter_mps,
            "ego_visibility": Visibility.named(self.ego.visibility),
            "others_visibility": Visibility.SIGNALLED if others_visibility is None else others_visibility,
        }

    def _road(self) -> Road:
        from ganlane.sim.state import Road

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
