// One decision of rule-driven traffic: ego command, IDM, MOBIL, steering, bicycle, collisions, events, recycling.
//
// The same model as ganlane.sim, ganlane.env and ganlane.traffic.idm_mobil, which say where each equation comes from;
// tests/native holds the two together. SI units, float32.
//
// A vector holds one number of LANES environments ("rows"), so no row depends on another: whatever is asked of a
// whole vector (any) only skips work whose result nobody uses. With -ffp-contract=off, own sine and arctangent, and
// nothing but + - * / and comparisons besides, an episode is the same bit for bit in any batch, with any LANES, on any
// instruction set.
//
// How to read it. `Float` and `Mask` (vectors.hpp) hold LANES numbers and answers, one of each row; there is no `if`
// on them, so `choose(mask, yes, no)` computes both and keeps, row by row, the one that holds. Integers (lanes, target
// lanes, steps, indices) are floats here, exact below 2^24, so that they mix with the others. Read from the bottom:
// ganlane_decide, load, decide, store. Names of arrays are those of the state's keys (ganlane.keys).

#include <stdint.h>
#include <stdlib.h>

#include "arrays.hpp"
#include "faults.hpp"
#include "generated.hpp"
#include "human.hpp"
#include "random_drivers.hpp"

const float RECYCLE_RANGE = 200.0f, RECYCLE_DECELERATION = 4.0f, RECYCLE_SIDE = 0.4f;
enum { KEEP, LEFT, RIGHT, FASTER, SLOWER };

static inline bool is_steered(const Settings& s) { return s.actions && s.actions->form == CONTINUOUS; }

// ---- The ego among the others

struct Ego {
    Float x, y, heading, sine, cosine, half_length, half_width, extent, speed, low, high, valid;
};

static inline Ego find_ego(const Rows& r) {
    Float zero = filled(0.0f);
    Ego e = {zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero};
    for (int i = 0; i < r.vehicles; i++) {
        Mask it = is_ego(r, i);
        if (!any(it)) continue;
        e.x = choose(it, r.x[i], e.x), e.y = choose(it, r.y[i], e.y);
        e.heading = choose(it, r.heading[i], e.heading);
        e.sine = choose(it, r.sine[i], e.sine), e.cosine = choose(it, r.cosine[i], e.cosine);
        e.half_length = choose(it, r.half_length[i], e.half_length);
        e.half_width = choose(it, r.half_width[i], e.half_width);
        e.extent = choose(it, r.extent[i], e.extent), e.speed = choose(it, r.speed[i], e.speed);
        e.low = choose(it, r.body_low[i], e.low), e.high = choose(it, r.body_high[i], e.high);
        e.valid = choose(it, r.valid[i], e.valid);
    }
    return e;
}

// Whether two oriented boxes overlap (separating axes; touching does not count).
INLINE Mask overlaps(const Ego& e, const Rows& r, int i) {
    Float dx = r.x[i] - e.x, dy = r.y[i] - e.y, c = e.cosine, s = e.sine, oc = r.cosine[i], os = r.sine[i];
    Float cosine = absolute(c * oc + s * os), sine = absolute(c * os - s * oc);
    Float length = e.half_length, width = e.half_width, other_length = r.half_length[i], other_width = r.half_width[i];
    Mask apart = (absolute(dx * c + dy * s) >= length + other_length * cosine + other_width * sine) |
                 (absolute(dy * c - dx * s) >= width + other_length * sine + other_width * cosine) |
                 (absolute(dx * oc + dy * os) >= other_length + length * cosine + width * sine) |
                 (absolute(dy * oc - dx * os) >= other_width + length * sine + width * cosine);
    return ~apart;
}

// Hard crash: the ego overlaps somebody. Only who is near along the road and across is looked at closely.
static inline Mask crashed(const Ego& e, const Rows& r) {
    Mask hit = none();
    for (int i = 0; i < r.vehicles; i++) {
        Mask counts = (r.valid[i] != 0.0f) & (e.valid != 0.0f) & ~is_ego(r, i);
        Float reach = e.half_length + e.half_width + r.half_length[i] + r.half_width[i];
        Mask near = (absolute(r.x[i] - e.x) < reach) & (absolute(r.y[i] - e.y) < e.extent + r.extent[i] + 0.01f);
        if (any(counts & near)) hit |= counts & overlaps(e, r, i);
    }
    return hit;
}

