"""Who drives the ego, as TensorDictModules that write ``action``.

A Q-network's best action with and without exploration, any driver behind a mask, and drivers that
need no learning: random, random but legal, keeping the lane, MOBIL.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from ganlane import keys
from ganlane.agents.network import QNetwork, allowed_values, redraw_noise
from ganlane.errors import UserError
from ganlane.keys import EGO_INDEX, LEFT, RIGHT
from ganlane.settings.actions import LANE_SPEED, ActionParameters
from ganlane.settings.driving import IdmParameters, MobilParameters
from ganlane.sim.dynamics import SIDES, ego_scene, stays_on_road
from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import TABLE_IV, mobil_wishes
from ganlane.sim.random import Purpose, Stream, episode_key, uniform
from ganlane.sim.state import Road, Vehicles, road_in
from ganlane.torch_settings import constant
from ganlane.traffic.idm_mobil import MOBIL_PERIOD_STEPS
from ganlane.transforms.mask import allowed_speeds

#: Gives the legal actions, [N, A] bool, of what the environment wrote.
LegalActions = Callable[[TensorDictBase], Tensor]


class ObservationPolicy(TensorDictModuleBase):
    """Base of policies that write ``action`` [N] for ``observation`` [N, D] through :meth:`act`."""

    in_keys = [keys.OBSERVATION]  # noqa: RUF012
    out_keys = [keys.ACTION]  # noqa: RUF012
    #: Nothing is held per row, so an evaluation may move running episodes to other rows.
    rows_must_stay = False

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """The action of every row."""
        raise NotImplementedError

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        return tensordict.set(keys.ACTION, self.act(tensordict))


class GreedyPolicy(ObservationPolicy):
    """Writes the best ``action`` [N] int64 for ``observation`` [N, D].

    There is never any noise, whatever the context says. Where the environment writes
    ``action_mask`` [N, A], it is the best of the allowed actions.

    Args:
        network: whose action values decide.
    """

    def __init__(self, network: QNetwork) -> None:
        super().__init__()
        self.network = network

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """The best action of every row."""
        # Without the noise of the layers: the same observation always gives the same action.
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            values = self.network.values(tensordict.get(keys.OBSERVATION))
        mask = tensordict.get(keys.ACTION_MASK, None)
        return allowed_values(values, mask).argmax(-1)


class ExploringPolicy(TensorDictModuleBase):
    """The policy that collects: network noise, new at every step, and random legal actions.

    It explores unless ``set_exploration_type`` says DETERMINISTIC, MODE or MEAN: outside any
    context, where TorchRL's noisy layers are silent, collecting would else be greedy by accident.
    Where the environment writes ``action_mask``, all actions are among the allowed ones, and
    ``legal`` is not asked.

    Args:
        network: its noise is redrawn in place, in one draw for all environments of the batch.
        generator: of the noise and of the random actions.
        legal: which actions may be drawn at random; all, if None.
    """

    in_keys = [keys.OBSERVATION]  # noqa: RUF012
    out_keys = [keys.ACTION, keys.CHOSEN_VALUE]  # noqa: RUF012

    def __init__(
        self, network: QNetwork, generator: torch.Generator, legal: LegalActions | None = None
    ) -> None:
        super().__init__()
        self.network = network
        self.generator = generator
        self.legal = legal
        #: Probability of a random action; the agent anneals it.
        self.epsilon = 0.0

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` and ``chosen_action_value``."""
        # None outside of any context.
        explore = exploration_type() in (None, ExplorationType.RANDOM)
        if explore:
            redraw_noise(self.network, self.generator)
        noise = ExplorationType.RANDOM if explore else ExplorationType.DETERMINISTIC
        with set_exploration_type(noise):
            values = self.network.values(tensordict.get(keys.OBSERVATION))

        mask = tensordict.get(keys.ACTION_MASK, None)
        action = allowed_values(values, mask).argmax(-1)
        if explore and self.epsilon > 0.0:
            # Without a mask, too, random actions stay on the road where legal says how.
            if mask is None:
                mask = torch.ones_like(values) if self.legal is None else self.legal(tensordict)
            action = self._with_random(action, mask)

        # For the statistics: what the policy expects of its choice.
        chosen_value = values.gather(-1, action[..., None])
        tensordict.set(keys.ACTION, action)
        return tensordict.set(keys.CHOSEN_VALUE, chosen_value)

    def _with_random(self, action: Tensor, allowed: Tensor) -> Tensor:
        """``action`` [N], of which a share epsilon becomes an ``allowed`` [N, A] one, drawn
        uniformly.
        """
        draw: dict[str, Any] = {"generator": self.generator, "device": self.generator.device}
        # The place of the largest of uniform numbers, 0 where not allowed, is a uniform draw.
        lottery = torch.rand(allowed.shape, **draw) * allowed
        is_random = torch.rand(action.shape, **draw) < self.epsilon
        return torch.where(is_random, lottery.argmax(-1), action)


