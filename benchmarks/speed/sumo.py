"""An on-ramp in SUMO: the road and the vehicles of ``env=on_ramp``, driven by SUMO's own drivers.

SUMO holds one simulation per process, and a simulation here is one environment: no batches.
"""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import ganlane
from benchmarks.peers.simulators import vehicle_type
from benchmarks.speed.measure import Runner
from benchmarks.speed.systems import SEED, STEPS
from ganlane import keys
from ganlane.env import HighwayEnv
from ganlane.errors import UserError
from ganlane_simulators.sumo_roads import sumo_command

#: Road before x = 0, where the ego starts, and behind the goal, m.
ROOM_M = 500.0
EGO = str(keys.EGO_INDEX)
#: The ego takes every change that is asked for, unless it would hit somebody.
ASKED_ONLY = 512


def build_road(folder: Path, env: HighwayEnv) -> None:
    """The network: a ramp becomes the rightmost lane for as long as one may leave it.

    Raises:
        UserError: SUMO's ``netconvert`` refuses it.
    """
    ramp = env.road.stretches[0]
    end_m = env.episode.goal_m + ROOM_M
    lanes = env.road.lanes
    places = {"in": -ROOM_M, "on": ramp.begin_m, "off": ramp.end_m, "out": end_m}
    nodes = [f'<node id="{name}" x="{x}" y="0"/>' for name, x in places.items()]
    nodes.append(f'<node id="yard" x="{-ROOM_M}" y="-50"/>')
    edges = []
    for name, start, end, its_lanes in (
        ("before", "in", "on", lanes - 1),
        ("ramp", "yard", "on", 1),
        ("beside", "on", "off", lanes),
        ("after", "off", "out", lanes - 1),
    ):
        length_m = places[end] - places.get(start, -ROOM_M)
        edges.append(
            f'<edge id="{name}" from="{start}" to="{end}" numLanes="{its_lanes}" speed="50" '
            f'width="{env.road.lane_width_m}" length="{length_m}"/>'
        )
    joints = ['<connection from="ramp" to="beside" fromLane="0" toLane="0"/>']
    for lane in range(lanes - 1):
        ends = f'fromLane="{lane}" toLane="{lane + 1}"'
        joints.append(f'<connection from="before" to="beside" {ends}/>')
        ends = f'fromLane="{lane + 1}" toLane="{lane}"'
        joints.append(f'<connection from="beside" to="after" {ends}/>')
    call = ["netconvert", "--no-internal-links", "--output-file", str(folder / "net.xml")]
    for name, lines in (("node", nodes), ("edge", edges), ("connection", joints)):
        path = folder / f"{name}s.xml"
        path.write_text(f"<{name}s>\n" + "\n".join(lines) + f"\n</{name}s>\n")
        call += [f"--{name}-files", str(path)]
    outcome = subprocess.run(call, capture_output=True, text=True, check=False)
    if outcome.returncode:
        raise UserError(f"netconvert cannot build the on-ramp: {outcome.stderr.strip()}")


def write_vehicles(folder: Path, env: HighwayEnv) -> None:
    """The vehicles of the first scene, with Table V's IDM and SUMO's lane changes (LC2013).

    Front bumpers are half a length ahead of the centres.
    """
    ramp = env.road.stretches[0]
    state = env.reset()[keys.VEHICLES]
    names = ("x", "target_lane", "speed", "length", "desired_speed")
    columns = [state[name][0].tolist() for name in names]
    lines = []
    for slot, (x, lane, speed_mps, length_m, desired_mps) in enumerate(zip(*columns)):
        front_m = x + 0.5 * length_m
        edges, at_m = "beside after", front_m - ramp.begin_m
        if at_m < 0.0:
            edges, at_m = f"{'before' if lane else 'ramp'} {edges}", front_m + ROOM_M
            # There the main road has one lane less.
            lane = max(lane - 1, 0)
        lines.append(vehicle_type(f"type{slot}", desired_mps, keys.PHYSICS_STEP_S))
        lines.append(
            f'<vehicle id="{slot}" type="type{slot}" depart="0" departLane="{lane}" '
            f'departPos="{at_m}" departSpeed="{min(speed_mps, desired_mps)}" '
            f'insertionChecks="none"><route edges="{edges}"/></vehicle>'
        )
    (folder / "routes.xml").write_text("<routes>\n" + "\n".join(lines) + "\n</routes>\n")


class OnRamp:
    """``env=on_ramp`` in SUMO, one environment: an ego and the drivers around it."""

    def __init__(self) -> None:
        import libsumo

        env: HighwayEnv = ganlane.make_env(env="on_ramp", seed=SEED).base_env
        self.episode = env.episode
        self.sumo: Any = libsumo
        # SUMO reads its files when it starts, and the state at every reset.
        self._folder = tempfile.TemporaryDirectory()
        folder = Path(self._folder.name)
        build_road(folder, env)
        write_vehicles(folder, env)
        if libsumo.isLoaded():
            libsumo.close()
        libsumo.start([*sumo_command(folder, keys.PHYSICS_STEP_S), "--seed", str(SEED)])
        libsumo.simulationStep()
        self._start = str(folder / "start.xml")
        libsumo.simulation.saveState(self._start)
        self._started_s = libsumo.simulation.getTime()
        self.reset()

    def reset(self) -> None:
        """The first scene again; the ego changes lanes when told to only."""
        self.sumo.simulation.loadState(self._start)
        self.sumo.vehicle.setLaneChangeMode(EGO, ASKED_ONLY)

    def step(self, action: int) -> None:
        """A decision; a reset after its end, as the other peers have it."""
        if action != keys.KEEP:
            aside = 1 if action == keys.LEFT else -1
            self.sumo.vehicle.changeLaneRelative(EGO, aside, 1.0)
        for _ in range(STEPS):
            self.sumo.simulationStep()
        driven_s = self.sumo.simulation.getTime() - self._started_s
        at_goal = self.sumo.vehicle.getDistance(EGO) > self.episode.goal_m
        if at_goal or driven_s > self.episode.timeout_s:
            self.reset()


def start_on_ramp(keep: bool = False) -> Runner:
    """SUMO's on-ramp: random actions, or the lane is kept."""
    ramp = OnRamp()
    random = np.random.default_rng(SEED)

    def run(decisions: int) -> int:
        for action in random.integers(3, size=decisions).tolist():
            ramp.step(keys.KEEP if keep else action)
        return decisions * STEPS

    return run
