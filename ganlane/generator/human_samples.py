"""From recordings to samples of what ``human`` is fitted to: a view, and the move that follows it.

A sample is a driver at a decision. *Teacher* samples are cut from the recordings as they are. For
*closed-loop* samples the policy drives: of several moves that it draws, the one nearest to the
recording is made, and the sample is what would lead back to the recording. Positions are smoothed
first, since a camera's noise is no driver's wish (docs/generators.md).

The way of the data: recordings, :func:`smooth_scene`, :func:`cuts` in time, :func:`batches` of
segments [B, T, M] (B stretches of T frames of 0.1 s and M vehicles), :func:`samples_of` every
decision in them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from ganlane.data.dense import Floats, Recording
from ganlane.generator.human import (
    ACCELERATIONS,
    ACROSS,
    ALONG,
    DECISION_S,
    HARDEST_BRAKING,
    LATERAL_SPEEDS,
    LONG_AGO,
    STEPS,
    STRONGEST_ACCELERATION,
    HumanPolicy,
    LaneChoice,
    Memory,
    Situation,
    bounded,
    cars,
    features_of,
    lane_choice,
    memory_of,
    moved,
    remembered,
    situation_of,
    with_velocity,
)
from ganlane.generator.human_estimator import Estimator, noise_shares, present_memory, trust
from ganlane.generator.windows import OBSERVED_POSITIONS, side_by_side
from ganlane.keys import PHYSICS_STEP_S
from ganlane.settings.generator import HumanConfig
from ganlane.sim.state import Road, Vehicles

#: Frames before the present that a segment holds, for the drivers' memory.
HISTORY = ACCELERATIONS * STEPS
#: Desired speeds are the track's highest speed and up to this much more, within bounds, m/s.
DESIRED_ABOVE_MPS = 10.0
DESIRED_MPS = (5.0, 36.0)
#: A lane change begins where the driver last moved towards it by more than this, m/s, or was nearer
#: to its lane's centre than that, m.
BEGUN_MPS = 0.1
BEGUN_M = 0.3
#: How much sharper than the recordings are smoothed an exact sensor shows them.
EXACT_TIMES = 2.0
#: Gains that lead a driver back to its recording: of speed, place along and place across.
SPEED_GAIN = 0.5
PLACE_GAIN = 0.08
LATERAL_GAIN = 0.3
#: Draws random numbers [N, M], or of a shape that it is asked for.
Draw = Callable[..., Tensor]
#: Pairs of vehicles in a batch; bounds the memory.
_MOST_PAIRS = 300_000


@dataclass(frozen=True)
class SmoothScene(Recording):
    """A recording whose ``x``, ``y`` and ``speed`` are smoothed; entries of absent vehicles are 0.

    Attributes:
        raw_x, raw_y: [T, V] as recorded, m.
        lateral_speed: [T, V] m/s.
        target: [T, V] lane that the driver heads for: the new one from the start of a change on.
        weight: of its samples.
    """

    raw_x: Floats
    raw_y: Floats
    lateral_speed: Floats
    target: np.ndarray
    weight: float

    @property
    def two_dimensional(self) -> bool:
        """Whether positions across the road were recorded."""
        return self.lanes > 1


def smooth(track: Floats, cutoff_hz: float) -> Floats:
    """A track [T] without what is faster than ``cutoff_hz``, of which half is left.

    A Gaussian; beyond its ends the track is continued by its own point reflection.
    """
    # The standard deviation at which the transform of a Gaussian is one half at this frequency.
    frames = np.sqrt(np.log(2.0) / 2.0) / (np.pi * cutoff_hz * PHYSICS_STEP_S)
    # Four of them hold nearly all of its weight.
    reach = min(len(track) - 1, int(4.0 * frames) + 1)
    longer = np.pad(track, reach, "reflect", reflect_type="odd")
    smoothed = gaussian_filter1d(longer, frames)
    return smoothed[reach : reach + len(track)]


def smooth_scene(recording: Recording, config: HumanConfig, weight: float = 1.0) -> SmoothScene:
    """The recording smoothed, with the drivers' target lanes.

    Args:
        recording: positions at 10 Hz, m.
        config: the cutoff frequencies along and across the road.
        weight: of the scene's samples in the fit.
    """
    x = recording.x.copy()
    y = recording.y.copy()
    speed = np.zeros_like(x)
    lateral_speed = np.zeros_like(y)
    target = np.zeros(x.shape, np.int64)

    for track in range(x.shape[1]):
        rows = np.flatnonzero(recording.present[:, track])
        # From its first to its last frame.
        part = slice(rows[0], rows[-1] + 1), track
        # A shorter track shows no motion.
        if len(rows) >= 3:
            x[part] = smooth(x[part], config.cutoff_hz)
            y[part] = smooth(y[part], config.lateral_cutoff_hz)
            speed[part] = np.gradient(x[part], PHYSICS_STEP_S).clip(0.0)
            lateral_speed[part] = np.gradient(y[part], PHYSICS_STEP_S)
        target[part] = target_lanes(
            y[part],
            lateral_speed[part],
            recording.lane_width_m,
            recording.lanes,
        )

    same = {part.name: getattr(recording, part.name) for part in fields(Recording)}
    same |= {"x": x, "y": y, "speed": speed}
    return SmoothScene(
        **same,
        raw_x=recording.x,
        raw_y=recording.y,
        lateral_speed=lateral_speed,
        target=target,
        weight=weight,
    )


def without_noise(recording: Recording, config: HumanConfig) -> SmoothScene:
    """The recording as an exact sensor might have shown it: less smooth, and nothing is noise.

    Other sensors than the recordings' follow a driver's motion more closely.
    """
    sharper = replace(
        config,
        cutoff_hz=EXACT_TIMES * config.cutoff_hz,
        lateral_cutoff_hz=EXACT_TIMES * config.lateral_cutoff_hz,
    )
    scene = smooth_scene(recording, sharper)
    return replace(scene, raw_x=scene.x, raw_y=scene.y)


def target_lanes(
    y: Floats,
    lateral_speed: Floats,
    width_m: float,
    lanes: int,
) -> np.ndarray:
    """The lane [T] that a driver heads for: from the start of a change on the new one.

    A change counts if the track stays for 0.5 s in each of the two lanes.

    Args:
        y: [T] place across the road, m.
        lateral_speed: [T] m/s.
        width_m: of a lane.
        lanes: of the road.
    """
    lane = np.rint(y / width_m).clip(0, lanes - 1).astype(np.int64)
    target = lane.copy()

    # The last frames before the track crosses from one lane to another.
    for last in np.flatnonzero(np.diff(lane)):
        old = lane[last]
        new = lane[last + 1]

        # Five frames, 0.5 s, in each of the two lanes.
        before = lane[max(0, last - 4) : last + 1]
        after = lane[last + 1 : last + 6]
        if (before != old).any() or (after != new).any():
            continue

        # Back to where the driver set out.
        side = np.sign(new - old)
        begin = last
        while (
            begin > 0
            and lane[begin - 1] == old
            and abs(y[begin - 1] - old * width_m) > BEGUN_M
            and side * lateral_speed[begin - 1] > BEGUN_MPS
        ):
            begin -= 1
        target[begin : last + 1] = new
    return target


class Segments(NamedTuple):
    """B stretches of scenes side by side; the present of the first decision is frame
    :data:`HISTORY`.

    Attributes:
        x: smoothed place along the road, m, [B, T, M].
        y: smoothed place across the road, m, [B, T, M].
        raw_x: place along the road as recorded, m, [B, T, M].
        raw_y: place across the road as recorded, m, [B, T, M].
        speed: along the road, m/s, [B, T, M].
        lateral_speed: across the road, m/s, [B, T, M].
        target: lane that the driver heads for, [B, T, M].
        present: who is in the recording, [B, T, M].
        length: of the bodies, m, [B, M].
        width: of the bodies, m, [B, M].
        driven: [B, M]; the other vehicles move as recorded and are in no sample.
        lanes: how many the roads have, [B, 1].
        lane_width_m: [B, 1].
        weight: of the samples, [B, 1].
    """

    x: Tensor
    y: Tensor
    raw_x: Tensor
    raw_y: Tensor
    speed: Tensor
    lateral_speed: Tensor
    target: Tensor
    present: Tensor
    length: Tensor
    width: Tensor
    driven: Tensor
    lanes: Tensor
    lane_width_m: Tensor
    weight: Tensor

    @property
    def road(self) -> Road:
        """One road per segment."""
        return Road(self.lanes, self.lane_width_m)

    @property
    def two_dimensional(self) -> Tensor:
        """Whether positions across the road were recorded, [B, 1]."""
        return self.lanes > 1

    def mirrored(self) -> Segments:
        """Left and right swapped."""
        # The leftmost lane becomes lane 0, whose centre is at y = 0.
        last = (self.lanes - 1)[:, None]
        leftmost_m = last * self.lane_width_m[:, None]
        # Entries of absent vehicles stay 0.
        return self._replace(
            y=torch.where(self.present, leftmost_m - self.y, self.y),
            raw_y=torch.where(self.present, leftmost_m - self.raw_y, self.raw_y),
            target=torch.where(self.present, last.long() - self.target, 0),
            lateral_speed=-self.lateral_speed,
        )

    def faster(self, by_mps: Tensor) -> Segments:
        """Everybody faster by ``by_mps`` [B, 1], m/s; gaps and accelerations stay.

        So recorded drivers seem to respond: to gaps in metres and to differences of speed, at any
        speed (docs/generators.md).
        """
        frames = torch.arange(self.x.shape[1], device=self.x.device)
        further = by_mps[:, None] * (PHYSICS_STEP_S * frames[:, None])
        further = torch.where(self.present, further, 0.0)
        return self._replace(
            x=self.x + further,
            raw_x=self.raw_x + further,
            speed=torch.where(self.present, self.speed + by_mps[:, None], 0.0),
        )

    def widened(self, factor: Tensor) -> Segments:
        """Lanes and lateral moves times ``factor`` [B, 1]."""
        by = factor[:, None]
        return self._replace(
            y=self.y * by,
            raw_y=self.raw_y * by,
            lateral_speed=self.lateral_speed * by,
            lane_width_m=self.lane_width_m * factor,
        )


class Cut(NamedTuple):
    """A stretch of a scene.

    Attributes:
        scene: that it is cut from.
        start: its first frame; below 0 where history is missing.
        frames: how many it has, T.
        who: columns of its vehicles in the scene, [M].
    """

    scene: SmoothScene
    start: int
    frames: int
    who: np.ndarray

    def field(self, name: str) -> np.ndarray:
        """A field of the scene in the frames of the stretch, [T, M]; 0 outside of the scene."""
        first = max(self.start, 0)
        frames = slice(first, self.start + self.frames)
        inside = getattr(self.scene, name)[frames, self.who]

        # Frames of the stretch that the scene does not have.
        before = first - self.start
        after = self.frames - before - len(inside)
        field = np.pad(inside, ((before, after), (0, 0)))

        if field.dtype == np.float64:
            field = field.astype(np.float32)
        if name in ("x", "raw_x"):
            # Near 0, where float32 is exact to micrometres.
            field -= self.scene.x[frames, self.who].mean()
        return field


#: What a stretch holds in every frame.
IN_FRAMES = ("x", "y", "raw_x", "raw_y", "speed", "lateral_speed", "target", "present")


def cuts(scenes: Sequence[SmoothScene], decisions: int, stride: int) -> list[Cut]:
    """Stretches of the scenes, which overlap.

    Args:
        scenes: smoothed ones.
        decisions: of 0.4 s, that a stretch has; its history comes before them.
        stride: frames between the starts of two stretches.
    """
    # The last decision needs what followed it.
    present_frames = STEPS * (decisions + 1) + 1
    frames = HISTORY + present_frames

    stretches = []
    for scene in scenes:
        # A stretch may end after its scene, which has three more moves at least if it is that long.
        end = max(1, len(scene.x) - STEPS * 3)
        for start in range(0, end, stride):
            who = scene.present[start : start + present_frames].any(0)
            if who.any():
                stretches.append(Cut(scene, start - HISTORY, frames, np.flatnonzero(who)))
    return stretches


def batches(stretches: Sequence[Cut]) -> Iterator[Segments]:
    """The stretches side by side, those with about as many vehicles together.

    Drivers see each other in pairs, so the pairs in a batch are what is bounded.
    """
    waiting: list[Cut] = []
    for stretch in sorted(stretches, key=lambda cut: len(cut.who)):
        # The newest is the widest, to which the others are filled up.
        pairs = (len(waiting) + 1) * len(stretch.who) ** 2
        if waiting and pairs > _MOST_PAIRS:
            yield segments_of(waiting)
            waiting = []
        waiting.append(stretch)
    if waiting:
        yield segments_of(waiting)


def segments_of(stretches: Sequence[Cut]) -> Segments:
    """The stretches as one batch; frames outside of their scenes are absent."""

    def column(name: str) -> Tensor:
        """A number of every scene, [B, 1]."""
        values = [[getattr(cut.scene, name)] for cut in stretches]
        return torch.tensor(values, dtype=torch.float32)

    def of_vehicles(name: str, filler: float) -> Tensor:
        """A field of the vehicles, [B, M]."""
        values = [getattr(cut.scene, name)[cut.who] for cut in stretches]
        return side_by_side(values, filler)

    in_frames = {}
    for name in IN_FRAMES:
        values = [cut.field(name) for cut in stretches]
        in_frames[name] = side_by_side(values)

    return Segments(
        **in_frames,
        # Finite sizes for those that fill the batch.
        length=of_vehicles("length", 1.0).float(),
        width=of_vehicles("width", 1.0).float(),
        driven=of_vehicles("driven", 0.0),
        lanes=column("lanes"),
        lane_width_m=column("lane_width_m"),
        weight=column("weight"),
    )


def recorded(segments: Segments, decision: int, desired: Tensor) -> tuple[Vehicles, Memory]:
    """Vehicles and memories [B, M] as recorded at a decision; style and closing speeds are empty.

    Args:
        segments: B stretches of scenes.
        decision: its number, from 0 on.
        desired: speeds that the drivers wish for, m/s, [B, M].
    """
    # The present, and the decisions before it, newest first: [B, 1 + ACCELERATIONS, M].
    frames = HISTORY + STEPS * (decision - torch.arange(ACCELERATIONS + 1))
    now = frames[0]
    speed = segments.speed[:, frames]
    aside = segments.lateral_speed[:, frames]
    present = segments.present[:, frames]

    # Mean accelerations between two decisions, as far back as the driver was recorded.
    without_gap = present.cumprod(1)[:, 1:]
    changes = (speed[:, :-1] - speed[:, 1:]) / DECISION_S
    accelerations = torch.where(without_gap > 0, changes, 0.0)
    age = without_gap.sum(1).to(speed.dtype)

    # Where nothing was recorded, the present lateral speed.
    past = slice(1, LATERAL_SPEEDS + 1)
    lateral_speeds = torch.where(present[:, past], aside[:, past], aside[:, :1])

    # The memory has the decisions in its last dimension.
    accelerations = accelerations.movedim(1, -1)
    lateral_speeds = lateral_speeds.movedim(1, -1)
    memory = memory_of(accelerations, lateral_speeds, age)

    vehicles = cars(
        segments.x[:, now],
        segments.y[:, now],
        speed[:, 0],
        aside[:, 0],
        acceleration=accelerations[..., 0],
        length=segments.length,
        width=segments.width,
        desired_speed=desired,
        target_lane=segments.target[:, now],
        valid=present[:, 0],
    )
    return vehicles, memory


class Moves(NamedTuple):
    """R samples of moves.

    Attributes:
        features: [R, FEATURES] what drivers perceive.
        change: [R] of the acceleration that should follow, m/s2.
        aside: [R] change of the lateral speed that should follow, m/s.
        weight: [R] of the sample in the fit of the acceleration.
        lateral_weight: [R] of the sample in the fit of the lateral speed.
    """

    features: Tensor
    change: Tensor
    aside: Tensor
    weight: Tensor
    lateral_weight: Tensor

    def rows(self, which: Tensor) -> Moves:
        """Those of an index or a mask."""
        return Moves(*(number[which] for number in self))


class Choices(NamedTuple):
    """Samples of lane choices.

    Attributes:
        sides: of drivers that could begin a lane change on a side, or are on one,
            [S, SIDE_FEATURES].
        begins: [S] 1 where it begins, 0 where not, -1 where a change is under way.
        keeping_sides: [K, 2, SIDE_FEATURES] both sides of drivers in their lanes, as in
            :class:`~ganlane.generator.human.LaneChoice`.
        keeping_exists: [K, 2] whether these drivers have lanes there.
    """

    sides: Tensor
    begins: Tensor
    keeping_sides: Tensor
    keeping_exists: Tensor

    def keeping(self, rows: Tensor | slice) -> LaneChoice:
        """The lane choices of ``rows`` of the drivers who are in their lanes."""
        sides = self.keeping_sides[rows]
        yes = torch.ones(len(sides), dtype=torch.bool)
        return LaneChoice(
            sides=sides,
            exists=self.keeping_exists[rows],
            keeping=yes,
            to_left=~yes,
        )


class Samples(NamedTuple):
    """Samples of what drivers do, and of when they change lanes."""

    moves: Moves
    choices: Choices


def joined(parts: Sequence[Samples]) -> Samples:
    """All samples of the parts."""
    moves, choices = zip(*parts)
    all_moves = Moves(*map(torch.cat, zip(*moves)))
    all_choices = Choices(*map(torch.cat, zip(*choices)))
    return Samples(all_moves, all_choices)


class Options(NamedTuple):
    """How samples are cut.

    Attributes:
        policy: that drives, in closed loop; None: everybody drives as recorded.
        estimator: drivers begin where it sees them by nine noisy positions; None: as recorded.
        samples: moves that the policy draws, the nearest of which is made.
        vary: mirror and widen the segments at random.
        faster_mps: everybody in a segment is faster, by up to this much, m/s.
        blind: share of batches without side lanes.
    """

    policy: HumanPolicy | None = None
    estimator: Estimator | None = None
    samples: int = 6
    vary: bool = True
    faster_mps: float = 0.0
    blind: float = 0.25


@torch.no_grad()
def samples_of(stretches: Sequence[Cut], options: Options, random: torch.Generator) -> Samples:
    """Samples of all decisions in the stretches."""
    return joined([_samples(segments, options, random) for segments in batches(stretches)])


def _samples(segments: Segments, options: Options, random: torch.Generator) -> Samples:
    """Samples of one batch: its vehicles are driven from decision to decision."""
    segments = varied(segments, options, random)

    # Desired speeds [B, M], m/s: what a driver has shown at most, and more.
    top = torch.where(segments.present, segments.speed, 0.0).amax(1)
    above = DESIRED_ABOVE_MPS * torch.rand(top.shape, generator=random)
    desired = (top + above).clamp(*DESIRED_MPS)

    # A policy for single lanes, too, has to do without the sides now and then.
    sides_seen = not (options.blind and torch.rand((), generator=random) < options.blind)

    # Before the first decision nobody is there, so that everybody comes at it.
    vehicles, memory = recorded(segments, 0, desired)
    vehicles = vehicles.with_(valid=torch.zeros_like(vehicles.valid))

    closed_loop = options.policy is not None
    driven = segments.driven & closed_loop
    two_dimensional = segments.two_dimensional

    parts = []
    decisions = (segments.x.shape[1] - HISTORY - 1) // STEPS - 1
    for decision in range(decisions):
        # Where everybody is: as recorded, or as driven so far.
        as_recorded = recorded(segments, decision, desired)
        vehicles, memory, first = _with_recorded(vehicles, memory, *as_recorded, driven)
        if options.estimator is not None and decision == 0:
            vehicles, memory = _estimated(segments, vehicles, memory, options.estimator, random)
        situation = situation_of(vehicles, memory, segments.road, sides_seen, first)
        features = features_of(situation)

        # What should follow: the recorded move, corrected towards the recording.
        now = HISTORY + STEPS * decision
        change, aside = _led_back(segments, now, situation)
        weight = segments.weight.expand_as(change)
        moves = Moves(features, change, aside, weight, weight * two_dimensional)

        # Of drivers who are there until the next decision. Without a policy, one that has just come
        # knows no acceleration of its own yet.
        follows = segments.present[:, now + STEPS] & vehicles.valid & segments.driven
        counts = follows
        if not closed_loop:
            counts = follows & (memory.age > 0)

        # Whether the target lane changes until the next decision.
        step = segments.target[:, now + STEPS] - vehicles.target_lane
        choices = _choices(lane_choice(situation), follows & two_dimensional, step)
        parts.append(Samples(moves.rows(counts), choices))

        # In closed loop the policy makes the move itself, so that it sees its own mistakes.
        if closed_loop:
            change, aside = _nearest_move(options, features, change, aside, random)
            aside = torch.where(two_dimensional, aside, 0.0)

        # A decision later.
        acceleration, lateral = bounded(situation, change, aside)
        memory = remembered(situation, acceleration)
        vehicles = moved(vehicles, acceleration, lateral)
    return joined(parts)


def _with_recorded(
    vehicles: Vehicles,
    memory: Memory,
    recorded_vehicles: Vehicles,
    recorded_memory: Memory,
    driven: Tensor,
) -> tuple[Vehicles, Memory, Tensor]:
    """Vehicles and memories [B, M] at a decision, and who is there for the first time.

    Who has just come, and who is not driven, is as recorded. All head for the lanes that they
    headed for in the recording.

    Args:
        vehicles: as driven so far, [B, M].
        memory: what they remember.
        recorded_vehicles: at the decision, [B, M].
        recorded_memory: theirs.
        driven: whom the policy drives, [B, M].
    """
    present = recorded_vehicles.valid
    target = recorded_vehicles.target_lane
    first = present & ~vehicles.valid
    replaced = present & (first | ~driven)

    # The time since a lane change began or ended is counted here: a recording does not hold it.
    changed = (target != vehicles.target_lane) & present & ~first
    since = torch.where(first, LONG_AGO, memory.since)
    since = torch.where(changed, 0.0, since)

    vehicles = recorded_vehicles.where(replaced, vehicles)
    vehicles = vehicles.with_(valid=present, target_lane=target)
    memory = _taken(memory, recorded_memory, replaced)._replace(since=since)
    return vehicles, memory, first


def _estimated(
    segments: Segments,
    vehicles: Vehicles,
    memory: Memory,
    estimator: Estimator,
    random: torch.Generator,
) -> tuple[Vehicles, Memory]:
    """Driven vehicles as nine positions show them, with less or more noise than recorded."""
    nine = slice(HISTORY - OBSERVED_POSITIONS + 1, HISTORY + 1)
    whole = segments.present[:, nine].all(1) & segments.driven

    # Positions [B, M, 9, 2], m: the smoothed ones, and a share of the recorded noise.
    share = noise_shares(len(segments.x), 0.2, 0.7, random)
    noise_x = (segments.raw_x - segments.x)[:, nine]
    noise_y = (segments.raw_y - segments.y)[:, nine]
    x = segments.x[:, nine] + share * noise_x
    y = segments.y[:, nine] + share * noise_y
    positions = torch.stack((x, y), -1).transpose(1, 2)

    # The motion [B, M, 7] is speed, two accelerations, two lateral speeds, and where the driver is
    # from the last position.
    last = positions[:, :, -1]
    motion = estimator(positions - last[:, :, None])
    x, y = (last + motion[..., 5:]).unbind(-1)
    seen = vehicles.with_(x=x, y=y, acceleration=motion[..., 1])
    seen = with_velocity(seen, motion[..., 0].clamp_min(0.0), motion[..., 3])
    seen_memory = present_memory(motion, trust(positions))

    # The others stay as they are.
    vehicles = seen.where(whole, vehicles)
    memory = _taken(memory, seen_memory, whole)
    return vehicles, memory


def varied(segments: Segments, options: Options, random: torch.Generator) -> Segments:
    """The segments mirrored, widened and sped up at random."""
    rand, _ = draws((len(segments.x), 1), random)
    if options.vary:
        # All of them or none.
        if torch.rand((), generator=random) < 0.5:
            segments = segments.mirrored()
        # From 5 % narrower to 20 % wider.
        segments = segments.widened(0.95 + 0.25 * rand())
    if options.faster_mps:
        segments = segments.faster(options.faster_mps * rand())
    return segments


def draws(shape: tuple[int, ...], random: torch.Generator) -> tuple[Draw, Draw]:
    """Functions that draw uniform and standard normal numbers.

    Args:
        shape: of the numbers, unless the functions are asked for another one.
        random: that they draw from, in the order of the calls.
    """

    def rand(*size: int) -> Tensor:
        return torch.rand(size or shape, generator=random)

    def randn(*size: int) -> Tensor:
        return torch.randn(size or shape, generator=random)

    return rand, randn


def _taken(memory: Memory, other: Memory, where: Tensor) -> Memory:
    """The memory with accelerations, lateral speeds and age of ``other`` at ``where`` [B, M]."""
    # For what a driver has several numbers of.
    many = where[..., None]
    return memory._replace(
        accelerations=torch.where(many, other.accelerations, memory.accelerations),
        lateral_speeds=torch.where(many, other.lateral_speeds, memory.lateral_speeds),
        age=torch.where(where, other.age, memory.age),
    )


def _led_back(segments: Segments, now: int, situation: Situation) -> tuple[Tensor, Tensor]:
    """Changes [B, M] of acceleration, m/s2, and lateral speed, m/s, that follow the recording from
    frame ``now`` on, or lead back to it.
    """
    vehicles, memory, _, view = situation
    later = now + STEPS

    # A proportional controller on top of the recorded motion.
    speed = segments.speed[:, now]
    recorded_acceleration = (segments.speed[:, later] - speed) / DECISION_S
    for_speed = SPEED_GAIN * (speed - view.speed)
    for_place = PLACE_GAIN * (segments.x[:, now] - vehicles.x)
    wanted = recorded_acceleration + for_speed + for_place
    wanted = wanted.clamp(HARDEST_BRAKING, STRONGEST_ACCELERATION)
    change = wanted - memory.accelerations[..., 0]

    # The same across the road, where a decision sets the speed.
    for_place_across = LATERAL_GAIN * (segments.y[:, now] - vehicles.y)
    wanted_aside = segments.lateral_speed[:, later] + for_place_across
    return change, wanted_aside - view.aside


def _nearest_move(
    options: Options,
    features: Tensor,
    change: Tensor,
    aside: Tensor,
    random: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Of several moves that the policy draws, the nearest to a wanted one, along and across alone.

    Args:
        options: the policy, and how many moves it draws.
        features: what drivers perceive, [B, M, FEATURES].
        change: of the acceleration that is wanted, m/s2, [B, M].
        aside: change of the lateral speed that is wanted, m/s, [B, M].
        random: draws the moves.
    """
    assert options.policy is not None
    logits_of_both = options.policy(features)
    nearest = []
    for tokens, logits, wanted in zip((ALONG, ACROSS), logits_of_both, (change, aside)):
        # Values [samples, B, M].
        u = torch.rand((options.samples, *wanted.shape), generator=random)
        repeated = logits.expand(options.samples, *logits.shape)
        drawn = tokens.sample(repeated, u)

        # The index of the best one of each driver, [1, B, M].
        best = (drawn - wanted).abs().argmin(0, keepdim=True)
        nearest.append(drawn.gather(0, best)[0])
    return nearest[0], nearest[1]


def _choices(choice: LaneChoice, counts: Tensor, step: Tensor) -> Choices:
    """What drivers chose at one decision.

    Args:
        choice: what they could do, [N, M].
        counts: who of them is in the samples, [N, M].
        step: by how many lanes their target lanes change until the next decision, [N, M].
    """
    # A change begins at the decision after which the target lane is another one: to the left, to
    # the right, [N, M, 2].
    begins = torch.stack((step == 1, step == -1), -1)
    keeping = counts & choice.keeping
    could = choice.exists & keeping[..., None]

    # The side to which a change is under way, [drivers under way, SIDE_FEATURES].
    under_way = counts & ~choice.keeping
    left, right = choice.sides.unbind(-2)
    aside = torch.where(choice.to_left[..., None], left, right)[under_way]

    # First those who could begin one, then those who are on their way.
    labels = (begins[could].float(), torch.full((len(aside),), -1.0))
    return Choices(
        sides=torch.cat((choice.sides[could], aside)),
        begins=torch.cat(labels),
        keeping_sides=choice.sides[keeping],
        keeping_exists=choice.exists[keeping],
    )
