// The parameters, constants and equations of the model; SI units. ganlane.sim says where each comes from.

#pragma once

#include "vectors.hpp"

struct Settings {
    // IDM, Table V
    float min_gap, headway, per_brake_scale, min_acceleration, max_acceleration;
    // MOBIL, Table IV
    float threshold, politeness_rear, politeness_side, safe_deceleration, exclusive;
    // two-point steering
    float per_near_s, per_far_s, gain_far, gain_near, gain_integral, slow, max_angle;
    // ego and episode
    float soft_crash_ttc, soft_crash_gap, goal;
    // road
    float lane_width, per_lane_width;
    int32_t lanes, vehicles, substeps, timeout_steps, mobil, abort_lane_change;
};

// ---- Constants of the model (ganlane.sim)

const float PHYSICS_STEP = 0.1f, WHEELBASE = 2.7f;
const float NOBODY_M = 1e9f;  // stands for the position of nobody
const float FREE_GAP = 10000.0f, SMALLEST_GAP = 0.1f;
const float ENTRY = 0.1f, ARRIVED = 0.3f;
enum { CENTRE, BODY, SIGNALLED };

// ---- Equations

// IDM: a (1 - (v/v0)^4 - (s*/s)^2) with s* = s0 + max(0, v T + v dv / (2 sqrt(a b))).
INLINE Float interaction(const Settings& s, Float speed, Float gap, Float leader_speed) {
    Float dynamic = speed * s.headway + speed * (speed - leader_speed) * s.per_brake_scale;
    return (s.min_gap + larger(dynamic, filled(0.0f))) / larger(gap, filled(SMALLEST_GAP));
}

INLINE Float free_road(Float speed, Float per_desired) {
    Float ratio = speed * per_desired, square = ratio * ratio;
    return 1.0f - square * square;
}

INLINE Float limited(const Settings& s, Float free, Float interaction) {
    return between(s.max_acceleration * (free - interaction * interaction), s.min_acceleration, s.max_acceleration);
}

INLINE Float idm(const Settings& s, Float speed, Float per_desired, Float gap, Float leader_speed) {
    return limited(s, free_road(speed, per_desired), interaction(s, speed, gap, leader_speed));
}

INLINE Float slip_of(Float steering) {
    Float sine, cosine;
    sincos_of(steering, sine, cosine);
    return arctangent(0.5f * (sine / cosine));
}

INLINE Float lane_of(const Settings& s, Float y) {
    return between(rounded(y * s.per_lane_width), 0.0f, (float)(s.lanes - 1));
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

// ---- Whom an ego has next to it in a lane: one look at everybody, in any order. (kernel.cpp finds the neighbours of
// all vehicles at once, in the order of the road.)

struct Around {
    Float gap, leader;                                 // to the nearest ahead, and its speed
    Float gap_behind, follower, per_desired, index;    // to the nearest behind, its speed, 1 / desired speed, and place
};

INLINE Around nobody_around(Float speed) {
    Float free = filled(FREE_GAP);
    return {free, speed, free, speed, filled(1.0f), filled(0.0f)};
}

// Looks at one more vehicle, where it is in the lane (`here`). One at the same x counts as behind: the ego has the
// lowest index. Of two at the same gap ahead the slower one counts, behind the one with the lower index.
INLINE void look_at(Around& a, Mask here, Float distance, Float gap, Float speed, Float per_desired, Float index) {
    Mask ahead = distance > 0.0f;
    Mask leads = here & ahead & ((gap < a.gap) | ((gap == a.gap) & (speed < a.leader)));
    Mask follows = here & ~ahead & ((gap < a.gap_behind) | ((gap == a.gap_behind) & (index < a.index)));
    a.gap = choose(leads, gap, a.gap), a.leader = choose(leads, speed, a.leader);
    a.gap_behind = choose(follows, gap, a.gap_behind), a.follower = choose(follows, speed, a.follower);
    a.per_desired = choose(follows, per_desired, a.per_desired), a.index = choose(follows, index, a.index);
}