// Soft crash ahead and behind: the nearest in a lane that the ego's body is in is dangerously close. One scan, in any
// order; written out, since sharing it with the like one of mask.cpp made a decision of 1024 rows take 8 % longer.
static inline void look_round(const Settings& s, const Rows& r, const Ego& e, Mask& ahead, Mask& behind) {
    ahead = none(), behind = none();
    Float lanes[3] = {e.low, e.high, smaller(e.low + 1.0f, e.high)};
    int count = any(e.high - e.low > 1.0f) ? 3 : any(e.high > e.low) ? 2 : 1;
    for (int k = 0; k < count; k++) {
        Float gap = filled(FREE_GAP), speed = e.speed, gap_behind = filled(FREE_GAP), follower = e.speed, index = filled(0.0f);
        for (int i = 0; i < r.vehicles; i++) {
            Float d = r.x[i] - e.x, g = absolute(d) - (e.half_length + r.half_length[i]);
            Mask here = seen_in(r, i, lanes[k]) & ~is_ego(r, i), before = d > 0.0f;  // at the same x the ego is ahead
            Mask leads = here & before & ((g < gap) | ((g == gap) & (r.speed[i] < speed)));
            Mask follows = here & ~before & ((g < gap_behind) | ((g == gap_behind) & (r.index[i] < index)));
            gap = choose(leads, g, gap), speed = choose(leads, r.speed[i], speed);
            gap_behind = choose(follows, g, gap_behind), follower = choose(follows, r.speed[i], follower);
            index = choose(follows, r.index[i], index);
        }
        ahead |= (gap < s.soft_crash_gap) | (gap < s.soft_crash_ttc * (e.speed - speed));
        behind |= (gap_behind < s.soft_crash_gap) | (gap_behind < s.soft_crash_ttc * (follower - e.speed));
    }
}

// Whether the ego has driven into the wall at the end of a lane that its body is in.
static __attribute__((noinline)) Mask hits_wall(const Settings& s, const Ego& e) {
    Mask hit = none();
    for (int lane = 0; lane < s.lanes; lane++) {
        Mask here = (e.low <= (float)lane) & ((float)lane <= e.high);
        hit |= here & (s.ends->wall[lane] - (e.x + e.half_length) < 0.0f);
    }
    return hit;
}

// What a physics step led to. A hard crash comes before leaving the road, that before goal and missed exit, all before
// the time-out. `y_before`: where the ego was, if it is steered.
static inline void note_events(const Settings& s, Rows& r, Float y_before) {
    Ego e = find_ego(r);
    Mask ahead, behind, on = r.running;
    look_round(s, r, e, ahead, behind);
    Mask crash = crashed(e, r) & on;
    if (s.ends) crash |= hits_wall(s, e) & on;
    Mask left = none(), goal = e.x >= s.goal, missed = none();
    if (is_steered(s))
        for (int lane = 0; lane < LANES; lane++) left[lane] = leaves_road(s, y_before[lane], e.y[lane], e.x[lane]) ? -1 : 0;
    left &= on & ~crash;
    if (s.ends && s.ends->exit_lane >= 0) {
        // On a road with an exit that is the goal, wherever it is.
        Mask passed = e.x >= s.ends->end[s.ends->exit_lane];
        goal = passed & (lane_of(s, e.y) == (float)s.ends->exit_lane), missed = passed & ~goal;
    }
    goal &= on & ~crash & ~left, missed &= on & ~crash & ~left;
    Float one = filled(1.0f), zero = filled(0.0f);
    r.step = r.step + choose(on, one, zero);
    r.onsets = r.onsets + choose(ahead & ~r.ahead & on, one, zero);
    r.onsets_behind = r.onsets_behind + choose(behind & ~r.behind & on, one, zero);
    r.ahead = (ahead & on) | (r.ahead & ~on);
    r.behind = (behind & on) | (r.behind & ~on);
    r.crash |= crash, r.goal |= goal, r.missed_exit |= missed, r.out_of_road |= left;
    r.running = on & ~crash & ~left & ~goal & ~missed & (r.step < (float)s.timeout_steps);
}

// ---- Recycling: who is left far behind is put far ahead, and the reverse, where nobody has to brake hard for it

// A vehicle at the place to which it may be put.
struct Placed {
    Float x, y, speed, per_desired, half_length, half_width, low, high, index;
};

// Whether it has nothing to do with vehicle j.
INLINE Mask is_apart(const Rows& r, const Placed& p, int j) {
    Mask beside = absolute(p.y - r.y[j]) < p.half_width + r.half_width[j] + RECYCLE_SIDE;
    return ~((((p.low <= r.high[j]) & (r.low[j] <= p.high)) | beside) & (r.valid[j] != 0.0f));
}

