// The arrays of a batch and the settings of an episode's start, as ganlane/native/settings.py declares them.
// [rows] or [rows, vehicles], the ego first; flags are bytes.

#pragma once

#include <stdint.h>

// ---- The legal command, as is_heard and on_road of ganlane.sim.dynamics say it

// Whether a wish to go to `side` (1 left, -1 right) is obeyed during a lane change in `direction`.
static inline bool is_heard(int64_t side, int64_t direction, bool abort) {
    return direction == 0 || (abort && side == -direction);
}

static inline bool on_road(int64_t lane, int64_t lanes) { return lane >= 0 && lane < lanes; }

// ---- Arrays. The soft crashes of a decision are counted in the state's events; those of the ego's memory are whether
// there is one at this instant.

struct Inputs {
    const int64_t* action;
    const float *x, *y, *heading, *speed, *acceleration, *length, *width, *desired_speed;
    const int64_t *target_lane, *visibility;
    const uint8_t* valid;
    const float* steering;  // null where the others are generated
    const float* ego_steering;
    const int64_t *change_direction, *decisions, *lane_changes;
    const uint8_t *soft_crash, *soft_crash_behind;
    const int64_t* step;
    const uint8_t* recycles;  // whether vehicles of the row return, or enter and leave; null: in none
    const int64_t *seed, *episode;
    const float* controls;   // [rows, 2], acceleration and line, -1 to 1; null: there is `action`
    const float* set_speed;  // that the ego aims at; null: the desired one
    const int64_t* rows;     // those to drive: a decision's rows [first, last) are places here; null: all
    // and the memory of generated drivers (Memory of generated.hpp), here and in Outputs
};

struct Outputs {  // may be the same memory as the inputs
    float *x, *y, *heading, *speed, *acceleration;
    int64_t* target_lane;
    float* steering;
    float *ego_steering, *mean_acceleration, *change_progress, *distance;
    int64_t *change_direction, *decisions, *lane_changes;
    uint8_t *soft_crash, *soft_crash_behind, *started_change;
    int64_t* step;
    uint8_t *goal, *hard_crash, *out_of_road, *missed_exit, *timeout;
    int64_t *soft_crashes, *soft_crashes_behind;
    float* set_speed;
    uint8_t *done, *terminated, *truncated;
    uint8_t* valid;  // null: nobody enters or leaves
};

struct Range {
    float low, span;
};

// A scene set by hand, the ego first; the others' positions and all speeds vary by up to the jitter.
struct Fixed {
    const float *x, *y, *speed, *length, *width, *desired_speed;
    const int64_t *target_lane, *visibility;
    float jitter_m, jitter_mps;
    int32_t waiting;  // so many of the last ones are outside at the start
};

struct Spawn {  // Table II
    double recycle_share;
    int64_t stream;
    Range front_speed, rear_speed, ego_speed, desired_speed, truck_desired_speed;
    float spread, spacing, ego_desired_speed, truck_share, length, width, truck_length, truck_width, lane_width;
    int32_t vehicles, lanes, capacity, ego_visibility, others_visibility, recycle;
    const Fixed* fixed;  // instead of Table II; null: none
};

struct Scene {  // what an episode's start sets besides the state
    const int64_t *seed, *episode;
    const uint8_t* fresh;  // rows that start
    float *length, *width, *desired_speed;
    int64_t* visibility;
    uint8_t *valid, *recycles;
};
