// The lane view (ganlane.transforms.observation): own state, the nearest ahead and behind in three lanes, own change.

#include <stdint.h>
#include <stdlib.h>

#include "vectors.hpp"

// As ganlane/native/settings.py declares them.
struct View {
    float range, speed_scale, lane_width, nearness_m, overlap_m;
    int32_t lanes, vehicles, drift, overlap;
};

struct ViewInputs {  // [rows, vehicles] or [rows]; the `seen` are as the ego perceives them
    const float *speed, *desired_speed, *length, *y;
    const float *seen_x, *seen_y, *seen_speed;
    const uint8_t* seen_valid;
    const float* progress;
    const int64_t* direction;
};

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
    Float lane = view_lane(v, gather(in.y, 0));
    numbers[0] = gather(in.speed, 0) / gather(in.desired_speed, 0);
    numbers[1] = choose(lane < (float)(v.lanes - 1), filled(1.0f), filled(0.0f));
    numbers[2] = choose(lane > 0.0f, filled(1.0f), filled(0.0f));
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
        out[row * size + count] = in.progress[row];
        out[row * size + count + 1] = (float)in.direction[row];
    }
}

// The observations [rows, size] of the rows [first, last).
extern "C" int ganlane_lane_view(const View* view, const ViewInputs* in, float* const* out, long first, long last) {
    Found found[6];
    long size = 5 + 6 * (view->drift ? 4 : 3);
    for (long row = first; row < last; row += LANES)
        look(*view, *in, *out, size, row, last - row < LANES ? last - row : LANES, found);
    return 0;
}
