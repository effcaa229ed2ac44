// The lane view (ganlane.transforms.observation): own state, the nearest ahead and behind in three lanes, own change.

#include <stdint.h>
#include <stdlib.h>

#include "model.hpp"

// What is at the end for drivers that command more than the lane (ganlane.transforms.observation.control_numbers).
enum { NO_CONTROL, SPEED_CONTROL, STEERED };

// As ganlane/native/settings.py declares them.
struct View {
    float range, speed_scale, lane_width, nearness_m, overlap_m, sight_m, heading_rad;
    int32_t lanes, vehicles, drift, overlap, road, control;
    const Ends* ends;  // null: all lanes go on for ever
};

struct ViewInputs {  // [rows, vehicles] or [rows]; the `seen` are as the ego perceives them
    const float *speed, *desired_speed, *length, *y;
    const float *seen_x, *seen_y, *seen_speed;
    const uint8_t* seen_valid;
    const float* progress;
    const int64_t* direction;
    const float *x, *heading;  // of the vehicles as they are
    const float* set_speed;    // null without
};

static inline float in_sight(const View& v, float distance) {
    float share = distance / v.sight_m;
    return share < 0.0f ? 0.0f : share > 1.0f ? 1.0f : share;
}

static inline bool lane_there(const View& v, int lane, float x) {
    return lane >= 0 && lane < v.lanes && (!v.ends || (v.ends->begin[lane] <= x && x < v.ends->end[lane]));
}

// Where lanes begin and end (ganlane.transforms.observation.road_ahead): eight numbers.
static float* look_ahead(const View& v, int lane, float front, float* out) {
    for (int k = 0; k < 3; k++) {
        int beside = lane + 1 - k;
        bool there = beside >= 0 && beside < v.lanes;
        out[k] = !there ? 0.0f : v.ends ? in_sight(v, v.ends->end[beside] - front) : 1.0f;
        out[3 + k] = !there ? 1.0f : v.ends ? in_sight(v, v.ends->begin[beside] - front) : 0.0f;
    }
    int exit = v.ends ? v.ends->exit_lane : -1, widest = v.lanes > 1 ? v.lanes - 1 : 1;
    out[6] = exit < 0 ? 0.0f : (float)(exit - lane) / (float)widest;
    out[7] = exit < 0 ? 1.0f : in_sight(v, v.ends->end[exit] - front);
    return out + 8;
}

static inline float limited(float number) { return number < -1.0f ? -1.0f : number > 1.0f ? 1.0f : number; }

// Length of an observation.
static inline long size_of(const View& v) { return 5 + 6 * (v.drift ? 4 : 3) + (v.road ? 8 : 0) + v.control; }

const float UNSEEN = 1e9f;

// e^z for z from -87 to 0: 2^n times Cephes' polynomial.
INLINE Float exponential(Float z) {
    z = larger(z, filled(-87.0f));
    Float n = rounded(z * 1.44269504088896341f);
    Float r = (z - n * 0.693359375f) - n * -2.12194440e-4f;
    Float p = ((((1.9875691500e-4f * r + 1.3981999507e-3f) * r + 8.3334519073e-3f) * r + 4.1665795894e-2f) * r +
               1.6666665459e-1f) * r + 5.0000001201e-1f;
    return (p * r * r + r + 1.0f) * (Float)((__builtin_convertvector(n, Mask) + 127) << 23);
}

INLINE Float view_lane(const View& v, Float y) {
    return between(rounded(y / v.lane_width), 0.0f, (float)(v.lanes - 1));
}

// The nearest of a lane's end: of several at the same distance the smallest of each number counts.
struct Found {
    Float distance, minus_bumpers, speed, drift;
};

