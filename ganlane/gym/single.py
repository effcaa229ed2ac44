"""One highway as a ``gymnasium.Env``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import numpy.typing as npt

from ganlane.arguments import seed_number, whole_number
from ganlane.errors import UserError
from ganlane.gym.base import OnRows, make_rows
from ganlane.gym.rows import SEEDS, Floats, action_of, reset_options
from ganlane.gym.window import FilmWindow, has_display
from ganlane.keys import PHYSICS_STEP_S

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
    ``reset(options={"episode": k})`` runs episode k. ``action`` is 0 (keep), 1 (left) or 2 (right)
    unless ``actions`` says otherwise; docs/gymnasium.md lists actions, observations and infos.
    ``spec.max_episode_steps`` follows from ``timeout_s``.

    Raises:
        UserError: a wrong value, or ``human`` without a display.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": FPS}  # noqa: RUF012 - gymnasium's own form

    def __init__(
        self,
        traffic: Any = "idm_mobil",
        *,
        seed: int | None = None,
        render_mode: str | None = None,
        transforms: Sequence[Any] = (),
        **options: Any,
    ) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise UserError(
                f"render_mode={render_mode}: expected one of {', '.join(RENDER_MODES)}; "
                "choose one of them."
            )
        # Episodes count on from -1, so that the first reset begins episode 0.
        self._seed = None if seed is None else seed_number(seed)
        self._episode = -1
        self._running = False

        self._rows = make_rows(
            traffic,
            count=1,
            pictures=render_mode is not None,
            transforms=transforms,
            keys=options,
        )
        self.observation_space: gymnasium.spaces.Box = self._rows.space  # type: ignore[assignment]
        self.action_space = self._rows.action_space()
        self._actions = self._rows.actions
        # Room for the number of an action, so that no step makes an array.
        self._number = np.zeros(1, np.int64)

        self.render_mode = render_mode
        fps = FPS
        if render_mode == "rgb_array":  # a picture per decision
            fps = max(1, round(1.0 / self._rows.episode.decision_period_s))

        # gymnasium's checker tries every mode that is listed, so a window only where there is one.
        modes = [mode for mode in RENDER_MODES if mode != "human" or has_display()]
        self.metadata = {
            "render_modes": modes,
            "render_fps": fps,
        }

        self._view: Any = None
        #: Pictures since the last ``render()``, with ``rgb_array_list``.
        self._pictures: list[Any] = []
        self._video: RecordVideo | None = None
        if render_mode is not None:
            from ganlane.gym.rendering import LiveView  # with torch, which takes seconds

            window = FilmWindow() if render_mode == "human" else None
            self._view = LiveView(self._rows, window)  # type: ignore[arg-type]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin an episode; see the class for which.

        Args:
            seed: from 0; None: goes on with the present one.
            options: ``episode``, a number from 0.

        Returns:
            The observation [D] and info, both the caller's to keep.

        Raises:
            UserError: a wrong value.
        """
        chosen = reset_options(options, ("episode",))
        if seed is not None:
            seed = seed_number(seed)
        # gymnasium seeds np_random here, from which unseeded environments draw.
        super().reset(seed=seed)

        # A seed begins with its episode 0; without one the next episode of the same seed follows.
        if seed is not None:
            self._seed = seed
            self._episode = -1
        elif self._seed is None:
            self._seed = int(self.np_random.integers(SEEDS))

        episode = chosen.get("episode", self._episode + 1)
        self._episode = whole_number("options: episode", episode, 0, 2**62)
        self._rows.start(self._seed, self._episode)
        self._running = True

        # The first frame is the scene before anything moves.
        if self._view is not None:
            self._view.start()
            self._pictures.clear()
            self._collect()

        # Copies: the arrays of the rows are overwritten by the next step.
        return self._rows.observation()[0].copy(), self._rows.first_info()

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """One decision: observation, reward, terminated, truncated, info.

        Args:
            action: the number of an action, or controls [2] from -1 to 1.

        Returns:
            The observation [D], and the others as Python's numbers; all the caller's to keep.

        Raises:
            UserError: a wrong action, or no episode under way.
        """
        if not self._running:
            raise UserError("step(): no episode is under way; call reset() first.")
        commanded = action_of(action, self._actions, self._number)

        # The view records the physics steps of the decision through the environment's recorder.
        if self._view is not None:
            # Pictures name the numbered actions.
            number = int(commanded[0]) if self._actions.names else -1
            self._view.before_step(number)

        stepped = self._rows.step(commanded)
        # item() is twice as fast as an index and a conversion.
        reward = stepped.reward.item(0)
        terminated = stepped.terminated.item(0)
        truncated = stepped.truncated.item(0)
        # gymnasium leaves it open what a step after the end does; here it is refused.
        self._running = not (terminated or truncated)

        if self._view is not None:
            self._view.after_step(reward)
            self._collect()

        observation = stepped.observation[0].copy()
        info = self._rows.first_info()
        return observation, reward, terminated, truncated, info

    def _collect(self) -> None:
        """Store the pictures of the last decision for ``render()``, or pass them to the video."""
        if self.render_mode == "rgb_array_list":
            self._pictures += self._view.pictures()

        if self._video is not None and self._video.recording:
            *between, _ = self._view.pictures()  # the wrapper asks for the last one itself
            self._video.recorded_frames += between

    def set_record_video_wrapper(self, wrapper: RecordVideo) -> None:
        """Let gymnasium's ``RecordVideo`` write ten frames per second of driving.

        By itself it gets one picture per decision. The name is HighwayEnv's.
        """
        self._video = wrapper
        wrapper.frames_per_sec = FPS

    def action_masks(self) -> npt.NDArray[np.bool_]:
        """Which actions are allowed now, bool [A]; sb3-contrib's MaskablePPO asks for them."""
        return self._rows.mask()[0].copy()

    def render(self) -> Any:
        """The present picture [height, width, 3] uint8, or a list of them.

        None for ``human``, which draws itself.
        """
        if self._view is None:
            modes = ", ".join(RENDER_MODES)
            raise UserError(f"render(): made without render_mode; give one of {modes} to make().")
        self._rows.check_started()

        if self.render_mode == "rgb_array":
            return self._view.picture()
        if self.render_mode == "rgb_array_list":
            # gymnasium's contract: a call empties the list.
            pictures = self._pictures
            self._pictures = []
            return pictures
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
