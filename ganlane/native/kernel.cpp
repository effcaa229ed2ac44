// One decision of rule-driven traffic: ego command, IDM, MOBIL, steering, bicycle, collisions, events, recycling.
//
// The same model as ganlane.sim, ganlane.env and ganlane.traffic.idm_mobil, which say where each equation comes from;
// tests/native holds the two together. SI units, float32.
//
// A vector holds one number of LANES environments ("rows"), so no row depends on another: whatever is asked of a
// whole vector (any) only skips work whose result nobody uses. With -ffp-contract=off, own sine and arctangent, and
// nothing but + - * / and comparisons besides, an episode is the same bit for bit in any batch, with any LANES, on any
// instruction set.
//
// Within a row the vehicles are kept in the order of the road, foremost first. Then one pass from the front finds
// everybody's leader in every lane, and one from the rear everybody's follower: linear in the number of vehicles.
//
// How to read it. `Float` and `Mask` (vectors.hpp) hold LANES numbers and answers, one of each row; there is no `if`
// on them, so `choose(mask, yes, no)` computes both and keeps, row by row, the one that holds. Integers (lanes, target
// lanes, steps, indices) are floats here, exact below 2^24, so that they mix with the others. Read from the bottom:
// ganlane_decide, load, decide, store. Names of arrays are those of the state's keys (ganlane.keys).

#include <stdint.h>
#include <stdlib.h>

#include "arrays.hpp"
#include "model.hpp"

const float RECYCLE_RANGE = 200.0f, RECYCLE_DECELERATION = 4.0f, RECYCLE_SIDE = 0.4f;
const int MOBIL_PERIOD = 10;
enum { KEEP, LEFT, RIGHT };

// ---- The vehicles of LANES rows, foremost first

// The nearest vehicle met so far in a lane.
struct Nearest {
    Float x, half_length, speed, per_desired, index;
};

struct Rows {
    int vehicles;
    // State, [vehicles]; `index` is the place in the arrays, the ego's is 0. Visibility, lanes and flags as floats.
    Float *x, *y, *heading, *speed, *acceleration, *half_length, *half_width, *per_desired, *target, *visibility;
    Float *valid, *steering, *index;
    // Follows from the state: slip angle, heading's sine and cosine, lateral half extent; the lowest and highest lane
    // that the body is in, that the driver attends to, and in which others see the vehicle.
    Float *slip, *slip_sine, *sine, *cosine, *extent, *body_low, *body_high, *low, *high, *seen_low, *seen_high;
    // Of one physics step: acceleration by IDM; the lane change that MOBIL wishes.
    Float *following, *wish, *kept;
    // MOBIL's neighbours in the own, left and right lane: [3][vehicles].
    Float *gap_ahead, *speed_ahead, *gap_behind, *speed_behind, *per_desired_behind;
    Nearest* nearest;  // [lanes]
    // Of the rows: whether they go on, physics steps since MOBIL's last decision and in all, and the ego's events.
    Mask running, ahead, behind, crash, goal;
    Float phase, step, onsets, onsets_behind;
};

const int STATE_FIELDS = 13, VEHICLE_FIELDS = 27, MOBIL_FIELDS = 5;

static size_t scratch_floats(const Settings& s) {
    return (size_t)s.vehicles * (VEHICLE_FIELDS + 3 * MOBIL_FIELDS) + 5 * (size_t)s.lanes;
}

static void lay_out(Rows& rows, Float* scratch, const Settings& s) {
    rows.vehicles = s.vehicles;
    Float** fields[VEHICLE_FIELDS] = {
        &rows.x, &rows.y, &rows.heading, &rows.speed, &rows.acceleration, &rows.half_length, &rows.half_width,
        &rows.per_desired, &rows.target, &rows.visibility, &rows.valid, &rows.steering, &rows.index,
        &rows.slip, &rows.slip_sine, &rows.sine, &rows.cosine, &rows.extent, &rows.body_low, &rows.body_high, &rows.low, &rows.high,
        &rows.seen_low, &rows.seen_high, &rows.following, &rows.wish, &rows.kept,
    };
    for (Float** field : fields) *field = scratch, scratch += s.vehicles;
    Float** neighbours[MOBIL_FIELDS] = {
        &rows.gap_ahead, &rows.speed_ahead, &rows.gap_behind, &rows.speed_behind, &rows.per_desired_behind,
    };
    for (Float** field : neighbours) *field = scratch, scratch += 3 * s.vehicles;
    rows.nearest = (Nearest*)scratch;
}

INLINE Mask is_ego(const Rows& r, int i) { return r.index[i] == 0.0f; }

