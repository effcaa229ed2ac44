"""``suite=sim``: how fast the simulator is, how its cost grows, what it holds in memory, and how a peer compares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from ganlane.benchmarks.case import COMPILED, EAGER, Case, Group, Labels, Row, Runner
from ganlane.benchmarks.memory import bytes_of, growth_per_environment
from ganlane.benchmarks.peers import MISSING, highway_env_case, highway_env_version
from ganlane.benchmarks.sim_findings import ENVIRONMENT, PHYSICS, ratios, scaling
from ganlane.benchmarks.sim_tables import sim_tables
from ganlane.benchmarks.systems import (
    Scenario,
    first_state,
    start_environment,
    start_physics,
)
from ganlane.benchmarks.tables import Table
from ganlane.build import make_traffic
from ganlane.config.env import DenseEnvConfig, EnvConfig

_START: dict[str, Any] = {PHYSICS: start_physics, ENVIRONMENT: start_environment}


@dataclass(frozen=True)
class SimOptions:
    """What to measure.

    ``scenario`` is the road and what surrounds it. ``batches`` are run for speed, and those from ``linear_from`` on
    once more side by side for the growth with the batch; ``vehicle_counts`` for the growth with the vehicles, at
    ``scaling_batch``. ``memory_batches``: two sizes between which memory per environment is measured. ``peers`` and
    ``memory`` switch HighwayEnv and every measurement in a fresh process on and off.
    """

    scenario: Scenario
    batches: tuple[int, ...] = (1, 16, 64, 256, 1024, 4096, 16384)
    modes: tuple[str, ...] = (EAGER, COMPILED)
    threads: tuple[int, ...] = (1, 2)
    devices: tuple[str, ...] = ("cpu",)
    vehicle_counts: tuple[int, ...] = (9, 15, 30, 60)
    scaling_batch: int = 1024
    linear_from: int = 1024
    memory_batches: tuple[int, int] = (1024, 4096)
    peers: bool = True
    memory: bool = True


class SimSuite:
    """See :class:`ganlane.benchmarks.case.Suite`."""

    name = "sim"

    def __init__(self, options: SimOptions) -> None:
        self.notes: list[str] = []
        self.memory = options.memory
        recycle = not make_traffic(options.scenario.traffic, options.scenario.env).own_roads
        env = replace(options.scenario.env, recycle=recycle)
        self.options = replace(options, scenario=replace(options.scenario, env=env))
        if not recycle:
            self.notes.append("Not recycled: recorded vehicles go where they went, so the road empties.")
        self.has_peer = options.peers and highway_env_version() is not None
        if options.peers and not self.has_peer:
            self.notes.append(MISSING)
        if not self._grows():
            self.notes.append("Not measured: growth with the vehicles; their number belongs to the scene.")

    # What is timed

    def groups(self) -> list[Group]:
        """Speed at every batch, then the two questions of growth."""
        return [*self._speed(), *self._growth()]

    def _speed(self) -> list[Group]:
        chosen = self.options
        # A GPU's work does not depend on the host's threads.
        places = [("cpu", n) for n in chosen.threads] if "cpu" in chosen.devices else []
        places += [(device, chosen.threads[0]) for device in chosen.devices if device != "cpu"]
        return [self._speed_group(*place, batch) for place in places for batch in chosen.batches]

    def _speed_group(self, device: str, threads: int, batch: int) -> Group:
        cases = [
            self._case("speed", system, mode, device, threads, batch)
            for system in _START
            for mode in self.options.modes
        ]
        title = f"{device}, threads {threads}, batch {batch}"
        return Group(title, threads, cases, self._reference() if self.has_peer else None)

    def _reference(self) -> Case:
        return highway_env_case(self.name, "speed", self.options.scenario.env, self.options.scenario.seed)

    def _growth(self) -> list[Group]:
        """Eager, on the CPU if it is among the devices, sizes side by side."""
        chosen = self.options
        device, threads = chosen.devices[0], chosen.threads[0]
        large = [batch for batch in chosen.batches if batch >= chosen.linear_from]
        counts = chosen.vehicle_counts if self._grows() else ()
        groups = []
        for system in _START:
            batches = [self._case("batch", system, EAGER, device, threads, batch) for batch in large]
            vehicles = [
                self._case("vehicles", system, EAGER, device, threads, chosen.scaling_batch, self._dense(number))
                for number in counts
            ]
            groups += [Group(f"{system}, growth with the batch", threads, batches)] if len(large) > 1 else []
            groups += [Group(f"{system}, growth with the vehicles", threads, vehicles)] if len(vehicles) > 1 else []
        return groups

    def _grows(self) -> bool:
        """Whether the number of vehicles is free; a scene set by hand has as many as it has."""
        return type(self.options.scenario.env) in (EnvConfig, DenseEnvConfig)

    def _dense(self, vehicles: int) -> Scenario:
        """So many vehicles at the density of Table II."""
        env = self.options.scenario.env
        spread_m = max(env.spread_m, DenseEnvConfig().metres_per_vehicle * vehicles)
        return replace(self.options.scenario, env=replace(env, vehicles=vehicles, spread_m=spread_m))

    def _case(
        self,
        part: str,
        system: str,
        mode: str,
        device: str,
        threads: int,
        batch: int,
        scenario: Scenario | None = None,
    ) -> Case:
        scenario = scenario or self.options.scenario
        labels = Labels(
            suite=self.name,
            part=part,
            system=system,
            traffic=scenario.traffic.label(),
            mode=mode,
            dtype="float32",
            device=device,
            threads=threads,
            vehicles=scenario.env.vehicles,
            lanes=scenario.env.lanes,
            batch=batch,
        )
        start: partial[Runner] = partial(_START[system], scenario, mode, device, batch)
        return Case(labels, start)

    # What follows

    def findings(self, rows: Sequence[Row]) -> dict[str, Any]:
        """``ratios`` to the peer, ``scaling`` with batch and vehicles, ``memory`` per environment."""
        return {"ratios": ratios(rows), "scaling": scaling(rows), "memory": self._memory()}

    def _memory(self) -> dict[str, Any]:
        """Bytes per environment: of the state, and of a process's peak as the batch grows."""
        scenario, batches = self.options.scenario, self.options.memory_batches
        found: dict[str, Any] = {
            "vehicles": scenario.env.vehicles,
            "state_bytes": bytes_of(first_state(scenario, 2)) / 2,
            "batches": list(batches),
            "peak_growth_bytes": None,
        }
        if self.options.memory:
            small, large = (self._case("memory", ENVIRONMENT, EAGER, "cpu", 1, batch) for batch in batches)
            found["peak_growth_bytes"] = growth_per_environment(small, large)
        return found

    def tables(self, rows: Sequence[Row], findings: Mapping[str, Any]) -> list[Table]:
        """For a reader."""
        return sim_tables(rows, findings)
