"""A traffic model of your own: IDM drivers who now and then look away and hold their speed.

Run it with ``python examples/own_traffic.py``. On the command line the same class is
``traffic._target_=own_traffic.Daydreamers traffic.every_s=20.0`` (with this folder on
PYTHONPATH).
"""

from __future__ import annotations

import sys

import torch

from ganlane.agents.drivers import MobilDriver
from ganlane.env import HighwayEnv
from ganlane.sim import Purpose, Road, Stream, advance, following_acceleration, perceive
from ganlane.sim.random import uniform
from ganlane.traffic import TrafficModule


class Daydreamers(TrafficModule):
    """Attention lapses come at random, once in ``every_s`` seconds of attention, and last
    ``lasts_s``.
    """

    memory_fields = {"away": ((), torch.int64)}  # noqa: RUF012

    def __init__(self, road=None, stream=Stream.TRAIN, every_s=30.0, lasts_s=2.0):
        super().__init__(road, stream)
        self.every_s, self.lasts_s = every_s, lasts_s

    def move(self, vehicles, memory, key, step):
        """Follow the leader by IDM, or hold the speed; straight on in either case."""
        u = uniform(key, step, vehicles.x.shape[1], [Purpose.FAULT], vehicles.x.dtype)[..., 0]
        lapses = (memory["away"] == 0) & (u < self.dt / self.every_s)
        away = torch.where(lapses, round(self.lasts_s / self.dt), memory["away"])
        acceleration = torch.where(
            away > 0, 0.0, following_acceleration(perceive(vehicles, self.road))
        )
        wheel, v = torch.zeros_like(vehicles.x), vehicles
        pose = advance(v.x, v.y, v.heading, v.speed, acceleration, wheel, self.dt)
        return v.with_(**pose._asdict()), {"away": (away - 1).clamp_min(0)}


def main(decisions="30"):
    """Drive a MOBIL ego through eight episodes side by side for half a minute."""
    road = Road(lanes=3)
    env = HighwayEnv(Daydreamers(road, every_s=20.0), num_envs=8, vehicles=9)
    env.check_env_specs()
    state = env.rollout(int(decisions), MobilDriver(road), break_when_any_done=False)["next"]
    others = state["vehicles"][..., 1:]
    looking_away = (state["traffic", "away"][..., 1:] > 0).double().mean()
    speed = others["speed"].mean()
    print(f"mean speed of the others {speed:.1f} m/s, {100 * looking_away:.0f} % look away")
    print(
        f"soft crashes of the ego: {int(state['events', 'soft_crash'].sum())} in 8 x {decisions} s"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
