"""The native kernel beside the tensor code: what it runs as here, and where the two differ."""

from __future__ import annotations

import torch
from reference.marks import slow
from reference.worlds import leaves
from tensordict import TensorDictBase

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.native.library import VARIANTS, best_variant
from ganlane.native.tensors import Kernel

#: Instruction sets of this processor. The one for any processor takes long to build and to drive;
#: .ci/run has a step for it.
RUNNABLE = [
    slow(name) if name == "default" else name
    for name in list(VARIANTS)[list(VARIANTS).index(best_variant()) :]
]
#: Parts of all kinds; no batch size of the tests is a multiple of the sum of their shares.
MIXED = {
    "name": "mixed",
    "shares": {"idm_mobil": 2}
    | dict.fromkeys(("gan", "human", "idm_faults", "idm_random", "gan_calibrated"), 1),
}


def kernel_of(env: HighwayEnv) -> Kernel:
    """The kernel for the environment's road, rules, traffic and actions."""
    drivers = env.traffic.native_drivers()
    rules = env.road, env.vehicles, env.episode, env.ego
    return Kernel(*rules, drivers, actions=env.actions, mobil=env.rules.mobil)


def apart(
    out: TensorDictBase, after: TensorDictBase, limit: float = 1e-3, of_ego: bool = True
) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows [N] in which an event, a flag, a counter or a lane differs, and rows in which a number
    of a valid vehicle does, by more than the ``limit``.

    Without ``of_ego`` the traffic's memory of the ego, which it does not drive, does not count.
    """
    events = torch.zeros(len(out), dtype=torch.bool)
    numbers = events.clone()
    for name, value in leaves(out):
        other, valid = after[name], after[keys.VEHICLES, "valid"]
        if name[0] == keys.TRAFFIC and not of_ego:
            value, other, valid = (field[:, 1:] for field in (value, other, valid))
        if value.is_floating_point():
            # A speed's rounding is ten times as large in an acceleration, its difference over
            # 0.1 s, and within a second the generator's network makes millimetres of it.
            amplified = name[:2] == (keys.TRAFFIC, "generator") or name[-1] == "acceleration"
            # Not "above the limit": what is no number differs, too.
            differs = ~((value - other).abs() < (10.0 if amplified else 1.0) * limit)
            if value.shape == valid.shape:
                differs &= valid
            numbers |= differs.reshape(len(out), -1).any(1)
        else:
            events |= (value != other).reshape(len(out), -1).any(1)
    return events, numbers
