// Drivers by the network: what ganlane.traffic.presets lays together for `gan` and `gan_calibrated`.
//
// The paper's (`gan`): the network's first displacement moves the vehicle; sudden accelerations, blind lane changes and
// the guard are laid over it (ganlane.traffic.overlays). Calibrated: the network's output is a residual on IDM and lane
// keeping (ganlane.generator.closed_loop), and lane changes wait for a gap. The ego drives by IDM, as everywhere.
//
// The network sees its vehicles by their index, [vehicles, environments], the rest in the order of the road (rows.hpp).

#pragma once

#include "arrays.hpp"
#include "network.hpp"
#include "memory.hpp"

struct Generated {
    Network network;
    float noise_share, noise_fresh, noise_scale;
    int32_t calibrated, guard;
    // paper's: sudden accelerations, lane changes, the guard
    float sudden_chance, sudden_mean, sudden_sd, sudden_steps;
    float mean_steps, lateral_speed_mps, lateral_speed_sd_mps, slowest_mps;
    float guard_headway_s, slack, hardest_braking, centring, damping, edge_margin_m, steepest_rad;
    // calibrated: the anchor and its residual, wishes for lane changes, headways
    float min_gap_m, per_brake_scale, min_acceleration, max_acceleration;
    float lane_stiffness, lane_damping, residual_along, residual_across, washout_share;
    float changes_per_m, patience_steps;
    float headways_s[5];
    int32_t further_inputs;
};

const float HEADWAY_LEVELS[5] = {0.05f, 0.25f, 0.5f, 0.75f, 0.95f};
const float STEEPEST = 0.3f, MARGIN = 0.1f, FADE = 0.3f;
// Places in the memory of a row's driver.
enum { SUDDEN, SUDDEN_LEFT, CLOCK, LATERAL_SPEED };
enum { MEAN_ALONG, MEAN_ACROSS, HEADWAY, WISH, WAITED };

// The network's memory in the state, [rows, vehicles, ...]: behind the arrays of the drivers' other numbers.
struct Memory {
    float *displacement, *noise;
    float* motions[1];  // as many as the network has
};

const Fields PAPER = {4, {{SUDDEN, 1, FLOAT}, {SUDDEN_LEFT, 1, INTEGER}, {CLOCK, 1, INTEGER}, {LATERAL_SPEED, 1, FLOAT}}};
const Fields CALIBRATED = {4, {{MEAN_ALONG, 2, FLOAT}, {HEADWAY, 1, FLOAT}, {WISH, 1, INTEGER}, {WAITED, 1, INTEGER}}};

// ---- The drivers of a block of environments

struct Crowd {
    const Generated* g;
    Layers layers;
    Activations work;
    int environments, vehicles;
    // [vehicles, environments] each with its numbers; `displacement` is that of the step before until `look`.
    float *position, *displacement, *difference, *extra, *noise, *scaled, *first_uniform, *second_uniform;
    float** motions;  // oldest first
    uint8_t* valid;
    uint64_t* step_key;  // of the rows
};

static Crowd crowd_in(Pieces& room, const Generated* g, int vehicles) {
    const Network& n = g->network;
    size_t rows = (size_t)vehicles * LANES;
    Crowd c;
    c.g = g, c.layers = layers_of(n), c.vehicles = vehicles;
    c.position = room(2 * rows), c.displacement = room(2 * rows), c.difference = room(2 * rows);
    c.extra = room(n.extra_inputs * rows), c.noise = room(n.noise * rows), c.scaled = room(n.noise * rows);
    c.first_uniform = room(n.noise * rows), c.second_uniform = room(n.noise * rows);
    c.valid = (uint8_t*)room(rows), c.motions = (float**)room(2 * (size_t)n.motions);
    for (int t = 0; t < n.motions; t++) {
        float* motion = room(4 * padded(n.hidden) * rows);
        if (c.motions) c.motions[t] = motion;
    }
    c.work = activations_in(room, n, rows, vehicles);
    return c;
}

// Of vehicle i of the road's order, the row of the network.
INLINE int row_of(const Crowd& c, const Rows& r, int i, int lane) { return (int)at(r.index, i, lane) * c.environments + lane; }