// Exchange two vehicles where `mask` holds; what follows from the state is computed anew afterwards, but for the slip
// angle and its sine: they follow from the steering alone, which `drive` has at hand and find_lanes does not need.
static inline void exchange(Rows& r, int i, int j, Mask mask) {
    Float* fields[STATE_FIELDS + 2] = {r.x, r.y, r.heading, r.speed, r.acceleration, r.half_length, r.half_width,
                                       r.per_desired, r.target, r.visibility, r.valid, r.steering, r.index, r.slip, r.slip_sine};
    for (Float* field : fields) {
        Float first = field[i], second = field[j];
        field[i] = choose(mask, second, first);
        field[j] = choose(mask, first, second);
    }
}

// Foremost first; of two at the same place the one with the lower index. A bubble sort, since few overtake within
// 0.1 s: mostly one pass of comparisons, and what lies behind the last exchange is in order.
static inline void put_in_order(Rows& r) {
    for (int last = r.vehicles - 1; last > 0;) {
        int exchanged = 0;
        for (int i = 0; i < last; i++) {
            Mask wrong = (r.x[i] < r.x[i + 1]) | ((r.x[i] == r.x[i + 1]) & (r.index[i] > r.index[i + 1]));
            if (any(wrong)) exchange(r, i, i + 1, wrong), exchanged = i;
        }
        last = exchanged;
    }
}

// ---- Who is in which lane

static inline void find_lanes(const Settings& s, Rows& r) {
    for (int i = 0; i < r.vehicles; i++) {
        sincos_of(r.heading[i], r.sine[i], r.cosine[i]);
        LanesOf l = lanes_of(s, r.y[i], r.sine[i], r.cosine[i], r.half_length[i], r.half_width[i], r.target[i],
                             r.visibility[i], r.valid[i] != 0.0f);
        r.extent[i] = l.extent;
        r.body_low[i] = l.body_low, r.body_high[i] = l.body_high, r.low[i] = l.low, r.high[i] = l.high;
        r.seen_low[i] = l.seen_low, r.seen_high[i] = l.seen_high;
    }
}

INLINE Mask seen_in(const Rows& r, int i, Float lane) { return (r.seen_low[i] <= lane) & (lane <= r.seen_high[i]); }

INLINE Nearest nobody_at(float x, Float speed) { return {filled(x), filled(0.0f), speed, filled(1.0f), filled(0.0f)}; }

static inline void nobody_met(const Settings& s, Rows& r, float x) {
    for (int lane = 0; lane < s.lanes; lane++) r.nearest[lane] = nobody_at(x, filled(0.0f));
}

// On the way from the front: vehicle i is the nearest in the lanes it is seen in, unless the rear of a longer one
// ahead reaches further back. Of two at the same gap the slower one counts.
INLINE void meet_from_front(const Settings& s, Rows& r, int i) {
    for (int lane = 0; lane < s.lanes; lane++) {
        Nearest& n = r.nearest[lane];
        Float nearer = (n.x - r.x[i]) + (r.half_length[i] - n.half_length);
        Mask here = seen_in(r, i, filled((float)lane)) & ((nearer > 0.0f) | ((nearer == 0.0f) & (r.speed[i] < n.speed)));
        n.x = choose(here, r.x[i], n.x);
        n.half_length = choose(here, r.half_length[i], n.half_length);
        n.speed = choose(here, r.speed[i], n.speed);
    }
}

// On the way from the rear; of two at the same gap the one with the lower index counts.
INLINE void meet_from_rear(const Settings& s, Rows& r, int i) {
    for (int lane = 0; lane < s.lanes; lane++) {
        Nearest& n = r.nearest[lane];
        Float nearer = (r.x[i] - n.x) + (r.half_length[i] - n.half_length);
        Mask here = seen_in(r, i, filled((float)lane)) & ((nearer > 0.0f) | ((nearer == 0.0f) & (r.index[i] < n.index)));
        n.x = choose(here, r.x[i], n.x);
        n.half_length = choose(here, r.half_length[i], n.half_length);
        n.speed = choose(here, r.speed[i], n.speed);
        n.per_desired = choose(here, r.per_desired[i], n.per_desired);
        n.index = choose(here, r.index[i], n.index);
    }
}

