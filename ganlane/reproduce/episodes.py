"""One episode of a driver, recorded for a picture."""

from __future__ import annotations

from ganlane.build import make_driver, make_env, make_traffic
from ganlane.settings.commands import DrivingConfig
from ganlane.settings.traffic import TrafficConfig
from ganlane.sim.random import Stream
from ganlane.view.record import Trajectory, record_episode


def drive_episode(
    name: str,
    traffic: TrafficConfig,
    config: DrivingConfig,
    episode: int,
    stream: int = Stream.REPORT,
    end_s: float | None = None,
) -> Trajectory:
    """Record an episode of the seed of ``config``, up to ``end_s``, with the driver ``name``.

    Raises:
        UserError: see :func:`ganlane.build.make_driver` and :func:`ganlane.build.make_traffic`.
    """
    driver = make_driver(name, config.env, device=config.device)
    # A trained agent brings the mask and the observation that it was trained with.
    mask, policy = driver.behind(config.mask)
    env = make_env(
        make_traffic(traffic, config.env, stream),
        config.env,
        config.observation.read_by(driver.observation),
        config.reward,
        device=config.device,
        mask=mask,
    )
    return record_episode(env, policy, config.seed, episode, driver.name, traffic.label(), end_s)