// Copies a motion of a vehicle: gates of `hidden` numbers in the state, of whole vectors here.
INLINE void copy_gates(int hidden, float* to, int to_width, const float* from, int from_width) {
    if (to_width == from_width) {
        __builtin_memcpy(to, from, 4 * (size_t)hidden * sizeof(float));
        return;
    }
    for (int gate = 0; gate < 4; gate++)
        __builtin_memcpy(to + gate * to_width, from + gate * from_width, hidden * sizeof(float));
}

static void load_memory(Crowd& c, const Memory& m, const Block& block) {
    const Network& n = c.g->network;
    int width = padded(n.hidden);
    for (int environment = 0; environment < c.environments; environment++)
        for (int v = 0; v < c.vehicles; v++) {
            long from = block.row[environment] * c.vehicles + v, to = (long)v * c.environments + environment;
            for (int k = 0; k < 2; k++) c.displacement[2 * to + k] = m.displacement[2 * from + k];
            for (int k = 0; k < n.noise; k++) c.noise[to * n.noise + k] = m.noise[from * n.noise + k];
            for (int t = 0; t < n.motions; t++)
                copy_gates(n.hidden, c.motions[t] + to * 4 * width, width, m.motions[t] + from * 4 * n.hidden, n.hidden);
        }
}

static void store_memory(const Crowd& c, const Memory& m, long row, int environment) {
    const Network& n = c.g->network;
    int width = padded(n.hidden);
    for (int v = 0; v < c.vehicles; v++) {
        long to = row * c.vehicles + v, from = (long)v * c.environments + environment;
        for (int k = 0; k < 2; k++) m.displacement[2 * to + k] = c.displacement[2 * from + k];
        for (int k = 0; k < n.noise; k++) m.noise[to * n.noise + k] = c.noise[from * n.noise + k];
        for (int t = 0; t < n.motions; t++)
            copy_gates(n.hidden, m.motions[t] + to * 4 * n.hidden, n.hidden, c.motions[t] + from * 4 * width, width);
    }
}

// ---- Random numbers

// Standard normal numbers [rows, noise] of the step keys into `noise`: noise = share * noise + fresh * number.
static void draw_noise(Crowd& c, float share, float fresh) {
    int noise = c.g->network.noise, rows = c.vehicles * c.environments;
    for (int row = 0; row < rows; row++) {
        uint64_t vehicle = absorb(c.step_key[row % c.environments], row / c.environments);
        for (int k = 0; k < noise; k++) {
            uint64_t key = absorb(vehicle, NOISE + k);
            c.first_uniform[row * noise + k] = uniform_of(absorb(key, 1));
            c.second_uniform[row * noise + k] = uniform_of(absorb(key, 2));
        }
    }
    // Whole vectors; what lies behind the last number is room that nobody reads.
    for (int k = 0; k < rows * noise; k += LANES) {
        Float number = normal_of(read(c.first_uniform + k), read(c.second_uniform + k));
        Float now = share * read(c.noise + k) + fresh * number;
        write(c.noise + k, now);
        write(c.scaled + k, c.g->noise_scale * now);
    }
}

// ---- A step of the network

// What the network sees of the vehicles.
static void look(const Rows& r, Crowd& c) {
    for (int lane = 0; lane < c.environments; lane++)
        for (int i = 0; i < c.vehicles; i++) {
            int row = row_of(c, r, i, lane);
            // From speed and heading: differences of float32 positions lose half a millimetre after 5 km.
            float length = at(r.speed, i, lane) * PHYSICS_STEP;
            float motion[2] = {length * at(r.cosine, i, lane), length * at(r.sine, i, lane)};
            for (int k = 0; k < 2; k++) {
                c.difference[2 * row + k] = motion[k] - c.displacement[2 * row + k];
                c.displacement[2 * row + k] = motion[k];
            }
            c.position[2 * row] = at(r.x, i, lane), c.position[2 * row + 1] = at(r.y, i, lane);
            c.valid[row] = at(r.valid, i, lane) != 0.0f && !(r.unseen[lane] && at(r.index, i, lane) == 0.0f);
        }
}