// The nearest met so far in the lane that each row has its own number of; `nobody` where the road has no such lane.
// A vector's rows may ask for different lanes, so all lanes are looked at, and each row keeps its own.
INLINE Nearest nearest_in(const Settings& s, const Rows& r, Float lane, Nearest nobody, int first = 0) {
    Nearest n = nobody;
    for (int k = first; k < s.lanes; k++) {
        Mask here = lane == (float)k;
        n.x = choose(here, r.nearest[k].x, n.x);
        n.half_length = choose(here, r.nearest[k].half_length, n.half_length);
        n.speed = choose(here, r.nearest[k].speed, n.speed);
        n.per_desired = choose(here, r.nearest[k].per_desired, n.per_desired);
    }
    return n;
}

INLINE Float gap_ahead(const Rows& r, int i, Float x, Float half_length) {
    return smaller((x - r.x[i]) - (r.half_length[i] + half_length), filled(FREE_GAP));
}

// ---- Car following: the smallest IDM acceleration over the lanes that the driver attends to

static inline void follow(const Settings& s, Rows& r) {
    nobody_met(s, r, NOBODY_M);
    for (int i = 0; i < r.vehicles; i++) {
        Float speed = r.speed[i], low = r.low[i], high = r.high[i];
        Float strongest = filled(0.0f);
        if (!any(low != high)) {
            // Nobody in any row is in two lanes, as nearly always: one lane each.
            Nearest n = nearest_in(s, r, low, r.nearest[0], 1);
            Float gap = gap_ahead(r, i, n.x, n.half_length);
            strongest = interaction(s, speed, gap, choose(gap < FREE_GAP, n.speed, speed));
        } else {
            Float middle = smaller(low + 1.0f, high);
            for (int lane = 0; lane < s.lanes; lane++) {
                float number = (float)lane;
                Mask here = (low == number) | (middle == number) | (high == number);
                if (!any(here)) continue;
                const Nearest& n = r.nearest[lane];
                Float gap = gap_ahead(r, i, n.x, n.half_length);
                Float force = interaction(s, speed, gap, choose(gap < FREE_GAP, n.speed, speed));
                strongest = choose(here, larger(strongest, force), strongest);
            }
        }
        r.following[i] = limited(s, free_road(speed, r.per_desired[i]), strongest);
        meet_from_front(s, r, i);
    }
}

// ---- MOBIL

// Leader and follower of everybody in the own lane, to the left and to the right.
static inline void find_neighbours(const Settings& s, Rows& r) {
    const float SIDES[3] = {0.0f, 1.0f, -1.0f};
    nobody_met(s, r, NOBODY_M);
    for (int i = 0; i < r.vehicles; i++) {
        for (int side = 0; side < 3; side++) {
            Nearest n = nearest_in(s, r, r.target[i] + SIDES[side], nobody_at(NOBODY_M, r.speed[i]));
            Float gap = gap_ahead(r, i, n.x, n.half_length);
            r.gap_ahead[side * r.vehicles + i] = gap;
            r.speed_ahead[side * r.vehicles + i] = choose(gap < FREE_GAP, n.speed, r.speed[i]);
        }
        meet_from_front(s, r, i);
    }
    nobody_met(s, r, -NOBODY_M);
    for (int i = r.vehicles - 1; i >= 0; i--) {
        for (int side = 0; side < 3; side++) {
            Nearest n = nearest_in(s, r, r.target[i] + SIDES[side], nobody_at(-NOBODY_M, r.speed[i]));
            Float gap = (r.x[i] - n.x) - (r.half_length[i] + n.half_length);
            r.gap_behind[side * r.vehicles + i] = smaller(gap, filled(FREE_GAP));
            r.speed_behind[side * r.vehicles + i] = n.speed;
            r.per_desired_behind[side * r.vehicles + i] = n.per_desired;
        }
        meet_from_rear(s, r, i);
    }
}

// Accelerations in a lane: the driver's own there; its follower's there with and without it, 0 without a follower.
struct Prospect {
    Float own, with_it, without;
};

INLINE Prospect prospect(const Settings& s, const Rows& r, int i, int side) {
    int at = side * r.vehicles + i;
    Float ahead = r.gap_ahead[at], behind = r.gap_behind[at], follower = r.speed_behind[at];
    Float free = free_road(follower, r.per_desired_behind[at]);
    Float with_it = limited(s, free, interaction(s, follower, behind, r.speed[i]));
    Mask leads = ahead < FREE_GAP, follows = behind < FREE_GAP;
    Float gap = choose(leads, behind + 2.0f * r.half_length[i] + ahead, filled(FREE_GAP));
    Float without = limited(s, free, interaction(s, follower, gap, choose(leads, r.speed_ahead[at], follower)));
    return {
        idm(s, r.speed[i], r.per_desired[i], ahead, r.speed_ahead[at]),
        choose(follows, with_it, filled(0.0f)),
        choose(follows, without, filled(0.0f)),
    };
}

