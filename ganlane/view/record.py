"""Episodes recorded at every physics step, as plain arrays, while they run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ganlane import keys
from ganlane.agents.drivers import GreedyPolicy
from ganlane.errors import UserError
from ganlane.evaluation.episodes import start_of
from ganlane.settings.road import Stretches
from ganlane.sim.collisions import pair_overlaps
from ganlane.sim.lane_ends import stretches_of_row
from ganlane.sim.state import Road, Vehicles, road_in

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

#: A vehicle that moves further than this in a physics step was recycled (placed elsewhere), m.
JUMP_M = 30.0


@dataclass(frozen=True)
class EpisodeLabel:
    """Agent, traffic, road and numbers of an episode."""

    agent: str = "ego"
    traffic: str = "traffic"
    seed: int = 0
    episode: int = 0
    #: Number of lanes; lane 0 is the rightmost.
    lanes: int = 3
    lane_width_m: float = 4.0
    #: Where each lane begins and ends; empty: all go on for ever.
    stretches: Stretches = ()

    @classmethod
    def of(
        cls, state: TensorDictBase, road: Road, agent: str, traffic: str, row: int = 0
    ) -> EpisodeLabel:
        """Of a row of ``state``: on its replayed scene if it has one, else on ``road``."""
        scene = road_in(state, road)

        def of_row(size: Tensor | float) -> Tensor:
            """One number for all rows, or [N, 1]: the row's."""
            return torch.as_tensor(size).flatten().expand(state.batch_size)[row]

        lanes = int(of_row(scene.lanes))
        stretches = scene.stretches
        if scene.row_stretches is not None:
            # The widest scene decides how many there are; this one may have fewer.
            stretches = stretches_of_row(scene.row_stretches, row)[:lanes]
        return cls(
            agent,
            traffic,
            int(state[keys.SEED][row]),
            int(state[keys.EPISODE][row]),
            lanes,
            float(of_row(scene.lane_width_m)),
            stretches,
        )


@dataclass(frozen=True)
class Trajectory:
    """T frames of M vehicles, a physics step (0.1 s) apart; the ego has index 0.

    Frame 0 is the state after the reset. SI units: positions of the bodies' centres in m, ``x``
    along the road, ``y`` to the left; ``heading`` in rad, anticlockwise.
    """

    label: EpisodeLabel
    #: Time since the reset, s, [T].
    time_s: FloatArray
    #: Fields of ``vehicles`` (:mod:`ganlane.keys`), each [T, M].
    x: FloatArray
    y: FloatArray
    heading: FloatArray
    speed: FloatArray
    acceleration: FloatArray
    length: FloatArray
    width: FloatArray
    target_lane: IntArray
    valid: BoolArray
    #: Action of the decision that a frame belongs to, [T]; -1 before the first decision.
    action: IntArray
    #: Return up to the decision before, [T]; the last frame has the whole return.
    returns: FloatArray
    #: Action values of the policy, [T, A]; NaN before the first decision and where unknown.
    action_values: FloatArray
    #: Reward of the decision that a frame belongs to, [T]; NaN before the first and where unknown.
    reward: FloatArray
    #: Ends of the decisions with a soft crash, s.
    soft_crash_s: FloatArray
    #: End event, one of :data:`ganlane.keys.END_EVENTS`; empty where the episode was cut off.
    outcome: str = ""

    def __len__(self) -> int:
        return len(self.time_s)

    def lane(self) -> IntArray:
        """Lane whose centre is nearest, [T, M]."""
        nearest = np.rint(self.y / self.label.lane_width_m).astype(np.int64)
        return nearest.clip(0, self.label.lanes - 1)

    def jumped(self) -> BoolArray:
        """Whether a vehicle was recycled (placed elsewhere) since the frame before, [T, M]."""
        return np.abs(np.diff(self.x, axis=0, prepend=self.x[:1])) > JUMP_M

    def overlapping(self) -> BoolArray:
        """Whether a vehicle's box overlaps another's, [T, M]."""
        # The frames as if they were T environments; fields that are not recorded do not matter.
        fields: dict[str, Any] = dict.fromkeys(keys.VEHICLE_FIELDS, torch.zeros(self.x.shape))
        for name in _FIELDS:
            fields[name] = torch.as_tensor(getattr(self, name))
        return pair_overlaps(Vehicles(**fields)).any(-1).numpy()

    def since(self, start_s: float) -> Trajectory:
        """The frames from ``start_s`` on.

        Raises:
            UserError: the episode is over by then.
        """
        first = int(np.searchsorted(self.time_s, start_s - 1e-9))
        if first == len(self):
            raise UserError(
                f"start at {start_s:g} s: the episode lasts {self.time_s[-1]:g} s; choose a part "
                "of it."
            )
        later: dict[str, Any] = {}
        for name, value in vars(self).items():
            # All other fields have one value per frame.
            if name not in ("label", "outcome", "soft_crash_s"):
                later[name] = value[first:]
        return replace(self, **later)


#: Fields of ``vehicles`` that a trajectory keeps.
_FIELDS = tuple(name for name in keys.VEHICLE_FIELDS if name in Trajectory.__annotations__)