// Whether it leaves room to vehicle j at `other`: none of the two brakes harder than is safe.
INLINE Mask leaves_room(const Settings& s, const Rows& r, const Placed& p, int j, Float other, Mask tie_ahead) {
    Float distance = other - p.x, bumpers = p.half_length + r.half_length[j];
    Mask ahead = (distance > 0.0f) | ((distance == 0.0f) & tie_ahead);
    Float gap = smaller(absolute(distance) - bumpers, filled(FREE_GAP));
    Float behind_it = idm(s, p.speed, p.per_desired, gap, r.speed[j]);
    Float before_it = idm(s, r.speed[j], r.per_desired[j], gap, p.speed);
    return choose(ahead, behind_it, before_it) >= -RECYCLE_DECELERATION;
}

static inline void recycle(const Settings& s, Rows& r, Mask rows) {
    Float* moved = r.wish;  // free between decisions of MOBIL, as is `kept`
    Float ego_x = find_ego(r).x;
    Mask away = none();
    for (int i = 0; i < r.vehicles; i++) {
        Float distance = r.x[i] - ego_x;
        Mask out = (absolute(distance) > RECYCLE_RANGE) & (r.valid[i] != 0.0f);
        Float jump = choose(distance > 0.0f, filled(2.0f * RECYCLE_RANGE), filled(-2.0f * RECYCLE_RANGE));
        moved[i] = choose(out, r.x[i] - jump, r.x[i]);
        away |= out & rows;
    }
    if (!any(away)) return;
    for (int i = 0; i < r.vehicles; i++) {
        Mask room = rows & (moved[i] != r.x[i]);
        r.kept[i] = r.x[i];
        if (!any(room)) continue;
        Placed p = {moved[i], r.y[i], r.speed[i], r.per_desired[i], r.half_length[i], r.half_width[i], r.low[i], r.high[i], r.index[i]};
        for (int j = 0; j < r.vehicles; j++) {
            Mask apart = is_apart(r, p, j);
            if (j == i || !any(room & ~apart)) continue;
            // Everybody where it may be put, and where it is: whoever else moves, there is room.
            room &= apart | (leaves_room(s, r, p, j, moved[j], r.index[j] < p.index) & leaves_room(s, r, p, j, r.x[j], none()));
        }
        r.kept[i] = choose(room, moved[i], r.x[i]);
    }
    for (int i = 0; i < r.vehicles; i++) r.x[i] = r.kept[i];
}

// ---- Flow: who has passed the end of the section is out, and others come in (ganlane.sim.flow)

// Whether the driver of a slot leaves by the exit.
static inline bool leaves_by_exit(const Flow& f, int64_t slot) {
    return slot > 0 && (int64_t)__builtin_floor((double)slot * f.exit_share) > (int64_t)__builtin_floor((double)(slot - 1) * f.exit_share);
}

static inline void let_out(const Settings& s, Rows& r, Mask rows) {
    int exit = s.ends->exit_lane;
    for (int i = 0; i < r.vehicles; i++) {
        Mask left = r.x[i] > s.flow->to;
        if (exit >= 0) left |= (r.x[i] >= s.ends->end[exit]) & (lane_of(s, r.y[i]) == (float)exit);
        r.valid[i] = choose(left & ~is_ego(r, i) & rows, filled(0.0f), r.valid[i]);
    }
}

// Who comes where somebody arrives: the place in the row's order of one of those who wait; -1 where nobody does.
static int who_comes(const Settings& s, const Rows& r, int lane, uint64_t at_step, bool exits) {
    int comes = -1;
    int64_t lowest = 0;
    for (int i = 0; i < r.vehicles; i++) {
        int64_t slot = (int64_t)at(r.index, i, lane);
        float off = at(r.y, i, lane) - at(r.target, i, lane) * s.lane_width;
        if (slot == 0 || at(r.valid, i, lane) != 0.0f || !((off < 0.0f ? -off : off) < ARRIVED)) continue;
        int64_t number = (int64_t)(absorb(absorb(at_step, slot), FLOW_SLOT) >> 40);
        if (s.flow->exit_share > 0.0 && s.ends->exit_lane >= 0 && leaves_by_exit(*s.flow, slot) != exits) number += 1 << 24;
        bool lower = comes < 0 || number < lowest || (number == lowest && slot < (int64_t)at(r.index, comes, lane));
        if (lower) comes = i, lowest = number;
    }
    return comes;
}