// Below every incentive that can be.
const float NEVER = -1e30f;

// The incentive of a change, m/s2; NEVER where it does not pay, is unsafe or leaves the road.
INLINE Float incentive(const Settings& s, const Prospect& here, const Prospect& there, Mask exists) {
    Float gain = there.own - here.own + s.politeness_side * (there.with_it - there.without) +
                 s.politeness_rear * (here.without - here.with_it);
    Mask safe = smaller(there.with_it, there.own) >= -s.safe_deceleration;
    return choose(exists & safe & (gain > s.threshold), gain, filled(NEVER));
}

// The change that MOBIL proposes to everybody but the ego: +1 left, -1 right, 0 none. Returns whether anybody wants.
static inline bool find_wishes(const Settings& s, Rows& r, Mask due) {
    find_neighbours(s, r);
    Mask wanted = none();
    for (int i = 0; i < r.vehicles; i++) {
        Mask free = due & ~is_ego(r, i) & (r.valid[i] != 0.0f) &
                    (absolute(r.y[i] - r.target[i] * s.lane_width) < ARRIVED);
        r.wish[i] = filled(0.0f);
        if (!any(free)) continue;
        Prospect here = prospect(s, r, i, 0);
        Float left = incentive(s, here, prospect(s, r, i, 1), r.target[i] + 1.0f <= (float)(s.lanes - 1));
        Float right = incentive(s, here, prospect(s, r, i, 2), r.target[i] - 1.0f >= 0.0f);
        Float side = choose(left >= right, filled(1.0f), filled(-1.0f));
        Mask pays = free & (larger(left, right) > NEVER);
        r.wish[i] = choose(pays, side, filled(0.0f));
        wanted |= pays;
    }
    return any(wanted);
}

// Of several that want into one lane, only the foremost within `exclusive` m goes, or whom no other makes brake hard.
static inline void one_at_a_time(const Settings& s, Rows& r) {
    for (int i = 0; i < r.vehicles; i++) {
        r.kept[i] = r.wish[i];
        Mask wants = r.wish[i] != 0.0f, waits = none();
        if (!any(wants)) continue;
        Float lane = r.target[i] + r.wish[i];
        for (int j = 0; j < i; j++) {
            Mask rival = wants & (r.wish[j] != 0.0f) & (r.target[j] + r.wish[j] == lane);
            if (!any(rival)) continue;
            Float distance = r.x[j] - r.x[i];
            Float demand = idm(s, r.speed[i], r.per_desired[i], gap_ahead(r, i, r.x[j], r.half_length[j]), r.speed[j]);
            waits |= rival & ((distance < s.exclusive) | (demand < -s.safe_deceleration));
        }
        r.kept[i] = choose(waits, filled(0.0f), r.wish[i]);
    }
}

static inline void change_lanes(const Settings& s, Rows& r, Mask due) {
    if (!any(due) || !find_wishes(s, r, due)) return;
    one_at_a_time(s, r);
    for (int i = 0; i < r.vehicles; i++) r.target[i] = r.target[i] + r.kept[i];
}

// ---- Motion: two-point steering and the kinematic bicycle, in the rows that go on