class FunctionPolicy(ObservationPolicy):
    """A plain function of observations as a policy, for ``ganlane benchmark`` and others.

    Args:
        function: takes observations, a NumPy array [N, D] float32, and returns [N] actions (0 keep,
            1 left, 2 right) as an array or a list. It may not remember anything of a row: episodes
            change their rows.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__()
        self.function = function

    def act(self, tensordict: TensorDictBase) -> Tensor:
        """What the function returns."""
        observation = tensordict.get(keys.OBSERVATION)
        returned = self.function(observation.cpu().numpy())
        action = torch.as_tensor(returned)
        if action.shape != observation.shape[:1] or action.is_floating_point():
            name = getattr(self.function, "__name__", "the function")
            raise UserError(
                f"{name}: returned {action.dtype} {list(action.shape)} for observations "
                f"{list(observation.shape)}; return a whole number 0, 1 or 2 for each row."
            )
        return action.long().to(observation.device)


class MaskedPolicy(TensorDictModuleBase):
    """Any policy behind the environment's ``action_mask``: what it forbids becomes 'keep the lane'.

    Agents of this package choose among the allowed actions themselves; it does not change them.

    Raises:
        UserError: the environment has no mask.
    """

    def __init__(self, policy: TensorDictModuleBase) -> None:
        super().__init__()
        self.policy = policy
        # Unless a policy says otherwise, it may hold something per row.
        self.rows_must_stay = getattr(policy, "rows_must_stay", True)
        self.in_keys = list(dict.fromkeys([*policy.in_keys, keys.ACTION_MASK]))
        self.out_keys = list(policy.out_keys)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        mask = mask_in(tensordict)
        action = self.policy(tensordict).get(keys.ACTION)
        # Whether the policy's own choice is among the allowed ones.
        is_allowed = mask.gather(1, action[:, None])[:, 0]
        return tensordict.set(keys.ACTION, torch.where(is_allowed, action, keys.KEEP))


def mask_in(tensordict: TensorDictBase) -> Tensor:
    """The environment's ``action_mask`` [N, A] bool.

    Raises:
        UserError: it has none.
    """
    mask = tensordict.get(keys.ACTION_MASK, None)
    if mask is None:
        raise UserError(
            "this driver chooses among allowed actions, but the environment has no "
            "action_mask; make it with mask='safe' or 'legal'."
        )
    return mask


class Driver(TensorDictModuleBase):
    """A rule-based policy: reads the raw state, writes ``action`` [N] int64 through :meth:`act`.

    Set ``rows_must_stay = True`` in one that remembers something per row in the module itself: an
    evaluation then never moves a running episode to another row, or into a smaller batch.

    Args:
        road: under the ego, where the state does not say another one.
        stream: family of episodes that the random numbers belong to.
    """

    # The simulator's raw state, without the observation's errors.
    in_keys = [keys.VEHICLES, keys.EGO, keys.SEED, keys.EPISODE, keys.STEP]  # noqa: RUF012
    out_keys = [keys.ACTION]  # noqa: RUF012
    rows_must_stay = False

    def __init__(self, road: Road, stream: int = Stream.TRAIN) -> None:
        super().__init__()
        self.road = road
        self.stream = int(stream)

    def act(self, vehicles: Vehicles, tensordict: TensorDictBase) -> Tensor:
        """The action of every row."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        vehicles = Vehicles.of(tensordict.get(keys.VEHICLES))
        return tensordict.set(keys.ACTION, self.act(vehicles, tensordict))


