"""N highways side by side in one SUMO simulation: roads, drivers, stand-ins for the egos.

libsumo holds one simulation per process. All highways are edges of the same network, each between
dead ends of its own, at the same coordinates, so that a vehicle's numbers do not depend on which of
them it drives on.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ganlane.errors import UserError
from ganlane.keys import PHYSICS_STEP_S

Array = NDArray[np.float64]

#: Where x = 0 lies on SUMO's edges, m, and how far they go on from there: 1000 s at 35 m/s and
#: more.
ORIGIN_M = 2_000.0
LENGTH_M = 60_000.0
#: Speed limit of every lane, m/s. Drivers have a speed factor: their desired speed is a multiple of
#: it.
LIMIT_MPS = 25.0


def import_libsumo() -> Any:
    """The module ``libsumo``; :class:`UserError` where it is not installed."""
    try:
        import libsumo
    except ModuleNotFoundError as error:
        raise UserError(
            f"traffic sumo: libsumo is not installed ({error}); pip install 'ganlane[sumo]' "
            "brings it."
        ) from error
    return libsumo


class SumoDriver(NamedTuple):
    """One driver of SUMO's Krauss model: m, s, m/s2; ``desired_speed`` in m/s."""

    desired_speed: float
    length: float
    width: float
    tau: float
    accel: float
    decel: float
    min_gap: float
    emergency_decel: float


class Place(NamedTuple):
    """Where a body is put: lane, position of its centre along the road (m), speed (m/s)."""

    lane: int
    x: float
    speed: float