static inline void drive(const Settings& s, Rows& r) {
    for (int i = 0; i < r.vehicles; i++) {
        Float y = r.y[i], heading = r.heading[i], speed = r.speed[i], slip = r.slip[i];
        // steering: ganlane.sim.dynamics.steer, with speed and distances inverted once, since a division takes as long
        // as ten products. An invalid vehicle is driven as well: cheaper than to leave it out.
        Float per_pace = 1.0f / larger(speed, filled(s.slow)), offset = r.target[i] * s.lane_width - y;
        Float lateral_speed = speed * sine_of(heading + slip);
        Float yaw_rate = speed * r.slip_sine[i] * (2.0f / WHEELBASE);
        Float per_near = per_pace * s.per_near_s, per_far = per_pace * s.per_far_s;
        Float slope_near = offset * per_near, slope_far = offset * per_far;
        // d/dt atan(offset / distance) = -lateral_speed / (distance (1 + slope^2)), of both points over one divisor
        Float near = 1.0f + slope_near * slope_near, far = 1.0f + slope_far * slope_far;
        Float sideways = lateral_speed / (near * far);
        Float rate_near = -(sideways * far * per_near) - yaw_rate, rate_far = -(sideways * near * per_far) - yaw_rate;
        Float theta_near = arctangent(slope_near) - heading;
        Float turn_wheel = s.gain_far * rate_far + s.gain_near * rate_near + s.gain_integral * theta_near * (speed * per_pace);
        Float steering = r.steering[i] + WHEELBASE * per_pace * turn_wheel * PHYSICS_STEP;
        steering = at_rest(between(steering, -s.max_angle, s.max_angle));
        // bicycle: ganlane.sim.dynamics.advance
        Float new_speed = larger(speed + r.following[i] * PHYSICS_STEP, filled(0.0f));
        Float distance = 0.5f * (speed + new_speed) * PHYSICS_STEP;
        Float new_slip = slip_of(steering), slip_sine = sine_of(new_slip);
        Float turn = distance * slip_sine * (2.0f / WHEELBASE);
        Float sine, cosine;
        sincos_of(heading + new_slip + 0.5f * turn, sine, cosine);
        Mask on = r.running;  // rows that have ended stay as they ended
        r.x[i] = choose(on, r.x[i] + distance * cosine, r.x[i]);
        r.y[i] = choose(on, at_rest(y + distance * sine), y);
        r.heading[i] = choose(on, at_rest(heading + turn), heading);
        r.speed[i] = choose(on, new_speed, speed);
        r.acceleration[i] = choose(on, (new_speed - speed) * (1.0f / PHYSICS_STEP), r.acceleration[i]);
        r.steering[i] = choose(on, steering, r.steering[i]);
        r.slip[i] = choose(on, new_slip, slip);
        r.slip_sine[i] = choose(on, slip_sine, r.slip_sine[i]);
    }
}

// ---- The ego among the others

struct Ego {
    Float x, y, heading, sine, cosine, half_length, half_width, extent, speed, low, high, valid;
};

static inline Ego find_ego(const Rows& r) {
    Float zero = filled(0.0f);
    Ego e = {zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero};
    for (int i = 0; i < r.vehicles; i++) {
        Mask it = is_ego(r, i);
        if (!any(it)) continue;
        e.x = choose(it, r.x[i], e.x), e.y = choose(it, r.y[i], e.y);
        e.heading = choose(it, r.heading[i], e.heading);
        e.sine = choose(it, r.sine[i], e.sine), e.cosine = choose(it, r.cosine[i], e.cosine);
        e.half_length = choose(it, r.half_length[i], e.half_length);
        e.half_width = choose(it, r.half_width[i], e.half_width);
        e.extent = choose(it, r.extent[i], e.extent), e.speed = choose(it, r.speed[i], e.speed);
        e.low = choose(it, r.body_low[i], e.low), e.high = choose(it, r.body_high[i], e.high);
        e.valid = choose(it, r.valid[i], e.valid);
    }
    return e;
}

// Whether two oriented boxes overlap (separating axes; touching does not count).
INLINE Mask overlaps(const Ego& e, const Rows& r, int i) {
    Float dx = r.x[i] - e.x, dy = r.y[i] - e.y, c = e.cosine, s = e.sine, oc = r.cosine[i], os = r.sine[i];
    Float cosine = absolute(c * oc + s * os), sine = absolute(c * os - s * oc);
    Float length = e.half_length, width = e.half_width, other_length = r.half_length[i], other_width = r.half_width[i];
    Mask apart = (absolute(dx * c + dy * s) >= length + other_length * cosine + other_width * sine) |
                 (absolute(dy * c - dx * s) >= width + other_length * sine + other_width * cosine) |
                 (absolute(dx * oc + dy * os) >= other_length + length * cosine + width * sine) |
                 (absolute(dy * oc - dx * os) >= other_width + length * sine + width * cosine);
    return ~apart;
}

// Hard crash: the ego overlaps somebody. Only who is near along the road and across is looked at closely.
static inline Mask crashed(const Ego& e, const Rows& r) {
    Mask hit = none();
    for (int i = 0; i < r.vehicles; i++) {
        Mask counts = (r.valid[i] != 0.0f) & (e.valid != 0.0f) & ~is_ego(r, i);
        Float reach = e.half_length + e.half_width + r.half_length[i] + r.half_width[i];
        Mask near = (absolute(r.x[i] - e.x) < reach) & (absolute(r.y[i] - e.y) < e.extent + r.extent[i] + 0.01f);
        if (any(counts & near)) hit |= counts & overlaps(e, r, i);
    }
    return hit;
}