def legal_actions(
    tensordict: TensorDictBase, road: Road, actions: ActionParameters | None = None
) -> Tensor:
    """Which actions stay on the road, bool [N, A]: keeping the lane always does.

    Of ``lane_speed`` also which have an effect on the speed; of actions that are not numbered
    [N, 0].

    Args:
        tensordict: what the environment wrote, batch [N].
        road: under the ego.
        actions: their form; None: keep, left and right.
    """
    actions = actions or ActionParameters()
    vehicles = Vehicles.of(tensordict.get(keys.VEHICLES))
    sides = constant(SIDES, vehicles.target_lane)
    # Beside the lane that it is moving to, not the one it is in.
    legal = stays_on_road(vehicles, sides, road)
    if not actions.names:
        return legal[:, :0]
    if actions.form == LANE_SPEED:
        legal = torch.cat((legal, allowed_speeds(tensordict, actions)), dim=1)
    return legal


class RandomDriver(Driver):
    """Any of the three actions with equal probability; it soon drives off the road."""

    def _uniform(self, tensordict: TensorDictBase) -> Tensor:
        # By counters, not by a generator: an episode draws the same actions in any batch.
        key = episode_key(self.stream, tensordict.get(keys.SEED), tensordict.get(keys.EPISODE))
        step = tensordict.get(keys.STEP)
        return uniform(key, step, 1, [Purpose.RANDOM_ACTION])[:, 0, 0]

    def act(self, vehicles: Vehicles, tensordict: TensorDictBase) -> Tensor:
        """Floor of three times a uniform number."""
        return (self._uniform(tensordict) * 3).long()


class RandomLegalDriver(RandomDriver):
    """As :class:`RandomDriver`, among the actions that stay on the road."""

    def act(self, vehicles: Vehicles, tensordict: TensorDictBase) -> Tensor:
        """The r-th legal action, r uniform."""
        legal = legal_actions(tensordict, road_in(tensordict, self.road))
        wanted = (self._uniform(tensordict) * legal.sum(1)).long()
        # The r-th action that is legal has rank r, and so have those behind it that are not.
        rank = legal.cumsum(1) - 1
        is_wanted = legal & (rank == wanted[:, None])
        return is_wanted.long().argmax(1)


class KeepLaneDriver(Driver):
    """Never changes lanes."""

    def act(self, vehicles: Vehicles, tensordict: TensorDictBase) -> Tensor:
        """Always 0."""
        return torch.zeros_like(vehicles.target_lane[:, EGO_INDEX])


class MobilDriver(Driver):
    """The ego driven by MOBIL; with ``politeness_rear=politeness_side=0`` an egoistic one.

    Args:
        road, stream: as of every driver.
        idm: by which it expects vehicles to follow.
        mobil: its weights and thresholds.
    """

    def __init__(
        self,
        road: Road,
        stream: int = Stream.TRAIN,
        idm: IdmParameters = TABLE_V,
        mobil: MobilParameters = TABLE_IV,
    ) -> None:
        super().__init__(road, stream)
        self.idm = idm
        self.mobil = mobil

    def act(self, vehicles: Vehicles, tensordict: TensorDictBase) -> Tensor:
        """MOBIL's wish as an action, in decisions in which a second of simulated time is full."""
        road = road_in(tensordict, self.road)
        scene = ego_scene(vehicles, road)
        # -1 right, 0 stay, 1 left, of the ego alone.
        wish = mobil_wishes(scene, self.idm, self.mobil)[:, 0]

        # MOBIL decides once a second; the decisions of the ego may come more often.
        step = tensordict.get(keys.STEP)
        decisions = tensordict.get(keys.EGO).get("decisions")
        # All decisions take equally many steps, so the last one was at step - step / decisions.
        last = step - step // decisions.clamp_min(1)
        new_second = step // MOBIL_PERIOD_STEPS != last // MOBIL_PERIOD_STEPS
        due = (decisions == 0) | new_second
        wish = torch.where(due, wish, 0)

        right_or_keep = torch.where(wish < 0, RIGHT, keys.KEEP)
        return torch.where(wish > 0, LEFT, right_or_keep)


def egoistic_mobil(road: Road, stream: int = Stream.TRAIN) -> MobilDriver:
    """MOBIL with politeness 0."""
    egoistic = replace(TABLE_IV, politeness_rear=0.0, politeness_side=0.0)
    return MobilDriver(road, stream, mobil=egoistic)


#: Name to a constructor from (road, stream).
DRIVERS: dict[str, Callable[[Road, int], Driver]] = {
    "random": RandomDriver,
    "random_legal": RandomLegalDriver,
    "keep_lane": KeepLaneDriver,
    "mobil": MobilDriver,
    "mobil_egoistic": egoistic_mobil,
}