// The network's output in r.along and r.across; 0 for the ego, which it does not drive.
static void ask_network(Rows& r, Crowd& c) {
    const Network& n = c.g->network;
    draw_noise(c, c.g->noise_share, c.g->noise_fresh);
    float* oldest = c.motions[0];
    for (int t = 0; t + 1 < n.motions; t++) c.motions[t] = c.motions[t + 1];
    c.motions[n.motions - 1] = oldest;
    Sight sight = {c.position, c.displacement, c.difference, c.extra, c.scaled, c.valid};
    forecast(n, c.layers, c.environments, c.vehicles, sight, c.motions, c.work);
    for (int i = 0; i < c.vehicles; i++)
        for (int lane = 0; lane < LANES; lane++) {
            int environment = lane < c.environments ? lane : c.environments - 1;
            int vehicle = (int)at(r.index, i, lane);
            const float* output = c.work.outputs + WIDEST * (vehicle * c.environments + environment);
            at(r.along, i, lane) = vehicle ? output[0] : 0.0f, at(r.across, i, lane) = vehicle ? output[1] : 0.0f;
        }
}

// ---- Motion

struct Moved {
    Float x, y, speed, heading, acceleration;
};

// At a new velocity; nobody drives backwards or slides sideways (closed_loop.moved_by).
INLINE Moved moved_by(const Rows& r, int i, Float velocity_x, Float velocity_y) {
    Float forward = larger(velocity_x, filled(0.0f)), limit = STEEPEST * forward;
    Float lateral = larger(smaller(velocity_y, limit), -limit);
    Float speed = root(forward * forward + lateral * lateral + 1e-12f);
    return {r.x[i] + forward * PHYSICS_STEP, r.y[i] + lateral * PHYSICS_STEP, speed,
            arctangent(lateral / larger(forward, filled(1e-3f))), (speed - r.speed[i]) / PHYSICS_STEP};
}

// `moved`, where `who` drives along the road at `acceleration` (overlays._accelerated).
INLINE Moved accelerated(const Rows& r, int i, Moved moved, Mask who, Float acceleration) {
    Float speed = larger(r.speed[i] + acceleration * PHYSICS_STEP, filled(0.0f));
    moved.speed = choose(who, speed, moved.speed);
    moved.acceleration = choose(who, (speed - r.speed[i]) / PHYSICS_STEP, moved.acceleration);
    moved.x = choose(who, r.x[i] + 0.5f * (r.speed[i] + speed) * PHYSICS_STEP, moved.x);
    return moved;
}

// The others as they have moved, the ego by IDM and steering; where a row has ended nobody moves.
INLINE void place(const Settings& s, Rows& r, int i, const Moved& moved) {
    Mask on = r.running & ~is_ego(r, i);
    r.x[i] = choose(on, moved.x, r.x[i]);
    r.y[i] = choose(on, at_rest(moved.y), r.y[i]);
    r.speed[i] = choose(on, moved.speed, r.speed[i]);
    r.heading[i] = choose(on, at_rest(moved.heading), r.heading[i]);
    r.acceleration[i] = choose(on, moved.acceleration, r.acceleration[i]);
    if (!any(r.running & ~on)) return;
    Mover ego = mover(r, i);
    steer_and_move(s, ego, r.target[i] * s.lane_width, r.following[i], r.running & ~on);
    put(r, i, ego);
}

// A random side with a lane: both where there are two, by the uniform number (overlays.random_side).
INLINE Float random_side(const Settings& s, const Rows& r, int i, Float u) {
    Mask left = r.target[i] < (float)(s.lanes - 1), right = r.target[i] > 0.0f;
    Float one = filled(1.0f), both = choose(u < 0.5f, one, -one), must = filled(0.0f);
    if (s.ends) {
        WaysOut ways = ways_out(s, r, i);
        left = ways.left, right = ways.right, must = ways.side;
    }
    Float side = choose(left & right, both, choose(left, one, choose(right, -one, filled(0.0f))));
    return choose(must != 0.0f, must, side);
}

// ---- The paper's drivers