static void let_in(const Settings& s, Rows& r, Mask rows) {
    const Flow& f = *s.flow;
    // Entry by entry, so that nobody enters beside one who has just done so without room.
    for (int entry = 0; entry < s.lanes; entry++) {
        if (f.arrival[entry] == 0.0) continue;
        int who[LANES];
        Mask room = none();
        Float zero = filled(0.0f), target = filled((float)entry), sine = zero, cosine = zero, visibility = zero;
        Placed p = {filled(f.from), zero, zero, zero, zero, zero, zero, zero, zero};
        for (int lane = 0; lane < LANES; lane++) {
            uint64_t at_step = absorb(r.episode_key[lane], (int64_t)r.step[lane]), at_entry = absorb(at_step, entry);
            if (!rows[lane] || !(fine_uniform_of(absorb(at_entry, FLOW_ARRIVAL)) < f.arrival[entry])) continue;
            int i = who[lane] = who_comes(s, r, lane, at_step, fine_uniform_of(absorb(at_entry, FLOW_EXIT)) < f.exit_share);
            if (i < 0) continue;
            room[lane] = -1;
            p.y[lane] = at(r.y, i, lane) + ((float)entry - at(r.target, i, lane)) * s.lane_width;
            p.speed[lane] = at(r.speed, i, lane), p.per_desired[lane] = at(r.per_desired, i, lane);
            p.half_length[lane] = at(r.half_length, i, lane), p.half_width[lane] = at(r.half_width, i, lane);
            p.index[lane] = at(r.index, i, lane), visibility[lane] = at(r.visibility, i, lane);
            sine[lane] = at(r.sine, i, lane), cosine[lane] = at(r.cosine, i, lane);
        }
        if (!any(room)) continue;
        LanesOf l = lanes_of(s, p.y, sine, cosine, p.half_length, p.half_width, target, visibility, room);
        p.low = l.low, p.high = l.high;
        // Who waits, as the one who comes, is not valid and so in nobody's way.
        for (int j = 0; j < r.vehicles; j++) {
            Mask apart = is_apart(r, p, j);
            if (any(room & ~apart)) room &= apart | leaves_room(s, r, p, j, r.x[j], r.index[j] < p.index);
        }
        for (int lane = 0; lane < LANES; lane++) {
            if (!room[lane]) continue;
            int i = who[lane];
            at(r.x, i, lane) = f.from, at(r.y, i, lane) = p.y[lane], at(r.target, i, lane) = (float)entry;
            at(r.low, i, lane) = p.low[lane], at(r.high, i, lane) = p.high[lane], at(r.valid, i, lane) = 1.0f;
        }
    }
}

// ---- A decision

// Rule-driven drivers. Everybody looks at the vehicles as they are before anybody moves: accelerations first, then lanes.
template <class Drivers>
static inline void drive_by_rules(const Settings& s, Rows& r, const Drivers& drivers, int substep) {
    follow(s, r, drivers);
    Float* target = r.along;
    if (s.faults)
        for (int i = 0; i < r.vehicles; i++) target[i] = r.target[i];
    if (s.mobil) change_lanes(s, r, r.running & (r.phase == 0.0f), drivers);
    r.phase = choose(r.phase == (float)(MOBIL_PERIOD - 1), filled(0.0f), r.phase + 1.0f);
    if (s.faults) drive_with_faults(s, r, target);
    else if (s.random) drive_with_traits(s, r, substep);
    else drive(s, r);
}

// What drivers by a network work with; of rule-driven ones nothing.
struct Networks {
    Crowd crowd;
    Humans humans;
};

static Networks networks_in(Pieces& room, const Settings& s) {
    Networks networks = {};
    if (s.generated) networks.crowd = crowd_in(room, s.generated, s.vehicles);
    if (s.human) networks.humans = humans_in(room, s.human, s.vehicles);
    return networks;
}

static size_t network_floats(const Settings& s) {
    Pieces counted = {};
    networks_in(counted, s);
    return counted.count;
}

static inline Mover ego_mover(const Rows& r) {
    Mover ego = mover(r, 0);
    for (int i = 1; i < r.vehicles; i++) {
        Mask it = is_ego(r, i);
        Mover m = mover(r, i);
        ego.x = choose(it, m.x, ego.x), ego.y = choose(it, m.y, ego.y);
        ego.heading = choose(it, m.heading, ego.heading), ego.speed = choose(it, m.speed, ego.speed);
        ego.acceleration = choose(it, m.acceleration, ego.acceleration);
        ego.steering = choose(it, m.steering, ego.steering);
        ego.slip = choose(it, m.slip, ego.slip), ego.slip_sine = choose(it, m.slip_sine, ego.slip_sine);
    }
    return ego;
}

// The ego, which has been driven like the others, from where it was `before` by its own pedal and line.
static inline void drive_ego(const Settings& s, Rows& r, Mover before) {
    steer_and_move(s, before, r.line, r.pedal, r.running);
    for (int i = 0; i < r.vehicles; i++) {
        Mask it = is_ego(r, i);
        r.x[i] = choose(it, before.x, r.x[i]), r.y[i] = choose(it, before.y, r.y[i]);
        r.heading[i] = choose(it, before.heading, r.heading[i]), r.speed[i] = choose(it, before.speed, r.speed[i]);
        r.acceleration[i] = choose(it, before.acceleration, r.acceleration[i]);
        r.steering[i] = choose(it, before.steering, r.steering[i]);
        r.slip[i] = choose(it, before.slip, r.slip[i]);
        r.slip_sine[i] = choose(it, before.slip_sine, r.slip_sine[i]);
    }
}

