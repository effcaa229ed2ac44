"""``ganlane render``: an episode of an agent on a traffic, as a film seen from above.

    ganlane render agent=mobil traffic=idm_mobil episode=3
    ganlane render agent=agent_idm traffic=gan format=mp4 out=film.mp4
    ganlane render agent=mobil traffic=gan_calibrated film.end_s=20 film.max_bytes=2000000

The episodes are those of ``ganlane evaluate`` with the same seed.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from ganlane.config.app import run_command
from ganlane.config.render import RenderConfig


def render(config: RenderConfig, folder: Path) -> str:
    """Drive the episode, draw it and write the film."""
    from ganlane.build import make_driver, make_env, make_traffic, set_threads
    from ganlane.sim.random import Stream
    from ganlane.view import DrawingParameters, Film, FramePainter, WindowParameters, record_episode, write_film
    from ganlane.view.films import film_format

    set_threads(config.threads)
    film, label = config.film, config.traffic.label()
    driver = make_driver(config.driver, config.env, device=config.device)
    traffic = make_traffic(config.traffic, config.env, Stream.REPORT)
    seen = config.observation.read_by(driver.observation)
    env = make_env(traffic, config.env, seen, config.reward, device=config.device)
    end_s = film.end_s if film.end_s is not None else float("inf")
    episode = record_episode(env, driver.policy, config.seed, config.episode, driver.name, label, end_s)
    window = WindowParameters(width=film.width, height=film.height, length_m=film.road_m)
    painter = FramePainter(episode, window, DrawingParameters(film.trail_s, film.speeds, film.leader_line))
    frames = Film(painter, film.fps, film.speedup, film.start_s, film.end_s)
    name = f"{Path(config.driver).stem}_{label}_{config.seed}_{config.episode}.{config.format}"
    out = Path(config.out) if config.out else folder / name
    path = write_film(frames, out, film.fps, film_format(out, config.format), film.max_bytes, film.scale)
    ending = episode.outcome or "cut off"
    which = f"{driver.name} on {label}, seed {config.seed}, episode {config.episode}"
    print(f"{which}: {ending} after {episode.time_s[-1]:.1f} s")
    return f"film: {path}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit status."""
    return run_command("render", render, arguments)


if __name__ == "__main__":
    sys.exit(main())
