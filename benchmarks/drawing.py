"""How fast frames of an episode are drawn: frames/s on one core, MOBIL with 8 others on three lanes.

    OMP_NUM_THREADS=1 python benchmarks/drawing.py
    OMP_NUM_THREADS=1 python benchmarks/drawing.py --width 1920 --height 480
    python benchmarks/drawing.py --profile

Prints the median and the best of the rounds, by the clock and by CPU time. Drawing runs in one thread: on an idle
core the two agree; on a busy machine the clock also counts the time that others had.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import statistics
import time

import torch

from ganlane.build import make_driver, make_env, make_traffic
from ganlane.config.env import EnvConfig
from ganlane.config.traffic import IdmMobilTrafficConfig
from ganlane.sim.random import Stream
from ganlane.view import FramePainter, Trajectory, WindowParameters, record_episode


def episode(length_s: float, number: int = 2) -> Trajectory:
    """The first ``length_s`` seconds of an episode of ``ganlane render agent=mobil traffic=idm_mobil``."""
    config = EnvConfig()
    env = make_env(make_traffic(IdmMobilTrafficConfig(), config, Stream.REPORT), config)
    return record_episode(env, make_driver("mobil", config).policy, 0, number, "mobil", "idm_mobil", length_s)


def rounds(painter: FramePainter, frames: int, count: int) -> tuple[list[float], list[float]]:
    """Frames per second of each round, and frames per second of CPU time; no frame is drawn twice."""
    by_clock, by_cpu = [], []
    for each in range(count):
        drawn = range(1 + each * frames, 1 + (each + 1) * frames)
        start, start_cpu = time.perf_counter(), time.process_time()
        for frame in drawn:
            painter.draw(frame)
        by_clock.append(frames / (time.perf_counter() - start))
        by_cpu.append(frames / (time.process_time() - start_cpu))
    return by_clock, by_cpu


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=320)
    parser.add_argument("--frames", type=int, default=80, help="per round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--profile", action="store_true", help="where the time goes")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    trajectory = episode(0.1 * (arguments.frames * arguments.rounds + 1))
    if len(trajectory) <= arguments.frames * arguments.rounds:
        parser.error(f"the episode has {len(trajectory)} frames, one of them for warming up; ask for fewer in all")
    painter = FramePainter(trajectory, WindowParameters(arguments.width, arguments.height))
    painter.draw(0)
    if arguments.profile:
        with cProfile.Profile() as profile:
            rounds(painter, arguments.frames, 1)
        pstats.Stats(profile).sort_stats("tottime").print_stats(20)
        return
    print(f"{arguments.width} x {arguments.height}, {trajectory.vehicles} vehicles, {arguments.rounds} rounds")
    for unit, found in zip(("s", "CPU-s"), rounds(painter, arguments.frames, arguments.rounds)):
        print(f"{statistics.median(found):.0f} frames/{unit} (best {max(found):.0f})")


if __name__ == "__main__":
    main()