// The ego's commanded speed holds within a decision; who enters behind it reckons with the desired one.
static void restore_desired_speeds(const Settings& s, const Inputs& in, Rows& r, const Block& block) {
    for (int i = 0; i < r.vehicles; i++)
        for (int lane = 0; lane < LANES; lane++)
            if (at(r.index, i, lane) == 0.0f) at(r.per_desired, i, lane) = 1.0f / in.desired_speed[block.row[lane] * s.vehicles];
}

// `ended(rows)` is called when rows of generated drivers end, before anything of them changes.
template <class Ended>
static inline void decide(const Settings& s, Rows& r, Networks& networks, Ended ended) {
    Alike alike = {common(s)};
    Different different = {common(s)};
    find_lanes(s, r);
    for (int substep = 0; substep < s.substeps && any(r.running); substep++) {
        Mask running = r.running;
        Mover before = {};
        if (is_steered(s)) before = ego_mover(r);
        if (r.memory_fields)  // drivers with a memory draw random numbers
            for (int lane = 0; lane < LANES; lane++) r.step_key[lane] = absorb(r.episode_key[lane], r.start_step[lane] + substep);
        if (s.generated) {
            follow(s, r, alike);
            drive_generated(s, r, networks.crowd);
        } else if (s.human) {
            follow(s, r, alike);
            drive_humans(s, r, networks.humans, substep);
        } else if (s.random) {
            drive_by_rules(s, r, different, substep);
        } else {
            drive_by_rules(s, r, alike, substep);
        }
        if (is_steered(s)) drive_ego(s, r, before);
        put_in_order(r);
        find_lanes(s, r);
        note_events(s, r, before.y);
        if (s.generated) ended(running & ~r.running);
    }
}

// ---- Arrays in and out: the rows of a block

struct Command {  // of one row, what the action leads to
    int64_t direction, target;
    bool starts, off_road;
    float speed;
    int64_t step;
    float set_speed, line, pedal;  // where there are such commands
};

// Acceleration and line (ganlane.sim.actions.apply_controls). A lane change starts where the lane of the line becomes
// another one.
static Command be_steered(const Settings& s, const Inputs& in, long row) {
    long ego = row * s.vehicles;
    const Actions& a = *s.actions;
    auto limited = [](float number) { return number < -1.0f ? -1.0f : number > 1.0f ? 1.0f : number; };
    float pedal = limited(in.controls[2 * row]), wheel = limited(in.controls[2 * row + 1]);
    float nearest = __builtin_rintf(in.y[ego] * s.per_lane_width), last = (float)(s.lanes - 1);
    nearest = nearest < 0.0f ? 0.0f : nearest > last ? last : nearest;
    int64_t lane = (int64_t)nearest, side = wheel > 0.5f ? 1 : wheel < -0.5f ? -1 : 0;
    int64_t target = may_change(s, lane, side, in.x[ego]) ? lane + side : lane, shift = target - in.target_lane[ego];
    float room = (in.desired_speed[ego] - in.speed[ego]) / a.period;
    float acceleration = pedal * (pedal > 0.0f ? a.strongest_acceleration : a.strongest_braking);
    room = room < 0.0f ? 0.0f : room;
    return {shift ? (shift > 0 ? 1 : -1) : in.change_direction[row], target, shift != 0, false, in.speed[ego], in.step[row],
            0.0f, (nearest + wheel) * s.lane_width, acceleration < room ? acceleration : room};
}

// The speed that the ego aims at after its action.
static float commanded_speed(const Settings& s, const Inputs& in, long row) {
    if (!in.set_speed) return in.desired_speed[row * s.vehicles];
    const Actions& a = *s.actions;
    int64_t action = in.action[row];
    float highest = in.desired_speed[row * s.vehicles], lowest = highest < a.lowest_speed ? highest : a.lowest_speed;
    float speed = in.set_speed[row] + (action == FASTER ? a.speed_step : action == SLOWER ? -a.speed_step : 0.0f);
    speed = speed < lowest ? lowest : speed;
    return speed < highest ? speed : highest;
}

