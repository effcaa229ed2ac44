// The vehicles of LANES environments, and how rule-driven ones go: order on the road, lanes, IDM, MOBIL, steering, bicycle.
//
// Within a row the vehicles are kept in the order of the road, foremost first. Then one pass from the front finds
// everybody's leader in every lane, and one from the rear everybody's follower: linear in the number of vehicles.

#pragma once

#include <stddef.h>

#include "model.hpp"

const int MOBIL_PERIOD = 10;
#define INLINE_METHOD inline __attribute__((always_inline))

// ---- The vehicles of LANES rows, foremost first

// Numbers that a driver carries from step to step: at most so many, as Fields (memory.hpp) lays them out.
const int MOST_FIELDS = 48;

// The nearest vehicle met so far in a lane.
struct Nearest {
    Float x, half_length, speed, per_desired, index;
};

struct Rows {
    int vehicles, memory_fields;  // how many of `memory` are used
    bool alone;  // there is only row 0
    // State, [vehicles]; `index` is the place in the arrays, the ego's is 0. Visibility, lanes and flags as floats;
    // `valid` is EXITS of drivers who leave the road by its exit.
    Float *x, *y, *heading, *speed, *acceleration, *half_length, *half_width, *per_desired, *target, *visibility;
    Float *valid, *steering, *index;
    // Follows from the state: slip angle, heading's sine and cosine, lateral half extent; the lowest and highest lane
    // that the body is in, that the driver attends to, and in which others see the vehicle.
    Float *slip, *slip_sine, *sine, *cosine, *extent, *body_low, *body_high, *low, *high, *seen_low, *seen_high;
    // Of one physics step: acceleration by IDM; the lane change that is wished, and that is begun.
    Float *following, *wish, *kept;
    // Of generated drivers (generated.hpp): what the network says, and bounds of the acceleration.
    Float *along, *across, *lowest, *highest;
    Float* memory[MOST_FIELDS];
    // MOBIL's neighbours in the own, left and right lane: [3][vehicles].
    Float *gap_ahead, *speed_ahead, *gap_behind, *speed_behind, *per_desired_behind;
    Nearest *nearest, *asking;  // [lanes]; `asking`: of those who have to change into the lane
    // Of the rows: whether they go on, physics steps since MOBIL's last decision and in all, and the ego's events.
    Mask running, ahead, behind, crash, goal, missed_exit, out_of_road;
    Mask unseen;  // the ego, to everybody
    Float phase, step, onsets, onsets_behind;
    Float line, pedal;  // of `continuous`: the line that the ego steers to, and its acceleration
    // Keys of the random numbers: of the episode, and of this step; physics steps at the start of the decision.
    uint64_t episode_key[LANES], step_key[LANES];
    int64_t start_step[LANES];
};

const int STATE_FIELDS = 13, VEHICLE_FIELDS = 31, MOBIL_FIELDS = 5;

static size_t scratch_floats(const Settings& s) {
    return (size_t)s.vehicles * (VEHICLE_FIELDS + 3 * MOBIL_FIELDS + MOST_FIELDS) + 10 * (size_t)s.lanes;
}

static void lay_out(Rows& rows, Float* scratch, const Settings& s) {
    rows.vehicles = s.vehicles;
    Float** fields[VEHICLE_FIELDS] = {
        &rows.x, &rows.y, &rows.heading, &rows.speed, &rows.acceleration, &rows.half_length, &rows.half_width,
        &rows.per_desired, &rows.target, &rows.visibility, &rows.valid, &rows.steering, &rows.index,
        &rows.slip, &rows.slip_sine, &rows.sine, &rows.cosine, &rows.extent, &rows.body_low, &rows.body_high, &rows.low, &rows.high,
        &rows.seen_low, &rows.seen_high, &rows.following, &rows.wish, &rows.kept,
        &rows.along, &rows.across, &rows.lowest, &rows.highest,
    };
    for (Float** field : fields) *field = scratch, scratch += s.vehicles;
    Float** neighbours[MOBIL_FIELDS] = {
        &rows.gap_ahead, &rows.speed_ahead, &rows.gap_behind, &rows.speed_behind, &rows.per_desired_behind,
    };
    for (Float** field : neighbours) *field = scratch, scratch += 3 * s.vehicles;
    for (int k = 0; k < rows.memory_fields; k++) rows.memory[k] = scratch, scratch += s.vehicles;
    rows.nearest = (Nearest*)scratch, rows.asking = rows.nearest + s.lanes;
}

