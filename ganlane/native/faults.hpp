// Rule-driven drivers that make mistakes: late reactions, phantom braking, hesitant and aborted lane changes
// (ganlane.traffic.faults, in its order).

#pragma once

#include "memory.hpp"

struct Faults {
    float braking_chance, braking_steps, deceleration;
    float lapse_chance, lapse_steps;
    float hesitation_share, pace, abort_share, abort_at;
    int32_t delay_steps;
};

const float SHORTEST = 1e-3f, NO_LANE = -1.0f;
// Places in a driver's memory: the last ones hold the accelerations decided in the last `delay_steps`, oldest first.
enum { LAPSE_LEFT, BRAKING_LEFT, HESITANT, ORIGIN, PAST };

static inline Fields fields_of(const Faults& f) {
    return {5, {{PAST, f.delay_steps, FLOAT}, {LAPSE_LEFT, 1, INTEGER}, {BRAKING_LEFT, 1, INTEGER}, {HESITANT, 1, FLAG}, {ORIGIN, 1, INTEGER}}};
}

// `m` with another acceleration: the same path from vehicle i, slower or faster (faults.driven_at).
INLINE Mover driven_at(const Rows& r, int i, Mover m, Mask who, Float acceleration) {
    Float speed = larger(r.speed[i] + acceleration * PHYSICS_STEP, filled(0.0f));
    Float usual = 0.5f * (r.speed[i] + m.speed) * PHYSICS_STEP, distance = 0.5f * (r.speed[i] + speed) * PHYSICS_STEP;
    Float share = distance / larger(usual, filled(SHORTEST));
    // A standing vehicle that moves off has no path to follow yet.
    Mask path = usual > SHORTEST;
    m.x = choose(who, r.x[i] + choose(path, share * (m.x - r.x[i]), distance * r.cosine[i]), m.x);
    m.y = choose(who, r.y[i] + choose(path, share * (m.y - r.y[i]), distance * r.sine[i]), m.y);
    m.heading = choose(who, r.heading[i] + choose(path, share * (m.heading - r.heading[i]), filled(0.0f)), m.heading);
    m.speed = choose(who, speed, m.speed);
    m.acceleration = choose(who, (speed - r.speed[i]) / PHYSICS_STEP, m.acceleration);
    return m;
}

// Remaining steps of a fault that lasts: it begins where there is none, at a constant hazard.
INLINE Float steps_left(const Rows& r, int i, int field, Mask others, Float u, float chance, float steps) {
    Float left = r.memory[field][i];
    return choose((left == 0.0f) & others & (u < chance), filled(steps), left);
}

// One step of everybody, who looked at the vehicles before; `target` are the lanes before MOBIL's decisions.
static inline void drive_with_faults(const Settings& s, Rows& r, const Float* target) {
    const Faults& f = *s.faults;
    for (int i = 0; i < r.vehicles; i++) {
        Keys keys = keys_of(r, i);
        Float zero = filled(0.0f);
        Mover m = mover(r, i);
        steer_and_move(s, m, r.target[i] * s.lane_width, r.following[i], ~none());
        Mask ego = is_ego(r, i), others = (r.valid[i] != 0.0f) & ~ego;
        // late reactions: what is delayed is the acceleration that was decided on
        Float left = steps_left(r, i, LAPSE_LEFT, others, uniform_of(keys, LATE_REACTION), f.lapse_chance, f.lapse_steps);
        Float decided = m.acceleration, oldest = r.memory[PAST][i];
        if (any(left > 0.0f)) m = driven_at(r, i, m, left > 0.0f, oldest);
        remember(r, i, LAPSE_LEFT, larger(left - 1.0f, zero));
        for (int k = 0; k + 1 < f.delay_steps; k++) remember(r, i, PAST + k, r.memory[PAST + k + 1][i]);
        remember(r, i, PAST + f.delay_steps - 1, decided);
        // phantom braking; who brakes harder anyway goes on doing so
        left = steps_left(r, i, BRAKING_LEFT, others, uniform_of(keys, FAULT), f.braking_chance, f.braking_steps);
        Mask brakes = (left > 0.0f) & (m.acceleration > -f.deceleration);
        if (any(brakes)) m = driven_at(r, i, m, brakes, filled(-f.deceleration));
        remember(r, i, BRAKING_LEFT, larger(left - 1.0f, zero));
        // hesitant and aborted lane changes: drawn when the change begins
        Mask begins = (r.target[i] != target[i]) & others, hesitant = r.memory[HESITANT][i] != 0.0f;
        Float origin = r.memory[ORIGIN][i];
        if (any(begins)) {
            hesitant = (begins & (uniform_of(keys, HESITANT_CHANGE) < f.hesitation_share)) | (hesitant & ~begins);
            Float back = choose(uniform_of(keys, ABORTED_CHANGE) < f.abort_share, target[i], filled(NO_LANE));
            origin = choose(begins, back, origin);
        }
        m.y = choose(hesitant, r.y[i] + f.pace * (m.y - r.y[i]), m.y);
        Mask done = absolute(m.y - r.target[i] * s.lane_width) < ARRIVED;
        remember(r, i, HESITANT, choose(hesitant & ~done, filled(1.0f), zero));
        Float start = origin * s.lane_width, end = r.target[i] * s.lane_width;
        Mask turns = (origin != NO_LANE) & (absolute(m.y - start) >= f.abort_at * absolute(end - start));
        remember(r, i, ORIGIN, choose(turns, filled(NO_LANE), origin));
        Mask on = r.running;
        r.target[i] = choose(turns & ~ego & on, origin, r.target[i]);
        Mover was = mover(r, i);
        put(r, i, {
            choose(on, m.x, was.x), choose(on, m.y, was.y), choose(on, m.heading, was.heading),
            choose(on, m.speed, was.speed), choose(on, m.acceleration, was.acceleration),
            choose(on, m.steering, was.steering), choose(on, m.slip, was.slip), choose(on, m.slip_sine, was.slip_sine),
        });
    }
}

// The memory of drivers that enter: no fault, and they have always accelerated as they do now.
static void enter_with_faults(const Faults& f, void* const* arrays, long first, long last, const float* acceleration) {
    for (long i = first; i < last; i++) {
        for (int k = 0; k < f.delay_steps; k++) ((float*)arrays[0])[i * f.delay_steps + k] = acceleration[i];
        ((int64_t*)arrays[1])[i] = ((int64_t*)arrays[2])[i] = 0;
        ((uint8_t*)arrays[3])[i] = 0;
        ((int64_t*)arrays[4])[i] = (int64_t)NO_LANE;
    }
}
