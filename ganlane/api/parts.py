"""Environments and drivers from a few arguments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchrl.envs import Transform, TransformedEnv

from ganlane import build
from ganlane.api.options import Option, option
from ganlane.build import Driver
from ganlane.config.env import check_reward
from ganlane.config.run import RunConfig
from ganlane.errors import UserError
from ganlane.sim.random import Stream

#: Families of episodes: to train on, to choose on, to report on.
STREAMS = {stream.name.lower(): stream for stream in Stream}


def make_env(
    traffic: Option = "idm_mobil",
    num_envs: int = 1,
    *,
    env: Option = "highway",
    observation: Option = "lane_view_overlap",
    reward: Option = "paper",
    mask: Option = "none",
    transforms: Sequence[Transform] = (),
    seed: int = 0,
    stream: str = "train",
    device: str = "cpu",
    **overrides: Any,
) -> TransformedEnv:
    """A batched TorchRL environment with observation and reward.

    ::

        env = make_env(traffic="gan", num_envs=256, lanes=4, vehicles=15, recycle=True)
        rollout = env.rollout(100)

    On the command line: ``traffic=gan collector.num_envs=256 env.lanes=4 env.vehicles=15 env.recycle=true``.

    Args:
        traffic: an option of the group ``traffic`` (``idm``, ``idm_mobil``, ``gan``, ``gan_calibrated``,
            ``idm_faults``, ``idm_random``, ``mixed``, ``replay``, ``sumo``, ``highway_env``), the import path or the
            class of a model of your own, or a mapping such as ``{"name": "gan", "noise_scale": 0.5}``.
        num_envs: N, environments side by side.
        env: an option of the group ``env``: ``highway``, ``dense``, or a scenario such as ``cut_in``.
        observation: ``table3``, ``table3_progress``, ``lane_view``, ``lane_view_drift``, ``lane_view_overlap``,
            ``table3_lane_view``, ``fixed_order``, or a mapping.
        reward: ``paper``, ``considerate``, or a mapping of what differs from it, ``{"hard_crash": -200}``.
        mask: ``none``, ``legal`` or ``safe`` (writes ``action_mask`` [N, 3] bool), or a mapping such as
            ``{"name": "safe", "safe_deceleration": 3.0}``.
        transforms: your own, after observation and reward.
        seed: base of the random numbers.
        stream: family of the episodes: ``train``, ``select`` or ``report`` (that of ``evaluate``).
        device: ``cpu`` or ``cuda``.
        overrides: keys of the environment (:class:`ganlane.config.env.EnvConfig`), ``lanes=4, idm={"headway_s": 1}``.

    Raises:
        UserError: an unknown name or key, a value of the wrong type or out of range.
    """
    config, pay, seen = option("env", env, overrides), option("reward", reward), option("observation", observation)
    check_reward(config, pay)
    run = RunConfig(seed=whole("seed", seed), device=device)
    module = build.make_traffic(option("traffic", traffic), config, stream_of(stream))
    made = build.make_env(
        module, config, seen, pay, rows_of(num_envs), run.seed, run.device, mask=option("mask", mask)
    )
    for transform in transforms:
        made.append_transform(transform)
    return made


def load_agent(
    name: str = "agent_general",
    *,
    env: Option = "highway",
    stream: str = "report",
    device: str = "cpu",
    **overrides: Any,
) -> Driver:
    """Somebody who can drive the ego: ``.policy``, its ``.observation`` (None: the raw state) and its ``.mask``.

    ::

        agent = load_agent("agent_idm")
        env = make_env(traffic="gan", num_envs=64, observation=agent.observation, mask=agent.mask)
        rollout = env.rollout(100, agent.policy)

    On the command line: ``ganlane evaluate 'agents=[agent_idm]'``.

    Args:
        name: a shipped agent, a rule-based driver (``mobil``, ``mobil_egoistic``, ``keep_lane``, ``random_legal``,
            ``random``), the path of an agent's ``.safetensors``, or the import path of a policy of your own.
        env, overrides: where it is to drive, as in :func:`make_env`; a network must fit.
        stream: of its random numbers, if it draws any.
        device: of its network.

    Raises:
        UserError: no such driver, or its network takes another observation.
    """
    return build.make_driver(
        str(name), option("env", env, overrides), stream_of(stream), RunConfig(device=device).device
    )


def stream_of(name: str) -> Stream:
    """The stream of a name."""
    if name not in STREAMS:
        raise UserError(f"stream={name}: expected one of {', '.join(STREAMS)}; choose one of them.")
    return STREAMS[name]


def rows_of(num_envs: Any) -> int:
    """The batch size, checked."""
    rows = whole("num_envs", num_envs)
    if not 1 <= rows <= 65536:
        raise UserError(f"num_envs={rows}: expected a number from 1 to 65536; give for instance num_envs=64.")
    return rows


def whole(name: str, value: Any) -> int:
    """``value`` as a whole number (NumPy's are, too)."""
    if isinstance(value, bool) or not hasattr(value, "__index__"):
        raise UserError(f"{name}={value!r}: expected a whole number; give for instance {name}=1.")
    return int(value)
