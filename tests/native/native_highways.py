"""Random highways in float32, and the kernel set beside the tensor code on them."""

from __future__ import annotations

import random

import torch
from reference.worlds import environment, leaves, packed
from tensordict import TensorDictBase

from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.native.tensors import Kernel, Outcome
from ganlane.parameters.driving import Visibility
from ganlane.sim.state import Vehicles
from ganlane.traffic.idm_mobil import IdmMobilTraffic

#: Events by the kernel's names, and the ego's memory without the fractions.
EVENTS = {"soft_crashes": "soft_crash", "soft_crashes_behind": "soft_crash_behind"}
EVENTS |= {name: name for name in ("goal", "hard_crash", "out_of_road", "timeout")}
EGO_EXACT = ("change_direction", "decisions", "lane_changes", "started_change", "soft_crash", "soft_crash_behind")
MOTION = ("x", "y", "heading", "speed", "acceleration")


def random_highway(rng: random.Random, rows: int, most_vehicles: int = 60, dtype=torch.float32) -> HighwayEnv:
    """1 to 6 lanes, 2 to 60 vehicles, dense and sparse, with and without MOBIL, all periods and visibilities."""
    lanes, vehicles = rng.randint(1, 6), rng.randint(2, most_vehicles)
    spacing = rng.choice([8.0, 12.0, 25.0])
    return environment(
        lanes,
        rows,
        vehicles,
        mobil=rng.random() < 0.75,
        period_s=rng.choice([0.1, 0.5, 1.0]),
        goal_m=rng.choice([60.0, 5000.0]),
        timeout_s=rng.choice([4.0, 1000.0]),
        abort=rng.random() < 0.3,
        visibility=Visibility(rng.randint(0, 2)),
        spawn=packed(max(60.0, 1.5 * spacing * vehicles / lanes + spacing), spacing),
        seed=rng.randrange(10**9),
        dtype=dtype,
        recycle=rng.random() < 0.5,
    )


def disturbed(env: HighwayEnv, generator: torch.Generator) -> TensorDictBase:
    """A first state with everything a little off: in mid-change, at angles, wheels turned, some of all kinds."""
    td = env.reset()
    scene, lanes = Vehicles.of(td[keys.VEHICLES]), env.road.lanes

    def between(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(scene.x.shape, generator=generator, dtype=env.dtype)

    changing = between(0, 1) < 0.3
    side = (between(0, 2).long() * 2 - 1) * changing
    off = scene.with_(
        x=scene.x * (1 + 3 * (between(0, 1) < 0.05)),
        y=scene.y + between(-0.5, 0.5) + 0.5 * side * between(0, 4),
        heading=between(-0.03, 0.03) * (1 + 20 * (between(0, 1) < 0.02)),
        speed=between(0, 30) * (between(0, 1) < 0.9),
        length=between(4, 6) + 8 * (between(0, 1) < 0.1),
        width=between(1.8, 2.6),
        desired_speed=between(15, 35),
        target_lane=(scene.target_lane + side).clamp(0, lanes - 1),
        visibility=between(0, 3).long(),
        valid=(between(0, 1) < 0.9) | (torch.arange(scene.x.shape[1]) == 0),
    )
    for name, value in off.as_dict().items():
        td[keys.VEHICLES, name] = value
    td[keys.EGO, "change_direction"] = (off.target_lane - scene.target_lane)[:, 0]
    td[keys.TRAFFIC, "steering"] = between(-0.02, 0.02)
    td[keys.EGO, "steering"] = td[keys.TRAFFIC, "steering"][:, 0]
    return td


def kernel_of(env: HighwayEnv, variant: str | None = None) -> Kernel:
    """The kernel for the environment's road, rules and traffic."""
    mobil = env.traffic.mobil if isinstance(env.traffic, IdmMobilTraffic) else None
    return Kernel(env.road, env.vehicles, env.episode, env.ego, mobil=mobil, variant=variant)


def by_kernel(kernel: Kernel, td: TensorDictBase, recycle: bool = False) -> Outcome:
    """The decision ``td["action"]`` from the state ``td``."""
    recycles = torch.ones_like(td["action"], dtype=torch.bool) if recycle else None
    vehicles = Vehicles.of(td[keys.VEHICLES])
    return kernel.decide(td["action"], vehicles, td[keys.TRAFFIC, "steering"], td[keys.EGO], td[keys.STEP], recycles)


def actions(env: HighwayEnv, generator: torch.Generator, change: float = 0.2) -> torch.Tensor:
    """Random actions [N], mostly to keep the lane."""
    drawn = torch.rand(env.batch_size, generator=generator)
    return torch.where(drawn < 0.5 * change, keys.LEFT, torch.where(drawn < change, keys.RIGHT, keys.KEEP))


def differing_rows(out: Outcome, after: TensorDictBase) -> torch.Tensor:
    """Rows [N] in which an event, a flag, a counter or a target lane differs."""
    differs = (out["target_lane"] != after[keys.VEHICLES, "target_lane"]).any(1)
    for ours, name in EVENTS.items():
        differs |= (out[ours] != after[keys.EVENTS, name])[:, 0]
    for name in EGO_EXACT:
        differs |= out[name] != after[keys.EGO, name]
    for name in ("done", "terminated", "truncated"):
        differs |= (out[name] != after[name])[:, 0]
    return differs | (out["step"] != after[keys.STEP])


def errors(out: Outcome, after: TensorDictBase, rows: torch.Tensor) -> dict[str, float]:
    """The largest difference of every number in ``rows``, of valid vehicles."""
    valid = after[keys.VEHICLES, "valid"] & rows[:, None]
    found = {}
    for name in MOTION:
        found[name] = torch.where(valid, out[name] - after[keys.VEHICLES, name], 0.0).abs().max().item()
    steering = torch.where(valid, out["steering"] - after[keys.TRAFFIC, "steering"], 0.0)
    found["steering"] = steering.abs().max().item()
    for name in ("mean_acceleration", "change_progress", "distance"):
        found[name] = torch.where(rows, out[name] - after[keys.EGO, name], 0.0).abs().max().item()
    return found


def within_rounding(env: HighwayEnv, td: TensorDictBase, row: int) -> bool:
    """Whether the decision of ``row`` hangs by a rounding: 64 states a rounding beside it lead to different ones."""
    copies = 64
    exact = HighwayEnv(
        env.traffic, copies, env.vehicles, env.spawn_parameters, env.ego, env.episode,
        dtype=torch.float64, recycle=env.recycle,
    )  # fmt: skip
    state = td[row : row + 1].expand(copies).clone()
    generator = torch.Generator().manual_seed(0)
    for name, size in (("x", 2e-5), ("y", 2e-6), ("speed", 4e-6), ("heading", 2e-7)):
        number = state[keys.VEHICLES, name].double()
        noise = 2.0 * torch.rand(number.shape, generator=generator, dtype=torch.float64) - 1.0
        state[keys.VEHICLES, name] = number + size * noise
    for name in ("acceleration", "length", "width", "desired_speed"):
        state[keys.VEHICLES, name] = state[keys.VEHICLES, name].double()
    state[keys.TRAFFIC, "steering"] = state[keys.TRAFFIC, "steering"].double()
    state[keys.EGO, "steering"] = state[keys.EGO, "steering"].double()
    after = exact.step(state)["next"]
    whole = [value.reshape(copies, -1) for _, value in leaves(after) if not value.is_floating_point()]
    return any(bool((value != value[:1]).any()) for value in whole)
