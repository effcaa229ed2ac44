"""How fast frames of an episode are drawn: frames/s on one core, MOBIL with 8 others on three
lanes.

    OMP_NUM_THREADS=1 python -m benchmarks.drawing
    OMP_NUM_THREADS=1 python -m benchmarks.drawing --width 1920 --height 480
    python -m benchmarks.drawing --profile

Prints the median and the best of the rounds, by the clock and by CPU time. Drawing runs in one
thread: on an idle core the two agree; on a busy machine the clock also counts the time that others
had.
"""

from __future__ import annotations

import argparse
import cProfile
import io
import pstats
import statistics
import sys
import time
from collections.abc import Sequence

from benchmarks.script import make_parser, run_script
from ganlane.build import make_driver, make_env, make_traffic
from ganlane.settings.env import EnvConfig
from ganlane.settings.traffic import IdmMobilTrafficConfig
from ganlane.errors import UserError
from ganlane.sim.random import Stream
from ganlane.view import FramePainter, Trajectory, WindowParameters, record_episode


def episode(length_s: float, number: int = 2) -> Trajectory:
    """The first ``length_s`` seconds of an episode of
    ``ganlane render agent=mobil traffic=idm_mobil``.
    """
    config = EnvConfig()
    env = make_env(make_traffic(IdmMobilTrafficConfig(), config, Stream.REPORT), config)
    return record_episode(
        env, make_driver("mobil", config).policy, 0, number, "mobil", "idm_mobil", length_s
    )


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


def profile(painter: FramePainter, frames: int) -> str:
    """Where the time of a round goes."""
    with cProfile.Profile() as taken:
        rounds(painter, frames, 1)
    text = io.StringIO()
    pstats.Stats(taken, stream=text).sort_stats("tottime").print_stats(20)
    return text.getvalue()


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=320)
    parser.add_argument("--frames", type=int, default=80, help="per round")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--profile", action="store_true", help="where the time goes")
    return parser.parse_args(arguments)


def measure(options: argparse.Namespace) -> str:
    """Draw all rounds; a line per clock."""
    wanted = options.frames * options.rounds
    trajectory = episode(0.1 * (wanted + 1))
    if len(trajectory) <= wanted:
        raise UserError(
            f"the episode has {len(trajectory)} frames, one of them for warming up; ask for fewer in all."
        )
    painter = FramePainter(trajectory, WindowParameters(options.width, options.height))
    painter.draw(0)
    if options.profile:
        return profile(painter, options.frames)
    lines = [
        f"{options.width} x {options.height}, {trajectory.vehicles} vehicles, {options.rounds} rounds"
    ]
    for unit, found in zip(("s", "CPU-s"), rounds(painter, options.frames, options.rounds)):
        lines.append(f"{statistics.median(found):.0f} frames/{unit} (best {max(found):.0f})")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure; the exit status."""
    return run_script(measure, parse(arguments))


if __name__ == "__main__":
    sys.exit(main())
