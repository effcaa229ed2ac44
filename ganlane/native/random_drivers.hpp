// Rule-driven drivers of which no two are alike (IdmRandomTraffic of ganlane.traffic.idm_mobil).

#pragma once

#include "arrays.hpp"
#include "memory.hpp"

struct Random {
    Range headway, max_acceleration, comfortable_deceleration, strongest_braking, politeness, reaction, sway, sway_period;
    Range desired_speed;
    int32_t delay_steps;
};

// Places in a driver's memory, as the columns of DriverParams; then the accelerations of the last `delay_steps`.
enum {
    OWN_TIME_GAP, OWN_ACCELERATION, OWN_DECELERATION, OWN_BRAKING, OWN_POLITENESS, DELAY, SWAY,
    FREQUENCY_ONE, FREQUENCY_TWO, PHASE_ONE, PHASE_TWO, TRAITS, DECIDED = TRAITS,
};
const int DRAWS = 12, DESIRED_SPEED = 11;
const float SWAY_MARGIN = 0.1f, START_MARGIN = 1.5f, TWO_PI = 6.283185307179586f;

static inline Fields fields_of(const Random& d) {
    Fields fields = {1, {{0, TRAITS, FLOAT}, {DECIDED, d.delay_steps, FLOAT}}};
    if (d.delay_steps) fields.arrays = 2;
    return fields;
}

// The ego has the parameters of the settings.
struct Different {
    Idm common;
    INLINE_METHOD Idm own(const Rows& r, int i, Float braking) const {
        Float a = r.memory[OWN_ACCELERATION][i], b = r.memory[OWN_DECELERATION][i];
        return {r.memory[OWN_TIME_GAP][i], 1.0f / (2.0f * root(a * b)), braking, a};
    }
    INLINE_METHOD Idm following(const Rows& r, int i) const {
        Idm p = own(r, i, -r.memory[OWN_BRAKING][i]);
        Mask ego = is_ego(r, i);
        return {choose(ego, common.headway, p.headway), choose(ego, common.per_brake_scale, p.per_brake_scale),
                choose(ego, common.min_acceleration, p.min_acceleration),
                choose(ego, common.max_acceleration, p.max_acceleration)};
    }
    // Others are predicted with the driver's own parameters, whatever it would brake itself.
    INLINE_METHOD Idm predicting(const Rows& r, int i) const { return own(r, i, common.min_acceleration); }
    INLINE_METHOD Float politeness(const Rows& r, int i) const { return r.memory[OWN_POLITENESS][i]; }
};

// One step of everybody: an acceleration decided `delay` steps ago, to a line that sways about the lane's centre.
static inline void drive_with_traits(const Settings& s, Rows& r, int substep) {
    const Random& d = *s.random;
    Float time;
    for (int lane = 0; lane < LANES; lane++) time[lane] = (float)(r.start_step[lane] + substep) * PHYSICS_STEP;
    for (int i = 0; i < r.vehicles; i++) {
        Float now = r.following[i], acceleration = now, sine, cosine, other;
        for (int k = 0; k < d.delay_steps; k++) {
            Mask here = r.memory[DELAY][i] == (float)(d.delay_steps - k);
            acceleration = choose(here, r.memory[DECIDED + k][i], acceleration);
        }
        for (int k = 0; k + 1 < d.delay_steps; k++) remember(r, i, DECIDED + k, r.memory[DECIDED + k + 1][i]);
        if (d.delay_steps) remember(r, i, DECIDED + d.delay_steps - 1, now);
        sincos_of(r.memory[FREQUENCY_ONE][i] * time + r.memory[PHASE_ONE][i], sine, cosine);
        sincos_of(r.memory[FREQUENCY_TWO][i] * time + r.memory[PHASE_TWO][i], other, cosine);
        Mask ego = is_ego(r, i);
        Float sway = choose(ego, filled(0.0f), 0.5f * r.memory[SWAY][i] * (sine + other));
        Mover m = mover(r, i);
        steer_and_move(s, m, r.target[i] * s.lane_width + sway, choose(ego, now, acceleration), r.running);
        put(r, i, m);
    }
}

// ---- The drivers of an episode, drawn at its start

// Vehicles of a first scene, who stand straight in the middle of their lanes; the ego is the first.
struct FirstScene {
    const Settings& s;
    const float *x, *speed, *length, *width;
    const int64_t *lane, *visibility;
    float longest;
};

