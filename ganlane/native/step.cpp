// A decision of a batch with all that a learner reads of it: state, reward and its terms, action mask, observation.

#include <stdint.h>

#include "arrays.hpp"
#include "model.hpp"

struct View;
struct ViewInputs;
struct MaskInputs;
struct MaskOutputs;

extern "C" {
int ganlane_decide(const Settings*, const Inputs*, const Outputs*, long first, long last);
int ganlane_spawn(const Spawn*, const Scene*, const Outputs*, long first, long last);
int ganlane_enter(const Settings*, const Scene*, const Outputs*, long first, long last);
int ganlane_lane_view(const View*, const ViewInputs*, float* const*, long first, long last);
int ganlane_mask(const Settings*, const MaskInputs*, const MaskOutputs*, long first, long last);
}

struct Reward {  // section V.C, see ganlane.transforms.reward
    float period, base_speed, low_acceleration;
    float lane_change, out_of_road, hard_crash, soft_crash, goal, soft_crash_behind;
    int32_t literal_low_acceleration, terms;
};

enum { MASK_ROAD, MASK_LEGAL, MASK_SAFE, MASK_FORESIGHT };

struct Batch {
    const Settings* settings;
    const Inputs* in;
    const Outputs* out;
    const Spawn* spawn;
    const Scene* scene;
    const Reward* reward_settings;
    float *reward, *terms;  // [rows], [rows, terms]
    const View* view;
    const ViewInputs* view_inputs;
    float* observation;  // [rows, size]
    const Settings* mask_settings;
    const MaskInputs* mask_inputs;
    const MaskOutputs* mask_outputs;
    uint8_t* mask;       // [rows, 3]
    uint8_t* speed_mask;  // [rows, 5], with faster and slower; null: there are no such actions
    double* time_s;       // [rows], since the episode's start
    int64_t* lane;        // [rows], that the ego is in; beyond the outer ones the outer one
    float lowest, highest, fastest;  // bounds of the observation; the last one is that of its first number
    int32_t vehicles, lanes, size, mask_form, abort_lane_change;
};

static void rate(const Batch& b, long row) {
    const Reward& p = *b.reward_settings;
    const Outputs& s = *b.out;
    long ego = row * b.vehicles;
    float value = (s.speed[ego] - p.base_speed) / (b.scene->desired_speed[ego] - p.base_speed);
    if (s.mean_acceleration[row] < p.low_acceleration)
        value = p.literal_low_acceleration || value > 0.0f ? -value : value;
    float terms[7] = {p.period * value, p.lane_change * (float)s.started_change[row],
                      p.out_of_road * (float)s.out_of_road[row], p.hard_crash * (float)s.hard_crash[row],
                      p.soft_crash * (float)s.soft_crashes[row], p.goal * (float)s.goal[row],
                      p.soft_crash_behind * (float)s.soft_crashes_behind[row]};
    float total = terms[0];
    for (int i = 1; i < p.terms; i++) total = total + terms[i];
    for (int i = 0; i < p.terms; i++) b.terms[row * p.terms + i] = terms[i];
    b.reward[row] = total;
}

static void allow(const Batch& b, long row) {
    int64_t lane = b.out->target_lane[row * b.vehicles], direction = b.out->change_direction[row];
    const int SIDES[3] = {0, 1, -1};
    uint8_t* mask = b.mask + 3 * row;
    mask[0] = 1;
    for (int action = 1; action < 3; action++) {
        bool heard = b.mask_form == MASK_ROAD || is_heard(SIDES[action], direction, b.abort_lane_change);
        mask[action] = heard && may_change(*b.settings, lane, SIDES[action], b.out->x[row * b.vehicles]);
    }
}

// The mask with faster and slower, which are allowed where they have an effect.
static void allow_speeds(const Batch& b, long row) {
    uint8_t* mask = b.speed_mask + 5 * row;
    for (int action = 0; action < 3; action++) mask[action] = b.mask[3 * row + action];
    float speed = b.out->set_speed[row];
    mask[3] = speed < b.scene->desired_speed[row * b.vehicles];
    mask[4] = speed > b.settings->actions->lowest_speed;
}

// Time and the ego's lane.
static void measure(const Batch& b, long row) {
    const double STEP_S = 0.1;  // PHYSICS_STEP in double precision
    b.time_s[row] = (double)b.out->step[row] * STEP_S;
    float lane = __builtin_rintf(b.out->y[row * b.vehicles] / b.settings->lane_width), outer = (float)(b.lanes - 1);
    b.lane[row] = (int64_t)(lane < 0.0f ? 0.0f : lane > outer ? outer : lane);
}

// Mask, observation, time and lane of the rows [first, last).
static int look(const Batch& b, long first, long last) {
    int failed = ganlane_lane_view(b.view, b.view_inputs, &b.observation, first, last);
    for (long row = first; row < last; row++) {
        float* numbers = b.observation + row * b.size;
        for (int i = 0; i < b.size; i++) {
            float low = i ? b.lowest : 0.0f, high = i ? b.highest : b.fastest;
            numbers[i] = numbers[i] < low ? low : numbers[i] > high ? high : numbers[i];
        }
        if (b.mask_form < MASK_SAFE) allow(b, row);
        measure(b, row);
    }
    if (b.mask_form >= MASK_SAFE) failed |= ganlane_mask(b.mask_settings, b.mask_inputs, b.mask_outputs, first, last);
    if (b.speed_mask)
        for (long row = first; row < last; row++) allow_speeds(b, row);
    return failed;
}

// Reward, mask and observation of the rows [first, last), which have been driven. Returns 0, or 1 without memory.
extern "C" int ganlane_judge(const Batch* batch, long first, long last) {
    const Batch& b = *batch;
    for (long row = first; row < last; row++) rate(b, row);
    return look(b, first, last);
}

// Drives the rows [first, last) through one decision. Returns as ganlane_decide does.
extern "C" int ganlane_step(const Batch* batch, long first, long last) {
    const Batch& b = *batch;
    if (int failed = ganlane_decide(b.settings, b.in, b.out, first, last)) return failed;
    return ganlane_judge(batch, first, last);
}

// Begins the episodes of those of the rows [first, last) that are `fresh`. Returns 0, or 1 without memory.
extern "C" int ganlane_start(const Batch* batch, long first, long last) {
    const Batch& b = *batch;
    if (ganlane_spawn(b.spawn, b.scene, b.out, first, last)) return 1;
    if (ganlane_enter(b.settings, b.scene, b.out, first, last)) return 1;
    for (long row = first; row < last; row++) {
        if (!b.scene->fresh[row]) continue;
        long end = row + 1;  // behind the last of the fresh rows beginning here
        while (end < last && b.scene->fresh[end]) end++;
        for (long i = row * b.reward_settings->terms; i < end * b.reward_settings->terms; i++) b.terms[i] = 0.0f;
        for (long i = row; i < end; i++) b.reward[i] = 0.0f;
        if (look(b, row, end)) return 1;
        row = end;
    }
    return 0;
}