// The action 0 keep, 1 left, 2 right (3 faster, 4 slower keep the lane); ignored during a lane change, but with `abort_lane_change` it may turn back.
static Command obey(const Settings& s, const Inputs& in, long row) {
    if (is_steered(s)) return be_steered(s, in, row);
    int64_t wish = in.action[row] == LEFT ? 1 : in.action[row] == RIGHT ? -1 : 0;
    int64_t direction = in.change_direction[row], target = in.target_lane[row * s.vehicles];
    if (!is_heard(wish, direction, s.abort_lane_change)) wish = 0;
    bool off_road = !may_change(s, target, wish, in.x[row * s.vehicles]);
    if (off_road) wish = 0;
    return {wish ? wish : direction, target + wish, wish != 0, off_road, in.speed[row * s.vehicles], in.step[row],
            commanded_speed(s, in, row), 0.0f, 0.0f};
}

// Whether nobody sees the ego in an episode (ganlane.traffic.BlindTraffic).
static inline bool is_blind(const Settings& s, uint64_t episode) {
    if (s.blind_share == 0.0) return false;
    const int64_t ego = 0;
    uint64_t key = absorb(absorb(before_first_step(episode), ego), BLIND_EPISODE);
    return fine_uniform_of(key) < s.blind_share;
}

static void load(const Settings& s, const Inputs& in, Rows& r, const Block& block, Command* commands) {
    bool has_exit = s.ends && s.ends->exit_lane >= 0;
    for (int lane = 0; lane < LANES; lane++) {
        long start = block.row[lane] * s.vehicles;
        for (int i = 0; i < s.vehicles; i++) at(r.x, i, lane) = in.x[start + i], at(r.index, i, lane) = (float)i;
    }
    for (int last = s.vehicles - 1; last > 0;) {  // as put_in_order, of positions and indices alone
        int exchanged = 0;
        for (int i = 0; i < last; i++) {
            Mask wrong = r.x[i] < r.x[i + 1];
            if (!any(wrong)) continue;
            Float x = r.x[i], index = r.index[i];
            r.x[i] = choose(wrong, r.x[i + 1], x), r.x[i + 1] = choose(wrong, x, r.x[i + 1]);
            r.index[i] = choose(wrong, r.index[i + 1], index), r.index[i + 1] = choose(wrong, index, r.index[i + 1]);
            exchanged = i;
        }
        last = exchanged;
    }
    for (int lane = 0; lane < LANES; lane++) {
        long row = block.row[lane], start = row * s.vehicles;
        Command command = commands[lane] = obey(s, in, row);
        for (int i = 0; i < s.vehicles; i++) {
            long index = (long)at(r.index, i, lane), from = start + index;
            at(r.y, i, lane) = in.y[from];
            at(r.heading, i, lane) = in.heading[from];
            at(r.speed, i, lane) = in.speed[from];
            at(r.acceleration, i, lane) = in.acceleration[from];
            at(r.half_length, i, lane) = 0.5f * in.length[from];
            at(r.half_width, i, lane) = 0.5f * in.width[from];
            at(r.per_desired, i, lane) = 1.0f / (index == 0 && in.set_speed ? command.set_speed : in.desired_speed[from]);
            at(r.target, i, lane) = (float)(index == 0 ? command.target : in.target_lane[from]);
            at(r.visibility, i, lane) = (float)in.visibility[from];
            at(r.valid, i, lane) = (float)(in.valid[from] != 0);
            bool exits = has_exit && (index == 0 || (s.flow && leaves_by_exit(*s.flow, index)));
            if (exits && in.valid[from]) at(r.valid, i, lane) = EXITS;
            at(r.steering, i, lane) = index == 0 ? in.ego_steering[row] : in.steering ? in.steering[from] : 0.0f;
        }
        r.line[lane] = command.line, r.pedal[lane] = command.pedal;
        r.running[lane] = lane < block.count && !command.off_road ? -1 : 0;
        r.ahead[lane] = in.soft_crash[row] ? -1 : 0;
        r.behind[lane] = in.soft_crash_behind[row] ? -1 : 0;
        r.phase[lane] = (float)(command.step % MOBIL_PERIOD);  // rows of a vector may be at different times
        r.step[lane] = (float)command.step;
        r.start_step[lane] = command.step;
        r.episode_key[lane] = episode_key(s.stream, in.seed[row], in.episode[row]);
        r.unseen[lane] = is_blind(s, r.episode_key[lane]) ? -1 : 0;
    }
    for (int i = 0; i < s.vehicles; i++) r.slip[i] = slip_of(r.steering[i]), r.slip_sine[i] = sine_of(r.slip[i]);
    r.crash = r.goal = r.missed_exit = r.out_of_road = none();
    r.onsets = r.onsets_behind = filled(0.0f);
}

