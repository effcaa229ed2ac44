"""The simulator once more, one car at a time in plain Python floats: what the tensor code is tested
against.

Written from the equations (section IV.C of the paper, Tables IV and V, Treiber et al. 2000, Kesting
et al. 2007, Salvucci and Gray 2004), not from the tensor code, and for reading, not for speed. SI
units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

from ganlane.settings.road import LaneStretch

DT = 0.1
REST = 1e-12  # a heading, steering angle or lateral position of at most this is 0
WHEELBASE = 2.7
NOBODY = 10_000.0  # Table V: the gap of an empty lane
LANE_WIDTH = 4.0
CENTRE = 0
SIGNALLED = 2
LEFT = 1
RIGHT = 2
FASTER = 3
SLOWER = 4


@dataclass
class Car:
    x: float
    y: float
    heading: float
    speed: float
    acceleration: float
    length: float
    width: float
    desired_speed: float
    target_lane: int
    visibility: int
    valid: bool
    steering: float = 0.0
    exits: bool = False


@dataclass(frozen=True)
class Rules:
    """What of a run can be chosen."""

    lanes: int
    mobil: bool = True
    abort: bool = False
    substeps: int = 10
    goal: float = 5000.0
    timeout_steps: int = 10_000
    ring: float | None = None
    # of every lane; none: all go on
    stretches: tuple[LaneStretch, ...] = ()
    # what the ego is commanded: lane, lane_speed or continuous
    actions: str = "lane"
    flow: Flow | None = None

    @cached_property
    def exit_lane(self) -> int | None:
        """The lane that ends in an exit."""
        exits = [lane for lane, stretch in enumerate(self.stretches) if stretch.end == "exit"]
        return exits[0] if exits else None

    def stretch(self, lane: int) -> LaneStretch:
        return self.stretches[lane] if self.stretches else LaneStretch()


@dataclass(frozen=True)
class Flow:
    """Who enters and leaves a section of the road."""

    arrivals: tuple[float, ...]  # probability in a decision, of every lane
    exit_share: float
    start: float
    end: float


@dataclass
class State:
    """Cars (the ego first) and what is remembered between two decisions."""

    cars: list[Car]
    step: int = 0
    direction: int = 0
    close_ahead: bool = False
    close_behind: bool = False
    lane_changes: int = 0
    # of the episode, for random numbers
    key: int = 0
    # of lane_speed: what the ego aims at
    set_speed: float = 25.0
    # of continuous: the line that the ego steers to, and what it accelerates with
    line: float | None = None
    throttle: float | None = None


@dataclass
class Outcome:
    """Of one decision."""

    reasons: list[str] = field(default_factory=list)
    soft_crash: int = 0
    soft_crash_behind: int = 0
    started_change: bool = False
    mean_acceleration: float = 0.0
    progress: float = 0.0


# Along the road: IDM, Table V


def idm(speed: float, desired_speed: float, gap: float, leader_speed: float) -> float:
    """a (1 - (v/v0)^4 - (s*/s)^2), s* = d0 + max(0, v T + v dv / (2 sqrt(a b))).

    Between -20 and 0.7 m/s2.
    """
    a = 0.7
    b = 1.7
    headway = 1.6
    d0 = 2.0
    wanted = d0 + max(
        0.0, speed * headway + speed * (speed - leader_speed) / (2.0 * math.sqrt(a * b))
    )
    acceleration = a * (1.0 - (speed / desired_speed) ** 4 - (wanted / max(gap, 0.1)) ** 2)
    return min(0.7, max(-20.0, acceleration))


# Who is where


def lanes_entered(car: Car, rules: Rules) -> set[int]:
    """Lanes whose strip the body enters by more than 0.1 m."""
    half = 0.5 * (car.width * math.cos(car.heading) + car.length * abs(math.sin(car.heading)))
    right = car.y - half + 0.1
    left = car.y + half - 0.1
    return {
        k
        for k in range(rules.lanes)
        if right < (k + 0.5) * LANE_WIDTH and left > (k - 0.5) * LANE_WIDTH
    }


def nearest_lane(car: Car, rules: Rules) -> int:
    return min(rules.lanes - 1, max(0, round(car.y / LANE_WIDTH)))


def lanes_seen_in(car: Car, rules: Rules) -> set[int]:
    """Lanes in which the others see it."""
    if not car.valid:
        return set()
    if car.visibility == CENTRE:
        return {nearest_lane(car, rules)}
    entered = lanes_entered(car, rules)
    return entered | {car.target_lane} if car.visibility == SIGNALLED else entered


class View:
    """The cars at one instant, and who stands in which lane."""

    def __init__(self, cars: list[Car], rules: Rules) -> None:
        self.cars = cars
        self.rules = rules
        self.in_lane: dict[int, list[int]] = {k: [] for k in range(rules.lanes)}
        for index, car in enumerate(cars):
            for lane in lanes_seen_in(car, rules):
                self.in_lane[lane].append(index)

    def distance(self, i: int, j: int) -> float:
        """From the centre of i forward to the centre of j (on a ring the nearer way round)."""
        distance = self.cars[j].x - self.cars[i].x
        ring = self.rules.ring
        return distance if ring is None else (distance + ring / 2) % ring - ring / 2

    def gap(self, behind: int, ahead: int) -> float:
        """Bumper to bumper."""
        return self.distance(behind, ahead) - 0.5 * (
            self.cars[behind].length + self.cars[ahead].length
        )

    def is_ahead(self, i: int, j: int) -> bool:
        """Whether j is ahead of i; at the same x the lower index is."""
        distance = self.distance(i, j)
        return distance > 0 or (distance == 0 and j < i)

    def leader(self, i: int, lane: int) -> int | None:
        """Nearest car ahead of i in ``lane``; of two as near the slower."""
        ahead = [j for j in self.in_lane.get(lane, []) if j != i and self.is_ahead(i, j)]
        return min(ahead, key=lambda j: (self.gap(i, j), self.cars[j].speed), default=None)

    def follower(self, i: int, lane: int) -> int | None:
        """Nearest car behind i in ``lane``."""
        behind = [j for j in self.in_lane.get(lane, []) if j != i and not self.is_ahead(i, j)]
        return min(behind, key=lambda j: self.gap(j, i), default=None)

    def acceleration(self, i: int, ahead: int | None) -> float:
        """IDM of car i behind car ``ahead``, or behind nobody."""
        car = self.cars[i]
        if ahead is None:
            return idm(car.speed, car.desired_speed, NOBODY, car.speed)
        return idm(car.speed, car.desired_speed, self.gap(i, ahead), self.cars[ahead].speed)

    def demanded(self, i: int) -> float:
        """What the lanes that the driver attends to (body and target) allow."""
        car = self.cars[i]
        attended = lanes_entered(car, self.rules) | {car.target_lane}
        behind_others = [self.acceleration(i, self.leader(i, lane)) for lane in attended]
        # Who leaves a lane goes on up to its wall, who keeps it stops 15 m before.
        before_walls = [
            before_wall(car, lane, self.rules, 15.0 if lane == car.target_lane else 0.0)
            for lane in attended
        ]
        return min([*behind_others, *before_walls, self.making_room(i)])

    @cached_property
    def wanted_lanes(self) -> list[int | None]:
        """Where each driver that is there has to change to."""
        return [asked(car, self.rules) if car.valid else None for car in self.cars]

    def making_room(self, i: int) -> float:
        """Behind the nearest ahead that has to change into its lane, with up to 2 m/s2; with
        2 m/s2 where the leader in the lane that it has to reach itself would make it brake hard.
        The ego does that also where it would make the follower there brake hard, who goes on.
        """
        if not (self.rules.mobil or i == 0):
            return math.inf
        lane = self.cars[i].target_lane
        wanted = self.wanted_lanes[i]
        blocked = wanted is not None and (
            self.acceleration(i, self.leader(i, wanted)) < -4.0
            or (i == 0 and self.follower_goes_on(wanted))
        )
        slowest = -2.0 if blocked else math.inf
        asking = [
            j
            for j, theirs in enumerate(self.wanted_lanes)
            if j != i and theirs == lane and self.is_ahead(i, j)
        ]
        nearest = min(asking, key=lambda j: (self.gap(i, j), self.cars[j].speed), default=None)
        # The ego makes room for nobody.
        if i and nearest is not None and self.gap(i, nearest) > 1.0:
            slowest = min(slowest, self.acceleration(i, nearest))
        return max(-2.0, slowest)

    def follower_goes_on(self, lane: int) -> bool:
        """Whether the ego's follower in ``lane`` would have to brake hard behind it, but neither
        stands, nor brakes with more than 1 m/s2 now, nor is faster by 2 m/s.
        """
        behind = self.follower(0, lane)
        if behind is None:
            return False
        car = self.cars[behind]
        faster = car.speed - self.cars[0].speed >= 2.0
        goes_on = car.speed > 0.0 and car.acceleration > -1.0 and not faster
        return goes_on and self.acceleration(behind, 0) < -4.0

    def in_a_lane(self, i: int, lane: int) -> float:
        """What the car would accelerate with if it kept ``lane``."""
        behind = self.acceleration(i, self.leader(i, lane))
        return min(behind, before_wall(self.cars[i], lane, self.rules, 15.0))


# Where lanes end


def front(car: Car) -> float:
    return car.x + 0.5 * car.length


def before_wall(car: Car, lane: int, rules: Rules, margin: float) -> float:
    """IDM behind a standing obstacle ``margin`` m before the lane's wall; infinite without one."""
    stretch = rules.stretch(lane)
    if stretch.end != "wall":
        return math.inf
    gap = stretch.end_m - margin - front(car)
    return idm(car.speed, car.desired_speed, gap, 0.0)


