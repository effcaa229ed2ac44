"""A decision of :class:`~ganlane.env.HighwayEnv` by the native kernel, where that can drive its traffic."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ganlane import keys
from ganlane.env.physics import Rules
from ganlane.env.state import pack
from ganlane.errors import UserError
from ganlane.native.calls import torch_on_one_thread
from ganlane.native.decision import EgoState, Kernel, Outcome
from ganlane.native.library import why_not
from ganlane.native.scenes import NativeScenes
from ganlane.parameters.episode import KERNELS
from ganlane.sim.scenes import Scenes
from ganlane.sim.spawn import RandomScenes
from ganlane.sim.state import Vehicles
from ganlane.traffic.base import TrafficModule
from ganlane.traffic.idm_mobil import IdmMobilTraffic, IdmTraffic

NATIVE_TAKEN = "env.kernel=auto: the native kernel"


def threads_for(env: EnvBase) -> AbstractContextManager[None]:
    """:func:`~ganlane.native.calls.torch_on_one_thread` for steps of an ``env`` that the kernel drives."""
    base: Any = env
    while hasattr(base, "base_env"):
        base = base.base_env
    return nullcontext() if getattr(base, "kernel", None) is None else torch_on_one_thread()


@lru_cache(maxsize=8)
def say_once(line: str) -> None:
    """Print a line to the standard error stream, the first time that it is given."""
    print(line, file=sys.stderr)


def make_kernel(
    wanted: str, traffic: TrafficModule, rules: Rules, vehicles: int, device: torch.device, dtype: torch.dtype
) -> Kernel | None:
    """The kernel for ``wanted`` (``torch``, ``native`` or ``auto``); None: the tensor code drives.

    Raises:
        UserError: an unknown name, or ``native`` where the kernel cannot do what is asked or cannot be built.
    """
    if wanted not in KERNELS:
        raise UserError(f"env.kernel={wanted}: expected one of {', '.join(KERNELS)}; choose one of them.")
    if wanted == "torch":
        return None
    reason, missing = _why_not(traffic, rules, device, dtype), why_not()
    if wanted == "native" and (reason or missing):
        raise UserError(f"env.kernel=native {reason or missing}; set env.kernel=torch.")
    if reason:
        return None
    if missing:
        say_once(f"env.kernel=auto: the tensor code, since the native kernel {missing}")
        return None
    assert isinstance(traffic, IdmTraffic)
    mobil = traffic.mobil if isinstance(traffic, IdmMobilTraffic) else None
    return Kernel(rules.road, vehicles, rules.episode, rules.ego, rules.idm, rules.steering, mobil)


def _why_not(traffic: TrafficModule, rules: Rules, device: torch.device, dtype: torch.dtype) -> str | None:
    """What the kernel cannot do of this, as the end of a sentence; None: it can do all."""
    if type(traffic) not in (IdmTraffic, IdmMobilTraffic):
        return f"drives the traffics idm and idm_mobil alone, not {type(traffic).__name__}"
    assert isinstance(traffic, IdmTraffic)
    if device.type != "cpu" or dtype != torch.float32:
        return f"runs on a CPU in float32, not on {device} in {dtype}"
    if rules.road.ring_m is not None:
        return "has no ring"
    if (traffic.idm, traffic.steering) != (rules.idm, rules.steering):
        return "has one set of parameters of car following and steering for the ego and the others"
    return None


def native_decision(
    kernel: Kernel, state: TensorDictBase, action: Tensor, recycles: Tensor | None
) -> tuple[Outcome, Vehicles]:
    """The decision ``action`` [N] from ``state``, and the vehicles after it; ``recycles`` [N] bool or None."""
    vehicles, ego = Vehicles.of(state.get(keys.VEHICLES)), state.get(keys.EGO)
    out = kernel.decide(
        action,
        vehicles,
        state.get(keys.TRAFFIC).get("steering"),
        EgoState(*(ego.get(name) for name in EgoState._fields)),
        state.get(keys.STEP),
        recycles,
    )
    return out, out.moved(vehicles)


def make_scenes(kernel: Kernel | None, scenes: Scenes, stream: int) -> NativeScenes | None:
    """What draws the first states for ``kernel``; None: the tensor code does."""
    return NativeScenes(scenes, stream) if kernel is not None and type(scenes) is RandomScenes else None


def as_state(seed: Tensor, episode: Tensor, out: Outcome, vehicles: Vehicles) -> TensorDictBase:
    """The state (:mod:`ganlane.env.state`) of the episodes (``seed``, ``episode``) [N], without a reward."""
    ego = {
        "steering": out.ego_steering,
        "mean_acceleration": out.mean_acceleration,
        "change_progress": out.change_progress,
        "distance": out.distance,
        "change_direction": out.change_direction,
        "decisions": out.decisions,
        "lane_changes": out.lane_changes,
        "soft_crash": out.ego_soft_crash,
        "soft_crash_behind": out.ego_soft_crash_behind,
        "started_change": out.started_change,
    }
    memory = TensorDict._new_unsafe({"steering": out.steering}, batch_size=out.step.shape)
    events = {name: getattr(out, name) for name in ("goal", "hard_crash", "out_of_road", "timeout")}
    events["scene_end"] = torch.zeros_like(out.timeout)  # of recorded scenes, which the kernel does not drive
    events |= {keys.SOFT_CRASH: out.soft_crash, keys.SOFT_CRASH_BEHIND: out.soft_crash_behind}
    rest = {keys.SEED: seed, keys.EPISODE: episode, keys.STEP: out.step}
    rest |= {"terminated": out.terminated, "truncated": out.truncated, "done": out.done}
    return pack(vehicles, ego, memory, events, rest)
