// The parameters, constants and equations of the model; SI units. ganlane.sim says where each comes from.

#pragma once

#include "vectors.hpp"

// Where lanes begin and end (ganlane.sim.lane_ends), of each lane; NOBODY_M: far away. A wall is an end that nobody may
// touch. `leave_by` and `reach`: where a driver has to have left it, and how long before that it becomes urgent;
// `exit_by` and `exit_reach`: the same of drivers who leave by the exit.
const int MOST_LANES = 20;
struct Ends {
    float begin[MOST_LANES], end[MOST_LANES], wall[MOST_LANES], leave_by[MOST_LANES], reach[MOST_LANES];
    float exit_by[MOST_LANES], exit_reach[MOST_LANES];
    float mandatory_bias;
    int32_t exit_lane;  // that the ego has to leave the road by; -1: none
};

// Who enters a section of the road and leaves it (ganlane.sim.flow).
struct Flow {
    double arrival[MOST_LANES];  // probability of one in a decision, of each lane
    double exit_share;
    float from, to;
};

// What the ego is commanded beside lanes (ganlane.sim.actions): its speed, or acceleration and line.
enum { LANE_SPEED, CONTINUOUS };
struct Actions {
    float speed_step, lowest_speed, strongest_acceleration, strongest_braking, period;
    int32_t form;
};

struct Settings {
    // IDM, Table V
    float min_gap, headway, per_brake_scale, min_acceleration, max_acceleration;
    // MOBIL, Table IV
    float threshold, politeness_rear, politeness_side, safe_deceleration, exclusive, courtesy, safe_behind;
    // two-point steering
    float per_near_s, per_far_s, gain_far, gain_near, gain_integral, slow, max_angle;
    // ego and episode
    float soft_crash_ttc, soft_crash_gap, goal;
    // road
    float lane_width, per_lane_width;
    int32_t lanes, vehicles, substeps, timeout_steps, mobil, courteous, abort_lane_change, foresight;
    int64_t stream;  // family of episodes that random numbers belong to
    double blind_share;  // of the episodes: nobody sees the ego
    const struct Generated* generated;  // generated.hpp; null: the others are rule-driven
    const struct Human* human;          // human.hpp; null: they are not of `traffic=human`
    const struct Faults* faults;        // faults.hpp; null: drivers make none
    const struct Random* random;        // random_drivers.hpp; null: all drivers are alike
    const Ends* ends;                   // null: all lanes go on for ever
    const Actions* actions;             // null: the ego is commanded lanes alone
    const Flow* flow;                   // null: nobody enters or leaves
};

// ---- Constants of the model (ganlane.sim)

const float PHYSICS_STEP = 0.1f, WHEELBASE = 2.7f;
const float NOBODY_M = 1e9f;  // stands for the position of nobody
const float FREE_GAP = 10000.0f, SMALLEST_GAP = 0.1f;
const float ENTRY = 0.1f, ARRIVED = 0.3f;
const float ASKS_FROM = 0.577f;  // others make room for those who have to leave their lane so urgently
const float TURN_OUT = 15.0f;  // a driver that keeps its lane stops so far before the wall
const float REST = 1e-12f;  // at most this is 0: see at_rest
enum { CENTRE, BODY, SIGNALLED };

// ---- Equations

// The parameters of car following that may differ between drivers.
struct Idm {
    Float headway, per_brake_scale, min_acceleration, max_acceleration;
};

INLINE Idm common(const Settings& s) {
    return {filled(s.headway), filled(s.per_brake_scale), filled(s.min_acceleration), filled(s.max_acceleration)};
}

// IDM: a (1 - (v/v0)^4 - (s*/s)^2) with s* = s0 + max(0, v T + v dv / (2 sqrt(a b))).
INLINE Float interaction(const Idm& p, float min_gap, Float speed, Float gap, Float leader_speed) {
    Float dynamic = speed * p.headway + speed * (speed - leader_speed) * p.per_brake_scale;
    return (min_gap + larger(dynamic, filled(0.0f))) / larger(gap, filled(SMALLEST_GAP));
}