def there_is(lane: int, x: float, rules: Rules) -> bool:
    """Whether the road has the lane at x."""
    if not 0 <= lane < rules.lanes:
        return False
    return rules.stretch(lane).begin_m <= x < rules.stretch(lane).end_m


def urge(car: Car, lane: int, rules: Rules) -> float:
    """How much the driver wants to leave the lane: from 500 m a change before its end up to 8 m/s2
    at it. Who leaves by the exit has to leave every other lane before the exit's end.
    """
    if car.exits and rules.exit_lane is not None:
        ways_out = [rules.exit_lane]
        end = rules.stretch(rules.exit_lane).end_m
    else:
        ways_out = [k for k in range(rules.lanes) if rules.stretch(k).end == "nothing"]
        end = rules.stretch(lane).end_m
    changes = min(abs(k - lane) for k in ways_out)
    if changes == 0:
        return 0.0
    return 8.0 * min(1.0, max(0.0, 1.0 - (end - car.x) / (500.0 * changes)))


def possible(car: Car, lane: int, rules: Rules) -> bool:
    """Whether the driver may change into the lane and would not be worse off there."""
    here = car.target_lane
    if not (there_is(lane, car.x, rules) and there_is(here, car.x, rules)):
        return False
    return urge(car, lane, rules) <= urge(car, here, rules)


