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
    Around around[3] = {nobody_around(speed), nobody_around(speed), nobody_around(speed)};
    for (int i = 1; i < s.vehicles; i++) {
        Float other = gather(in.speed, i), half = 0.5f * gather(in.length, i), sine, cosine;
        sincos_of(gather(in.heading, i), sine, cosine);
        LanesOf l = lanes_of(s, gather(in.y, i), sine, cosine, half, 0.5f * gather(in.width, i),
                             gather(in.target_lane, i), gather(in.visibility, i), gather(in.valid, i) != 0.0f);
        Float distance = gather(in.x, i) - x, gap = absolute(distance) - (half_length + half);
        Float per_desired = 1.0f / gather(in.desired_speed, i);
        for (int side = 0; side < 3; side++) {
            Float lane = target + SIDES[side];
            Mask here = (l.seen_low <= lane) & (lane <= l.seen_high);
            look_at(around[side], here, distance, gap, other, per_desired, filled((float)i));
        }
    }
    Float per_own_desired = 1.0f / gather(in.desired_speed, 0);
    Mask safe[3];
    for (int side = 0; side < 3; side++) {
        const Around& a = around[side];
        Float own = idm(s, speed, per_own_desired, a.gap, a.leader);
        Float behind = idm(s, a.follower, a.per_desired, a.gap_behind, speed);
        behind = choose(a.gap_behind < FREE_GAP, behind, filled(0.0f));
        safe[side] = smaller(own, behind) >= -s.safe_deceleration;
    }
    for (int lane = 0; lane < rows; lane++) {
        long row = first + lane;
        int64_t direction = in.direction[row], at = in.target_lane[row * s.vehicles];
        bool left = on_road(at + 1, s.lanes) && is_heard(1, direction, s.abort_lane_change);
        bool right = on_road(at - 1, s.lanes) && is_heard(-1, direction, s.abort_lane_change);
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