// Equations 9 to 11: blind lane changes. Sets r.wish (side begun) and r.kept (lateral speed, without its sign).
static inline bool change_lanes_blindly(const Settings& s, Rows& r, const Crowd& c) {
    const Generated& g = *c.g;
    Mask anybody = none();
    for (int i = 0; i < r.vehicles; i++) {
        Keys keys = keys_of(r, i);
        Float hazard = between(r.memory[CLOCK][i] / filled(g.mean_steps), 0.0f, 1.0f), zero = filled(0.0f);
        if (s.ends) hazard = larger(hazard, ways_out(s, r, i).urgency);
        Mask starts = (r.memory[LATERAL_SPEED][i] == 0.0f) & (r.valid[i] != 0.0f) & (uniform_of(keys, CHANGE_HAZARD) < hazard);
        r.wish[i] = zero, r.kept[i] = absolute(r.memory[LATERAL_SPEED][i]);
        if (!any(starts)) continue;
        r.wish[i] = choose(starts, random_side(s, r, i, uniform_of(keys, CHANGE_SIDE)), zero);
        Float drawn = g.lateral_speed_mps + g.lateral_speed_sd_mps * normal_of(keys, CHANGE_SPEED);
        r.kept[i] = choose(r.wish[i] != 0.0f, larger(drawn, filled(g.slowest_mps)), r.kept[i]);
        anybody |= r.wish[i] != 0.0f;
    }
    return any(anybody);
}

// The guard's bounds: IDM at a short headway, and IDM less some slack, both behind whoever is in the lanes that are
// attended to, with the lane changed to.
static inline void find_bounds(const Settings& s, const Generated& g, Rows& r) {
    Idm usual = common(s), close = usual;
    close.headway = filled(g.guard_headway_s);
    nobody_met(s, r, NOBODY_M);
    for (int i = 0; i < r.vehicles; i++) {
        Float speed = r.speed[i], free = free_road(speed, r.per_desired[i]), hardest = filled(g.hardest_braking);
        Float ahead_close = strongest_ahead(s, r, i, close), ahead = strongest_ahead(s, r, i, usual);
        if (s.ends) ahead_close = larger(ahead_close, strongest_wall(s, r, i, close));
        if (s.ends) ahead = larger(ahead, strongest_wall(s, r, i, usual));
        r.highest[i] = larger(limited(close, free, ahead_close), hardest);
        Float lowest = limited(usual, free, ahead) - g.slack * speed * r.per_desired[i];
        r.lowest[i] = larger(lowest, hardest);
        meet_from_front(s, r, i);
    }
}

INLINE Moved guarded(const Settings& s, const Generated& g, const Rows& r, int i, Moved m) {
    Float wanted = (m.speed - r.speed[i]) / PHYSICS_STEP;
    Float bounded = smaller(larger(wanted, smaller(r.lowest[i], r.highest[i])), r.highest[i]);
    m = accelerated(r, i, m, bounded != wanted, bounded);
    // A pull to the lane's centre where a lane is kept, and the edges of the road for the turned body.
    Float y = r.y[i], offset = r.target[i] * s.lane_width - y, half = r.half_width[i];
    Float pulled = (y + g.damping * (m.y - y)) + g.centring * offset;
    Float across = choose(absolute(offset) < 0.5f * s.lane_width, pulled, m.y);
    Float left = filled(((float)s.lanes - 0.5f) * s.lane_width - g.edge_margin_m);
    Float right = filled(-0.5f * s.lane_width + g.edge_margin_m);
    across = smaller(larger(across, right + half), left - half);
    Float heading = arctangent((across - y) / larger(m.x - r.x[i], filled(0.1f)));
    heading = choose(across == m.y, m.heading, heading);
    Float room = smaller(left - across, across - right) - half;
    Float steepest = between(room / r.half_length[i], 0.0f, g.steepest_rad);
    m.y = across, m.heading = smaller(larger(heading, -steepest), steepest);
    return m;
}