// Soft crash ahead and behind: the nearest in a lane that the ego's body is in is dangerously close. One scan, in any
// order; written out, since sharing it with the like one of mask.cpp made a decision of 1024 rows take 8 % longer.
static inline void look_round(const Settings& s, const Rows& r, const Ego& e, Mask& ahead, Mask& behind) {
    ahead = none(), behind = none();
    Float lanes[3] = {e.low, e.high, smaller(e.low + 1.0f, e.high)};
    int count = any(e.high - e.low > 1.0f) ? 3 : any(e.high > e.low) ? 2 : 1;
    for (int k = 0; k < count; k++) {
        Float gap = filled(FREE_GAP), speed = e.speed, gap_behind = filled(FREE_GAP), follower = e.speed, index = filled(0.0f);
        for (int i = 0; i < r.vehicles; i++) {
            Float d = r.x[i] - e.x, g = absolute(d) - (e.half_length + r.half_length[i]);
            Mask here = seen_in(r, i, lanes[k]) & ~is_ego(r, i), before = d > 0.0f;  // at the same x the ego is ahead
            Mask leads = here & before & ((g < gap) | ((g == gap) & (r.speed[i] < speed)));
            Mask follows = here & ~before & ((g < gap_behind) | ((g == gap_behind) & (r.index[i] < index)));
            gap = choose(leads, g, gap), speed = choose(leads, r.speed[i], speed);
            gap_behind = choose(follows, g, gap_behind), follower = choose(follows, r.speed[i], follower);
            index = choose(follows, r.index[i], index);
        }
        ahead |= (gap < s.soft_crash_gap) | (gap < s.soft_crash_ttc * (e.speed - speed));
        behind |= (gap_behind < s.soft_crash_gap) | (gap_behind < s.soft_crash_ttc * (follower - e.speed));
    }
}

// What a physics step led to. A hard crash comes before the goal, both before the time-out.
static inline void note_events(const Settings& s, Rows& r) {
    Ego e = find_ego(r);
    Mask ahead, behind, on = r.running;
    look_round(s, r, e, ahead, behind);
    Mask crash = crashed(e, r) & on, goal = (e.x >= s.goal) & on & ~crash;
    Float one = filled(1.0f), zero = filled(0.0f);
    r.step = r.step + choose(on, one, zero);
    r.onsets = r.onsets + choose(ahead & ~r.ahead & on, one, zero);
    r.onsets_behind = r.onsets_behind + choose(behind & ~r.behind & on, one, zero);
    r.ahead = (ahead & on) | (r.ahead & ~on);
    r.behind = (behind & on) | (r.behind & ~on);
    r.crash |= crash, r.goal |= goal;
    r.running = on & ~crash & ~goal & (r.step < (float)s.timeout_steps);
}

// ---- Recycling: who is left far behind is put far ahead, and the reverse, where nobody has to brake hard for it

// Whether vehicle i at `x` leaves room to vehicle j at `other`: none of the two brakes harder than is safe.
INLINE Mask leaves_room(const Settings& s, const Rows& r, int i, Float x, int j, Float other, Mask tie_ahead) {
    Float distance = other - x, bumpers = r.half_length[i] + r.half_length[j];
    Mask ahead = (distance > 0.0f) | ((distance == 0.0f) & tie_ahead);
    Float gap = smaller(absolute(distance) - bumpers, filled(FREE_GAP));
    Float behind_it = idm(s, r.speed[i], r.per_desired[i], gap, r.speed[j]);
    Float before_it = idm(s, r.speed[j], r.per_desired[j], gap, r.speed[i]);
    return choose(ahead, behind_it, before_it) >= -RECYCLE_DECELERATION;
}

static inline void recycle(const Settings& s, Rows& r, Mask rows) {
    Float* moved = r.wish;  // free between decisions of MOBIL, as is `kept`
    Float ego_x = find_ego(r).x;
    Mask away = none();
    for (int i = 0; i < r.vehicles; i++) {
        Float distance = r.x[i] - ego_x;
        Mask out = (absolute(distance) > RECYCLE_RANGE) & (r.valid[i] != 0.0f);
        Float jump = choose(distance > 0.0f, filled(2.0f * RECYCLE_RANGE), filled(-2.0f * RECYCLE_RANGE));
        moved[i] = choose(out, r.x[i] - jump, r.x[i]);
        away |= out & rows;
    }
    if (!any(away)) return;
    for (int i = 0; i < r.vehicles; i++) {
        Mask room = rows & (moved[i] != r.x[i]);
        r.kept[i] = r.x[i];
        if (!any(room)) continue;
        for (int j = 0; j < r.vehicles; j++) {
            Mask beside = absolute(r.y[i] - r.y[j]) < r.half_width[i] + r.half_width[j] + RECYCLE_SIDE;
            Mask counts = (((r.low[i] <= r.high[j]) & (r.low[j] <= r.high[i])) | beside) & (r.valid[j] != 0.0f);
            if (j == i || !any(counts & room)) continue;
            // Everybody where it may be put, and where it is: whoever else moves, there is room.
            room &= ~counts | (leaves_room(s, r, i, moved[i], j, moved[j], r.index[j] < r.index[i]) &
                               leaves_room(s, r, i, moved[i], j, r.x[j], none()));
        }
        r.kept[i] = choose(room, moved[i], r.x[i]);
    }
    for (int i = 0; i < r.vehicles; i++) r.x[i] = r.kept[i];
}

