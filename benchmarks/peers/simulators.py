"""The scene in ganlane, HighwayEnv and SUMO: the same drivers, with what has to be set for that.

**ganlane**: the traffic module that the package ships, in float64, on one lane.

**HighwayEnv** (1.10 to 1.12): its own IDM vehicles on its own road.

- ``COMFORT_ACC_MAX``, ``COMFORT_ACC_MIN`` (negative), ``TIME_WANTED``, ``DELTA`` and
  ``DISTANCE_WANTED`` are Table V. ``DISTANCE_WANTED`` is from centre to centre and so includes a
  length.
- ``ACC_MAX`` (6 m/s2) bounds the acceleration both ways; here Table V's 20 m/s2.
- ``target_speed`` is the desired speed, but the lane's ``speed_limit`` (20 or 30 m/s by default)
  cuts it.
- Lane changes are off; the step is 0.1 s rather than the environments' 1/15 s.

**SUMO** (1.20 to 1.28): ``carFollowModel`` IDM through libsumo.

- ``accel``, ``decel`` (the comfortable one), ``tau``, ``minGap`` and ``delta`` are Table V;
  ``emergencyDecel`` is its hardest braking. ``maxSpeed`` is the desired speed, as long as the lane
  allows it and ``speedFactor`` is 1.
- ``stepping`` (0.25 s by default) is the step within a step; at the step itself (0.1 s) IDM is
  evaluated once a step, as elsewhere.
- ``sigma`` and ``speedDev`` are 0; vehicles enter without checks (``insertionChecks="none"``).
- The prescribed leader is driven by ``setSpeed`` with all checks off (speed mode 0).
"""

from __future__ import annotations

import importlib.metadata
import math
import platform
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.peers.scene import (
    DESIRED_SPEED_MPS,
    LAW,
    LENGTH_M,
    ROAD_M,
    Law,
    Scene,
    Scheme,
    Trace,
)
from ganlane._version import __version__
from ganlane.errors import UserError
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import TABLE_V
from ganlane.sim.state import Road, Vehicles, Visibility
from ganlane.traffic.idm_mobil import IdmTraffic
from ganlane_simulators.sumo_roads import sumo_command


def vehicles_of(scene: Scene) -> Vehicles:
    """The first moment of ``scene`` as one row of vehicles on the centre of lane 0."""
    speed = torch.tensor([scene.speeds_mps], dtype=torch.float64)
    zero, whole = torch.zeros_like(speed), torch.zeros_like(speed, dtype=torch.int64)
    return Vehicles(
        x=torch.tensor(scene.positions_m())[None],
        y=zero,
        heading=zero,
        speed=speed,
        acceleration=zero,
        length=zero + LENGTH_M,
        width=zero + 2.5,
        desired_speed=zero + DESIRED_SPEED_MPS,
        target_lane=whole,
        visibility=whole + int(Visibility.BODY),
        valid=whole == 0,
    )


def led(before: Vehicles, moved: Vehicles, leader_mps: float) -> Vehicles:
    """``moved`` with the foremost at its prescribed speed, at constant acceleration within the
    step.
    """
    first = before.at(0)
    x = first.x + 0.5 * PHYSICS_STEP_S * (first.speed + leader_mps)
    leader = moved.at(0).with_(speed=torch.full_like(x, leader_mps), x=x)
    return moved.with_first(leader)


def drive_ours(scene: Scene) -> Trace:
    """Drive ``scene`` with :class:`~ganlane.traffic.idm_mobil.IdmTraffic` as it stands."""
    traffic = IdmTraffic(Road(lanes=1))
    vehicles = vehicles_of(scene)
    key = torch.zeros(1, dtype=torch.int64)
    memory = traffic.fresh_memory(vehicles, key)
    driven = [vehicles]
    leader = scene.leader_speeds()
    for step in range(scene.steps()):
        moved, memory = traffic.move(vehicles, memory, key, key + step)
        if leader is not None:
            moved = led(vehicles, moved, leader[step + 1])
        vehicles = moved
        driven.append(vehicles)
    speeds, positions = (
        torch.cat([getattr(moment, name) for moment in driven]).numpy() for name in ("speed", "x")
    )
    return Trace(speeds, positions)