static inline void look(const View& v, const ViewInputs& in, float* out, long size, long first, long rows, Found* found) {
    const float SIDES[6] = {1, 1, 0, 0, -1, -1}, AHEAD[6] = {1, -1, 1, -1, 1, -1};
    auto row_of = [&](int lane) { return first + (lane < rows ? lane : rows - 1); };
    auto gather = [&](const float* field, int vehicle) {
        Float made;
        for (int lane = 0; lane < LANES; lane++) made[lane] = field[row_of(lane) * v.vehicles + vehicle];
        return made;
    };
    for (int slot = 0; slot < 6; slot++) found[slot] = {filled(UNSEEN), filled(0.0f), filled(0.0f), filled(0.0f)};
    Float x = gather(in.seen_x, 0), speed = gather(in.seen_speed, 0), half_length = 0.5f * gather(in.length, 0);
    Float own_lane = view_lane(v, gather(in.seen_y, 0));
    for (int i = 1; i < v.vehicles; i++) {
        Mask valid;
        for (int lane = 0; lane < LANES; lane++) valid[lane] = in.seen_valid[row_of(lane) * v.vehicles + i] ? -1 : 0;
        Float position = between((gather(in.seen_x, i) - x) / v.range, -1.0f, 1.0f);
        Mask in_sight = valid & (absolute(position) < 1.0f);
        if (!any(in_sight)) continue;
        Float y = gather(in.seen_y, i), lane = view_lane(v, y), offset = lane - own_lane;
        Float faster = between((gather(in.seen_speed, i) - speed) / v.speed_scale, -1.0f, 1.0f);
        Float drift = between(2.0f * (y - lane * v.lane_width) / v.lane_width, -1.0f, 1.0f);
        Float minus_bumpers = -(half_length + 0.5f * gather(in.length, i));
        for (int slot = 0; slot < 6; slot++) {
            Found& f = found[slot];
            Mask end = AHEAD[slot] > 0 ? position > 0.0f : position <= 0.0f;
            Mask counts = in_sight & end & (offset == SIDES[slot]);
            Float distance = absolute(position);
            Mask nearer = counts & (distance < f.distance), as_near = counts & (distance == f.distance);
            f.distance = choose(nearer, distance, f.distance);
            f.minus_bumpers = choose(nearer | (as_near & (minus_bumpers < f.minus_bumpers)), minus_bumpers, f.minus_bumpers);
            f.speed = choose(nearer | (as_near & (faster < f.speed)), faster, f.speed);
            f.drift = choose(nearer | (as_near & (drift < f.drift)), drift, f.drift);
        }
    }
    Float numbers[3 + 6 * 4];
    Float lane_here = view_lane(v, gather(in.y, 0));
    numbers[0] = gather(in.speed, 0) / gather(in.desired_speed, 0);
    numbers[1] = choose(lane_here < (float)(v.lanes - 1), filled(1.0f), filled(0.0f));
    numbers[2] = choose(lane_here > 0.0f, filled(1.0f), filled(0.0f));
    int count = 3;
    for (int slot = 0; slot < 6; slot++) {
        const Found& f = found[slot];
        Mask there = f.distance <= 1.0f;
        Float gap = choose(there, f.distance * v.range + f.minus_bumpers, filled(v.range));
        if (!v.overlap) gap = larger(gap, filled(0.0f));
        Float beside = larger(-gap, filled(0.0f)) / v.overlap_m;
        Float nearness = exponential(-larger(gap, filled(0.0f)) / v.nearness_m) + beside;
        numbers[count++] = choose(there, gap / v.range, filled(1.0f));
        numbers[count++] = choose(there, nearness, filled(0.0f));
        numbers[count++] = f.speed;
        if (v.drift) numbers[count++] = f.drift;
    }
    for (int lane = 0; lane < rows; lane++) {
        long row = first + lane;
        for (int k = 0; k < count; k++) out[row * size + k] = numbers[k][lane];
        float* end = out + row * size + count;
        *end++ = in.progress[row];
        *end++ = (float)in.direction[row];
        long ego = row * v.vehicles;
        int here = (int)lane_here[lane];
        if (v.road) {
            // A lane that the ego may change into where it is.
            bool own = lane_there(v, here, in.x[ego]);
            out[row * size + 1] = own && lane_there(v, here + 1, in.x[ego]) ? 1.0f : 0.0f;
            out[row * size + 2] = own && lane_there(v, here - 1, in.x[ego]) ? 1.0f : 0.0f;
            end = look_ahead(v, here, in.x[ego] + 0.5f * in.length[ego], end);
        }
        if (v.control == SPEED_CONTROL) *end++ = in.set_speed[row] / in.desired_speed[ego];
        if (v.control == STEERED) {
            *end++ = limited(2.0f * (in.y[ego] - (float)here * v.lane_width) / v.lane_width);
            *end++ = limited(in.heading[ego] / v.heading_rad);
        }
    }
}

// The observations [rows, size] of the rows [first, last).
extern "C" int ganlane_lane_view(const View* view, const ViewInputs* in, float* const* out, long first, long last) {
    Found found[6];
    long size = size_of(*view);
    for (long row = first; row < last; row += LANES)
        look(*view, *in, *out, size, row, last - row < LANES ? last - row : LANES, found);
    return 0;
}