def asked(car: Car, rules: Rules) -> int | None:
    """The lane that the driver has to change into, the sooner the better; the left one at a tie."""
    here = urge(car, car.target_lane, rules)
    best = here
    lane = None
    for side in (1, -1):
        other = car.target_lane + side
        if possible(car, other, rules) and urge(car, other, rules) < best:
            lane, best = other, urge(car, other, rules)
    return lane if here > 0.577 * 8.0 else None


def arrival(ego: Car, rules: Rules) -> str:
    """``goal``, ``missed_exit`` where there is an exit, or nothing yet."""
    way_out = rules.exit_lane
    if way_out is None:
        return "goal" if ego.x >= rules.goal else ""
    if ego.x < rules.stretch(way_out).end_m:
        return ""
    return "goal" if nearest_lane(ego, rules) == way_out else "missed_exit"


def in_the_wall(car: Car, rules: Rules) -> bool:
    """Whether its body is in a lane whose wall its front has passed."""
    walls = [rules.stretch(lane) for lane in lanes_entered(car, rules)]
    return any(wall.end == "wall" and front(car) > wall.end_m for wall in walls)


# Across the road: MOBIL, Table IV


def settled(car: Car) -> bool:
    return abs(car.y - car.target_lane * LANE_WIDTH) < 0.3


def incentive(view: View, i: int, lane: int) -> tuple[float, bool]:
    """``a~_c - a_c + p (a~_n - a_n) + q (a~_o - a_o)`` and whether nobody has to brake harder than
    4 m/s2.
    """
    here = view.cars[i].target_lane
    gain = view.in_a_lane(i, lane) - view.in_a_lane(i, here)
    urgent = urge(view.cars[i], here, view.rules)
    gain += urgent if urgent > urge(view.cars[i], lane, view.rules) else 0.0
    safe = view.in_a_lane(i, lane) >= -4.0
    new = view.follower(i, lane)
    if new is not None:
        after = view.acceleration(new, i)
        before = view.acceleration(new, view.leader(i, lane))
        gain += 1.0 * (after - before)
        safe = safe and after >= -4.0
    old = view.follower(i, here)
    if old is not None:
        gain += 0.5 * (view.acceleration(old, view.leader(i, here)) - view.acceleration(old, i))
    return gain, safe