def highway_env_road(scene: Scene, offset_m: float) -> Any:
    """A HighwayEnv road with the vehicles of ``scene``, the foremost first, each drawn forward by
    :func:`squeeze`.
    """
    from highway_env.road.road import Road, RoadNetwork
    from highway_env.vehicle.behavior import IDMVehicle
    from highway_env.vehicle.kinematics import Vehicle

    class Driver(IDMVehicle):
        LENGTH = LENGTH_M
        ACC_MAX = -TABLE_V.min_acceleration
        COMFORT_ACC_MAX = TABLE_V.max_acceleration
        COMFORT_ACC_MIN = -TABLE_V.comfortable_deceleration
        DISTANCE_WANTED = TABLE_V.min_gap_m + offset_m
        TIME_WANTED = TABLE_V.headway_s
        DELTA = 4.0

    limit_mps = 2.0 * DESIRED_SPEED_MPS
    network = RoadNetwork.straight_road_network(lanes=1, length=ROAD_M, speed_limit=limit_mps)
    road = Road(network, np_random=np.random.RandomState(0))
    free = {"target_speed": DESIRED_SPEED_MPS, "enable_lane_change": False, "timer": 1.0}
    squeezed = scene.positions_m() + squeeze(scene, offset_m)
    for rank, (x, speed) in enumerate(zip(squeezed, scene.speeds_mps)):
        is_led = rank == 0 and scene.leader
        kind, more = (Vehicle, {}) if is_led else (Driver, free)
        vehicle = kind(road, [x, 0.0], speed=speed, **more)
        # Its crash physics would push the points apart that stand for bodies.
        vehicle.check_collisions = offset_m > 0.0
        road.vehicles.append(vehicle)
    return road


def squeeze(scene: Scene, offset_m: float) -> np.ndarray:
    """How far forward each vehicle is drawn, m, [M].

    HighwayEnv's distances are those of centres: to be the net gaps (plus ``offset_m``), centres
    have to be as far apart as bumpers should be.
    """
    return np.arange(len(scene.speeds_mps)) * (LENGTH_M - offset_m)


def drive_highway_env(scene: Scene, offset_m: float = 0.0, dt: float = PHYSICS_STEP_S) -> Trace:
    """Drive ``scene`` with HighwayEnv at steps of ``dt`` seconds.

    Its drivers take the net gap plus ``offset_m`` for the distance to their leader, and as much
    more for their minimum gap: 0 for points instead of bodies, as far apart as the bumpers are; the
    length of a vehicle for HighwayEnv as it comes. Positions in the trace are the bodies' centres.
    """
    road = highway_env_road(scene, offset_m)
    leader = scene.leader_speeds(dt)
    speeds, positions = [], []
    for step in range(scene.steps(dt) + 1):
        if step:
            road.act()
            if leader is not None:
                pushed = (leader[step] - leader[step - 1]) / dt
                road.vehicles[0].act({"steering": 0.0, "acceleration": pushed})
            road.step(dt)
        speeds.append([vehicle.speed for vehicle in road.vehicles])
        positions.append([vehicle.position[0] for vehicle in road.vehicles])
    return Trace(np.array(speeds), np.array(positions) - squeeze(scene, offset_m))


#: SUMO's own ``stepping``, for steps longer than that.
DEFAULT_STEPPING_S = 0.25
#: One lane from a dead end to a dead end; its speed limit is out of everybody's way.
NETWORK = f"""<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,{ROAD_M},0" origBoundary="0,0,{ROAD_M},0"
    projParameter="!"/>
  <edge id="road" from="start" to="end">
    <lane id="road_0" index="0" speed="{2 * DESIRED_SPEED_MPS}" length="{ROAD_M}"
      shape="0,0 {ROAD_M},0"/>
  </edge>
  <junction id="start" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0"/>
  <junction id="end" type="dead_end" x="{ROAD_M}" y="0" incLanes="road_0" intLanes=""
    shape="{ROAD_M},0"/>
</net>
"""


def vehicle_type(name: str, max_speed_mps: float, dt: float) -> str:
    """A ``vType`` of Table V's drivers."""
    p = TABLE_V
    return (
        f'<vType id="{name}" carFollowModel="IDM" length="{LENGTH_M}" minGap="{p.min_gap_m}" '
        f'tau="{p.headway_s}" accel="{p.max_acceleration}" decel="{p.comfortable_deceleration}" '
        f'emergencyDecel="{-p.min_acceleration}" '
        f'delta="4" stepping="{min(dt, DEFAULT_STEPPING_S)}" '
        f'sigma="0" speedFactor="1" speedDev="0" maxSpeed="{max_speed_mps}"/>'
    )