static inline void drive_paper(const Settings& s, Rows& r, Crowd& c) {
    const Generated& g = *c.g;
    ask_network(r, c);
    bool changes = change_lanes_blindly(s, r, c);
    if (changes) {
        for (int i = 0; i < r.vehicles; i++) r.target[i] = r.target[i] + choose(r.running, r.wish[i], filled(0.0f));
        find_lanes(s, r, false);
    }
    if (g.guard) find_bounds(s, g, r);
    for (int i = 0; i < r.vehicles; i++) {
        Keys keys = keys_of(r, i);
        Float zero = filled(0.0f), length = r.speed[i] * PHYSICS_STEP;
        Float along = length * r.cosine[i] + DIFFERENCE_ALONG * r.along[i];
        Float across = length * r.sine[i] + DIFFERENCE_ACROSS * r.across[i];
        Moved m = moved_by(r, i, along / PHYSICS_STEP, across / PHYSICS_STEP);
        // sudden accelerations
        Float left = r.memory[SUDDEN_LEFT][i], sudden = r.memory[SUDDEN][i];
        Mask starts = (left == 0.0f) & (uniform_of(keys, SUDDEN_ACCELERATION) < g.sudden_chance) & (r.valid[i] != 0.0f);
        if (any(starts)) {
            sudden = choose(starts, g.sudden_mean + g.sudden_sd * normal_of(keys, SUDDEN_ACCELERATION), sudden);
            left = choose(starts, filled(g.sudden_steps), left);
        }
        m = accelerated(r, i, m, left > 0.0f, sudden);
        remember(r, i, SUDDEN, sudden), remember(r, i, SUDDEN_LEFT, larger(left - 1.0f, zero));
        // sideways to the target lane, at the change's own speed
        Float pace = r.kept[i], remaining = r.target[i] * s.lane_width - r.y[i];
        Mask changing = pace != 0.0f;
        Float lateral = (Float)((Mask)pace | ((Mask)remaining & (Mask)filled(-0.0f))), stride = lateral * PHYSICS_STEP;
        Mask arrives = changing & (absolute(remaining) <= absolute(stride));
        m.y = choose(changing, r.y[i] + choose(arrives, remaining, stride), m.y);
        m.heading = choose(changing, arctangent(lateral / larger(r.speed[i], filled(1.0f))), m.heading);
        remember(r, i, CLOCK, choose(changing, zero, r.memory[CLOCK][i] + 1.0f));
        remember(r, i, LATERAL_SPEED, choose(arrives, zero, lateral));
        if (g.guard) m = guarded(s, g, r, i, m);
        // The overlay's lane of the ego is nobody's: its own command holds.
        if (changes) r.target[i] = choose(is_ego(r, i) & r.running, r.target[i] - r.wish[i], r.target[i]);
        place(s, r, i, m);
    }
}

// ---- The calibrated drivers

// IDM at the driver's own headway as anchor in r.lowest; what the network is told besides, by its rows.
static inline void find_anchor(const Settings& s, Rows& r, Crowd& c) {
    const Generated& g = *c.g;
    Settings own = s;
    own.min_gap = g.min_gap_m, own.per_brake_scale = g.per_brake_scale;
    own.min_acceleration = g.min_acceleration, own.max_acceleration = g.max_acceleration;
    Idm p = common(own);
    nobody_met(s, r, NOBODY_M);
    for (int i = 0; i < r.vehicles; i++) {
        Float speed = r.speed[i];
        p.headway = r.memory[HEADWAY][i];
        Float strongest = strongest_ahead(own, r, i, p);
        if (s.ends) strongest = larger(strongest, strongest_wall(own, r, i, p));
        r.lowest[i] = limited(p, free_road(speed, r.per_desired[i]), strongest);
        if (s.ends) r.lowest[i] = smaller(r.lowest[i], r.following[i]);  // makes room
        Nearest n = nearest_in(s, r, r.target[i], nobody_at(NOBODY_M, speed));
        Float ahead = gap_ahead(r, i, n.x, n.half_length), gap = larger(ahead, filled(0.0f));
        Float closing = (speed - choose(ahead < FREE_GAP, n.speed, speed)) / 5.0f;
        Float offset = r.target[i] * s.lane_width - r.y[i];
        Float inputs[4] = {between(r.lowest[i], -4.0f, 4.0f), gap / (gap + 20.0f), between(closing, -3.0f, 3.0f),
                           between(offset / 2.0f, -3.0f, 3.0f)};
        for (int lane = 0; lane < c.environments; lane++)
            for (int k = 0; k < 4; k++)
                c.extra[4 * row_of(c, r, i, lane) + k] = g.further_inputs ? inputs[k][lane] : 0.0f;
        meet_from_front(s, r, i);
    }
}