static void store_ego(const Settings& s, const Inputs& in, const Rows& r, const Outputs& out, long row, int lane,
                      const Command& command) {
    long ego = row * s.vehicles;
    float y = out.y[ego], centre = (float)out.target_lane[ego] * s.lane_width;
    float off = y - centre < 0.0f ? centre - y : y - centre;
    int64_t direction = off < ARRIVED ? 0 : command.direction, step = (int64_t)r.step[lane];
    float progress = 1.0f - off / s.lane_width;
    int64_t steps = step - command.step;
    bool goal = r.goal[lane], crash = r.crash[lane], missed = r.missed_exit[lane];
    bool off_road = command.off_road || r.out_of_road[lane];
    bool ended = goal || crash || missed || off_road;
    if (out.set_speed) out.set_speed[row] = command.set_speed;
    bool truncated = !r.running[lane] && !ended;
    out.mean_acceleration[row] = (out.speed[ego] - command.speed) / ((float)(steps < 1 ? 1 : steps) * PHYSICS_STEP);
    out.change_progress[row] = direction == 0 || progress < 0.0f ? 0.0f : progress > 1.0f ? 1.0f : progress;
    out.distance[row] = out.x[ego];
    out.change_direction[row] = direction;
    out.decisions[row] = in.decisions[row] + 1;
    out.lane_changes[row] = in.lane_changes[row] + command.starts;
    out.soft_crash[row] = r.ahead[lane] != 0;
    out.soft_crash_behind[row] = r.behind[lane] != 0;
    out.started_change[row] = command.starts;
    out.step[row] = step;
    out.goal[row] = goal, out.hard_crash[row] = crash, out.out_of_road[row] = off_road;
    out.missed_exit[row] = missed;
    out.timeout[row] = out.truncated[row] = truncated;
    out.soft_crashes[row] = (int64_t)r.onsets[lane], out.soft_crashes_behind[row] = (int64_t)r.onsets_behind[lane];
    out.terminated[row] = ended, out.done[row] = ended || truncated;
}

static void store(const Settings& s, const Inputs& in, Rows& r, const Outputs& out, const Block& block,
                  const Command* commands) {
    for (int lane = 0; lane < block.count; lane++) {
        long row = block.row[lane], start = row * s.vehicles;
        for (int i = 0; i < s.vehicles; i++) {
            long index = (long)at(r.index, i, lane), to = start + index;
            out.x[to] = at(r.x, i, lane);
            out.y[to] = at(r.y, i, lane);
            out.heading[to] = at(r.heading, i, lane);
            out.speed[to] = at(r.speed, i, lane);
            out.acceleration[to] = at(r.acceleration, i, lane);
            out.target_lane[to] = (int64_t)at(r.target, i, lane);
            if (out.steering) out.steering[to] = at(r.steering, i, lane);
            if (index == 0) out.ego_steering[row] = at(r.steering, i, lane);
            if (out.valid) out.valid[to] = at(r.valid, i, lane) != 0.0f;
        }
        store_ego(s, in, r, out, row, lane, commands[lane]);
    }
}

// Memory of one call, aligned to a vector's size, which its instructions ask for; null without memory.
static void* scratch(size_t bytes) {
    void* memory = nullptr;
    return posix_memalign(&memory, 64, bytes) ? nullptr : memory;
}

static Fields fields_of(const Settings& s) {
    if (s.generated) return s.generated->calibrated ? CALIBRATED : PAPER;
    if (s.human) return HUMAN;
    if (s.faults) return fields_of(*s.faults);
    return s.random ? fields_of(*s.random) : Fields{0, {}};
}

