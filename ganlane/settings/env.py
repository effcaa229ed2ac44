"""``env=...``: road, vehicles, initial scenes, and the end of an episode; m, s, m/s.

``env=highway`` and ``env=dense`` start with random scenes (Table II). ``env=cut_in, stalled_car,
blocked_lane, stop_and_go, merge, on_ramp, lane_drop, weave, exit`` start with a scene made by
:mod:`ganlane.sim.scenarios`, ``env=scene`` with one from a file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from ganlane.arguments import call_with
from ganlane.errors import ParameterError, as_typed
from ganlane.settings.actions import ActionParameters
from ganlane.settings.driving import EgoParameters, IdmParameters, MobilParameters, Visibility
from ganlane.settings.episode import KERNELS, EpisodeParameters, SpawnParameters
from ganlane.settings.observation import RewardParameters
from ganlane.settings.record import (
    NotNegative,
    Positive,
    Record,
    Rule,
    Share,
    Text,
    assign,
    below,
    between,
    key_names,
    one_of,
    part_of,
)
from ganlane.settings.road import EXIT, WALL, FlowParameters, LaneStretch, Stretches, with_side_lane

if TYPE_CHECKING:
    from ganlane.sim.scenes import FixedScene, SceneVehicle
    from ganlane.sim.state import Road

# 0 waits for the number of vehicles in the scene.
_VEHICLES_OR_SCENE = Rule(lambda count: count == 0 or 2 <= count <= 1000, "a number from 2 to 1000")


@dataclass(frozen=True)
class SceneConfig(Record):
    """``env.scene``: a first scene set by hand.

    Attributes:
        kind: which one: a function of :mod:`ganlane.sim.scenarios`, or file.
        jitter_m: positions vary by up to so much to either side from episode to episode, m.
        jitter_mps: and speeds, m/s; standing vehicles remain standing.
    """

    chosen_by = alone = "kind"

    kind: str
    jitter_m: NotNegative = 0.5
    jitter_mps: NotNegative = 0.5

    def vehicles(self, env: EnvConfig) -> tuple[SceneVehicle, ...]:
        """The vehicles, the ego first."""
        # The scene's function takes what its signature names: of the road, and of its record.
        from ganlane.sim import scenarios

        offered = {
            "lanes": env.lanes,
            "desired_speed_mps": env.ego_desired_speed_mps,
            "lane_width_m": env.lane_width_m,
            "idm": env.idm,
            **vars(self),
        }
        return call_with(getattr(scenarios, self.kind), offered, {}, self.label())

    def stretches(self, lanes: int) -> Stretches:
        """Where each of the ``lanes`` begins and ends; empty: all go on for ever."""
        return ()

    def label(self) -> str:
        """The scene, for messages."""
        return f"env={self.kind}"


@dataclass(frozen=True)
class CutInScene(SceneConfig):
    """A slower vehicle changes into the ego's lane, close ahead, at the first moment.

    Attributes:
        gap_m: from the ego's bumper to the other's when it cuts in, m.
        speed_mps: of the ego and the others, m/s.
        cutter_speed_mps: of the vehicle that cuts in, and its desired speed, m/s.
    """

    kind: str = "cut_in"
    jitter_m: NotNegative = 1.0
    gap_m: Positive = 20.0
    speed_mps: Positive = 20.0
    cutter_speed_mps: Positive = 17.0


@dataclass(frozen=True)
class StalledCarScene(SceneConfig):
    """A broken-down vehicle ahead in the ego's lane, the rightmost; traffic in the next lane.

    Attributes:
        distance_m: from the ego's centre to the stalled car's, m.
        speed_mps: of the ego and the others, m/s.
        spacing_m: centre to centre, of those in the next lane, m.
    """

    kind: str = "stalled_car"
    jitter_m: NotNegative = 1.0
    distance_m: Positive = 200.0
    speed_mps: Positive = 20.0
    spacing_m: Positive = 120.0


@dataclass(frozen=True)
class BlockedLaneScene(SceneConfig):
    """The ego's lane, the rightmost, is closed by standing vehicles; traffic passes in the others.

    Attributes:
        distance_m: from the ego's centre to the first standing vehicle's, m.
        standing: vehicles that close the lane, 1 to 100.
        speed_mps: of the ego and the others, m/s.
        spacing_m: centre to centre, of those in the other lanes, m; from 100 on MOBIL finds a gap.
    """

    kind: str = "blocked_lane"
    distance_m: Positive = 250.0
    standing: Annotated[int, between(1, 100)] = 3
    speed_mps: Positive = 15.0
    spacing_m: Positive = 60.0


@dataclass(frozen=True)
class StopAndGoScene(SceneConfig):
    """Columns in which queues stand and groups flow.

    Attributes:
        waves: queues in a lane, 1 to 50.
        per_wave: vehicles in a queue, and in the group behind it, 2 to 50.
        speed_mps: of those that flow, m/s.
    """

    kind: str = "stop_and_go"
    waves: Annotated[int, between(1, 50)] = 2
    per_wave: Annotated[int, between(2, 50)] = 5
    speed_mps: Positive = 10.0


@dataclass(frozen=True)
class MergeScene(SceneConfig):
    """The ego comes from an on-ramp, the rightmost lane, which ends; traffic in the other lanes.

    Attributes:
        ramp_m: from the ego to where the ramp becomes an acceleration lane, m.
        merge_m: length of the acceleration lane, which ends at a wall, m; 250 m in the German
            guidelines for motorways (RAA 2008).
        ego_speed_mps: of the ego, m/s.
        speed_mps: of the others, m/s.
        spacing_m: centre to centre, of those in one lane, m.
    """

    kind: str = "merge"
    jitter_m: NotNegative = 14.0
    jitter_mps: NotNegative = 2.0
    ramp_m: Positive = 100.0
    merge_m: Positive = 250.0
    ego_speed_mps: Positive = 18.0
    speed_mps: Positive = 20.0
    spacing_m: Positive = 50.0

    def stretches(self, lanes: int) -> Stretches:
        """The rightmost lane ends, the others go on."""
        return with_side_lane(lanes, self.ramp_m, self.merge_m, WALL)


@dataclass(frozen=True)
class LaneDropScene(SceneConfig):
    """The ego's lane, the leftmost, ends for all; traffic in every lane.

    Attributes:
        drop_m: from the ego's centre to the wall at the end of its lane, m.
        speed_mps: of the ego and the others, m/s.
        spacing_m: centre to centre, of those in one lane, m.
    """

    kind: str = "lane_drop"
    jitter_m: NotNegative = 14.0
    jitter_mps: NotNegative = 2.0
    drop_m: Positive = 500.0
    speed_mps: Positive = 20.0
    spacing_m: Positive = 60.0

    def stretches(self, lanes: int) -> Stretches:
        """The leftmost lane ends, the others go on."""
        return (*[LaneStretch()] * (lanes - 1), LaneStretch(end_m=self.drop_m, end=WALL))


@dataclass(frozen=True)
class ExitScene(SceneConfig):
    """The ego, in the leftmost lane, has to leave by the exit lane on the right.

    Attributes:
        distance_m: from the ego's centre to where the exit lane begins, m.
        exit_m: length of the exit lane, at whose end the ego has left the road or missed the exit,
            m; 250 m in the German guidelines for motorways (RAA 2008).
        speed_mps: of the vehicles in the lane beside the exit lane, m/s.
        faster_mps: how much faster each further lane to the left is, m/s.
        spacing_m: centre to centre, of those in one lane, m.
    """

    kind: str = "exit"
    jitter_m: NotNegative = 25.0
    jitter_mps: NotNegative = 2.0
    distance_m: Positive = 1000.0
    exit_m: Positive = 250.0
    speed_mps: Positive = 18.0
    faster_mps: NotNegative = 3.0
    spacing_m: Positive = 80.0

    def stretches(self, lanes: int) -> Stretches:
        """The rightmost lane is there for a while, the others go on."""
        return with_side_lane(lanes, self.distance_m, self.exit_m, EXIT)


@dataclass(frozen=True)
class OnRampScene(SceneConfig):
    """Others come from an on-ramp, the rightmost lane, and merge in front of the ego beside it.

    Attributes:
        ramp_m: from the ego to where the ramp becomes an acceleration lane, m.
        merge_m: length of the acceleration lane, m; as of ``merge``.
        exit: whether that lane becomes the one of an exit, by which the ego has to leave the road
            (env=weave); else it ends at a wall.
        ramp_speed_mps: of the vehicles on the ramp, m/s.
        ramp_spacing_m: centre to centre, of those on the ramp, m.
        speed_mps: of the ego and the others on the road, m/s.
        spacing_m: centre to centre, of those in one lane of the road, m.
    """

    kind: str = "on_ramp"
    jitter_m: NotNegative = 14.0
    jitter_mps: NotNegative = 2.0
    ramp_m: Positive = 150.0
    merge_m: Positive = 250.0
    exit: bool = False
    ramp_speed_mps: Positive = 18.0
    ramp_spacing_m: Positive = 50.0
    speed_mps: Positive = 20.0
    spacing_m: Positive = 60.0

    def stretches(self, lanes: int) -> Stretches:
        """The rightmost lane ends, the others go on."""
        return with_side_lane(lanes, self.ramp_m, self.merge_m, EXIT if self.exit else WALL)


@dataclass(frozen=True)
class FileScene(SceneConfig):
    """A scene of your own.

    Attributes:
        path: the file; its first vehicle is the ego.
    """

    kind: str = "file"
    jitter_m: NotNegative = 0.0
    jitter_mps: NotNegative = 0.0
    path: Text | None = None

    def read(self, env: EnvConfig) -> FixedScene:
        """The file's vehicles and road; the numbers of ``env`` replace the road's unless 0."""
        from ganlane.sim.scene_files import read_scene, with_ego_speed

        if self.path is None:
            raise ParameterError(
                "{scene.path}: no file; give one, env=scene {scene.path}=my_scene.csv."
            )
        # 0 is no possible value, so it can say: as in the file.
        scene = read_scene(self.path, env.lanes or None, env.lane_width_m or None)
        speed = env.ego_desired_speed_mps
        return with_ego_speed(scene, speed) if speed else scene

    def vehicles(self, env: EnvConfig) -> tuple[SceneVehicle, ...]:
        """Those of the file."""
        return self.read(env).rows

    def stretches(self, lanes: int) -> Stretches:
        """Those of the file."""
        from ganlane.sim.scene_files import read_scene

        return () if self.path is None else read_scene(self.path).road.stretches

    def label(self) -> str:
        """The file."""
        return str(self.path)


@dataclass(frozen=True)
class EnvConfig(SpawnParameters, EpisodeParameters):
    """The paper's highway (section IV, Tables II, IV and V).

    Attributes:
        vehicles: M, the ego included, 2 (Table III has no entry for fewer) to 1000; 0: as many as
            the scene has.
        lanes: 1 to 20; 0: as the scene's file says (JSON), or just enough for its vehicles.
        lane_width_m: above the vehicles' width; the paper gives none. In narrower lanes noise alone
            makes cars of 2.5 m touch. 0: as the scene's file says, or 4 m.
        ego_desired_speed_mps: of the ego; 0: as the scene's file says.
        metres_per_vehicle: spread_m is at least this times vehicles, m (env=dense); null: no bound.
        recycle: true: vehicles that the ego leaves 200 m behind return ahead of it, and the
            reverse.
        recycle_share: share of the episodes in which they do, 0 to 1.
        kernel: what drives a decision: the tensor code (torch), the native kernel (native), which
            does the same up to rounding on a CPU (not for recordings, foreign simulators and
            traffic of your own), or the kernel where it can (auto).
        scene: the first scene, set by hand; null: Table II.
        flow: who enters the road and leaves it; by default nobody does.
        actions: what the ego's driver commands: lane (the paper's), lane_speed or continuous.
        ego: how the ego drives.
        idm: how all follow, Table V.
        mobil: how the others change lanes, Table IV.
    """

    group = "env"

    # the road and who is on it
    vehicles: Annotated[int, _VEHICLES_OR_SCENE] = 9
    lanes: Annotated[int, between(0, 20)] = 3
    lane_width_m: NotNegative = 4.0
    ego_desired_speed_mps: NotNegative = 25.0
    metres_per_vehicle: Positive | None = None
    # whether the road empties behind the ego
    recycle: bool = False
    recycle_share: Share = 1.0
    # how a decision is computed; the course of an episode is the same
    kernel: Annotated[str, one_of(KERNELS)] = "auto"
    # what stands at the start, and how everybody drives
    scene: SceneConfig | None = None
    flow: FlowParameters = FlowParameters()
    actions: ActionParameters = ActionParameters()
    ego: EgoParameters = EgoParameters()
    idm: IdmParameters = IdmParameters()
    mobil: MobilParameters = MobilParameters()

    def __post_init__(self) -> None:
        super().__post_init__()
        # Idempotent, so that a saved run is made again with the same spread.
        if self.metres_per_vehicle is not None:
            assign(self, spread_m=max(self.spread_m, self.metres_per_vehicle * self.vehicles))
        if isinstance(self.scene, FileScene):
            scene = self.scene.read(self)
            assign(
                self,
                lanes=int(scene.road.lanes),
                lane_width_m=float(scene.road.lane_width_m),
                ego_desired_speed_mps=scene.rows[0].desired_speed_mps,
            )
        # A file has given what was 0; the number of vehicles may still wait for its scene.
        for name in ("vehicles", "lanes", "ego_desired_speed_mps"):
            if getattr(self, name) == 0 and (self.scene is None or name != "vehicles"):
                raise ParameterError(
                    f"{{{name}}}=0: expected a number above 0; 0 means what a scene's file says."
                )
        # A lorry's width counts only where there may be lorries.
        for name in ("width_m", "truck_width_m") if self.truck_share > 0 else ("width_m",):
            if self.lane_width_m <= getattr(self, name):
                raise ParameterError(
                    f"{{lane_width_m}}={self.lane_width_m:g}: expected more than {{{name}}}="
                    f"{getattr(self, name):g}, or vehicles in neighbouring lanes touch; widen the "
                    "lanes."
                )
        # An episode that ends before its first decision would have no action and no reward.
        if self.timeout_s < self.decision_period_s:
            raise ParameterError(
                f"{{timeout_s}}={self.timeout_s:g}: expected at least {{decision_period_s}}="
                f"{self.decision_period_s:g}, or every episode ends in its first step."
            )
        self._check_flow()
        self._check_start()

    def _check_flow(self) -> None:
        if not self.flow.is_on:
            return
        if not self.stretches():
            raise ParameterError(
                "{flow}: vehicles enter and leave on roads whose lanes end; take env=merge, "
                "on_ramp, weave, lane_drop or exit."
            )
        if self.recycle:
            raise ParameterError(
                "{recycle}=true: with a flow of vehicles nobody returns; leave it off."
            )
        with below("flow"):
            self.flow.check(self.stretches(), self.decision_period_s)

    def _check_start(self) -> None:
        """Refuse first scenes that do not fit on the road, or make a crash unavoidable."""
        if self.scene is not None:
            self._check_scene()
            return
        # The check imports torch. The defaults are valid, so a mistake elsewhere is reported
        # without it.
        start = (self.spawn_parameters(), self.vehicles, self.lanes, self.idm)
        if start == (SpawnParameters(), EnvConfig.vehicles, EnvConfig.lanes, IdmParameters()):
            return
        from ganlane.sim.spawn import check_start

        check_start(*start)

    def _check_scene(self) -> None:
        # Table II draws scenes at random; on one set by hand its keys would do nothing.
        for name in key_names(SpawnParameters):
            value = getattr(self, name)
            if name != "ego_desired_speed_mps" and value != getattr(SpawnParameters, name):
                raise ParameterError(
                    f"{{{name}}}={as_typed(value)}: has no effect on a scene set by hand; leave it "
                    "out, or take env=highway."
                )
        scene = self.scenes()
        # For type checkers: without a scene this check is not called.
        assert scene is not None
        if self.vehicles not in (0, scene.vehicles):
            raise ParameterError(
                f"{{vehicles}}={self.vehicles}: the scene has {scene.vehicles}, the ego included; "
                "leave this key out."
            )
        # From here on the number is known, also where it was 0.
        assign(self, vehicles=scene.vehicles)
        scene.check(scene.road, self.idm)

    def scenes(self, others_visibility: int | None = None) -> FixedScene | None:
        """Initial scenes of episodes; None: Table II. ``others_visibility`` is the traffic's."""
        if self.scene is None:
            return None
        # Imported here, since it imports torch, which takes seconds.
        from ganlane.sim.scenes import FixedScene, with_waiting

        if others_visibility is None:
            others_visibility = Visibility.SIGNALLED
        road = self.road()
        return FixedScene(
            with_waiting(self.scene.vehicles(self), road),
            road,
            jitter_m=self.scene.jitter_m,
            jitter_mps=self.scene.jitter_mps,
            ego_visibility=Visibility.named(self.ego.visibility),
            others_visibility=others_visibility,
            name=self.scene.label(),
            waiting=0 if road.flow is None else road.flow.slots,
        )

    def road(self) -> Road:
        """The road, and who enters and leaves it."""
        from ganlane.sim.state import Road  # with torch, which takes seconds

        flow = self.flow if self.flow.is_on else None
        return Road(self.lanes, self.lane_width_m, stretches=self.stretches(), flow=flow)

    def stretches(self) -> Stretches:
        """Where each lane begins and ends; empty: all go on for ever."""
        return () if self.scene is None else self.scene.stretches(self.lanes)

    def spawn_parameters(self) -> SpawnParameters:
        """The parameters of Table II."""
        return part_of(self, SpawnParameters)

    def episode_parameters(self) -> EpisodeParameters:
        """Decision period, goal and time-out."""
        return part_of(self, EpisodeParameters)


def check_reward(env: EnvConfig, reward: RewardParameters) -> None:
    """Refuse a desired speed of the ego, where the speed reward is 1, not above its base speed."""
    if env.ego_desired_speed_mps <= reward.base_speed_mps:
        raise ParameterError(
            f"{{env.ego_desired_speed_mps}}={env.ego_desired_speed_mps:g}: expected more than "
            f"{{reward.base_speed_mps}}={reward.base_speed_mps:g}, where the speed reward is 0; "
            "raise the one or lower the other."
        )