// Wishes for a lane change, old and new, into r.wish; returns whether there is one.
static inline bool find_calibrated_wishes(const Settings& s, Rows& r, const Crowd& c) {
    Mask anybody = none();
    for (int i = 0; i < r.vehicles; i++) {
        Keys keys = keys_of(r, i);
        Float zero = filled(0.0f), chance = 1.0f - decay<1>(r.speed[i] * c.g->changes_per_m);
        Mask free = (absolute(r.y[i] - r.target[i] * s.lane_width) < ARRIVED) & (r.valid[i] != 0.0f);
        Mask comes = free & (uniform_of(keys, CHANGE_HAZARD) < chance);
        Float wish = r.memory[WISH][i];
        if (any(comes)) {
            Float side = random_side(s, r, i, uniform_of(keys, CHANGE_SIDE));
            wish = choose(wish != 0.0f, wish, choose(comes, side, zero));
        }
        if (s.ends) {
            // The side that one has to go to comes before what one would like.
            WaysOut ways = ways_out(s, r, i);
            wish = choose(free & (ways.side != 0.0f), ways.side, wish);
            wish = choose(((wish > 0.0f) & ways.left) | ((wish < 0.0f) & ways.right), wish, zero);
        }
        r.wish[i] = choose(is_ego(r, i), zero, wish);
        anybody |= r.wish[i] != 0.0f;
    }
    return any(anybody);
}

// Whether a near vehicle other than the ego is already moving into `lane` of vehicle i.
INLINE Mask contested(const Settings& s, const Rows& r, int i, Float lane) {
    Mask taken = none();
    for (int j = 0; j < r.vehicles; j++) {
        if (j == i) continue;
        Mask changing = (lane_of(s, r.y[j]) != r.target[j]) & (r.valid[j] != 0.0f) & ~is_ego(r, j);
        Float gap = absolute(r.x[j] - r.x[i]) - (r.half_length[i] + r.half_length[j]);
        taken |= changing & (r.target[j] == lane) & (gap < s.exclusive);
    }
    return taken;
}

// The side that each driver changes to now, in r.kept, and what is left of its wish.
static inline void begin_calibrated_changes(const Settings& s, Rows& r, const Crowd& c) {
    Float zero = filled(0.0f);
    Alike alike = {common(s)};
    if (find_calibrated_wishes(s, r, c)) {
        for (int i = 0; i < r.vehicles; i++) r.along[i] = r.wish[i];  // the network has been heard
        find_neighbours(s, r);
        for (int i = 0; i < r.vehicles; i++) {
            Float wish = r.wish[i];
            if (!any(wish != 0.0f)) continue;
            Prospect left = prospect(s, r, i, 1, alike.idm), right = prospect(s, r, i, 2, alike.idm);
            Float own = choose(wish > 0.0f, left.own, right.own);
            Float behind = choose(wish > 0.0f, left.with_it, right.with_it);
            Mask safe = smaller(behind, own) >= -s.safe_deceleration;
            r.wish[i] = choose(safe & ~contested(s, r, i, r.target[i] + wish), wish, zero);
        }
        one_at_a_time(s, r, alike);
    } else {
        for (int i = 0; i < r.vehicles; i++) r.along[i] = r.kept[i] = zero;
    }
    for (int i = 0; i < r.vehicles; i++) {
        Float wish = r.along[i], waited = choose(wish != 0.0f, r.memory[WAITED][i] + 1.0f, zero);
        Float rest = choose((r.kept[i] != 0.0f) | (waited >= c.g->patience_steps), zero, wish);
        remember(r, i, WISH, rest);
        remember(r, i, WAITED, choose(rest == 0.0f, zero, waited));
    }
}

// Lateral residual without what would move the body out of its lane (closed_loop.inside_lane).
INLINE Float inside_lane(const Settings& s, const Generated& g, const Rows& r, int i, Float residual, Float offset, Float velocity) {
    Float rest = velocity / g.lane_damping - offset, outwards = choose(residual > 0.0f, rest, -rest);
    Float room = 0.5f * (s.lane_width - 2.0f * r.half_width[i]) - MARGIN;
    return residual * between((room - outwards) / FADE, 0.0f, 1.0f);
}

INLINE Float tanh_of(Float x) {
    Float tail = decay<2>(x);
    return (1.0f - tail) / (1.0f + tail);
}

