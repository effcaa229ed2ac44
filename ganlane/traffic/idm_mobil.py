"""Rule-driven traffic: IDM along the road, MOBIL or no lane changes, steered like the ego."""

from __future__ import annotations

import torch
from torch import Tensor

from ganlane.parameters.driving import IdmParameters, MobilParameters
from ganlane.sim.dynamics import STEERING, SteeringParameters, advance, steer
from ganlane.sim.idm import TABLE_V, following_acceleration
from ganlane.sim.mobil import TABLE_IV, mobil_changes
from ganlane.sim.neighbours import Scene, perceive
from ganlane.sim.random import Stream
from ganlane.sim.state import Road, Vehicles
from ganlane.torch_settings import compiled
from ganlane.traffic.base import Memory, Moved, TrafficModule

#: MOBIL decides once a second of simulated time, whatever the ego's decision period.
MOBIL_PERIOD_STEPS = 10


class IdmTraffic(TrafficModule):
    """``traffic=idm``: all keep their lanes (the paper's Traffic_IDM, 'without complex decisions').

    Memory: the steering angle of each vehicle, rad.
    """

    memory_fields = {"steering": ((), None)}  # noqa: RUF012

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        idm: IdmParameters = TABLE_V,
        steering: SteeringParameters = STEERING,
    ) -> None:
        super().__init__(road, stream)
        self.idm, self.steering = idm, steering

    def fresh_memory(self, vehicles: Vehicles, key: Tensor) -> Memory:
        """Steering angle 0."""
        return {"steering": torch.zeros_like(vehicles.x)}

    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """Accelerate, steer, advance."""
        return self.drive(perceive(vehicles, self.road), vehicles.target_lane, memory)

    def drive(self, scene: Scene, target: Tensor, memory: Memory) -> Moved:
        """The vehicles at t + 0.1 s, steered to the lanes ``target`` [N, M] int64."""
        v, acceleration = scene.vehicles, following_acceleration(scene, self.idm)
        centre = self.road.centre_of(target, v.y.dtype)
        steering = steer(memory["steering"], v.y, v.heading, v.speed, centre, self.dt, self.steering)
        pose = advance(v.x, v.y, v.heading, v.speed, acceleration, steering, self.dt)
        return v.with_(target_lane=target, **pose._asdict()), {"steering": steering}


class IdmMobilTraffic(IdmTraffic):
    """``traffic=idm_mobil``: IDM with MOBIL's lane changes once a second (Tables IV and V)."""

    def __init__(
        self,
        road: Road | None = None,
        stream: int = Stream.TRAIN,
        idm: IdmParameters = TABLE_V,
        steering: SteeringParameters = STEERING,
        mobil: MobilParameters = TABLE_IV,
    ) -> None:
        super().__init__(road, stream, idm, steering)
        self.mobil = mobil

    def move(self, vehicles: Vehicles, memory: Memory, key: Tensor, step: Tensor) -> Moved:
        """As IDM; rows at a full second decide first."""
        due = step % MOBIL_PERIOD_STEPS == 0
        # Reading a flag is cheap on a CPU and saves nine evaluations of ten; on a GPU it would stall the queue.
        if due.device.type == "cpu" and not bool(due.any()):
            return self.keep_lanes(vehicles, memory)
        return self.decide(vehicles, memory, due)

    def keep_lanes(self, vehicles: Vehicles, memory: Memory) -> Moved:
        """A step without decisions."""
        return self.drive(perceive(vehicles, self.road), vehicles.target_lane, memory)

    def decide(self, vehicles: Vehicles, memory: Memory, due: Tensor) -> Moved:
        """A step in which the drivers of the rows ``due`` [N] decide."""
        scene = perceive(vehicles, self.road)
        change = torch.where(due[:, None], mobil_changes(scene, self.road, self.idm, self.mobil), 0)
        return self.drive(scene, vehicles.target_lane + change, memory)

    def compile_graphs(self) -> None:
        """One graph for a step with decisions, one for a step without."""
        self.keep_lanes = compiled(self.keep_lanes)  # type: ignore[method-assign]
        self.decide = compiled(self.decide)  # type: ignore[method-assign]
