// Counter-based random numbers (ganlane.sim.random): splitmix64's finaliser, one field after the other.

#pragma once

#include <stdint.h>

static inline uint64_t absorb(uint64_t key, int64_t field) {
    uint64_t h = (key ^ (uint64_t)field) + 0x9E3779B97F4A7C15u;
    h = (h ^ (h >> 30)) * 0xBF58476D1CE4E5B9u;
    h = (h ^ (h >> 27)) * 0x94D049BB133111EBu;
    return h ^ (h >> 31);
}

static inline uint64_t episode_key(int64_t stream, int64_t seed, int64_t episode) {
    return absorb(absorb(absorb((uint64_t)stream, 0), seed), episode);
}

// Step -1 of a key of its own: apart from the draws of the steps.
static inline uint64_t before_first_step(uint64_t episode) { return absorb(absorb(episode, 0), -1); }

static inline float uniform_of(uint64_t key) { return (float)(key >> 40) * (1.0f / 16777216.0f); }

// With the 53 bits that float64 has.
static inline double fine_uniform_of(uint64_t key) { return (double)(key >> 11) * (1.0 / 9007199254740992.0); }

// Purpose of ganlane.sim.random.
enum {
    SPAWN_LANE, SPAWN_POSITION, SPAWN_SPEED, SPAWN_DESIRED_SPEED,
    CHANGE_HAZARD = 5, CHANGE_SIDE, CHANGE_SPEED, SUDDEN_ACCELERATION, OWN_HEADWAY,
    FAULT = 11, LATE_REACTION, HESITANT_CHANGE, ABORTED_CHANGE,
    NOISE = 16, BLIND_EPISODE = 69, DRIVER = 70, SPAWN_TRUCK = 90, RECYCLED_EPISODE = 91, FLOW_ARRIVAL, FLOW_EXIT, FLOW_SLOT,
};