// ---- A decision

static inline void decide(const Settings& s, Rows& r) {
    find_lanes(s, r);
    for (int substep = 0; substep < s.substeps && any(r.running); substep++) {
        // Everybody looks at the vehicles as they are before anybody moves: accelerations first, then lanes.
        follow(s, r);
        if (s.mobil) change_lanes(s, r, r.running & (r.phase == 0.0f));
        r.phase = choose(r.phase == (float)(MOBIL_PERIOD - 1), filled(0.0f), r.phase + 1.0f);
        drive(s, r);
        put_in_order(r);
        find_lanes(s, r);
        note_events(s, r);
    }
}

// ---- Arrays in and out: LANES rows beginning at `first`; behind the last row its numbers are repeated

struct Command {  // of one row, what the action leads to
    int64_t direction, target;
    bool starts, off_road;
    float speed;
    int64_t step;
};

// The action 0 keep, 1 left, 2 right; ignored during a lane change, but with `abort_lane_change` it may turn back.
static Command obey(const Settings& s, const Inputs& in, long row) {
    int64_t wish = in.action[row] == LEFT ? 1 : in.action[row] == RIGHT ? -1 : 0;
    int64_t direction = in.change_direction[row], target = in.target_lane[row * s.vehicles];
    if (!is_heard(wish, direction, s.abort_lane_change)) wish = 0;
    bool off_road = !on_road(target + wish, s.lanes);
    if (off_road) wish = 0;
    return {wish ? wish : direction, target + wish, wish != 0, off_road, in.speed[row * s.vehicles], in.step[row]};
}

// One row's number of a vehicle: a vector seen as the array that it is.
INLINE float& at(Float* field, int i, int lane) { return ((float*)(field + i))[lane]; }

static void load(const Settings& s, const Inputs& in, Rows& r, long first, long rows, Command* commands) {
    for (int lane = 0; lane < LANES; lane++) {
        long start = (first + (lane < rows ? lane : rows - 1)) * s.vehicles;
        for (int i = 0; i < s.vehicles; i++) at(r.x, i, lane) = in.x[start + i], at(r.index, i, lane) = (float)i;
    }
    for (int last = s.vehicles - 1; last > 0;) {  // as put_in_order, of positions and indices alone
        int exchanged = 0;
        for (int i = 0; i < last; i++) {
            Mask wrong = r.x[i] < r.x[i + 1];
            if (!any(wrong)) continue;
            Float x = r.x[i], index = r.index[i];
            r.x[i] = choose(wrong, r.x[i + 1], x), r.x[i + 1] = choose(wrong, x, r.x[i + 1]);
            r.index[i] = choose(wrong, r.index[i + 1], index), r.index[i + 1] = choose(wrong, index, r.index[i + 1]);
            exchanged = i;
        }
        last = exchanged;
    }
    for (int lane = 0; lane < LANES; lane++) {
        long row = first + (lane < rows ? lane : rows - 1), start = row * s.vehicles;
        Command command = commands[lane] = obey(s, in, row);
        for (int i = 0; i < s.vehicles; i++) {
            long index = (long)at(r.index, i, lane), from = start + index;
            at(r.y, i, lane) = in.y[from];
            at(r.heading, i, lane) = in.heading[from];
            at(r.speed, i, lane) = in.speed[from];
            at(r.acceleration, i, lane) = in.acceleration[from];
            at(r.half_length, i, lane) = 0.5f * in.length[from];
            at(r.half_width, i, lane) = 0.5f * in.width[from];
            at(r.per_desired, i, lane) = 1.0f / in.desired_speed[from];
            at(r.target, i, lane) = (float)(index == 0 ? command.target : in.target_lane[from]);
            at(r.visibility, i, lane) = (float)in.visibility[from];
            at(r.valid, i, lane) = (float)(in.valid[from] != 0);
            at(r.steering, i, lane) = index == 0 ? in.ego_steering[row] : in.steering[from];
        }
        r.running[lane] = lane < rows && !command.off_road ? -1 : 0;
        r.ahead[lane] = in.soft_crash[row] ? -1 : 0;
        r.behind[lane] = in.soft_crash_behind[row] ? -1 : 0;
        r.phase[lane] = (float)(command.step % MOBIL_PERIOD);  // rows of a vector may be at different times
        r.step[lane] = (float)command.step;
    }
    for (int i = 0; i < s.vehicles; i++) r.slip[i] = slip_of(r.steering[i]), r.slip_sine[i] = sine_of(r.slip[i]);
    r.crash = r.goal = none();
    r.onsets = r.onsets_behind = filled(0.0f);
}