def mobil_wish(view: View, i: int) -> int:
    """-1, 0 or +1 lanes; the better side, left at a tie; nothing in the middle of a change."""
    car = view.cars[i]
    rules = view.rules
    if not car.valid or not settled(car):
        return 0
    best = -math.inf
    wish = 0
    for side in (1, -1):
        if possible(car, car.target_lane + side, rules):
            gain, safe = incentive(view, i, car.target_lane + side)
            if safe and gain > 0.1 and gain > best:
                best = gain
                wish = side
    return wish


def mobil_changes(view: View) -> dict[int, int]:
    """Car to change, of all but the ego.

    Of several that want into one lane the one behind waits if it is within 60 m or would have to
    brake too hard.
    """
    wishes = {i: mobil_wish(view, i) for i in range(1, len(view.cars))}
    wanted = {i: view.cars[i].target_lane + wish for i, wish in wishes.items() if wish}

    def yields(i: int) -> bool:
        rivals = [j for j in wanted if j != i and wanted[j] == wanted[i] and view.is_ahead(i, j)]
        return any(view.distance(i, j) < 60.0 or view.acceleration(i, j) < -4.0 for j in rivals)

    return {i: wishes[i] for i in wanted if not yields(i)}


# Motion


def at_rest(number: float) -> float:
    return 0.0 if abs(number) <= REST else number


def steered(car: Car, centre: float) -> float:
    """Two points on the lane centre, 1 s and 4 s ahead; gains 1.5, 3 and 3.375 times L/v'."""
    pace = max(car.speed, 3.0)
    beta = math.atan(math.tan(car.steering) / 2)
    sideways = car.speed * math.sin(car.heading + beta)
    yaw_rate = car.speed * math.sin(beta) / (WHEELBASE / 2)
    offset = centre - car.y

    def angle_rate(distance: float) -> float:
        # d/dt atan(offset / distance), the point moving along with the car
        return -sideways * distance / (distance**2 + offset**2) - yaw_rate

    near = 1.0 * pace
    far = 4.0 * pace
    near_angle = math.atan2(offset, near) - car.heading
    # Below 3 m/s the integral term is per distance: it fades with the speed.
    rate = 1.5 * angle_rate(far) + 3.0 * angle_rate(near) + 3.375 * near_angle * car.speed / pace
    return at_rest(min(0.5, max(-0.5, car.steering + WHEELBASE / pace * rate * DT)))


def driven(car: Car, acceleration: float, steering: float) -> Car:
    """Kinematic bicycle with slip angle, over 0.1 s, along the chord of its mean heading."""
    speed = max(0.0, car.speed + acceleration * DT)
    distance = (car.speed + speed) / 2 * DT
    beta = math.atan(math.tan(steering) / 2)
    turn = distance * math.sin(beta) / (WHEELBASE / 2)
    course = car.heading + beta + turn / 2
    return replace(
        car,
        x=car.x + distance * math.cos(course),
        y=at_rest(car.y + distance * math.sin(course)),
        heading=at_rest(car.heading + turn),
        speed=speed,
        acceleration=(speed - car.speed) / DT,
        steering=steering,
    )


# Events


def corners(car: Car) -> list[tuple[float, float]]:
    c = math.cos(car.heading)
    s = math.sin(car.heading)
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    half = [(a * car.length / 2, b * car.width / 2) for a, b in signs]
    return [(car.x + c * a - s * b, car.y + s * a + c * b) for a, b in half]


def overlap(one: Car, other: Car) -> bool:
    """Whether no line parallel to an edge separates the two boxes."""
    boxes = corners(one), corners(other)
    edges = [car.heading + turn for car in (one, other) for turn in (0.0, math.pi / 2)]
    for angle in edges:
        c = math.cos(angle)
        s = math.sin(angle)
        shadows = [[c * x + s * y for x, y in box] for box in boxes]
        if max(shadows[0]) <= min(shadows[1]) or max(shadows[1]) <= min(shadows[0]):
            return False
    return True