static inline void drive_calibrated(const Settings& s, Rows& r, Crowd& c) {
    const Generated& g = *c.g;
    find_anchor(s, r, c);
    ask_network(r, c);
    for (int i = 0; i < r.vehicles; i++) {
        Float residual = g.residual_along * tanh_of(r.along[i] / g.residual_along);
        Float lateral = g.residual_across * tanh_of(r.across[i] / g.residual_across);
        Float mean = r.memory[MEAN_ALONG][i] + g.washout_share * (residual - r.memory[MEAN_ALONG][i]);
        Float lateral_mean = r.memory[MEAN_ACROSS][i] + g.washout_share * (lateral - r.memory[MEAN_ACROSS][i]);
        remember(r, i, MEAN_ALONG, mean), remember(r, i, MEAN_ACROSS, lateral_mean);
        Float velocity_x = (r.speed[i] * PHYSICS_STEP * r.cosine[i]) / PHYSICS_STEP;
        Float velocity_y = (r.speed[i] * PHYSICS_STEP * r.sine[i]) / PHYSICS_STEP;
        Float offset = r.target[i] * s.lane_width - r.y[i];
        Float anchor = g.lane_stiffness * offset - g.lane_damping * velocity_y;
        lateral = inside_lane(s, g, r, i, lateral - lateral_mean, offset, velocity_y);
        velocity_x = velocity_x + (r.lowest[i] + (residual - mean)) * PHYSICS_STEP;
        velocity_y = velocity_y + (anchor + lateral) * PHYSICS_STEP;
        r.highest[i] = velocity_x, r.across[i] = velocity_y;
    }
    begin_calibrated_changes(s, r, c);  // everybody looks before anybody moves
    for (int i = 0; i < r.vehicles; i++) {
        place(s, r, i, moved_by(r, i, r.highest[i], r.across[i]));
        r.target[i] = r.target[i] + choose(r.running, r.kept[i], filled(0.0f));
    }
}

// One physics step of everybody.
static inline void drive_generated(const Settings& s, Rows& r, Crowd& c) {
    c.step_key = r.step_key;
    look(r, c);
    if (c.g->calibrated) drive_calibrated(s, r, c);
    else drive_paper(s, r, c);
}

// ---- The memory of drivers that enter: they have always driven straight on at their present speed

static void enter(Crowd& c, void* const* arrays, long row, uint64_t before_first_step, const float* speed) {
    const Network& n = c.g->network;
    const Memory& m = *(const Memory*)(arrays + (c.g->calibrated ? CALIBRATED.arrays : PAPER.arrays));
    c.environments = 1;
    c.step_key = &before_first_step;
    for (int v = 0; v < c.vehicles; v++) {
        c.displacement[2 * v] = speed[row * c.vehicles + v] * PHYSICS_STEP, c.displacement[2 * v + 1] = 0.0f;
        c.difference[2 * v] = c.difference[2 * v + 1] = 0.0f;
    }
    for (int k = 0; k < n.noise * c.vehicles; k++) c.noise[k] = 0.0f;
    draw_noise(c, 0.0f, 1.0f);
    motion_features(n, c.vehicles, c.displacement, c.difference, c.work.features);
    project(n, c.layers, c.vehicles, c.work, c.motions[0]);
    int width = padded(n.hidden);
    for (int v = 0; v < c.vehicles; v++) {
        long to = row * c.vehicles + v;
        for (int k = 0; k < 2; k++) m.displacement[2 * to + k] = c.displacement[2 * v + k];
        for (int k = 0; k < n.noise; k++) m.noise[to * n.noise + k] = c.noise[v * n.noise + k];
        for (int t = 0; t < n.motions; t++)
            copy_gates(n.hidden, m.motions[t] + to * 4 * n.hidden, n.hidden, c.motions[0] + (size_t)v * 4 * width, width);
        const Fields& fields = c.g->calibrated ? CALIBRATED : PAPER;
        for (int k = 0; k < fields.arrays; k++) {
            const Field& f = fields.field[k];
            if (f.kind == INTEGER) ((int64_t*)arrays[k])[to] = 0;
            else
                for (int j = 0; j < f.numbers; j++) ((float*)arrays[k])[to * f.numbers + j] = 0.0f;
        }
        if (!c.g->calibrated) continue;
        // Linear between the recorded quantiles of headways, flat beyond the outer ones.
        float u = uniform_of(absorb(absorb(before_first_step, v), OWN_HEADWAY));
        int upper = 1;
        while (upper < 4 && HEADWAY_LEVELS[upper] < u) upper++;
        float low = HEADWAY_LEVELS[upper - 1], part = (u - low) / (HEADWAY_LEVELS[upper] - low);
        part = part < 0.0f ? 0.0f : part > 1.0f ? 1.0f : part;
        float from = c.g->headways_s[upper - 1];
        ((float*)arrays[1])[to] = from + part * (c.g->headways_s[upper] - from);
    }
}