// Drives the rows [first, last) through one decision. Returns 0, or 1 without memory, or 2 and drives none of them
// where an action is none of those there are, or no finite number.
extern "C" int ganlane_decide(const Settings* settings, const Inputs* in, const Outputs* out, long first, long last) {
    const Settings& s = *settings;
    uint64_t actions = s.actions ? 5 : 3;
    for (long place = first; place < last; place++) {
        long row = in->rows ? (long)in->rows[place] : place;
        if (is_steered(s)) {
            for (int k = 0; k < 2; k++)
                if (!__builtin_isfinite(in->controls[2 * row + k])) return 2;
        } else if ((uint64_t)in->action[row] >= actions) return 2;
    }
    size_t floats = scratch_floats(s) * LANES;
    float* memory = (float*)scratch((floats + network_floats(s)) * sizeof(float));
    if (!memory) return 1;
    Fields fields = fields_of(s);
    Rows r;
    r.memory_fields = count_of(fields);
    lay_out(r, (Float*)memory, s);
    Pieces room = {memory + floats, 0};
    Networks networks = networks_in(room, s);
    Crowd& crowd = networks.crowd;
    // Behind the fields, the network's memory.
    const Memory& network_before = *(const Memory*)(memory_of(in) + fields.arrays);
    const Memory& network_after = *(const Memory*)(memory_of(out) + fields.arrays);
    Command commands[LANES];
    for (long place = first; place < last; place += LANES) {
        Block block = {last - place < LANES ? last - place : LANES, {}};
        for (int lane = 0; lane < LANES; lane++) {
            long at = place + (lane < block.count ? lane : block.count - 1);
            block.row[lane] = in->rows ? (long)in->rows[at] : at;
        }
        r.alone = block.count == 1;
        load(s, *in, r, block, commands);
        load_fields(fields, r, memory_of(in), block);
        crowd.environments = (int)block.count;
        if (s.generated) load_memory(crowd, network_before, block);
        // The network of a row that ends remembers nothing of what comes after.
        auto keep = [&](Mask ended) {
            for (int lane = 0; any(ended) && lane < block.count; lane++)
                if (ended[lane]) store_memory(crowd, network_after, block.row[lane], lane);
        };
        if (s.generated) keep(~r.running);
        decide(s, r, networks, keep);
        if (s.generated) keep(r.running);
        if (in->recycles) {
            Mask recycles = none();
            for (int lane = 0; lane < block.count; lane++) recycles[lane] = in->recycles[block.row[lane]] ? -1 : 0;
            recycles &= r.running;
            if (in->set_speed) restore_desired_speeds(s, *in, r, block);
            if (s.flow) let_out(s, r, recycles), let_in(s, r, recycles);
            else recycle(s, r, recycles);
        }
        store_fields(fields, r, memory_of(out), block);
        store(s, *in, r, *out, block, commands);
    }
    free(memory);
    return 0;
}

static inline uint64_t before_first_step(const Settings& s, const Scene& scene, long row) {
    return before_first_step(episode_key(s.stream, scene.seed[row], scene.episode[row]));
}

// First scenes, as far as drivers see them.
static void load_scene(const Settings& s, Rows& r, const Scene& scene, const Outputs& out, const Block& block) {
    for (int lane = 0; lane < LANES; lane++) {
        long row = block.row[lane];
        r.step_key[lane] = before_first_step(s, scene, row);
        r.unseen[lane] = 0;  // the first memory is that of drivers who see
        for (int i = 0; i < s.vehicles; i++) {
            long from = row * s.vehicles + i;
            at(r.index, i, lane) = (float)i;
            at(r.x, i, lane) = out.x[from], at(r.y, i, lane) = out.y[from];
            at(r.heading, i, lane) = out.heading[from], at(r.speed, i, lane) = out.speed[from];
            at(r.acceleration, i, lane) = out.acceleration[from], at(r.half_length, i, lane) = 0.5f * scene.length[from];
            at(r.valid, i, lane) = (float)(scene.valid[from] != 0);
        }
    }
    put_in_order(r);
    for (int i = 0; i < r.vehicles; i++) sincos_of(r.heading[i], r.sine[i], r.cosine[i]);
}

// Gives the drivers of those of the rows [first, last) that are `fresh` their first memory, and random ones their
// desired speed: after ganlane_spawn. Returns 0, or 1 without memory.
extern "C" int ganlane_enter(const Settings* settings, const Scene* scene, const Outputs* out, long first, long last) {
    const Settings& s = *settings;
    Fields fields = fields_of(s);
    if (!fields.arrays) return 0;
    float* memory = (float*)scratch((network_floats(s) + scratch_floats(s) * LANES) * sizeof(float));
    if (!memory) return 1;
    Pieces room = {memory + scratch_floats(s) * LANES, 0};
    Networks networks = networks_in(room, s);
    void* const* arrays = memory_of(out);
    Rows r;
    r.memory_fields = count_of(fields);
    __builtin_memset(memory, 0, scratch_floats(s) * LANES * sizeof(float));
    lay_out(r, (Float*)memory, s);
    Block block = {};
    for (long row = first; row < last; row++) {
        uint64_t key = before_first_step(s, *scene, row);
        bool fresh = scene->fresh[row];
        if (s.human) {
            if (fresh) block.row[block.count++] = row;
            if (!block.count || (block.count < LANES && row + 1 < last)) continue;
            for (int lane = (int)block.count; lane < LANES; lane++) block.row[lane] = block.row[block.count - 1];
            load_scene(s, r, *scene, *out, block);
            enter_humans(s, r, networks.humans);
            store_fields(fields, r, arrays, block);
            block.count = 0;
        } else if (fresh) {
            if (s.generated) enter(networks.crowd, arrays, row, key, out->speed);
            else if (s.faults) enter_with_faults(*s.faults, arrays, row * s.vehicles, (row + 1) * s.vehicles, out->acceleration);
            else enter_with_traits(s, arrays, row, key, *scene, *out);
        }
    }
    free(memory);
    return 0;
}
