"""One highway as a ``gymnasium.Env``, and the window that shows it."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import numpy.typing as npt

from ganlane.arguments import checked_arguments, seed_number, whole_number
from ganlane.errors import UserError
from ganlane.gym import has_display
from ganlane.gym.rows import (
    SEEDS,
    Floats,
    OnRows,
    actions_of,
    array_of,
    known_options,
    make_rows,
    row_of,
)
from ganlane.keys import ACTIONS, PHYSICS_STEP_S
from ganlane.options import Option

if TYPE_CHECKING:
    from gymnasium.wrappers import RecordVideo

RENDER_MODES = ("human", "rgb_array", "rgb_array_list")
#: Frames per second of driving, except with ``rgb_array``.
FPS = round(1.0 / PHYSICS_STEP_S)


class HighwayGym(OnRows, gymnasium.Env[Floats, Any]):
    """``gymnasium.make("ganlane/Highway-v0", ...)``.

    Args:
        traffic: as in :func:`ganlane.api.make_env`, as are ``options``.
        seed: of the first episodes, until ``reset(seed=...)`` gives another; None: drawn at random,
            as in gymnasium.
        render_mode: None, ``rgb_array`` (a frame per decision), ``rgb_array_list`` (all frames
            since the last ``render()``, ten per second of driving) or ``human`` (a window, in real
            time; needs the extra ``human``).
        options: further arguments of ``make_env``: ``observation``, ``reward``, ``mask``, ``env``,
            ``transforms``, ``stream``, ``device``, and keys of the environment.

    ``reset(seed=s)`` begins episode 0 of seed s, every further ``reset()`` the next one;
    ``reset(options={"episode": k})`` runs episode k. ``action`` is 0 (keep), 1 (left) or 2 (right);
    docs/gymnasium.md lists observations and infos. ``spec.max_episode_steps`` follows from
    ``timeout_s``.

    Raises:
        UserError: a wrong value, or ``human`` without a display.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": FPS}  # noqa: RUF012 - gymnasium's own form

    @checked_arguments
    def __init__(
        self,
        traffic: Option = "idm_mobil",
        *,
        seed: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise UserError(
                f"render_mode={render_mode}: expected one of {', '.join(RENDER_MODES)}; choose one of them."
            )
        self._rows = make_rows(traffic, 1, render_mode, options)
        self.observation_space: gymnasium.spaces.Box = self._rows.space  # type: ignore[assignment]
        self.action_space = gymnasium.spaces.Discrete(ACTIONS)
        modes = [mode for mode in RENDER_MODES if mode != "human" or has_display()]
        decisions = max(1, round(1.0 / self._rows.episode.decision_period_s))
        self.metadata = {
            "render_modes": modes,
            "render_fps": decisions if render_mode == "rgb_array" else FPS,
        }
        self.render_mode = render_mode
        self._view: Any = None
        #: Pictures since the last ``render()``, with ``rgb_array_list``.
        self._pictures: list[Any] = []
        self._video: RecordVideo | None = None
        if render_mode is not None:
            from ganlane.gym.tensor_rows import LiveView  # with torch, which takes seconds

            self._view = LiveView(
                self._rows, traffic, FilmWindow() if render_mode == "human" else None
            )
        self._seed = None if seed is None else seed_number(seed)
        self._episode = -1
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin an episode; see the class for which."""
        given = known_options(options, ("episode",))
        seed = None if seed is None else seed_number(seed)
        super().reset(seed=seed)
        if seed is not None:
            self._seed, self._episode = seed, -1
        elif self._seed is None:
            self._seed = int(self.np_random.integers(SEEDS))
        self._episode = whole_number(
            "options: episode", given.get("episode", self._episode + 1), 0, 2**62
        )
        self._rows.start(self._seed, self._episode)
        self._running = True
        if self._view is not None:
            self._view.start()
            self._pictures.clear()
            self._collect()
        return self._rows.observation()[0].copy(), row_of(self._rows.info(), 0)

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """One decision: observation, reward, terminated, truncated, info."""
        if not self._running:
            raise UserError("step(): no episode is under way; call reset() first.")
        actions = actions_of(array_of(action).reshape(-1), 1)
        if self._view is not None:
            self._view.before_step(int(actions[0]))
        stepped = self._rows.step(actions)
        reward = float(stepped.reward[0])
        terminated, truncated = bool(stepped.terminated[0]), bool(stepped.truncated[0])
        self._running = not (terminated or truncated)
        if self._view is not None:
            self._view.after_step(reward)
            self._collect()
        return (
            stepped.observation[0].copy(),
            reward,
            terminated,
            truncated,
            row_of(self._rows.info(), 0),
        )

    def _collect(self) -> None:
        """Store the pictures of the last decision for ``render()``, or pass them to the video."""
        if self.render_mode == "rgb_array_list":
            self._pictures += self._view.pictures()
        if self._video is not None and self._video.recording:
            *between, _ = self._view.pictures()  # the wrapper asks for the last one itself
            self._video.recorded_frames += between

    def set_record_video_wrapper(self, wrapper: RecordVideo) -> None:
        """Let gymnasium's ``RecordVideo`` around this environment write ten frames per second of
        driving.

        By itself it gets one picture per decision. The name is HighwayEnv's.
        """
        self._video, wrapper.frames_per_sec = wrapper, FPS

    def action_masks(self) -> npt.NDArray[np.bool_]:
        """Which actions are allowed now, bool [3]; the name is that of sb3-contrib's MaskablePPO."""
        return self._rows.mask()[0].copy()

    def render(self) -> Any:
        """The present picture [height, width, 3] uint8, or a list of them.

        None for ``human``, which draws itself.
        """
        if self._view is None:
            raise UserError(
                f"render(): made without render_mode; give one of {', '.join(RENDER_MODES)} to make()."
            )
        self._rows.check_started()
        if self.render_mode == "rgb_array_list":
            pictures, self._pictures = self._pictures, []
            return pictures
        return self._view.picture() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()


class FilmWindow:
    """A pygame window that shows pictures until the user closes it.

    Raises:
        UserError: pygame is missing, or there is no display.
    """

    def __init__(self) -> None:
        if not has_display():
            raise UserError(
                "render_mode=human: needs pygame (pip install 'ganlane[human]') and a display, and one of them is "
                "missing here; use render_mode=rgb_array, or ganlane render for a film."
            )
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame  # an extra

        self._pygame: Any = pygame
        self._screen: Any = None
        try:
            pygame.display.init()
        except pygame.error as error:
            raise UserError(
                f"render_mode=human: no window can be opened ({error}); use render_mode=rgb_array."
            ) from error
        pygame.display.set_caption("ganlane")

    def show(self, picture: npt.NDArray[np.uint8]) -> None:
        """Put a picture [height, width, 3] uint8 into the window."""
        pygame = self._pygame
        if pygame is None:
            return
        size = picture.shape[1::-1]
        try:
            if self._screen is None:
                self._screen = pygame.display.set_mode(size)
            self._screen.blit(pygame.image.frombuffer(picture.tobytes(), size, "RGB"), (0, 0))
            pygame.display.flip()
            if pygame.event.get(pygame.QUIT):
                self.close()
            pygame.event.pump()
        except pygame.error:  # closed by other code: pygame has one window per process
            self._pygame = None

    def wait(self, seconds: float) -> None:
        """Wait, if the window is open."""
        if self._pygame is not None:
            time.sleep(seconds)

    def close(self) -> None:
        """Close the window; may be called again."""
        pygame, self._pygame, self._screen = self._pygame, None, None
        if pygame is not None:
            pygame.display.quit()