// How many lanes to each side of its own vehicle i's body reaches into.
static inline int64_t reach_of(const FirstScene& f, int i) {
    float lanes = (0.5f * f.width[i] - ENTRY) * f.s.per_lane_width;
    return lanes > 0.5f ? (int64_t)(lanes + 0.5f) : 0;
}

// Whether j is ahead of i; of two at the same place the one with the lower index is ahead.
static inline bool is_ahead(const FirstScene& f, int j, int i) { return f.x[j] > f.x[i] || (f.x[j] == f.x[i] && j < i); }

// Whether vehicle i sees j in the outermost lanes that it attends to.
static inline bool shares_lane(const FirstScene& f, int i, int j) {
    int64_t reach = reach_of(f, i), seen = f.visibility[j] == CENTRE ? 0 : reach_of(f, j), last = f.s.lanes - 1;
    int64_t low = f.lane[i] - reach < 0 ? 0 : f.lane[i] - reach, high = f.lane[i] + reach > last ? last : f.lane[i] + reach;
    return (f.lane[j] - seen <= low && low <= f.lane[j] + seen) || (f.lane[j] - seen <= high && high <= f.lane[j] + seen);
}

// The deceleration with which vehicle i stays behind all ahead of it in its lane (idm_mobil.start_braking).
static float start_braking(const FirstScene& f, int i, float reaction) {
    float strongest = 0.0f;
    for (int j = 0; j < f.s.vehicles; j++) {
        if (!is_ahead(f, j, i) || !shares_lane(f, i, j)) continue;
        int between = 0;
        for (int k = 0; k < f.s.vehicles; k++) between += is_ahead(f, k, i) && shares_lane(f, i, k) && is_ahead(f, j, k);
        float closing = f.speed[i] > f.speed[j] ? f.speed[i] - f.speed[j] : 0.0f;
        float gap = (f.x[j] - f.x[i]) - (0.5f * f.length[i] + 0.5f * f.length[j]);
        gap = (gap < FREE_GAP ? gap : FREE_GAP) - (float)between * (f.longest + f.s.min_gap) - closing * reaction;
        float needed = closing * closing / (2.0f * (gap > 1.0f ? gap : 1.0f));
        strongest = needed > strongest ? needed : strongest;
    }
    return strongest;
}

static inline float in_range(const Range& range, float u) { return range.low + u * range.span; }

// Desired speeds and memory of the row's drivers, who stand straight in their lanes.
static void enter_with_traits(const Settings& s, void* const* arrays, long row, uint64_t before_first_step, const Scene& scene,
                              const Outputs& out) {
    const Random& d = *s.random;
    long start = row * s.vehicles;
    FirstScene f = {s, out.x + start, out.speed + start, scene.length + start, scene.width + start,
                    out.target_lane + start, scene.visibility + start, 0.0f};
    for (int i = 0; i < s.vehicles; i++) f.longest = f.length[i] > f.longest ? f.length[i] : f.longest;
    for (int i = 0; i < s.vehicles; i++) {
        float u[DRAWS];
        for (int k = 0; k < DRAWS; k++) u[k] = uniform_of(absorb(absorb(before_first_step, i), DRIVER + k));
        if (i) scene.desired_speed[start + i] = in_range(d.desired_speed, u[DESIRED_SPEED]) * scene.desired_speed[start + i];
        float reaction = in_range(d.reaction, u[5]), braking = in_range(d.strongest_braking, u[3]);
        float required = START_MARGIN * start_braking(f, i, reaction);
        float room = 0.5f * (s.lane_width - scene.width[start + i]) - SWAY_MARGIN, sway = in_range(d.sway, u[6]);
        room = room > 0.0f ? room : 0.0f;
        float delay = reaction / PHYSICS_STEP;
        float traits[TRAITS] = {
            in_range(d.headway, u[0]), in_range(d.max_acceleration, u[1]), in_range(d.comfortable_deceleration, u[2]),
            braking > required ? braking : required, in_range(d.politeness, u[4]), (delay + 12582912.0f) - 12582912.0f,
            sway < room ? sway : room, TWO_PI / in_range(d.sway_period, u[7]), TWO_PI / in_range(d.sway_period, u[8]),
            TWO_PI * u[9], TWO_PI * u[10],
        };
        for (int k = 0; k < TRAITS; k++) ((float*)arrays[0])[(start + i) * TRAITS + k] = traits[k];
        for (int k = 0; k < d.delay_steps; k++)
            ((float*)arrays[1])[(start + i) * d.delay_steps + k] = out.acceleration[start + i];
    }
}