class SumoRoads:
    """The simulation of ``rows`` highways. Only the one that was opened last exists.

    Args:
        rows: number of highways.
        lanes, lane_width_m: of each.
        change_s: how long a lane change takes (``lanechange.duration``).
        keep_right: LC2013's ``lcKeepRight``; 1 as it comes, 0 for drivers who stay where they are.

    Raises:
        UserError: libsumo is not installed, or holds a simulation that is not ours.
    """

    #: The one whose simulation libsumo holds.
    _current: SumoRoads | None = None

    def __init__(
        self,
        rows: int,
        lanes: int,
        lane_width_m: float,
        change_s: float,
        keep_right: float,
    ) -> None:
        self.libsumo = import_libsumo()
        if SumoRoads._current is not None:
            SumoRoads._current = None
            self.libsumo.close()
        elif self.libsumo.isLoaded():
            raise UserError(
                "traffic sumo: libsumo already runs a simulation that is not ours, and a process "
                "has one; close it (libsumo.close()) or start another process."
            )
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "net.xml").write_text(_network(rows, lanes, lane_width_m))
            (folder / "routes.xml").write_text(_routes(rows, keep_right))
            command = sumo_command(folder, PHYSICS_STEP_S)
            self.libsumo.start([*command, f"--lanechange.duration={change_s}"])
        SumoRoads._current = self
        self._serial = 0
        #: Names of the others [row][index]; empty where there is no vehicle (any more).
        self.names: list[list[str]] = [[] for _ in range(rows)]
        self._drivers: list[list[SumoDriver | None]] = [[] for _ in range(rows)]
        self._stand_ins: list[dict[int, str]] = [{} for _ in range(rows)]

    @property
    def is_open(self) -> bool:
        """Whether libsumo still holds this simulation."""
        return SumoRoads._current is self

    def clear(self, row: int) -> None:
        """Take everybody off a highway."""
        for name in (
            *self.names[row],
            *self._stand_ins[row].values(),
        ):
            if name:
                self.libsumo.vehicle.remove(name)
        self.names[row], self._stand_ins[row] = [], {}

    def fill(
        self,
        row: int,
        drivers: Sequence[SumoDriver | None],
        places: Sequence[Place],
    ) -> None:
        """Put the others of a new episode onto an empty highway; None: nobody has this index."""
        self._drivers[row] = list(drivers)
        for driver, place in zip(drivers, places):
            self.names[row].append(self._add(row, driver, place) if driver else "")

    def _add(
        self,
        row: int,
        driver: SumoDriver,
        place: Place,
    ) -> str:
        """A new vehicle, on the road at once; its name."""
        self._serial += 1
        name = f"{row}.{self._serial}"
        vehicle = self.libsumo.vehicle
        vehicle.add(name, _edge(row), "driver", depart="now", departLane="0")
        vehicle.setLength(name, driver.length)
        vehicle.setWidth(name, driver.width)
        vehicle.setSpeedFactor(name, driver.desired_speed / LIMIT_MPS)
        vehicle.setTau(name, driver.tau)
        vehicle.setAccel(name, driver.accel)
        vehicle.setDecel(name, driver.decel)
        vehicle.setEmergencyDecel(name, driver.emergency_decel)
        vehicle.setApparentDecel(name, driver.decel)
        vehicle.setMinGap(name, driver.min_gap)
        vehicle.moveTo(
            name,
            f"{_edge(row)}_{place.lane}",
            place.x + 0.5 * driver.length + ORIGIN_M,
        )
        vehicle.setPreviousSpeed(name, place.speed)
        return name

    def replace(
        self,
        row: int,
        index: int,
        place: Place,
    ) -> None:
        """Put one of the others somewhere else: a new vehicle of the same driver.

        SUMO's own move leaves traces.
        """
        driver = self._drivers[row][index]
        if driver and self.names[row][index]:
            self.libsumo.vehicle.remove(self.names[row][index])
            self.names[row][index] = self._add(row, driver, place)

    def set_desired_speed(self, name: str, speed: float) -> None:
        """m/s."""
        self.libsumo.vehicle.setSpeedFactor(name, speed / LIMIT_MPS)

    def lead_ego(
        self,
        row: int,
        lanes: range,
        ego: SumoDriver,
        place: Place,
        next_x: float,
    ) -> None:
        """Have stand-ins in ``lanes`` that will be at ``next_x`` (m) at the end of the coming step.

        One per lane in which the others see the ego: SUMO's drivers see a vehicle in one lane only.
        Each stays in its lane. One that is needed no longer is taken off the road; parked, or led
        along, it would disturb the order of a lane. ``place`` is where the ego is now; its lane
        does not matter.
        """
        stand_ins = self._stand_ins[row]
        vehicle = self.libsumo.vehicle
        for lane in set(stand_ins) - set(lanes):
            vehicle.remove(stand_ins.pop(lane))
        for lane in lanes:
            if lane not in stand_ins:
                name = stand_ins[lane] = self._add(row, ego, place._replace(lane=lane))
                # Neither safe speeds nor lane changes of its own.
                vehicle.setSpeedMode(name, 0)
                vehicle.setLaneChangeMode(name, 0)
            name = stand_ins[lane]
            # SUMO's ballistic step moves it by the mean of old and new speed.
            now = vehicle.getLanePosition(name) - 0.5 * ego.length - ORIGIN_M
            vehicle.setPreviousSpeed(name, place.speed)
            vehicle.setSpeed(
                name,
                max(
                    2.0 * (next_x - now) / PHYSICS_STEP_S - place.speed,
                    0.0,
                ),
            )

    def step(self) -> None:
        """Drive on by 0.1 s; who has come to the end of the road is gone."""
        self.libsumo.simulationStep()
        for name in self.libsumo.simulation.getArrivedIDList():
            row = int(name.split(".")[0])
            if name in self.names[row]:
                self.names[row][self.names[row].index(name)] = ""

    def read(
        self,
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
        """Everybody who is there.

        Row, index among the others, (x of the front bumper, y) in m, speed in m/s.
        """
        names = []
        places = []
        for row, names_of_row in enumerate(self.names):
            for index, name in enumerate(names_of_row):
                if name:
                    names.append(name)
                    places.append((row, index))
        vehicle = self.libsumo.vehicle
        xy = np.array([vehicle.getPosition(name) for name in names]).reshape(-1, 2)
        xy[:, 0] -= ORIGIN_M
        speeds = np.array([vehicle.getSpeed(name) for name in names])
        at = np.array(places, dtype=np.int64).reshape(-1, 2)
        return at[:, 0], at[:, 1], xy, speeds


def _edge(row: int) -> str:
    return f"h{row}"


def _network(
    rows: int,
    lanes: int,
    width: float,
) -> str:
    """The net file: lane 0 on the right, its centre at y = 0, as ours."""
    end = ORIGIN_M + LENGTH_M
    parts = []
    for row in range(rows):
        name = _edge(row)
        lane_names = []
        shapes = []
        for lane in range(lanes):
            lane_name = f"{name}_{lane}"
            y = lane * width
            lane_names.append(lane_name)
            shapes.append(
                f'<lane id="{lane_name}" index="{lane}" speed="{LIMIT_MPS}" length="{end}" '
                f'width="{width}" shape="0,{y} {end},{y}"/>'
            )
        parts.append(
            f'<edge id="{name}" from="{name}a" to="{name}b" priority="1">{"".join(shapes)}</edge>'
        )
        for side, x, inward in (
            ("a", 0.0, ""),
            ("b", end, " ".join(lane_names)),
        ):
            parts.append(
                f'<junction id="{name}{side}" type="dead_end" x="{x}" y="0" incLanes="{inward}" '
                f'intLanes="" shape="{x},0"/>'
            )
    # SUMO wants all edges before the junctions.
    parts.sort(key=lambda part: part.startswith("<junction"))
    box = f"0,0,{end},{lanes * width}"
    return (
        f'<net version="1.20"><location netOffset="0,0" convBoundary="{box}" origBoundary="{box}" '
        f'projParameter="!"/>{"".join(parts)}</net>'
    )


def _routes(rows: int, keep_right: float) -> str:
    """The route file: one route per highway, and one type of driver.

    The type's numbers are set vehicle by vehicle.
    """
    routes = "".join(f'<route id="{_edge(row)}" edges="{_edge(row)}"/>' for row in range(rows))
    return (
        '<routes><vType id="driver" carFollowModel="Krauss" laneChangeModel="LC2013" sigma="0" '
        f'speedDev="0" maxSpeed="70" lcKeepRight="{keep_right}"/>{routes}</routes>'
    )


def sumo_command(folder: Path, step_s: float, ballistic: bool = True) -> list[str]:
    """SUMO's command line for ``net.xml`` and ``routes.xml`` in ``folder``.

    No vehicle is removed for standing still or for a crash.
    """
    options = {
        "net-file": folder / "net.xml",
        "route-files": folder / "routes.xml",
        "step-length": step_s,
        "step-method.ballistic": str(ballistic).lower(),
        "default.speeddev": 0,
        "collision.action": "none",
        "time-to-teleport": -1,
        "xml-validation": "never",
        "no-step-log": "true",
        "duration-log.disable": "true",
        "no-warnings": "true",
    }
    return ["sumo", *(f"--{name}={value}" for name, value in options.items())]