INLINE Float free_road(Float speed, Float per_desired) {
    Float ratio = speed * per_desired, square = ratio * ratio;
    return 1.0f - square * square;
}

INLINE Float limited(const Idm& p, Float free, Float interaction) {
    return smaller(larger(p.max_acceleration * (free - interaction * interaction), p.min_acceleration), p.max_acceleration);
}

INLINE Float idm(const Idm& p, float min_gap, Float speed, Float per_desired, Float gap, Float leader_speed) {
    return limited(p, free_road(speed, per_desired), interaction(p, min_gap, speed, gap, leader_speed));
}

INLINE Float idm(const Settings& s, Float speed, Float per_desired, Float gap, Float leader_speed) {
    return idm(common(s), s.min_gap, speed, per_desired, gap, leader_speed);
}

INLINE Float slip_of(Float steering) {
    Float sine, cosine;
    sincos_of(steering, sine, cosine);
    return arctangent(0.5f * (sine / cosine));
}

// A heading, steering angle or lateral position, and 0 where it is next to nothing: they decay by a factor a step, and
// would go on as denormal numbers, with which a product takes a hundred times as long (ganlane.sim.dynamics.at_rest).
INLINE Float at_rest(Float number) { return choose(absolute(number) <= REST, filled(0.0f), number); }

INLINE Float lane_of(const Settings& s, Float y) {
    return between(rounded(y * s.per_lane_width), 0.0f, (float)(s.lanes - 1));
}

// Whether the road has a lane at `x`, and whether one may change from it to the one at its `side` there.
static inline bool exists(const Settings& s, int64_t lane, float x) {
    return lane >= 0 && lane < s.lanes && (!s.ends || (s.ends->begin[lane] <= x && x < s.ends->end[lane]));
}

static inline bool may_change(const Settings& s, int64_t lane, int64_t side, float x) {
    return side == 0 || (exists(s, lane, x) && exists(s, lane + side, x));
}

// Whether a body at `x` that moves from `y` to `later` crosses a line beside which there is no lane to change into.
static inline bool leaves_road(const Settings& s, float y, float later, float x) {
    int64_t lane = (int64_t)__builtin_rintf(y * s.per_lane_width), beside = (int64_t)__builtin_rintf(later * s.per_lane_width);
    // Who is beside the road may come back.
    return beside != lane && !(exists(s, beside, x) && (!s.ends || exists(s, lane, x)));
}

// The number of the lane that each row has its own number of; `otherwise` where the road has no such lane.
INLINE Float of_lane(const Settings& s, const float* numbers, Float lane, float otherwise) {
    Float number = filled(otherwise);
    for (int k = 0; k < s.lanes; k++) number = choose(lane == (float)k, filled(numbers[k]), number);
    return number;
}

INLINE Mask exists(const Settings& s, Float lane, Float x) {
    return (of_lane(s, s.ends->begin, lane, NOBODY_M) <= x) & (x < of_lane(s, s.ends->end, lane, -NOBODY_M));
}

// The lanes that a body at `y` is in, that its driver attends to, and in which the others see it: the lowest and the
// highest of each; and half of the lateral space that it takes.
struct LanesOf {
    Float extent, body_low, body_high, low, high, seen_low, seen_high;
};

INLINE LanesOf lanes_of(const Settings& s, Float y, Float sine, Float cosine, Float half_length, Float half_width,
                        Float target, Float visibility, Mask valid) {
    LanesOf l;
    l.extent = half_width * cosine + half_length * absolute(sine);
    Float reach = l.extent - ENTRY, centre = lane_of(s, y);
    l.body_low = lane_of(s, y - reach), l.body_high = lane_of(s, y + reach);
    l.low = smaller(l.body_low, target), l.high = larger(l.body_high, target);
    Mask signalled = visibility == (float)SIGNALLED, by_body = visibility == (float)BODY;
    l.seen_low = choose(valid, choose(signalled, l.low, choose(by_body, l.body_low, centre)), filled(1e9f));
    l.seen_high = choose(valid, choose(signalled, l.high, choose(by_body, l.body_high, centre)), filled(-1e9f));
    return l;
}