const float EXITS = 2.0f;  // a valid vehicle whose driver leaves the road by its exit

INLINE Mask is_ego(const Rows& r, int i) { return r.index[i] == 0.0f; }

// Whether the others know of vehicle i.
INLINE Mask visible(const Rows& r, int i) { return (r.valid[i] != 0.0f) & ~(r.unseen & is_ego(r, i)); }

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
    for (int k = 0; k < r.memory_fields; k++) {
        Float first = r.memory[k][i], second = r.memory[k][j];
        r.memory[k][i] = choose(mask, second, first);
        r.memory[k][j] = choose(mask, first, second);
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

static inline void find_lanes(const Settings& s, Rows& r, bool turned = true) {
    for (int i = 0; i < r.vehicles; i++) {
        if (turned) sincos_of(r.heading[i], r.sine[i], r.cosine[i]);
        LanesOf l = lanes_of(s, r.y[i], r.sine[i], r.cosine[i], r.half_length[i], r.half_width[i], r.target[i],
                             r.visibility[i], visible(r, i));
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
INLINE void meet_from_rear(const Settings& s, Rows& r, int i, Float speed) {
    for (int lane = 0; lane < s.lanes; lane++) {
        Nearest& n = r.nearest[lane];
        Float nearer = (r.x[i] - n.x) + (r.half_length[i] - n.half_length);
        Mask here = seen_in(r, i, filled((float)lane)) & ((nearer > 0.0f) | ((nearer == 0.0f) & (r.index[i] < n.index)));
        n.x = choose(here, r.x[i], n.x);
        n.half_length = choose(here, r.half_length[i], n.half_length);
        n.speed = choose(here, speed, n.speed);
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

// ---- Drivers: of each the parameters of car following, those by which it predicts the others, and its politeness

struct Alike {  // all have those of the settings
    Idm idm;
    INLINE_METHOD Idm following(const Rows&, int) const { return idm; }
    INLINE_METHOD Idm predicting(const Rows&, int) const { return idm; }
    INLINE_METHOD Float politeness(const Rows&, int) const { return filled(1.0f); }
};

// ---- Car following: the smallest IDM acceleration over the lanes that the driver attends to

// look(gap, leader's speed, rows) for each lane that vehicle i attends to, in the rows that attend to it.
template <class Look>
INLINE void look_ahead(const Settings& s, const Rows& r, int i, Look look) {
    Float speed = r.speed[i], low = r.low[i], high = r.high[i];
    if (!any(low != high)) {
        // Nobody in any row is in two lanes, as nearly always: one lane each.
        Nearest n = nearest_in(s, r, low, r.nearest[0], 1);
        Float gap = gap_ahead(r, i, n.x, n.half_length);
        return look(gap, choose(gap < FREE_GAP, n.speed, speed), ~none());
    }
    Float middle = smaller(low + 1.0f, high);
    for (int lane = 0; lane < s.lanes; lane++) {
        float number = (float)lane;
        Mask here = (low == number) | (middle == number) | (high == number);
        if (!any(here)) continue;
        const Nearest& n = r.nearest[lane];
        Float gap = gap_ahead(r, i, n.x, n.half_length);
        look(gap, choose(gap < FREE_GAP, n.speed, speed), here);
    }
}

// The strongest interaction of IDM with the parameters `p` over the lanes that vehicle i attends to.
INLINE Float strongest_ahead(const Settings& s, const Rows& r, int i, const Idm& p) {
    Float strongest = filled(0.0f);
    look_ahead(s, r, i, [&](Float gap, Float leader, Mask here) __attribute__((always_inline)) {
        strongest = choose(here, larger(strongest, interaction(p, s.min_gap, r.speed[i], gap, leader)), strongest);
    });
    return strongest;
}

// ---- Ends of lanes (ganlane.sim.lane_ends): out of line, since most roads have none

// The interaction of IDM with a wall `room` m ahead: a standing obstacle.
INLINE Float before_wall(const Settings& s, const Rows& r, int i, Float wall, Mask keeps, const Idm& p) {
    Float room = wall - (r.x[i] + r.half_length[i]);
    return interaction(p, s.min_gap, r.speed[i], choose(keeps, room - TURN_OUT, room), filled(0.0f));
}

// The strongest interaction with the walls of the lanes that vehicle i attends to. A vehicle that `drifts` may reach into
// a lane behind its wall.
static __attribute__((noinline)) Float strongest_wall(const Settings& s, const Rows& r, int i, const Idm& p,
                                                      bool drifts = false) {
    Float strongest = filled(0.0f), low = r.low[i], high = r.high[i], middle = smaller(low + 1.0f, high);
    for (int lane = 0; lane < s.lanes; lane++) {
        if (s.ends->wall[lane] >= NOBODY_M) continue;
        float number = (float)lane;
        Mask here = (low == number) | (middle == number) | (high == number);
        if (drifts) here &= r.x[i] + r.half_length[i] <= s.ends->wall[lane];
        Float wall = before_wall(s, r, i, filled(s.ends->wall[lane]), r.target[i] == number, p);
        strongest = choose(here, larger(strongest, wall), strongest);
    }
    return strongest;
}

// What vehicle i would accelerate with in a lane that it keeps: no more than `acceleration`.
static __attribute__((noinline)) Float stopping(const Settings& s, const Rows& r, int i, Float lane, const Idm& p,
                                                Float acceleration) {
    Float wall = of_lane(s, s.ends->wall, lane, NOBODY_M);
    Float braking = limited(p, free_road(r.speed[i], r.per_desired[i]), before_wall(s, r, i, wall, ~none(), p));
    return choose(wall < NOBODY_M, smaller(acceleration, braking), acceleration);
}

// What the ends of lanes add to the incentive of a change to a `side` (MOBIL's bias); whether it is possible.
struct Mandatory {
    Float gain;
    Mask possible;
};

INLINE Float urgency(const Settings& s, const Rows& r, int i, Float lane) {
    Float by = of_lane(s, s.ends->leave_by, lane, NOBODY_M), reach = of_lane(s, s.ends->reach, lane, 1.0f);
    if (s.ends->exit_lane >= 0) {
        Mask exits = r.valid[i] == EXITS;
        by = choose(exits, of_lane(s, s.ends->exit_by, lane, NOBODY_M), by);
        reach = choose(exits, of_lane(s, s.ends->exit_reach, lane, 1.0f), reach);
    }
    return between(1.0f - (by - r.x[i]) / reach, 0.0f, 1.0f);
}

static __attribute__((noinline)) Mandatory mandatory(const Settings& s, const Rows& r, int i, float side) {
    Float lane = r.target[i];
    Float here = urgency(s, r, i, lane), there = urgency(s, r, i, lane + side);
    return {choose(here > there, s.ends->mandatory_bias * here, filled(0.0f)),
            exists(s, lane, r.x[i]) & exists(s, lane + side, r.x[i]) & (here >= there)};
}

// Of a driver who changes lanes as it likes: whether it may go left or right, the side to which it has to leave its lane
// (0: none), and how urgently.
struct WaysOut {
    Mask left, right;
    Float side, urgency;
};

static __attribute__((noinline)) WaysOut ways_out(const Settings& s, const Rows& r, int i) {
    Float lane = r.target[i], x = r.x[i], one = filled(1.0f), zero = filled(0.0f);
    Float here = urgency(s, r, i, lane), left = urgency(s, r, i, lane + 1.0f), right = urgency(s, r, i, lane - 1.0f);
    WaysOut ways;
    ways.left = exists(s, lane, x) & exists(s, lane + 1.0f, x) & (here >= left);
    ways.right = exists(s, lane, x) & exists(s, lane - 1.0f, x) & (here >= right);
    Mask out_left = ways.left & (here > left), out_right = ways.right & (here > right);
    ways.side = choose(out_left & (~out_right | (left <= right)), one, choose(out_right, -one, zero));
    ways.urgency = choose(ways.side != 0.0f, here, zero);
    return ways;
}

// ---- Courtesy (ganlane.sim.mobil.yielding), where lanes end

const float NO_LIMIT = 1e9f;  // stands for no bound on an acceleration

// No more than the acceleration with which vehicle i makes room for the nearest ahead that has to change into its lane.
static __attribute__((noinline)) Float with_courtesy(const Settings& s, const Rows& r, int i, const Idm& p, Float acceleration) {
    Nearest n = nobody_at(NOBODY_M, filled(0.0f));
    for (int lane = 0; lane < s.lanes; lane++) {
        Mask here = r.target[i] == (float)lane;
        n.x = choose(here, r.asking[lane].x, n.x);
        n.half_length = choose(here, r.asking[lane].half_length, n.half_length);
        n.speed = choose(here, r.asking[lane].speed, n.speed);
    }
    Mask exists = (n.x < NOBODY_M) & ~is_ego(r, i);
    if (!any(exists)) return acceleration;
    Float gap = gap_ahead(r, i, n.x, n.half_length);
    exists &= gap > 0.5f * s.min_gap;
    Float free = free_road(r.speed[i], r.per_desired[i]);
    Float makes_room = larger(limited(p, free, interaction(p, s.min_gap, r.speed[i], gap, n.speed)), filled(-s.courtesy));
    return choose(exists, smaller(acceleration, makes_room), acceleration);
}

// On the way from the front: vehicle i asks for room in a lane beside its own, and falls behind the leader there. The ego
// does among all drivers, the others where they are courteous. Whether the ego does in any row.
static __attribute__((noinline)) bool ask_from_front(const Settings& s, Rows& r, int i, const Idm& p) {
    WaysOut ways = ways_out(s, r, i);
    Mask asks = (ways.side != 0.0f) & (ways.urgency > ASKS_FROM) & (r.valid[i] != 0.0f), ego = asks & is_ego(r, i);
    if (!s.courteous) asks = ego;
    if (!any(asks)) return false;
    Nearest leader = nearest_in(s, r, r.target[i] + ways.side, nobody_at(NOBODY_M, r.speed[i]));
    Float gap = gap_ahead(r, i, leader.x, leader.half_length), free = free_road(r.speed[i], r.per_desired[i]);
    Float speed = choose(gap < FREE_GAP, leader.speed, r.speed[i]);
    Mask blocked = limited(p, free, interaction(p, s.min_gap, r.speed[i], gap, speed)) < -s.safe_behind;
    r.following[i] = choose(asks & blocked, smaller(r.following[i], filled(-s.courtesy)), r.following[i]);
    asks &= visible(r, i);
    for (int lane = 0; lane < s.lanes; lane++) {
        Nearest& n = r.asking[lane];
        Float nearer = (n.x - r.x[i]) + (r.half_length[i] - n.half_length);
        Mask here = asks & (r.target[i] + ways.side == (float)lane) &
                    ((nearer > 0.0f) | ((nearer == 0.0f) & (r.speed[i] < n.speed)));
        n.x = choose(here, r.x[i], n.x);
        n.half_length = choose(here, r.half_length[i], n.half_length);
        n.speed = choose(here, r.speed[i], n.speed);
    }
    return any(ego);
}

// On the way from the rear: the ego, if it has to change its lane, lets the follower there go past
// (ganlane.sim.mobil.letting_past).
static __attribute__((noinline)) void let_past(const Settings& s, Rows& r, int i, const Idm& p) {
    WaysOut ways = ways_out(s, r, i);
    Mask asks = is_ego(r, i) & (ways.side != 0.0f) & (ways.urgency > ASKS_FROM) & (r.valid[i] != 0.0f);
    if (!any(asks)) return;
    Nearest n = nearest_in(s, r, r.target[i] + ways.side, nobody_at(-NOBODY_M, filled(0.0f)));
    Float gap = smaller((r.x[i] - n.x) - (r.half_length[i] + n.half_length), filled(FREE_GAP));
    Float demand = limited(p, free_road(n.speed, n.per_desired), interaction(p, s.min_gap, n.speed, gap, r.speed[i]));
    // It goes on, but is not faster than the ego by what a second of braking gives.
    Mask beside = (gap < FREE_GAP) & (n.speed > 0.0f) & (n.speed - r.speed[i] < s.courtesy);
    Mask blocked = asks & beside & (demand < -s.safe_behind);
    r.following[i] = choose(blocked, smaller(r.following[i], filled(-s.courtesy)), r.following[i]);
}

template <class Drivers>
static inline void follow(const Settings& s, Rows& r, const Drivers& drivers) {
    nobody_met(s, r, NOBODY_M);
    bool courteous = s.ends && s.courtesy > 0.0f, asked = false;
    for (int lane = 0; courteous && lane < s.lanes; lane++) r.asking[lane] = nobody_at(NOBODY_M, filled(0.0f));
    for (int i = 0; i < r.vehicles; i++) {
        Idm p = drivers.following(r, i);
        Float strongest = strongest_ahead(s, r, i, p);
        if (s.ends) strongest = larger(strongest, strongest_wall(s, r, i, p));
        r.following[i] = limited(p, free_road(r.speed[i], r.per_desired[i]), strongest);
        // Where lanes end, who does not drive by IDM makes room all the same.
        if (s.ends && (s.generated || s.human)) r.following[i] = choose(is_ego(r, i), r.following[i], filled(NO_LIMIT));
        if (courteous) {
            if (s.courteous) r.following[i] = with_courtesy(s, r, i, p, r.following[i]);
            asked |= ask_from_front(s, r, i, p);
        }
        meet_from_front(s, r, i);
    }
    if (!asked) return;
    nobody_met(s, r, -NOBODY_M);
    for (int i = r.vehicles - 1; i >= 0; i--) {
        if (any(is_ego(r, i))) let_past(s, r, i, drivers.following(r, i));
        // It does not wait for one who brakes or stands.
        meet_from_rear(s, r, i, choose(r.acceleration[i] > -0.5f * s.courtesy, r.speed[i], filled(0.0f)));
    }
}

// ---- MOBIL

const float SIDES[3] = {0.0f, 1.0f, -1.0f};

// Leader and follower of everybody in the own lane, to the left and to the right.
static inline void find_neighbours(const Settings& s, Rows& r) {
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
        meet_from_rear(s, r, i, r.speed[i]);
    }
}

// Accelerations in a lane: the driver's own there; its follower's there with and without it, 0 without a follower.
struct Prospect {
    Float own, with_it, without;
};

INLINE Prospect prospect(const Settings& s, const Rows& r, int i, int side, const Idm& p) {
    int at = side * r.vehicles + i;
    Float ahead = r.gap_ahead[at], behind = r.gap_behind[at], follower = r.speed_behind[at];
    Float free = free_road(follower, r.per_desired_behind[at]);
    Float with_it = limited(p, free, interaction(p, s.min_gap, follower, behind, r.speed[i]));
    Mask leads = ahead < FREE_GAP, follows = behind < FREE_GAP;
    Float gap = choose(leads, behind + 2.0f * r.half_length[i] + ahead, filled(FREE_GAP));
    Float without = limited(p, free, interaction(p, s.min_gap, follower, gap, choose(leads, r.speed_ahead[at], follower)));
    Float own = idm(p, s.min_gap, r.speed[i], r.per_desired[i], ahead, r.speed_ahead[at]);
    if (s.ends) own = stopping(s, r, i, r.target[i] + SIDES[side], p, own);
    return {
        own,
        choose(follows, with_it, filled(0.0f)),
        choose(follows, without, filled(0.0f)),
    };
}

// Below every incentive that can be.
const float NEVER = -1e30f;

// The incentive of a change, m/s2; NEVER where it does not pay, is unsafe or leaves the road.
INLINE Float incentive(const Settings& s, const Prospect& here, const Prospect& there, Mask exists, Float politeness,
                       Float bias) {
    Float gain = there.own - here.own + politeness * s.politeness_side * (there.with_it - there.without) +
                 politeness * s.politeness_rear * (here.without - here.with_it);
    if (s.ends) gain = gain + bias;
    Mask safe = smaller(there.with_it, there.own) >= -s.safe_deceleration;
    return choose(exists & safe & (gain > s.threshold), gain, filled(NEVER));
}

// The change that MOBIL proposes to everybody but the ego: +1 left, -1 right, 0 none. Returns whether anybody wants.
template <class Drivers>
static inline bool find_wishes(const Settings& s, Rows& r, Mask due, const Drivers& drivers) {
    find_neighbours(s, r);
    Mask wanted = none();
    for (int i = 0; i < r.vehicles; i++) {
        Mask free = due & ~is_ego(r, i) & (r.valid[i] != 0.0f) &
                    (absolute(r.y[i] - r.target[i] * s.lane_width) < ARRIVED);
        r.wish[i] = filled(0.0f);
        if (!any(free)) continue;
        Idm p = drivers.predicting(r, i);
        Float politeness = drivers.politeness(r, i);
        Prospect here = prospect(s, r, i, 0, p);
        Mandatory to_left = {filled(0.0f), r.target[i] + 1.0f <= (float)(s.lanes - 1)};
        Mandatory to_right = {filled(0.0f), r.target[i] - 1.0f >= 0.0f};
        if (s.ends) to_left = mandatory(s, r, i, 1.0f), to_right = mandatory(s, r, i, -1.0f);
        Float left = incentive(s, here, prospect(s, r, i, 1, p), to_left.possible, politeness, to_left.gain);
        Float right = incentive(s, here, prospect(s, r, i, 2, p), to_right.possible, politeness, to_right.gain);
        Float side = choose(left >= right, filled(1.0f), filled(-1.0f));
        Mask pays = free & (larger(left, right) > NEVER);
        r.wish[i] = choose(pays, side, filled(0.0f));
        wanted |= pays;
    }
    return any(wanted);
}

// Of several that want into one lane, only the foremost within `exclusive` m goes, or whom no other makes brake hard.
template <class Drivers>
static inline void one_at_a_time(const Settings& s, Rows& r, const Drivers& drivers) {
    for (int i = 0; i < r.vehicles; i++) {
        r.kept[i] = r.wish[i];
        Mask wants = r.wish[i] != 0.0f, waits = none();
        if (!any(wants)) continue;
        Float lane = r.target[i] + r.wish[i];
        Idm p = drivers.predicting(r, i);
        for (int j = 0; j < i; j++) {
            Mask rival = wants & (r.wish[j] != 0.0f) & (r.target[j] + r.wish[j] == lane);
            if (!any(rival)) continue;
            Float distance = r.x[j] - r.x[i];
            Float gap = gap_ahead(r, i, r.x[j], r.half_length[j]);
            Float demand = idm(p, s.min_gap, r.speed[i], r.per_desired[i], gap, r.speed[j]);
            waits |= rival & ((distance < s.exclusive) | (demand < -s.safe_deceleration));
        }
        r.kept[i] = choose(waits, filled(0.0f), r.wish[i]);
    }
}

template <class Drivers>
static inline void change_lanes(const Settings& s, Rows& r, Mask due, const Drivers& drivers) {
    if (!any(due) || !find_wishes(s, r, due, drivers)) return;
    one_at_a_time(s, r, drivers);
    for (int i = 0; i < r.vehicles; i++) r.target[i] = r.target[i] + r.kept[i];
}

// ---- Motion: two-point steering and the kinematic bicycle, in the rows that go on

struct Mover {
    Float x, y, heading, speed, acceleration, steering, slip, slip_sine;
};

// One step of a vehicle at `acceleration`, steered to the line at y = `line`; rows that have ended stay as they ended.
INLINE void steer_and_move(const Settings& s, Mover& m, Float line, Float acceleration, Mask on) {
    Float y = m.y, heading = m.heading, speed = m.speed, slip = m.slip;
    // steering: ganlane.sim.dynamics.steer, with speed and distances inverted once, since a division takes as long
    // as ten products. An invalid vehicle is driven as well: cheaper than to leave it out.
    Float per_pace = 1.0f / larger(speed, filled(s.slow)), offset = line - y;
    Float lateral_speed = speed * sine_of(heading + slip);
    Float yaw_rate = speed * m.slip_sine * (2.0f / WHEELBASE);
    Float per_near = per_pace * s.per_near_s, per_far = per_pace * s.per_far_s;
    Float slope_near = offset * per_near, slope_far = offset * per_far;
    // d/dt atan(offset / distance) = -lateral_speed / (distance (1 + slope^2)), of both points over one divisor
    Float near = 1.0f + slope_near * slope_near, far = 1.0f + slope_far * slope_far;
    Float sideways = lateral_speed / (near * far);
    Float rate_near = -(sideways * far * per_near) - yaw_rate, rate_far = -(sideways * near * per_far) - yaw_rate;
    Float theta_near = arctangent(slope_near) - heading;
    Float turn_wheel = s.gain_far * rate_far + s.gain_near * rate_near + s.gain_integral * theta_near * (speed * per_pace);
    Float steering = m.steering + WHEELBASE * per_pace * turn_wheel * PHYSICS_STEP;
    steering = at_rest(between(steering, -s.max_angle, s.max_angle));
    // bicycle: ganlane.sim.dynamics.advance
    Float new_speed = larger(speed + acceleration * PHYSICS_STEP, filled(0.0f));
    Float distance = 0.5f * (speed + new_speed) * PHYSICS_STEP;
    Float new_slip = slip_of(steering), slip_sine = sine_of(new_slip);
    Float turn = distance * slip_sine * (2.0f / WHEELBASE);
    Float sine, cosine;
    sincos_of(heading + new_slip + 0.5f * turn, sine, cosine);
    m.x = choose(on, m.x + distance * cosine, m.x);
    m.y = choose(on, at_rest(y + distance * sine), y);
    m.heading = choose(on, at_rest(heading + turn), heading);
    m.speed = choose(on, new_speed, speed);
    m.acceleration = choose(on, (new_speed - speed) * (1.0f / PHYSICS_STEP), m.acceleration);
    m.steering = choose(on, steering, m.steering);
    m.slip = choose(on, new_slip, slip);
    m.slip_sine = choose(on, slip_sine, m.slip_sine);
}

INLINE Mover mover(const Rows& r, int i) {
    return {r.x[i], r.y[i], r.heading[i], r.speed[i], r.acceleration[i], r.steering[i], r.slip[i], r.slip_sine[i]};
}

INLINE void put(Rows& r, int i, const Mover& m) {
    r.x[i] = m.x, r.y[i] = m.y, r.heading[i] = m.heading, r.speed[i] = m.speed, r.acceleration[i] = m.acceleration;
    r.steering[i] = m.steering, r.slip[i] = m.slip, r.slip_sine[i] = m.slip_sine;
}

// Row 0 of the vehicles [first, first + LANES), as one vector; behind the last vehicle it is repeated.
INLINE Float of_vehicles(const Rows& r, const Float* field, int first) {
    Float numbers;
#pragma GCC unroll 16
    for (int k = 0; k < LANES; k++) numbers[k] = field[first + k < r.vehicles ? first + k : r.vehicles - 1][0];
    return numbers;
}

// Back again, into all rows.
INLINE void to_vehicles(const Rows& r, Float* field, int first, Float numbers) {
#pragma GCC unroll 16
    for (int k = 0; k < LANES; k++)
        if (first + k < r.vehicles) field[first + k] = filled(numbers[k]);
}

// As drive, of one row alone: its vehicles fill the vectors. Of a decision's 10 us that saves 2 (9 vehicles, AVX2).
static inline void drive_alone(const Settings& s, Rows& r) {
    Mask on = none() | r.running[0];
    for (int i = 0; i < r.vehicles; i += LANES) {
        Mover m = {of_vehicles(r, r.x, i), of_vehicles(r, r.y, i), of_vehicles(r, r.heading, i), of_vehicles(r, r.speed, i),
                   of_vehicles(r, r.acceleration, i), of_vehicles(r, r.steering, i), of_vehicles(r, r.slip, i),
                   of_vehicles(r, r.slip_sine, i)};
        steer_and_move(s, m, of_vehicles(r, r.target, i) * s.lane_width, of_vehicles(r, r.following, i), on);
        to_vehicles(r, r.x, i, m.x), to_vehicles(r, r.y, i, m.y);
        to_vehicles(r, r.heading, i, m.heading), to_vehicles(r, r.speed, i, m.speed);
        to_vehicles(r, r.acceleration, i, m.acceleration), to_vehicles(r, r.steering, i, m.steering);
        to_vehicles(r, r.slip, i, m.slip), to_vehicles(r, r.slip_sine, i, m.slip_sine);
    }
}

static inline void drive(const Settings& s, Rows& r) {
    if (r.alone) return drive_alone(s, r);
    for (int i = 0; i < r.vehicles; i++) {
        Mover m = mover(r, i);
        steer_and_move(s, m, r.target[i] * s.lane_width, r.following[i], r.running);
        put(r, i, m);
    }
}