@dataclass
class Recorder:
    """Collects frames of one row; the environment calls it after each physics step."""

    #: Index of the row.
    row: int = 0
    #: What a trajectory keeps of a frame, by its name there.
    frames: list[dict[str, Any]] = field(default_factory=list)
    #: Ends of the decisions with a soft crash, s.
    soft_crash_s: list[float] = field(default_factory=list)
    #: Action of the decision under way; -1 before the first one.
    current_action: int = -1
    #: Return up to the decision before.
    current_return: float = 0.0
    #: Action values of the decision under way, [A]; NaN where unknown.
    current_values: FloatArray = field(default_factory=lambda: np.full(keys.ACTIONS, np.nan))

    @property
    def time_s(self) -> float:
        """Time of the last frame, s."""
        return self.frames[-1]["time_s"]

    def __call__(self, vehicles: Vehicles, running: Tensor) -> None:
        """Hook of the environment.

        Vehicles [N, M] after a physics step, ``running`` [N] the rows that took it.
        """
        if bool(running[self.row]):
            self.add(vehicles.as_dict(), self.time_s + keys.PHYSICS_STEP_S)

    def add(self, vehicles: Mapping[str, Tensor] | TensorDictBase, time_s: float) -> None:
        """Append a frame: the row's of ``vehicles`` [N, M], ``time_s`` after the reset."""
        frame: dict[str, Any] = {
            "time_s": time_s,
            "action": self.current_action,
            "returns": self.current_return,
            "action_values": self.current_values,
            "reward": np.nan,  # known after the decision
        }
        for name in _FIELDS:
            column = vehicles[name][self.row].detach().cpu().numpy()
            dtype = np.float64 if column.dtype.kind == "f" else column.dtype
            # A copy, since the environment may write into its own.
            frame[name] = column.astype(dtype)
        self.frames.append(frame)

    def trajectory(self, label: EpisodeLabel, outcome: str = "") -> Trajectory:
        """The frames so far; the last one shows the return after the last decision."""
        arrays: dict[str, Any] = {}
        for name in self.frames[0]:
            arrays[name] = np.stack([frame[name] for frame in self.frames])
        # Sums of 0.1 s are off by rounding.
        arrays["time_s"] = arrays["time_s"].round(6)
        arrays["returns"][-1] = self.current_return
        soft_crash_s = np.array(self.soft_crash_s)
        return Trajectory(label, outcome=outcome, soft_crash_s=soft_crash_s, **arrays)


def outcome_of(state: TensorDictBase) -> str:
    """The event that ended the episode of the first row; empty where none did."""
    events = state[keys.EVENTS]
    for name in keys.END_EVENTS:
        if bool(events[name][0]):
            return name
    return ""


def record_episode(
    env: EnvBase,
    policy: TensorDictModuleBase,
    seed: int,
    episode: int,
    agent: str = "ego",
    traffic: str = "traffic",
    max_time_s: float | None = None,
) -> Trajectory:
    """Drive one episode to its end and record it at every physics step.

    The environment's own recorder, if it has one, rests meanwhile.

    Args:
        env: batched environment; all rows run the episode, row 0 is recorded. One row is enough.
        policy: writes ``action``; acts deterministically.
        seed, episode: the episode's numbers.
        agent, traffic: names for the label.
        max_time_s: stop after this much simulated time; the outcome is then empty.

    Raises:
        UserError: the environment, below its transforms, is no ``HighwayEnv``.
    """
    # Transforms wrap the environment; the recorder hooks into the innermost one.
    base: Any = env
    while hasattr(base, "base_env"):
        base = base.base_env
    if not hasattr(base, "recorder"):
        raise UserError(
            f"env={type(base).__name__}: it cannot be recorded; expected a HighwayEnv of this "
            "process."
        )

    recorder = Recorder()
    # Times are sums of 0.1 s, a little off by rounding.
    end_s = np.inf if max_time_s is None else max_time_s - 1e-6
    # The environment may have one already, which is put back.
    before = base.recorder
    base.recorder = recorder
    try:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            state = env.reset(start_of(env, [episode], seed))
            label = EpisodeLabel.of(state, base.road, agent, traffic)
            # The state after the reset, to which no decision has led.
            recorder.add(state[keys.VEHICLES], 0.0)
            while not state["done"][0] and recorder.time_s < end_s:
                state = _decide(env, policy, state, recorder)
    finally:
        base.recorder = before
    return recorder.trajectory(label, outcome_of(state))


def _decide(
    env: EnvBase, policy: TensorDictModuleBase, state: TensorDictBase, recorder: Recorder
) -> TensorDictBase:
    """One decision of ``policy`` in ``state``, noted by the recorder; the state after it."""
    # What the recorder notes in the frames of this decision.
    state = policy(state)
    action = state[keys.ACTION][0]
    # Acceleration and line have no number; pictures then name no action.
    recorder.current_action = int(action) if action.ndim == 0 else -1
    if isinstance(policy, GreedyPolicy):
        values = policy.network.values(state[keys.OBSERVATION])
        recorder.current_values = values[0].double().cpu().numpy()

    # The environment calls the recorder after each of its physics steps.
    first = len(recorder.frames)
    stepped = env.step(state)
    after = stepped["next"]

    # Only now the reward is known.
    reward = float(after[keys.REWARD][0])
    for frame in recorder.frames[first:]:
        frame["reward"] = reward
    recorder.current_return += reward
    if int(after[keys.EVENTS, keys.SOFT_CRASH][0]) > 0:
        recorder.soft_crash_s.append(recorder.time_s)
    return env.step_mdp(stepped)