def close(gap: float, closing: float) -> bool:
    """Soft crash: gap under 2 m or time to collision under 1.5 s."""
    return gap < 2.0 or (closing > 0 and gap / closing < 1.5)


def ego_close(view: View) -> tuple[bool, bool]:
    """Whether the ego is dangerously close to somebody ahead, behind, in a lane its body is in."""
    ego = view.cars[0]
    cars = view.cars
    ahead = behind = False
    for lane in lanes_entered(ego, view.rules):
        j = view.leader(0, lane)
        ahead |= j is not None and close(view.gap(0, j), ego.speed - cars[j].speed)
        j = view.follower(0, lane)
        behind |= j is not None and close(view.gap(j, 0), cars[j].speed - ego.speed)
    return ahead, behind


# Episodes


def physics_step(state: State, rules: Rules) -> None:
    """Everybody looks, then everybody moves."""
    view = View(state.cars, rules)
    accelerations = [view.demanded(i) for i in range(len(state.cars))]
    if rules.mobil and state.step % 10 == 0:
        for i, change in mobil_changes(view).items():
            state.cars[i] = replace(state.cars[i], target_lane=state.cars[i].target_lane + change)
    lines = [car.target_lane * LANE_WIDTH for car in state.cars]
    if state.line is not None and state.throttle is not None:
        lines[0] = state.line
        accelerations[0] = state.throttle
    state.cars = [
        driven(car, a, steered(car, line)) for car, a, line in zip(state.cars, accelerations, lines)
    ]
    state.step += 1


def obey(state: State, action: int, rules: Rules) -> tuple[bool, bool]:
    """Whether the command starts a change, and whether it would leave the road."""
    wish = {LEFT: 1, RIGHT: -1}.get(action, 0)
    turns_back = rules.abort and state.direction != 0 and wish == -state.direction
    if wish == 0 or (state.direction != 0 and not turns_back):
        return False, False
    ego = state.cars[0]
    target = ego.target_lane + wish
    if not (there_is(target, ego.x, rules) and there_is(ego.target_lane, ego.x, rules)):
        return False, True
    state.cars[0] = replace(ego, target_lane=target)
    state.direction = wish
    state.lane_changes += 1
    return True, False


def crossing_allowed(lane: int, other: int, x: float, rules: Rules) -> bool:
    """From lane to lane; where none ends, one may come back from beside the road."""
    from_here = not rules.stretches or there_is(lane, x, rules)
    return lane == other or (from_here and there_is(other, x, rules))


def be_steered(state: State, pedal: float, wheel: float, rules: Rules) -> bool:
    """Acceleration and line of this decision; whether the lane aimed at becomes another one.

    Numbers beyond -1 and 1 count as these.
    """
    ego = state.cars[0]
    pedal, wheel = (max(-1.0, min(1.0, number)) for number in (pedal, wheel))
    lane = nearest_lane(ego, rules)
    state.line = (lane + wheel) * LANE_WIDTH
    target = lane + (wheel > 0.5) - (wheel < -0.5)
    if not crossing_allowed(lane, target, ego.x, rules):
        target = lane
    # Up to 3 m/s2, and 8 m/s2 braking; no faster than desired at the end of the decision.
    remaining = max(0.0, (ego.desired_speed - ego.speed) / (rules.substeps * DT))
    state.throttle = min(pedal * (3.0 if pedal > 0 else 8.0), remaining)
    if target == ego.target_lane:
        return False
    state.direction = 1 if target > ego.target_lane else -1
    state.cars[0] = replace(ego, target_lane=target)
    state.lane_changes += 1
    return True


# Who enters and leaves


