"""How many vehicles pass a ramp where more arrive than fit, and does anybody stand for ever?

    python -m benchmarks.flow

Of an on-ramp (`env=on_ramp`) and a weave (`env=weave`), on a section that begins 1.1 km upstream,
without an ego. More vehicles arrive than the road can hold, in the lanes and on the ramp. After a
while in which the queue forms, those who leave are counted: downstream, by the exit, and those who
wanted to leave by it but drove past. Standing is below 0.1 m/s: `stood` is the longest time that a
vehicle stood, `last` how long one had stood at the end. Beside it, the largest flow of a platoon in
equilibrium by IDM alone.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

import numpy as np
import torch

from benchmarks.script import make_parser, run_script
from ganlane import keys
from ganlane.build import make_env, make_traffic
from ganlane.evaluation.table import Table
from ganlane.settings.commands import DrivingConfig
from ganlane.settings.driving import IdmParameters, MobilParameters
from ganlane.settings.env import EnvConfig
from ganlane.settings.record import make
from ganlane.settings.traffic import TrafficConfig

#: Arrivals in each lane and on the ramp, veh/h: more than fit.
VPH = 2400.0
RAMP_VPH = 900.0
#: Share of the drivers who leave by the exit of the weave.
EXIT_SHARE = 0.25
SCENES = ("on_ramp", "weave")
TRAFFICS = ("idm_mobil", "idm_random")
#: The section, m, and so many vehicles that some wait outside even if it is a single queue.
FROM_M = -1000.0
TO_M = 1000.0
SLOTS = 560
#: Sections side by side.
ROWS = 16
#: Until the queue has formed, s.
WARM_UP_S = 400
STANDING_MPS = 0.1
#: Of the drivers of both scenes, the slowest and the fastest.
DESIRED_MPS = (18.0, 24.0)
#: Where the absent ego is, m.
NOWHERE_M = -1e6


@dataclass
class Passed:
    """Vehicles that left, and how long they stood.

    Attributes:
        hours: of all rows together.
        lanes: that go on, of the road.
        downstream, by_exit, missed: vehicles; ``missed`` of those downstream wanted the exit.
        longest_s: time that one vehicle stood without a break.
        last_s: and up to the end of the measurement.
    """

    scene: str
    traffic: str
    lanes: int
    hours: float = 0.0
    downstream: int = 0
    by_exit: int = 0
    missed: int = 0
    longest_s: int = 0
    last_s: int = 0

    @property
    def left(self) -> int:
        """Vehicles that have left, on the road and by the exit."""
        return self.downstream + self.by_exit

    @property
    def vph_per_lane(self) -> float:
        """Vehicles per hour and lane that leave."""
        return self.left / self.hours / self.lanes


def measure(
    scene: str,
    traffic: str,
    vehicles: int,
    courtesy: float = MobilParameters.courtesy,
) -> Passed:
    """Until so many ``vehicles`` have left, in all :data:`ROWS` together; ``courtesy`` in m/s2."""
    flow = {
        "vph": VPH,
        "ramp_vph": RAMP_VPH,
        "exit_share": EXIT_SHARE if scene == "weave" else 0.0,
        "from_m": FROM_M,
        "to_m": TO_M,
        "slots": SLOTS,
    }
    changed = {"name": scene, "flow": flow, "mobil": {"courtesy": courtesy}, "timeout_s": 1e6}
    config = make(EnvConfig, changed)
    module = make_traffic(make(TrafficConfig, traffic), config)
    base = make_env(module, DrivingConfig(env=config), ROWS).base_env
    road = base.road
    passed = Passed(scene, traffic, lanes=config.lanes - 1)
    exits = torch.tensor(road.flow.exits(base.vehicles))
    state = base.reset()
    # Nobody meets the ego.
    state[keys.VEHICLES, "x"][:, keys.EGO_INDEX] = NOWHERE_M
    state[keys.VEHICLES, "valid"][:, keys.EGO_INDEX] = False
    stood = torch.zeros(ROWS, base.vehicles, dtype=torch.int64)
    second = 0
    # No more than six times as long as at 1000 veh/h/lane, in case nobody gets through.
    most_s = WARM_UP_S + 6 * 3600 * vehicles // (1000 * passed.lanes * ROWS)
    while passed.left < vehicles and second < most_s:
        before = state[keys.VEHICLES, "valid"]
        state = base.step(state.set("action", torch.zeros(ROWS, dtype=torch.int64)))["next"]
        assert not state["done"].any()
        now = state[keys.VEHICLES]
        stands = now["valid"] & (now["speed"] < STANDING_MPS)
        stood = torch.where(stands, stood + 1, 0)
        second += 1
        if second <= WARM_UP_S:
            continue
        gone = before & ~now["valid"]
        by_exit = torch.zeros_like(gone)
        if road.exit_lane is not None:
            by_exit = gone & (road.lane_of(now["y"]) == road.exit_lane)
        passed.hours += ROWS / 3600.0
        passed.by_exit += int(by_exit.sum())
        passed.downstream += int((gone & ~by_exit).sum())
        passed.missed += int((gone & ~by_exit & exits).sum())
        passed.longest_s = max(passed.longest_s, int(stood.max()))
    passed.last_s = int(stood.max())
    return passed


def largest_flow(idm: IdmParameters, desired_mps: float) -> float:
    """Of a platoon in equilibrium, veh/h per lane; vehicles are 4.5 m long."""
    speed = desired_mps * np.arange(1, 1000) / 1000
    gap = (idm.min_gap_m + speed * idm.headway_s) / np.sqrt(1.0 - (speed / desired_mps) ** 4)
    return float((3600.0 * speed / (gap + 4.5)).max())


def table_of(results: list[Passed]) -> Table:
    """A line per scene and traffic."""
    lines = []
    for one in results:
        missed = one.missed if one.scene == "weave" else "-"
        flow = round(one.vph_per_lane)
        numbers = (one.left, one.by_exit, missed, flow, one.longest_s, one.last_s)
        lines.append([one.scene, one.traffic, *map(str, numbers)])
    heads = ["scene", "traffic", "left", "by exit", "missed", "veh/h/lane", "stood, s", "last, s"]
    slow, fast = (largest_flow(IdmParameters(), speed) for speed in DESIRED_MPS)
    note = (
        f"A platoon of Table V in equilibrium: at most {slow:.0f} to {fast:.0f} veh/h/lane, for "
        f"desired speeds of {DESIRED_MPS[0]:g} to {DESIRED_MPS[1]:g} m/s."
    )
    return Table("", heads, lines, names=2, notes=[note])


def report(arguments: argparse.Namespace) -> str:
    """All that is asked for."""
    results = [
        measure(scene, traffic, arguments.vehicles, arguments.courtesy)
        for scene in arguments.scenes
        for traffic in arguments.traffics
    ]
    return table_of(results).text()


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--vehicles", type=int, default=10_000, help="that leave, of a line")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--traffics", nargs="+", default=list(TRAFFICS))
    parser.add_argument("--courtesy", type=float, default=MobilParameters.courtesy, help="m/s2")
    sys.exit(run_script(report, parser.parse_args()))