def demand(scene: Scene, dt: float) -> str:
    """The route file.

    Everybody on the road from the first step, front bumpers half a length ahead of the centres.
    """
    limits = {"leader": 2 * DESIRED_SPEED_MPS, "driver": DESIRED_SPEED_MPS}
    lines = [vehicle_type(name, limit, dt) for name, limit in limits.items()]
    lines.append('<route id="all" edges="road"/>')
    for rank, (x, speed) in enumerate(zip(scene.positions_m().tolist(), scene.speeds_mps)):
        kind = "leader" if rank == 0 and scene.leader else "driver"
        lines.append(
            f'<vehicle id="{rank}" type="{kind}" route="all" depart="0" '
            f'departPos="{x + 0.5 * LENGTH_M!r}" departSpeed="{speed!r}" insertionChecks="none"/>'
        )
    return "<routes>\n" + "\n".join(lines) + "\n</routes>\n"


def drive_sumo(scene: Scene, ballistic: bool = True, dt: float = PHYSICS_STEP_S) -> Trace:
    """Drive ``scene`` with SUMO at steps of ``dt`` seconds; positions in the trace are the bodies'
    centres.

    Raises:
        UserError: a vehicle is missing, so the trace would not be that of the scene.
    """
    import libsumo

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "net.xml").write_text(NETWORK)
        (folder / "routes.xml").write_text(demand(scene, dt))
        libsumo.start(sumo_command(folder, dt, ballistic))
        try:
            return _run_sumo(libsumo, scene, dt)
        finally:
            libsumo.close()


def _run_sumo(libsumo: Any, scene: Scene, dt: float) -> Trace:
    """Step the loaded simulation and record it. SUMO inserts at the end of its first step.

    That is the start.
    """
    leader = scene.leader_speeds(dt)
    libsumo.simulationStep()
    names = [str(rank) for rank in range(len(scene.speeds_mps))]
    if sorted(libsumo.vehicle.getIDList()) != names:
        raise UserError(
            f"SUMO put {libsumo.vehicle.getIDList()} on the road; expected the vehicles {names}."
        )
    if leader is not None:
        libsumo.vehicle.setSpeedMode("0", 0)
    speeds, positions = [], []
    for step in range(scene.steps(dt) + 1):
        if step:
            if leader is not None:
                libsumo.vehicle.setSpeed("0", leader[step])
            libsumo.simulationStep()
        speeds.append([libsumo.vehicle.getSpeed(vehicle) for vehicle in names])
        positions.append([libsumo.vehicle.getLanePosition(vehicle) for vehicle in names])
    return Trace(np.array(speeds), np.array(positions) - 0.5 * LENGTH_M)


class Peer(NamedTuple):
    """A simulator as it is set up here: how it drives a scene, integrates, and reads IDM.

    ``module`` is imported for it.
    """

    name: str
    module: str
    drive: Callable[..., Trace]
    scheme: Scheme
    law: Law


OURS = Peer("ganlane", "ganlane", drive_ours, Scheme.BALLISTIC, LAW)
#: HighwayEnv neither floors the desired gap nor the speed, and sees nobody on an empty road.
_HIGHWAY_ENV = Law(floored=False, reverses=True, free_gap_m=math.inf)
_SUMO = Law(free_gap_m=math.inf)
PEERS = (
    Peer("HighwayEnv", "highway_env", drive_highway_env, Scheme.EXPLICIT_EULER, _HIGHWAY_ENV),
    Peer(
        "HighwayEnv, centres",
        "highway_env",
        partial(drive_highway_env, offset_m=LENGTH_M),
        Scheme.EXPLICIT_EULER,
        replace(_HIGHWAY_ENV, offset_m=LENGTH_M),
    ),
    Peer("SUMO, ballistic", "libsumo", drive_sumo, Scheme.BALLISTIC, _SUMO),
    Peer(
        "SUMO, Euler",
        "libsumo",
        partial(drive_sumo, ballistic=False),
        Scheme.SEMI_IMPLICIT_EULER,
        _SUMO,
    ),
)
PACKAGES = ("highway-env", "eclipse-sumo", "libsumo", "torch", "numpy")


def require_peers() -> None:
    """Say what to install where a peer is missing.

    Raises:
        UserError: HighwayEnv or SUMO is not installed.
    """
    missing = sorted({peer.module for peer in PEERS if find_spec(peer.module) is None})
    if missing:
        raise UserError(
            f"{', '.join(missing)}: not installed; pip install 'ganlane[bench]' brings the peers."
        )


def versions() -> dict[str, str]:
    """Versions of everything that the figures depend on."""
    ours = {"ganlane": __version__, "python": platform.python_version()}
    return ours | {name: importlib.metadata.version(name) for name in PACKAGES}
