// The action mask `safe` (ganlane.transforms.mask): a lane change is allowed where it has an effect and neither the ego
// nor its new follower would have to brake harder than is safe.

#include <stdint.h>

#include "arrays.hpp"
#include "model.hpp"

struct MaskInputs {  // as the ego perceives them: [rows, vehicles], `direction` [rows]
    const float *x, *y, *heading, *speed, *length, *width, *desired_speed;
    const int64_t *target_lane, *visibility;
    const uint8_t* valid;
    const int64_t* direction;
};

struct MaskOutputs {
    uint8_t* mask;  // [rows, 3]: keep, left, right
    uint8_t* none;  // [rows]
};

static inline void allow(const Settings& s, const MaskInputs& in, const MaskOutputs& out, long first, long rows) {
    const float SIDES[3] = {0.0f, 1.0f, -1.0f};  // of the three actions
    auto gather = [&](auto* field, int vehicle) {
        Float made;
        for (int lane = 0; lane < LANES; lane++)
            made[lane] = (float)field[(first + (lane < rows ? lane : rows - 1)) * s.vehicles + vehicle];
        return made;
    };
    Float x = gather(in.x, 0), speed = gather(in.speed, 0), half_length = 0.5f * gather(in.length, 0);
    Float target = gather(in.target_lane, 0);
    Float gap[3], leader[3], gap_behind[3], follower[3], per_desired[3];
    for (int side = 0; side < 3; side++) {
        gap[side] = gap_behind[side] = filled(FREE_GAP);
        leader[side] = follower[side] = speed, per_desired[side] = filled(1.0f);
    }
    for (int i = 1; i < s.vehicles; i++) {
        Float other = gather(in.speed, i), half = 0.5f * gather(in.length, i), sine, cosine;
        sincos_of(gather(in.heading, i), sine, cosine);
        LanesOf l = lanes_of(s, gather(in.y, i), sine, cosine, half, 0.5f * gather(in.width, i),
                             gather(in.target_lane, i), gather(in.visibility, i), gather(in.valid, i) != 0.0f);
        Float d = gather(in.x, i) - x, g = absolute(d) - (half_length + half);
        Float per_its_desired = 1.0f / gather(in.desired_speed, i);
        for (int side = 0; side < 3; side++) {
            Float lane = target + SIDES[side];
            Mask here = (l.seen_low <= lane) & (lane <= l.seen_high), before = d > 0.0f;
            Mask leads = here & before & ((g < gap[side]) | ((g == gap[side]) & (other < leader[side])));
            Mask follows = here & ~before & (g < gap_behind[side]);
            gap[side] = choose(leads, g, gap[side]), leader[side] = choose(leads, other, leader[side]);
            gap_behind[side] = choose(follows, g, gap_behind[side]);
            follower[side] = choose(follows, other, follower[side]);
            per_desired[side] = choose(follows, per_its_desired, per_desired[side]);
        }
    }
    Float per_own_desired = 1.0f / gather(in.desired_speed, 0);
    Mask safe[3];
    for (int side = 0; side < 3; side++) {
        Float own = idm(s, speed, per_own_desired, gap[side], leader[side]);
        if (s.ends) {
            // The wall at the end of the lane: a standing obstacle, for a driver that keeps the lane.
            Float wall = of_lane(s, s.ends->wall, target + SIDES[side], NOBODY_M);
            Float braking = idm(s, speed, per_own_desired, wall - (x + half_length) - TURN_OUT, filled(0.0f));
            own = choose(wall < NOBODY_M, smaller(own, braking), own);
        }
        Float behind = idm(s, follower[side], per_desired[side], gap_behind[side], speed);
        behind = choose(gap_behind[side] < FREE_GAP, behind, filled(0.0f));
        safe[side] = smaller(own, behind) >= -s.safe_deceleration;
    }
    for (int lane = 0; lane < rows; lane++) {
        long row = first + lane;
        int64_t direction = in.direction[row], at = in.target_lane[row * s.vehicles];
        bool left = may_change(s, at, 1, x[lane]) && is_heard(1, direction, s.abort_lane_change);
        bool right = may_change(s, at, -1, x[lane]) && is_heard(-1, direction, s.abort_lane_change);
        uint8_t* mask = out.mask + 3 * row;
        mask[0] = 1, mask[1] = left && safe[1][lane], mask[2] = right && safe[2][lane];
        out.none[row] = !(safe[0][lane] || mask[1] || mask[2]);
    }
}

// The masks of the rows [first, last).
extern "C" int ganlane_mask(const Settings* settings, const MaskInputs* in, const MaskOutputs* out, long first, long last) {
    for (long row = first; row < last; row += LANES)
        allow(*settings, *in, *out, row, last - row < LANES ? last - row : LANES);
    return 0;
}