static void store_ego(const Settings& s, const Inputs& in, const Rows& r, const Outputs& out, long row, int lane,
                      const Command& command) {
    long ego = row * s.vehicles;
    float y = out.y[ego], centre = (float)out.target_lane[ego] * s.lane_width;
    float off = y - centre < 0.0f ? centre - y : y - centre;
    int64_t direction = off < ARRIVED ? 0 : command.direction, step = (int64_t)r.step[lane];
    float progress = 1.0f - off / s.lane_width;
    int64_t steps = step - command.step;
    bool goal = r.goal[lane], crash = r.crash[lane], ended = goal || crash || command.off_road;
    bool truncated = !r.running[lane] && !ended;
    out.mean_acceleration[row] = (out.speed[ego] - command.speed) / ((float)(steps < 1 ? 1 : steps) * PHYSICS_STEP);
    out.change_progress[row] = direction == 0 || progress < 0.0f ? 0.0f : progress > 1.0f ? 1.0f : progress;
    out.distance[row] = out.x[ego];
    out.change_direction[row] = direction;
    out.decisions[row] = in.decisions[row] + 1;
    out.lane_changes[row] = in.lane_changes[row] + command.starts;
    out.soft_crash[row] = r.ahead[lane] != 0;
    out.soft_crash_behind[row] = r.behind[lane] != 0;
    out.started_change[row] = command.starts;
    out.step[row] = step;
    out.goal[row] = goal, out.hard_crash[row] = crash, out.out_of_road[row] = command.off_road;
    out.timeout[row] = out.truncated[row] = truncated;
    out.soft_crashes[row] = (int64_t)r.onsets[lane], out.soft_crashes_behind[row] = (int64_t)r.onsets_behind[lane];
    out.terminated[row] = ended, out.done[row] = ended || truncated;
}

static void store(const Settings& s, const Inputs& in, Rows& r, const Outputs& out, long first, long rows,
                  const Command* commands) {
    for (int lane = 0; lane < rows; lane++) {
        long row = first + lane, start = row * s.vehicles;
        for (int i = 0; i < s.vehicles; i++) {
            long index = (long)at(r.index, i, lane), to = start + index;
            out.x[to] = at(r.x, i, lane);
            out.y[to] = at(r.y, i, lane);
            out.heading[to] = at(r.heading, i, lane);
            out.speed[to] = at(r.speed, i, lane);
            out.acceleration[to] = at(r.acceleration, i, lane);
            out.target_lane[to] = (int64_t)at(r.target, i, lane);
            out.steering[to] = at(r.steering, i, lane);
        }
        out.ego_steering[row] = out.steering[start];
        store_ego(s, in, r, out, row, lane, commands[lane]);
    }
}

// Drives the rows [first, last) through one decision. Returns 0, or 1 without memory, or 2 and drives none of them
// where an action is not 0, 1 or 2.
extern "C" int ganlane_decide(const Settings* settings, const Inputs* in, const Outputs* out, long first, long last) {
    const Settings& s = *settings;
    for (long row = first; row < last; row++)
        if ((uint64_t)in->action[row] > 2) return 2;
    // One vector more than needed, to begin at a multiple of a vector's size, which its instructions ask for.
    size_t bytes = scratch_floats(s) * sizeof(Float) + sizeof(Float);
    void* memory = malloc(bytes);
    if (!memory) return 1;
    Rows r;
    lay_out(r, (Float*)(((uintptr_t)memory + sizeof(Float) - 1) / sizeof(Float) * sizeof(Float)), s);
    Command commands[LANES];
    for (long row = first; row < last; row += LANES) {
        long rows = last - row < LANES ? last - row : LANES;
        load(s, *in, r, row, rows, commands);
        decide(s, r);
        if (in->recycles) {
            Mask recycles = none();
            for (int lane = 0; lane < rows; lane++) recycles[lane] = in->recycles[row + lane] ? -1 : 0;
            recycle(s, r, recycles & r.running);
        }
        store(s, *in, r, *out, row, rows, commands);
    }
    free(memory);
    return 0;
}
