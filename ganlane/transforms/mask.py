"""Action masks: which of the ego's numbered actions are allowed at each decision.

A mask is a safety layer between a driver and the road (action masking, Krasowski et al. 2020;
shielding, Alshiekh et al. 2018): computed by rules, never learnt, and the same for every driver.
``legal`` removes commands without an effect (off the road, or during a lane change). ``safe`` also
removes lane changes that violate MOBIL's safety criterion (Kesting et al. 2007): after the change
neither the new follower nor the ego itself would have to brake harder than ``safe_deceleration`` by
IDM. ``foresight`` also removes those without room for the next seconds with a follower who does not
react or a leader who brakes (:mod:`ganlane.sim.foresight`). Keeping the lane is always allowed, and
so are faster and slower where they have an effect.

The mask uses what the ego perceives: with sensor errors it can be wrong. It holds at the instant of
the command; a lane change that has begun continues (or, with ``abort_lane_change``, can be turned
back if that is safe).
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ganlane import keys
from ganlane.errors import UserError
from ganlane.native.tensors import SafeActions
from ganlane.settings.actions import LANE_SPEED, ActionParameters
from ganlane.settings.driving import IdmParameters
from ganlane.settings.observation import MASKS, MaskParameters
from ganlane.sim.actions import speed_changes
from ganlane.sim.dynamics import SIDES, ego_scene, is_heard, stays_on_road
from ganlane.sim.foresight import has_room
from ganlane.sim.idm import TABLE_V
from ganlane.sim.mobil import lane_accelerations
from ganlane.sim.state import Road, Vehicles, road_in
from ganlane.torch_settings import constant
from ganlane.transforms.sensors import PerceptionTransform

#: What this transform computes; an environment without a mask (``none``) has no transform.
FORMS = tuple(form for form in MASKS if form != "none")


def allowed_speeds(state: TensorDictBase, actions: ActionParameters) -> Tensor:
    """Whether ``faster`` and ``slower`` have an effect in ``state``, bool [N, 2]."""
    desired = state.get(keys.VEHICLES).get("desired_speed")[:, keys.EGO_INDEX]
    return speed_changes(state.get(keys.EGO).get(keys.SET_SPEED), desired, actions)


class ActionMaskTransform(PerceptionTransform):
    """Write ``action_mask`` [N, A] bool: which actions are allowed; TorchRL's key and meaning.

    Belongs after a :class:`~ganlane.transforms.SensorTransform`. Append TorchRL's own
    ``ActionMask()`` to restrict the action spec, and with it ``env.rand_action``.

    With ``form="safe"`` and ``foresight`` it also writes ``no_safe_action`` [N, 1] bool: no lane
    change is allowed, and keeping the lane requires the ego or its follower to brake harder than is
    safe. The ego then keeps its lane and brakes.

    Args:
        road: the environment's.
        form: ``legal``, ``safe`` or ``foresight``.
        safe_deceleration: m/s2, above 0; MOBIL's ``b_safe``.
        idm: by which braking is judged.
        abort: whether the ego may turn back during a lane change (``env.ego.abort_lane_change``).
        native_vehicles: M, where the native kernel computes ``safe`` and ``foresight`` (float32,
            CPU); None: the tensor code does.
        actions: those of the environment.

    Raises:
        UserError: an unknown form, actions that are not numbered, or a deceleration that is not
            above 0.
    """

    def __init__(
        self,
        road: Road,
        form: str = "safe",
        safe_deceleration: float = 4.0,
        idm: IdmParameters = TABLE_V,
        abort: bool = False,
        native_vehicles: int | None = None,
        actions: ActionParameters | None = None,
    ) -> None:
        if form not in FORMS:
            raise UserError(
                f"mask.form={form!r}: expected one of {', '.join(FORMS)}; choose one of them."
            )

        self.mask = MaskParameters(form, safe_deceleration)
        self.actions = actions or ActionParameters()
        self.actions.check_mask(form)
        # Behind legal there is nothing to report: keeping the lane is always legal.
        further = [] if form == "legal" else [keys.NO_SAFE_ACTION]
        super().__init__(
            in_keys=[keys.VEHICLES, keys.EGO],
            out_keys=[keys.ACTION_MASK, *further],
        )
        self.road = road
        self.idm = idm
        self.abort = abort

        # The kernel has no function for ``legal``, which is a comparison or two.
        self.native: SafeActions | None = None
        if native_vehicles is not None and form != "legal":
            self.native = SafeActions(road, native_vehicles, idm, self.mask, abort)

    def allowed(self, vehicles: Vehicles, direction: Tensor, road: Road) -> tuple[Tensor, Tensor]:
        """The mask [N, 3] of keep, left and right, and whether no action is safe [N]; bool.

        Args:
            vehicles: [N, M], as the ego perceives them.
            direction: of its current lane change, [N]: -1 right, 0 none, 1 left.
            road: the environment's, or of each row.
        """
        side = constant(SIDES, direction)

        # Keeping the lane is no command that the ego could fail to hear.
        obeyed = (side == 0) | is_heard(side, direction[:, None], self.abort)
        legal = stays_on_road(vehicles, side, road) & obeyed

        form = self.mask.form
        if form == "legal":
            return legal, torch.zeros_like(legal[:, 0])

        # How hard the ego, in its lane and in those beside it, and who would follow it there would
        # have to brake by IDM. A lane that does not exist has no vehicles, and is not legal.
        scene = ego_scene(vehicles, road)
        lanes = scene.observers.target_lane[..., None] + side.to(vehicles.x.dtype)
        accelerations = lane_accelerations(scene, lanes, self.idm)
        ego = accelerations.observer[:, 0]
        follower = accelerations.with_it[:, 0]
        safe_deceleration = self.mask.safe_deceleration
        safe = torch.minimum(ego, follower) >= -safe_deceleration

        # Of the two changes, [N, 2].
        changes = legal[:, 1:] & safe[:, 1:]
        if form == "foresight":
            # On the way the ego heeds its own lane and the new one.
            slowest = torch.minimum(ego[:, :1], ego[:, 1:])
            room = has_room(scene, lanes[:, 0, 1:], slowest, safe_deceleration)
            changes = changes & room

        # Keeping the lane is always allowed: where nothing is safe, there is nothing better.
        none = ~(safe[:, :1] | changes).any(1)
        keep = torch.ones_like(safe[:, :1])
        return torch.cat((keep, changes), dim=1), none

    def write(self, state: TensorDictBase, vehicles: Vehicles, seen: Vehicles) -> TensorDictBase:
        """Write ``action_mask``, and with ``safe`` and ``foresight`` ``no_safe_action``."""
        direction = state.get(keys.EGO).get("change_direction")
        if self.native is not None:
            mask, none = self.native.allowed(seen, direction)
        else:
            mask, none = self.allowed(seen, direction, road_in(state, self.road))

        if self.actions.form == LANE_SPEED:
            mask = torch.cat((mask, allowed_speeds(state, self.actions)), dim=1)

        # With ``legal`` there is one out key alone.
        for name, flags in zip(self.out_keys, (mask, none[:, None])):
            state.set(name, flags)
        return state
