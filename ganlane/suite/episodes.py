"""One episode of a driver, recorded for a film or a page."""

from __future__ import annotations

from ganlane.build import Driver, make_env, make_traffic
from ganlane.settings.commands import EvaluateConfig
from ganlane.settings.render import RenderConfig
from ganlane.settings.traffic import TrafficConfig
from ganlane.sim.random import Stream
from ganlane.view.record import Trajectory, record_episode


def drive_episode(
    driver: Driver,
    traffic: TrafficConfig,
    config: EvaluateConfig | RenderConfig,
    episode: int,
    end_s: float | None = None,
) -> Trajectory:
    """Record an episode of the seed and stream of ``config``, up to ``end_s``.

    Raises:
        UserError: see :func:`ganlane.build.make_traffic`.
    """
    # A trained agent brings the mask and the observation that it was trained with.
    driven, policy = driver.driving(config)
    env = make_env(make_traffic(traffic, config.env, Stream.named(config.stream)), driven)
    return record_episode(env, policy, config.seed, episode, driver.name, traffic.label(), end_s)