def mixed(key: int, number: int) -> int:
    """A random 64-bit number of the two: the finaliser of splitmix64."""
    h = ((key ^ number % 2**64) + 0x9E3779B97F4A7C15) % 2**64
    h = (h ^ (h >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    h = (h ^ (h >> 27)) * 0x94D049BB133111EB % 2**64
    return h ^ (h >> 31)


def drawn(key: int, *numbers: int) -> int:
    for number in numbers:
        key = mixed(key, number)
    return key


def may_enter(newcomer: Car, number: int, state: State, rules: Rules) -> bool:
    """Whether it and nobody else has to brake harder than 4 m/s2."""
    cars = [*state.cars[:number], replace(newcomer, valid=True), *state.cars[number + 1 :]]
    view = View(cars, rules)
    mine = lanes_entered(newcomer, rules) | {newcomer.target_lane}
    for other, car in enumerate(cars):
        theirs = lanes_entered(car, rules) | {car.target_lane}
        beside = abs(car.y - newcomer.y) < (car.width + newcomer.width) / 2 + 0.4
        meet = max(min(mine), min(theirs)) <= min(max(mine), max(theirs)) or beside
        if other == number or not car.valid or not meet:
            continue
        behind, ahead = (number, other) if view.is_ahead(number, other) else (other, number)
        if view.acceleration(behind, ahead) < -4.0:
            return False
    return True


def let_in_and_out(state: State, rules: Rules) -> None:
    """After a decision: who is past the end has left, and others enter."""
    flow = rules.flow
    way_out = rules.exit_lane
    for number, car in enumerate(state.cars):
        by_exit = way_out is not None and nearest_lane(car, rules) == way_out
        past = by_exit and car.x >= rules.stretch(way_out).end_m
        if number and (past or car.x > flow.end):
            state.cars[number] = replace(car, valid=False)
    for lane, probability in enumerate(flow.arrivals):
        arrives, leaves = (drawn(state.key, state.step, lane, use) / 2**64 for use in (92, 93))
        if arrives >= probability:
            continue
        numbers = {}
        for slot, car in enumerate(state.cars):
            if slot and not car.valid and settled(car):
                differs = way_out is not None and car.exits != (leaves < flow.exit_share)
                numbers[slot] = (differs, drawn(state.key, state.step, slot, 94))
        if not numbers:
            continue
        slot = min(numbers, key=numbers.__getitem__)
        car = state.cars[slot]
        y = car.y + (lane - car.target_lane) * LANE_WIDTH
        newcomer = replace(car, x=flow.start, y=y, target_lane=lane)
        if may_enter(newcomer, slot, state, rules):
            state.cars[slot] = replace(newcomer, valid=True)


def decide(state: State, action: int | list[float], rules: Rules) -> Outcome:
    """One decision, in place; a state that has ended stays as it was at that instant."""
    outcome = Outcome()
    start_speed = state.cars[0].speed
    start_step = state.step
    off_road = False
    desired = state.cars[0].desired_speed
    if rules.actions == "continuous":
        outcome.started_change = be_steered(state, *action, rules)
    else:
        outcome.started_change, off_road = obey(state, action, rules)
    if rules.actions == "lane_speed":
        wanted = state.set_speed + {FASTER: 2.5, SLOWER: -2.5}.get(action, 0.0)
        state.set_speed = min(desired, max(min(5.0, desired), wanted))
        state.cars[0] = replace(state.cars[0], desired_speed=state.set_speed)
    if off_road:
        outcome.reasons.append("out_of_road")
    for _ in range(rules.substeps):
        if outcome.reasons:
            break
        lane = round(state.cars[0].y / LANE_WIDTH)
        physics_step(state, rules)
        ego = state.cars[0]
        left = not crossing_allowed(lane, round(ego.y / LANE_WIDTH), ego.x, rules)
        ahead, behind = ego_close(View(state.cars, rules))
        outcome.soft_crash += ahead and not state.close_ahead
        outcome.soft_crash_behind += behind and not state.close_behind
        state.close_ahead = ahead
        state.close_behind = behind
        hit = any(overlap(ego, other) for other in state.cars[1:] if other.valid)
        if hit or in_the_wall(ego, rules):
            outcome.reasons.append("hard_crash")
        elif rules.actions == "continuous" and left:
            outcome.reasons.append("out_of_road")
        elif arrival(ego, rules):
            outcome.reasons.append(arrival(ego, rules))
        elif state.step >= rules.timeout_steps:
            outcome.reasons.append("timeout")
    state.cars[0] = ego = replace(state.cars[0], desired_speed=desired)
    if settled(ego):
        state.direction = 0
    if state.step > start_step:
        outcome.mean_acceleration = (ego.speed - start_speed) / ((state.step - start_step) * DT)
    if state.direction:
        remaining = abs(ego.y - ego.target_lane * LANE_WIDTH) / LANE_WIDTH
        outcome.progress = min(1.0, max(0.0, 1.0 - remaining))
    if rules.flow is not None and not outcome.reasons:
        let_in_and_out(state, rules)
    return outcome
