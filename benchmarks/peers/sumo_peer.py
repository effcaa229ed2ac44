"""The scene in SUMO: carFollowModel IDM with Table V's parameters, through libsumo.

What has to be set so that the drivers are the same (written against SUMO 1.20 to 1.28):

- ``accel``, ``decel`` (the comfortable one), ``tau``, ``minGap`` and ``delta`` are Table V; ``emergencyDecel`` is its
  hardest braking. ``maxSpeed`` is the desired speed, as long as the lane allows it and ``speedFactor`` is 1.
- ``stepping`` (0.25 s as it comes) is the step within a step; at the step itself (0.1 s) IDM is evaluated once a
  step, as elsewhere.
- ``sigma`` and ``speedDev`` are 0; vehicles enter without checks (``insertionChecks="none"``).
- The prescribed leader is driven by ``setSpeed`` with all checks off (speed mode 0).
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers.scene import DESIRED_SPEED_MPS, LENGTH_M, ROAD_M, Scene, Trace
from ganlane.errors import UserError
from ganlane.keys import PHYSICS_STEP_S
from ganlane.sim.idm import TABLE_V, IdmParameters

#: SUMO's own ``stepping``, for steps longer than that.
DEFAULT_STEPPING_S = 0.25
#: One lane from a dead end to a dead end; its speed limit is out of everybody's way.
NETWORK = f"""<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,{ROAD_M},0" origBoundary="0,0,{ROAD_M},0" projParameter="!"/>
  <edge id="road" from="start" to="end">
    <lane id="road_0" index="0" speed="{2 * DESIRED_SPEED_MPS}" length="{ROAD_M}" shape="0,0 {ROAD_M},0"/>
  </edge>
  <junction id="start" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0"/>
  <junction id="end" type="dead_end" x="{ROAD_M}" y="0" incLanes="road_0" intLanes="" shape="{ROAD_M},0"/>
</net>
"""


def vehicle_type(name: str, max_speed_mps: float, dt: float, p: IdmParameters) -> str:
    """A ``vType`` of drivers with the parameters ``p``."""
    return (
        f'<vType id="{name}" carFollowModel="IDM" length="{LENGTH_M}" minGap="{p.min_gap_m}" tau="{p.headway_s}" '
        f'accel="{p.max_acceleration}" decel="{p.comfortable_deceleration}" emergencyDecel="{-p.min_acceleration}" '
        f'delta="4" stepping="{min(dt, DEFAULT_STEPPING_S)}" '
        f'sigma="0" speedFactor="1" speedDev="0" maxSpeed="{max_speed_mps}"/>'
    )


def demand(scene: Scene, dt: float, idm: IdmParameters) -> str:
    """The route file: everybody on the road from the first step, front bumpers half a length ahead of the centres."""
    limits = {"leader": 2 * DESIRED_SPEED_MPS, "driver": DESIRED_SPEED_MPS}
    lines = [vehicle_type(name, limit, dt, idm) for name, limit in limits.items()]
    lines.append('<route id="all" edges="road"/>')
    for rank, (x, speed) in enumerate(zip(scene.positions_m().tolist(), scene.speeds_mps)):
        kind = "leader" if rank == 0 and scene.leader else "driver"
        lines.append(
            f'<vehicle id="{rank}" type="{kind}" route="all" depart="0" departPos="{x + 0.5 * LENGTH_M!r}" '
            f'departSpeed="{speed!r}" insertionChecks="none"/>'
        )
    return "<routes>\n" + "\n".join(lines) + "\n</routes>\n"


def command(folder: Path, ballistic: bool, dt: float) -> list[str]:
    """SUMO's command line for the files in ``folder``."""
    return [
        *("sumo", "--net-file", str(folder / "net.xml"), "--route-files", str(folder / "routes.xml")),
        *("--step-length", str(dt), "--step-method.ballistic", str(ballistic).lower(), "--default.speeddev", "0"),
        *("--collision.action", "none", "--time-to-teleport", "-1", "--xml-validation", "never"),
        *("--no-step-log", "true", "--duration-log.disable", "true", "--no-warnings", "true"),
    ]


def drive(scene: Scene, ballistic: bool = True, dt: float = PHYSICS_STEP_S, idm: IdmParameters = TABLE_V) -> Trace:
    """Drive ``scene`` with SUMO at steps of ``dt`` seconds; positions in the trace are the bodies' centres.

    Raises:
        UserError: a vehicle is missing, so the trace would not be that of the scene.
    """
    import libsumo

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "net.xml").write_text(NETWORK)
        (folder / "routes.xml").write_text(demand(scene, dt, idm))
        libsumo.start(command(folder, ballistic, dt))
        try:
            return _run(libsumo, scene, dt)
        finally:
            libsumo.close()


def _run(libsumo: Any, scene: Scene, dt: float) -> Trace:
    """Step the loaded simulation and record it. SUMO inserts at the end of its first step: that is the start."""
    leader = scene.leader_speeds(dt) if scene.leader else None
    libsumo.simulationStep()
    names = [str(rank) for rank in range(len(scene.speeds_mps))]
    if sorted(libsumo.vehicle.getIDList()) != names:
        raise UserError(f"SUMO put {libsumo.vehicle.getIDList()} on the road; expected the vehicles {names}.")
    if leader is not None:
        libsumo.vehicle.setSpeedMode("0", 0)
    speeds, positions = [], []
    for step in range(scene.steps(dt) + 1):
        if step and leader is not None:
            libsumo.vehicle.setSpeed("0", leader[step])
        if step:
            libsumo.simulationStep()
        speeds.append([libsumo.vehicle.getSpeed(vehicle) for vehicle in names])
        positions.append([libsumo.vehicle.getLanePosition(vehicle) for vehicle in names])
    return Trace(np.array(speeds), np.array(positions) - 0.5 * LENGTH_M)
