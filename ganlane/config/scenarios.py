"""The scenarios that ship, ``env=cut_in, stalled_car, blocked_lane, stop_and_go``: their numbers and ranges.

The scenes themselves are made in :mod:`ganlane.sim.scenarios`; what they share stands in
:mod:`~ganlane.config.scene`, a scene of one's own in :mod:`~ganlane.config.scene_file`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ganlane.config.scene import SceneEnvConfig, SceneOptions
from ganlane.config.scene_file import FileSceneEnvConfig, FileSceneOptions
from ganlane.parameters.checks import above, between, check

if TYPE_CHECKING:
    from ganlane.sim.scenes import SceneVehicle

__all__ = [
    "BlockedLaneEnvConfig",
    "BlockedLaneOptions",
    "CutInEnvConfig",
    "CutInOptions",
    "FileSceneEnvConfig",
    "FileSceneOptions",
    "StalledCarEnvConfig",
    "StalledCarOptions",
    "StopAndGoEnvConfig",
    "StopAndGoOptions",
]


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
        check(self, gap_m=above(0), speed_mps=above(0), cutter_speed_mps=above(0))


@dataclass(frozen=True)
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
        check(self, distance_m=above(0), speed_mps=above(0), spacing_m=above(0))


@dataclass(frozen=True)
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
        check(self, standing=between(1, 100), **positive)


@dataclass(frozen=True)
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
        check(self, waves=between(1, 50), per_wave=between(2, 50), speed_mps=above(0))


@dataclass(frozen=True)
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
            idm=self.idm,
        )
