"""The native kernel beside the tensor code: what it runs as here, and random highways for both."""

from __future__ import annotations

import random
from collections.abc import Sequence

import pytest
import torch
from reference.worlds import environment, packed

from ganlane.env import HighwayEnv
from ganlane.native.library import VARIANTS, best_variant
from ganlane.native.tensors import Kernel
from ganlane.settings.driving import Visibility

#: Instruction sets of this processor. The one for any processor takes long to build and to drive;
#: .ci/run has a step for it.
RUNNABLE = [
    pytest.param(name, marks=pytest.mark.slow) if name == "default" else name
    for name in list(VARIANTS)[list(VARIANTS).index(best_variant()) :]
]


def kernel_of(env: HighwayEnv, variant: str | None = None) -> Kernel:
    """The kernel for the environment's road, rules, traffic and actions."""
    drivers = env.traffic.native_drivers()
    rules = env.road, env.vehicles, env.episode, env.ego
    return Kernel(*rules, drivers, variant, env.actions, env.rules.mobil)


def random_environment(
    rng: random.Random,
    lanes: int,
    rows: int,
    most_vehicles: int,
    spacings_m: Sequence[float],
    **others: object,
) -> HighwayEnv:
    """Tensor code on 2 to ``most_vehicles`` vehicles, dense and sparse, all periods and
    visibilities, in float32.
    """
    vehicles = rng.randint(2, most_vehicles)
    spacing_m = rng.choice(spacings_m)
    spread_m = max(60.0, 1.5 * spacing_m * vehicles / lanes + spacing_m)
    return environment(
        lanes,
        rows,
        vehicles,
        spawn=packed(spread_m, spacing_m),
        period_s=rng.choice([0.1, 0.5, 1.0]),
        goal_m=rng.choice([60.0, 5000.0]),
        timeout_s=rng.choice([4.0, 1000.0]),
        abort=rng.random() < 0.5,
        visibility=rng.choice(list(Visibility)),
        dtype=torch.float32,
        kernel="torch",
        **others,
    )
