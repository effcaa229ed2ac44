// The action masks `safe` and `foresight` (ganlane.transforms.mask): a lane change is allowed where it has an effect and
// neither the ego nor its new follower would have to brake harder than is safe; with `foresight` also only where there
// is room for the next seconds (ganlane.sim.foresight).

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

const float HORIZON = 3.0f, MARGIN = 1.0f, REACTION = 0.5f, DRIFT = 1.0f;

// The egos and one of the others, of some rows.
struct Pair {
    Float speed, sine, y, distance, gap;
    LanesOf lanes;
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
    auto pair = [&](int i) {
        Pair p;
        Float half = 0.5f * gather(in.length, i), cosine;
        sincos_of(gather(in.heading, i), p.sine, cosine);
        p.speed = gather(in.speed, i), p.y = gather(in.y, i);
        p.lanes = lanes_of(s, p.y, p.sine, cosine, half, 0.5f * gather(in.width, i), gather(in.target_lane, i),
                           gather(in.visibility, i), gather(in.valid, i) != 0.0f);
        p.distance = gather(in.x, i) - x, p.gap = absolute(p.distance) - (half_length + half);
        return p;
    };
    Float gap[3], leader[3], gap_behind[3], follower[3], per_desired[3];
    for (int side = 0; side < 3; side++) {
        gap[side] = gap_behind[side] = filled(FREE_GAP);
        leader[side] = follower[side] = speed, per_desired[side] = filled(1.0f);
    }
    for (int i = 1; i < s.vehicles; i++) {
        Pair p = pair(i);
        Float per_its_desired = 1.0f / gather(in.desired_speed, i);
        for (int side = 0; side < 3; side++) {
            Float lane = target + SIDES[side];
            Mask here = (p.lanes.seen_low <= lane) & (lane <= p.lanes.seen_high), before = p.distance > 0.0f;
            Mask leads = here & before & ((p.gap < gap[side]) | ((p.gap == gap[side]) & (p.speed < leader[side])));
            Mask follows = here & ~before & (p.gap < gap_behind[side]);
            gap[side] = choose(leads, p.gap, gap[side]), leader[side] = choose(leads, p.speed, leader[side]);
            gap_behind[side] = choose(follows, p.gap, gap_behind[side]);
            follower[side] = choose(follows, p.speed, follower[side]);
            per_desired[side] = choose(follows, per_its_desired, per_desired[side]);
        }
    }
    Float per_own_desired = 1.0f / gather(in.desired_speed, 0);
    Float accelerates[3];
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
        accelerates[side] = own;
    }
    if (s.foresight) {
        Float way[3];
        for (int side = 1; side < 3; side++) {
            // As slowly as both lanes let the ego drive, until it stands or the horizon ends.
            Float slows = smaller(smaller(accelerates[0], accelerates[side]), filled(0.0f));
            Float time = choose(slows < 0.0f, smaller(speed / -slows, filled(HORIZON)), filled(HORIZON));
            way[side] = speed * time + 0.5f * slows * time * time;
        }
        for (int i = 1; i < s.vehicles; i++) {
            Pair p = pair(i);
            Float towards = lane_of(s, p.y + DRIFT * p.speed * p.sine), per_braking = filled(0.5f / s.safe_deceleration);
            Mask valid = gather(in.valid, i) != 0.0f;
            Float low = smaller(p.lanes.seen_low, towards), high = larger(p.lanes.seen_high, towards);
            Float ahead = p.gap + (p.speed * p.speed - speed * speed) * per_braking - REACTION * speed;
            for (int side = 1; side < 3; side++) {
                Float lane = target + SIDES[side], behind = p.gap + way[side] - HORIZON * p.speed;
                Mask there = (low <= lane) & (lane <= high) & valid;
                Mask room = smaller(p.gap, choose(p.distance > 0.0f, ahead, behind)) >= MARGIN;
                safe[side] = safe[side] & (room | ~there);
            }
        }
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
