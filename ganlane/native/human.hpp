// Drivers by the policy of `traffic=human`: ganlane.generator.human and ganlane.traffic.human, whose functions and
// features have the same names and order here.
//
// Every 0.4 s a driver decides; in between it holds its acceleration. What drivers see is computed for LANES
// environments side by side, the network for the drivers of those environments in which a decision is due.

#pragma once

#include "generated.hpp"

struct Human {
    const float* weights;  // in the order of `layers_of`, aligned to a vector
    int32_t hidden, lane_hidden;
    float temperature, lane_changes, politeness;
    int32_t delayed;  // decisions by which accelerations come late
};

const int DECISION_STEPS = 4, FEATURES = 65, SIDE_FEATURES = 17;
const float DECISION_S = 0.4f, SIGHT = 150.0f, STYLE_S = 6.0f, ANTICIPATION_S = 1.0f, LONGEST_MEMORY = 12.0f;
const float HARDEST_BRAKING = -8.0f, STRONGEST_ACCELERATION = 3.5f, STEEPEST_ASIDE = 0.12f, FASTEST_ASIDE = 2.0f;
const float EDGE_S = 0.8f, EDGE_M = 0.15f, STEEPEST_PATH = 0.2f, MOST_LIKELY = 0.98f, LONG_AGO = 6.0f, BESIDE_WALL = 0.4f;

// Places in a driver's memory.
enum {
    ACCELERATIONS = 0, LATERAL_SPEEDS = 5, CLOSING = 7, STYLE = 9, AGE = 12, SINCE, DECIDED_ALONG, LATERAL_FROM, LATERAL_TO,
};
const Fields HUMAN = {9, {{ACCELERATIONS, 5, FLOAT}, {LATERAL_SPEEDS, 2, FLOAT}, {CLOSING, 2, FLOAT}, {STYLE, 3, FLOAT},
                          {AGE, 1, FLOAT}, {SINCE, 1, FLOAT}, {DECIDED_ALONG, 1, FLOAT}, {LATERAL_FROM, 1, FLOAT},
                          {LATERAL_TO, 1, FLOAT}}};
// Those of the features that depend on the choice of a lane.
enum { FROM_TARGET = 10, TARGET_SIDE = 12, SINCE_CHANGE = 18 };

// Tokens of a change: `number` values, at asinh(value / scale) spaced evenly up to +-reach.
struct Tokens {
    int number;
    float scale, reach;
};
const Tokens ALONG = {41, 0.15f, 4.19993000f}, ACROSS = {31, 0.04f, 3.40230664f};

// ---- Memory of one thread

// The nearest vehicle of a lane, ahead or behind; without one the gap is SIGHT and the rest 0.
struct Near {
    Float gap, closing, acceleration, aside, lateral_speed, index, exists;
};

enum { RIGHT_LANE, MIDDLE_LANE, LEFT_LANE };

struct PolicyLayers {
    Layer first, second, along, across, lane_first, lane_second;
};

struct Humans {
    const Human* h;
    PolicyLayers layers;
    // [vehicles], in the order of the road: lane, the lanes that others see the vehicle in, speeds along and across.
    Float *lane, *low, *high, *speed, *lateral;
    Near *ahead, *behind;  // [vehicles][3]
    // Of the drivers who decide, one after the other: what they see, their tokens, and [BLOCK_ROWS, ...] of the layers.
    float *features, *sides, *first, *second, *along, *across, *choice;
    float *change, *aside;  // the drawn tokens: real-valued indices
};

static PolicyLayers layers_of(const Human& h) {
    PackedWeights layer = {h.weights};
    PolicyLayers l;
    l.first = layer(FEATURES, h.hidden), l.second = layer(h.hidden, h.hidden);
    l.along = layer(h.hidden, ALONG.number), l.across = layer(h.hidden, ACROSS.number);
    l.lane_first = layer(SIDE_FEATURES, h.lane_hidden), l.lane_second = layer(h.lane_hidden, 2);
    return l;
}

static Humans humans_in(Pieces& room, const Human* h, int vehicles) {
    size_t rows = (size_t)vehicles * LANES;
    auto numbers = [&] { return (Float*)room(rows); };
    Humans m;
    m.h = h, m.layers = layers_of(*h);
    m.lane = numbers(), m.low = numbers(), m.high = numbers(), m.speed = numbers(), m.lateral = numbers();
    m.ahead = (Near*)room(3 * rows * sizeof(Near) / sizeof(Float));
    m.behind = (Near*)room(3 * rows * sizeof(Near) / sizeof(Float));
    m.features = room(FEATURES * rows), m.sides = room(2 * SIDE_FEATURES * rows), m.choice = room(2 * WIDEST * rows);
    m.change = room(rows), m.aside = room(rows);
    int widest = padded(h->hidden > h->lane_hidden ? h->hidden : h->lane_hidden);
    m.first = room(widest * BLOCK_ROWS), m.second = room(widest * BLOCK_ROWS);
    m.along = room(padded(ALONG.number) * BLOCK_ROWS), m.across = room(padded(ACROSS.number) * BLOCK_ROWS);
    return m;
}

// ---- Functions

INLINE Float exponential(Float x) { return decay<1>(-x); }
INLINE Float sigmoid(Float x) { return 1.0f / (1.0f + decay<1>(x)); }
INLINE Float signed_as(Float magnitude, Float number) {
    return (Float)((Mask)magnitude | ((Mask)number & (Mask)filled(-0.0f)));
}
INLINE Float inverse_sinh(Float x) {
    Float size = absolute(x);
    return signed_as(logarithm(size + root(size * size + 1.0f)), x);
}
INLINE Float log_of_gap(Float gap) { return logarithm(larger(gap, filled(0.5f)) / 10.0f); }
INLINE Float as_number(Mask mask) { return choose(mask, filled(1.0f), filled(0.0f)); }

// ---- What drivers see

// Vehicle j, seen by i from `distance`, where it is nearer than the nearest so far; of two level ones the first counts.
INLINE void meet(const Rows& r, const Humans& m, int i, int j, Float distance, Float lane, Near& n) {
    Float gap = distance - (r.half_length[i] + r.half_length[j]);
    Mask nearer = (gap < n.gap) | ((gap == n.gap) & (n.exists != 0.0f) & (r.index[j] < n.index));
    Mask here = (m.low[j] <= lane) & (lane <= m.high[j]) & nearer;
    if (!any(here)) return;
    n.gap = choose(here, gap, n.gap);
    n.closing = choose(here, m.speed[j] - m.speed[i], n.closing);
    n.acceleration = choose(here, r.acceleration[j], n.acceleration);
    n.aside = choose(here, r.y[j] - r.y[i], n.aside);
    n.lateral_speed = choose(here, m.lateral[j], n.lateral_speed);
    n.index = choose(here, r.index[j], n.index);
    n.exists = choose(here, filled(1.0f), n.exists);
}

// Everybody's lane and neighbours.
static void see(const Settings& s, const Rows& r, Humans& m) {
    for (int i = 0; i < r.vehicles; i++) {
        m.speed[i] = r.speed[i] * r.cosine[i], m.lateral[i] = r.speed[i] * r.sine[i];
        Float lane = m.lane[i] = lane_of(s, r.y[i]);
        Float soon = lane_of(s, r.y[i] + ANTICIPATION_S * m.lateral[i]);
        soon = smaller(larger(soon, lane - 1.0f), lane + 1.0f);
        m.low[i] = choose(visible(r, i), smaller(lane, soon), filled(NOBODY_M)), m.high[i] = larger(lane, soon);
    }
    Float zero = filled(0.0f);
    for (int i = 0; i < r.vehicles; i++)
        for (int side = 0; side < 3; side++) {
            Float lane = m.lane[i] + (float)(side - MIDDLE_LANE);
            Near ahead = {filled(SIGHT), zero, zero, zero, zero, zero, zero}, behind = ahead;
            for (int j = i - 1; j >= 0; j--) meet(r, m, i, j, r.x[j] - r.x[i], lane, ahead);
            for (int j = i + 1; j < r.vehicles; j++) meet(r, m, i, j, r.x[i] - r.x[j], lane, behind);
            m.ahead[3 * i + side] = ahead, m.behind[3 * i + side] = behind;
        }
}

// Gap and closing speed between vehicle i's leader and that one's own leader.
INLINE void leader_of_leader(const Rows& r, const Humans& m, int i, Float& gap, Float& closing) {
    const Near& leader = m.ahead[3 * i + MIDDLE_LANE];
    gap = filled(SIGHT), closing = filled(0.0f);
    for (int j = 0; j < i; j++) {
        Mask it = (leader.index == r.index[j]) & (leader.exists != 0.0f);
        if (!any(it)) continue;
        gap = choose(it, m.ahead[3 * j + MIDDLE_LANE].gap, gap);
        closing = choose(it, m.ahead[3 * j + MIDDLE_LANE].closing, closing);
    }
}

// Room to those alongside on one side (`sign` 1: left), and whether there is anybody.
INLINE Float room_aside(const Near& ahead, const Near& behind, float sign, Float width, Mask& alongside) {
    Float nearest = filled(9.0f);
    alongside = none();
    const Near* const both[2] = {&ahead, &behind};
    for (const Near* near : both) {
        Mask beside = (near->exists != 0.0f) & (near->gap < 1.0f);
        nearest = choose(beside, smaller(nearest, sign * near->aside), nearest);
        alongside |= beside;
    }
    return between(nearest - width, -0.5f, 1.5f);
}

// The logarithm of the headway in s of drivers who follow somebody within 80 m, for others `otherwise`.
INLINE Float log_headway(const Humans& m, int i, Float otherwise) {
    const Near& leader = m.ahead[3 * i + MIDDLE_LANE];
    Float headway = larger(leader.gap, filled(0.5f)) / larger(m.speed[i], filled(2.0f));
    Mask follows = (leader.exists != 0.0f) & (leader.gap < 80.0f);
    return choose(follows, logarithm(between(headway, 0.2f, 6.0f)), otherwise);
}

// The speed over the mean of the neighbours, in units of 3 m/s.
INLINE Float pace_among(const Humans& m, int i) {
    Float sum = filled(0.0f), count = sum;
    const Near* const both[2] = {m.ahead + 3 * i, m.behind + 3 * i};
    for (const Near* near : both)
        for (int side = 0; side < 3; side++) sum = sum - near[side].closing, count = count + near[side].exists;
    return between(sum / larger(count, filled(1.0f)) / 3.0f, -2.0f, 2.0f);
}

// The 65 numbers that the network sees; those that depend on the choice of a lane are set by `choose_lane`.
static inline void features_of(const Settings& s, const Rows& r, const Humans& m, int i, Float* f) {
    const Near *ahead = m.ahead + 3 * i, *behind = m.behind + 3 * i;
    Float speed = m.speed[i], width = 2.0f * r.half_width[i], gap, closing;
    Float* const* memory = r.memory;
    auto remembered = [&](int place) { return memory[place][i]; };
    Float* out = f;
    auto add = [&](Float number) { *out++ = number; };
    add(speed / 10.0f);
    add(between((1.0f / r.per_desired[i] - speed) / 5.0f, -2.0f, 2.0f));
    add(tanh_of(speed / 2.0f));
    for (int k = 0; k < 5; k++) add(remembered(ACCELERATIONS + k));
    for (int k = 0; k < 2; k++) add(inverse_sinh(remembered(CLOSING + k)));
    out++;  // FROM_TARGET
    add((r.y[i] - m.lane[i] * s.lane_width) * s.per_lane_width * 2.0f);
    out++;  // TARGET_SIDE
    add(m.lateral[i] * 2.0f);
    for (int k = 0; k < 2; k++) add(remembered(LATERAL_SPEEDS + k) * 2.0f);
    add(as_number(r.half_length[i] > 3.5f));
    add(smaller(remembered(AGE), filled(LONGEST_MEMORY)) / LONGEST_MEMORY);
    out++;  // SINCE_CHANGE
    for (int k = 0; k < 3; k++) add(remembered(STYLE + k));
    leader_of_leader(r, m, i, gap, closing);
    add(log_of_gap(gap)), add(inverse_sinh(closing)), add(ahead[MIDDLE_LANE].acceleration / 1.5f);
    add(as_number(m.lane[i] + 1.0f <= (float)(s.lanes - 1))), add(as_number(m.lane[i] - 1.0f >= 0.0f));
    Mask alongside;
    add(room_aside(ahead[LEFT_LANE], behind[LEFT_LANE], 1.0f, width, alongside)), add(as_number(alongside));
    add(room_aside(ahead[RIGHT_LANE], behind[RIGHT_LANE], -1.0f, width, alongside)), add(as_number(alongside));
    float left = ((float)s.lanes - 0.5f) * s.lane_width, right = -0.5f * s.lane_width;
    add(between(left - r.y[i] - r.half_width[i], -0.5f, 1.5f)), add(between(r.y[i] - right - r.half_width[i], -0.5f, 1.5f));
    add(between(ahead[MIDDLE_LANE].aside, -2.0f, 2.0f)), add(between(ahead[MIDDLE_LANE].lateral_speed, -1.0f, 1.0f));
    Float pace = larger(speed, filled(3.0f));
    const Near* const both[2] = {ahead, behind};
    for (const Near* near : both) {
        for (int k = 0; k < 3; k++) add(choose(near[k].exists != 0.0f, log_of_gap(near[k].gap), filled(2.7f)));
        for (int k = 0; k < 3; k++) add(between(near[k].gap / pace, -1.0f, 5.0f) * 0.5f);
        for (int k = 0; k < 3; k++) add(inverse_sinh(near[k].closing));
        for (int k = 0; k < 3; k++)
            add(between(-near[k].closing / larger(near[k].gap, filled(2.0f)), -1.0f, 1.0f) * 3.0f);
        for (int k = 0; k < 3; k++) add(near[k].exists);
    }
}

// Deceleration that keeps the rear one off the front one, m/s2, at most 8.
INLINE Float needed_braking(Float closing, Float gap) {
    Float approach = larger(closing, filled(0.0f));
    return smaller(approach * approach / (2.0f * larger(gap - 1.0f, filled(0.3f))), filled(8.0f));
}

// What counts for a lane change to one side (`sign` 1: left).
static inline void side_of(const Settings& s, const Rows& r, const Humans& m, int i, int side, float sign, Float* f) {
    const Near &front = m.ahead[3 * i + side], &rear = m.behind[3 * i + side], &leader = m.ahead[3 * i + MIDDLE_LANE];
    Float pace = larger(m.speed[i], filled(3.0f)), zero = filled(0.0f);
    auto gain = [](const Near& n) { return between(choose(n.exists != 0.0f, n.closing, filled(3.0f)), -5.0f, 5.0f); };
    Float here = gain(leader), there = gain(front);
    Float towards = choose(front.gap < 25.0f, front.lateral_speed, zero);
    towards = towards + choose(rear.gap < 15.0f, rear.lateral_speed, zero);
    Mask under_way = between(r.target[i], 0.0f, (float)(s.lanes - 1)) != m.lane[i];
    Float numbers[SIDE_FEATURES] = {
        logarithm(1.0f + larger(front.gap, zero)) - 2.5f,
        logarithm(1.0f + larger(rear.gap, zero)) - 2.5f,
        log_of_gap(leader.gap),
        between(front.gap / pace, -1.0f, 4.0f),
        between(rear.gap / pace, -1.0f, 4.0f),
        there / 3.0f,
        between(rear.closing, -5.0f, 5.0f) / 3.0f,
        here / 3.0f,
        (there - here) / 3.0f,
        m.h->politeness * needed_braking(rear.closing, rear.gap),
        needed_braking(-front.closing, front.gap),
        between(1.5f - front.gap, 0.0f, 2.0f),
        between(1.5f - rear.gap, 0.0f, 2.0f),
        between(sign * towards, -1.0f, 1.0f),
        choose(under_way, between(sign * m.lateral[i] * 3.0f, -3.0f, 3.0f), zero),
        choose(under_way, between(sign * (r.y[i] - m.lane[i] * s.lane_width), -1.5f, 1.5f), zero),
        smaller(r.memory[SINCE][i], filled(LONGEST_MEMORY)) / LONGEST_MEMORY,
    };
    for (int k = 0; k < SIDE_FEATURES; k++) f[k] = numbers[k];
}

// ---- The network

static void activate(float* numbers, int rows, int width) {
    for (int k = 0; k < rows * width; k += LANES) write(numbers + k, read(numbers + k) * sigmoid(read(numbers + k)));
}

// Logits of both sides' lane changes of `count` drivers, [2 * count, WIDEST], of which the first two count.
static void consider_lanes(Humans& m, int count) {
    const PolicyLayers& l = m.layers;
    for (int row = 0; row < 2 * count; row += BLOCK_ROWS) {
        int rows = 2 * count - row < BLOCK_ROWS ? 2 * count - row : BLOCK_ROWS;
        apply(l.lane_first, rows, m.sides + row * SIDE_FEATURES, SIDE_FEATURES, m.first, l.lane_first.width);
        activate(m.first, rows, l.lane_first.width);
        apply(l.lane_second, rows, m.first, l.lane_first.width, m.choice + row * WIDEST, WIDEST);
    }
}

// A token drawn by a uniform number, as a real-valued index: the inverse of the distribution function, linear within a
// token. `logits` [padded(number)] are overwritten.
static float drawn(const Tokens& tokens, float* logits, float per_temperature, float u) {
    int width = padded(tokens.number);
    for (int k = tokens.number; k < width; k++) logits[k] = logits[0];
    Float most = read(logits);
    for (int k = LANES; k < width; k += LANES) most = larger(most, read(logits + k));
    float highest = most[0];
    for (int lane = 1; lane < LANES; lane++) highest = most[lane] > highest ? most[lane] : highest;
    for (int k = 0; k < width; k += LANES)
        write(logits + k, exponential((read(logits + k) - highest) * per_temperature));
    // Four sums side by side, in the same order whatever a vector's size.
    float sums[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    for (int k = tokens.number; k < width; k++) logits[k] = 0.0f;
    for (int k = 0; k < width; k += 4)
        for (int part = 0; part < 4; part++) sums[part] += logits[k + part];
    float total = (sums[0] + sums[1]) + (sums[2] + sums[3]), wanted = u * total, upper = logits[0];
    int token = 0;
    while (upper < wanted && token < tokens.number - 1) upper += logits[++token];
    float least = 1e-9f * total, chance = logits[token] > least ? logits[token] : least;
    float within = (wanted - (upper - chance)) / chance;
    return (float)token + (within < 0.0f ? 0.0f : within > 1.0f ? 1.0f : within) - 0.5f;
}

// Value of a token.
INLINE Float value_of(const Tokens& tokens, Float index) {
    Float z = (index / (float)(tokens.number - 1) * 2.0f - 1.0f) * tokens.reach;
    Float up = exponential(absolute(z));
    return signed_as(tokens.scale * (0.5f * (up - 1.0f / up)), z);
}

// Tokens of `count` drivers, drawn by the uniform numbers that m.change and m.aside hold.
static void decide_moves(Humans& m, int count) {
    const PolicyLayers& l = m.layers;
    float per_temperature = 1.0f / m.h->temperature;
    for (int row = 0; row < count; row += BLOCK_ROWS) {
        int rows = count - row < BLOCK_ROWS ? count - row : BLOCK_ROWS;
        apply(l.first, rows, m.features + row * FEATURES, FEATURES, m.first, l.first.width);
        activate(m.first, rows, l.first.width);
        apply(l.second, rows, m.first, l.first.width, m.second, l.second.width);
        activate(m.second, rows, l.second.width);
        apply(l.along, rows, m.second, l.second.width, m.along, l.along.width);
        apply(l.across, rows, m.second, l.second.width, m.across, l.across.width);
        for (int k = 0; k < rows; k++) {
            m.change[row + k] = drawn(ALONG, m.along + k * l.along.width, per_temperature, m.change[row + k]);
            m.aside[row + k] = drawn(ACROSS, m.across + k * l.across.width, per_temperature, m.aside[row + k]);
        }
    }
}

// ---- A decision

// Style and features of vehicle i, of the environments that are `due`, into rows `count` and on.
static inline void look_at(const Settings& s, Rows& r, Humans& m, int i, Mask due, int count) {
    auto blend = [&](int place, Float now) {
        Float old = r.memory[STYLE + place][i];
        r.memory[STYLE + place][i] = choose(due, old + (DECISION_S / STYLE_S) * (now - old), old);
    };
    Float effort = r.memory[ACCELERATIONS][i];
    blend(0, log_headway(m, i, r.memory[STYLE][i])), blend(1, effort * effort), blend(2, pace_among(m, i));
    Float features[FEATURES], sides[2][SIDE_FEATURES];
    features_of(s, r, m, i, features);
    side_of(s, r, m, i, LEFT_LANE, 1.0f, sides[0]), side_of(s, r, m, i, RIGHT_LANE, -1.0f, sides[1]);
    Keys keys = keys_of(r, i);
    Float along = uniform_of(keys, SUDDEN_ACCELERATION), across = uniform_of(keys, CHANGE_SPEED);
    for (int lane = 0; lane < LANES; lane++) {
        if (!due[lane]) continue;
        for (int k = 0; k < FEATURES; k++) m.features[count * FEATURES + k] = features[k][lane];
        for (int side = 0; side < 2; side++)
            for (int k = 0; k < SIDE_FEATURES; k++) m.sides[(2 * count + side) * SIDE_FEATURES + k] = sides[side][k][lane];
        m.change[count] = along[lane], m.aside[count] = across[lane];
        count++;
    }
}

INLINE Mask choose_mask(Mask mask, Mask yes, Mask no) { return (mask & yes) | (~mask & no); }

// Whether a change of vehicle i leaves 1 m ahead and behind, as much as who makes room leaves at least, and makes nobody
// brake harder than 2.5 m/s2.
INLINE Mask leaves_room(const Humans& m, int i, Mask leftwards) {
    Mask room[2];
    for (int side = 0; side < 2; side++) {
        const Near &front = m.ahead[3 * i + 2 * side], &rear = m.behind[3 * i + 2 * side];
        Float braking = larger(needed_braking(rear.closing, rear.gap), needed_braking(-front.closing, front.gap));
        room[side] = (front.gap > 1.0f) & (rear.gap > 1.0f) & (braking < 2.5f);
    }
    return choose_mask(leftwards, room[1], room[0]);
}

// Begins or breaks off lane changes of vehicle i; completes its features.
static inline void choose_lane(const Settings& s, Rows& r, Humans& m, int i, Mask due, int count) {
    Float logits[4] = {};
    int row = count;
    for (int lane = 0; lane < LANES; lane++) {
        if (!due[lane]) continue;
        const float* choice = m.choice + 2 * row++ * WIDEST;
        logits[0][lane] = choice[0], logits[1][lane] = choice[1];
        logits[2][lane] = choice[WIDEST], logits[3][lane] = choice[WIDEST + 1];
    }
    WaysOut ways = {};
    if (s.ends) ways = ways_out(s, r, i);
    Float lane = m.lane[i], target = between(r.target[i], 0.0f, (float)(s.lanes - 1)), zero = filled(0.0f);
    Mask keeping = target == lane;
    Mask to_left = lane + 1.0f <= (float)(s.lanes - 1), to_right = lane - 1.0f >= 0.0f;
    if (s.ends) to_left = ways.left, to_right = ways.right;
    float most = MOST_LIKELY * m.h->lane_changes;
    Float left = choose(to_left, most * sigmoid(logits[0]), zero);
    Float right = choose(to_right, most * sigmoid(logits[2]), zero);
    Float total = larger(left + right, filled(1e-9f)), share = smaller(total, filled(MOST_LIKELY)) / total;
    Float stop = sigmoid(choose(target > lane, logits[1], logits[3]));
    Float first = larger(choose(keeping, left * share, stop), filled(1e-9f));
    Float second = larger(choose(keeping, right * share, zero), filled(1e-9f));
    Float u = uniform_of(keys_of(r, i), CHANGE_SIDE);
    Mask one = u < first, two = u >= 1.0f - second;
    if (s.ends) {
        Mask wants = keeping & (ways.side != 0.0f) & (uniform_of(keys_of(r, i), CHANGE_HAZARD) < ways.urgency);
        Mask leftwards = ways.side > 0.0f, leaves = wants & leaves_room(m, i, leftwards);
        one = choose_mask(leaves, leftwards, one), two = choose_mask(leaves, ~leftwards, two);
    }
    Float changed = choose(keeping, target + as_number(one) - as_number(two), choose(one, lane, target));
    Float since = choose(changed != target, zero, r.memory[SINCE][i]);
    r.target[i] = choose(due, changed, r.target[i]);
    r.memory[SINCE][i] = choose(due, since, r.memory[SINCE][i]);
    Float from_target = between(r.y[i] - changed * s.lane_width, -4.0f, 4.0f), side = between(changed - lane, -1.0f, 1.0f);
    since = smaller(since, filled(LONGEST_MEMORY)) / LONGEST_MEMORY;
    for (int k = 0; k < LANES; k++) {
        if (!due[k]) continue;
        float* f = m.features + count++ * FEATURES;
        f[FROM_TARGET] = from_target[k], f[TARGET_SIDE] = side[k], f[SINCE_CHANGE] = since[k];
    }
}

// What vehicle i does until its next decision, and what it remembers of this one.
static inline void commit(const Settings& s, Rows& r, const Humans& m, int i, Mask due, int count) {
    Float change = {}, aside = {};
    for (int lane = 0; lane < LANES; lane++)
        if (due[lane]) change[lane] = m.change[count], aside[lane] = m.aside[count++];
    Float speed = m.speed[i], lateral = m.lateral[i];
    Float acceleration = r.memory[ACCELERATIONS][i] + value_of(ALONG, change);
    acceleration = between(acceleration, HARDEST_BRAKING, STRONGEST_ACCELERATION);
    acceleration = larger(acceleration, -speed / DECISION_S);
    if (s.ends) {
        Idm p = common(s);
        Float wall = strongest_wall(s, r, i, p, true);
        Float stopping = limited(p, free_road(r.speed[i], r.per_desired[i]), wall);
        acceleration = choose(wall > 0.0f, smaller(acceleration, stopping), acceleration);
        acceleration = smaller(acceleration, r.following[i]);  // makes room
    }
    float left = ((float)s.lanes - 0.5f) * s.lane_width, right = -0.5f * s.lane_width;
    Float half = r.half_width[i] + EDGE_M;
    Float to_left = (left - r.y[i] - half) / EDGE_S, to_right = (r.y[i] - right - half) / EDGE_S;
    Float across = larger(smaller(lateral + value_of(ACROSS, aside), to_left), -to_right);
    Float most = smaller(STEEPEST_ASIDE * speed, filled(FASTEST_ASIDE));
    across = smaller(larger(across, -most), most);
    auto set = [&](int place, Float number) { r.memory[place][i] = choose(due, number, r.memory[place][i]); };
    for (int k = 4; k > 0; k--) set(ACCELERATIONS + k, r.memory[ACCELERATIONS + k - 1][i]);
    set(ACCELERATIONS, acceleration);
    set(LATERAL_SPEEDS + 1, r.memory[LATERAL_SPEEDS][i]), set(LATERAL_SPEEDS, lateral);
    set(CLOSING + 1, r.memory[CLOSING][i]), set(CLOSING, m.ahead[3 * i + MIDDLE_LANE].closing);
    set(AGE, r.memory[AGE][i] + 1.0f), set(SINCE, r.memory[SINCE][i] + 1.0f);
    set(DECIDED_ALONG, r.memory[ACCELERATIONS + m.h->delayed][i]), set(LATERAL_FROM, lateral), set(LATERAL_TO, across);
}

// The lanes whose walls a driver heeds: its target lane, and those that its front reaches into by half a metre. Unlike
// drivers by rules these do not keep to the centres of their lanes, and they would brake for the end of another's.
static inline void find_lanes_of_fronts(const Settings& s, Rows& r) {
    Float zero = filled(0.0f), one = filled(1.0f);
    for (int i = 0; i < r.vehicles; i++) {
        Float front = r.y[i] + r.half_length[i] * r.sine[i], half = r.half_width[i] - BESIDE_WALL;
        LanesOf l = lanes_of(s, front, zero, one, r.half_length[i], half, r.target[i], r.visibility[i], visible(r, i));
        r.low[i] = l.low, r.high[i] = l.high;
    }
}

// The others' decisions in the environments that are `due`; the ego decides elsewhere.
static void decide_humans(const Settings& s, Rows& r, Humans& m, Mask due) {
    see(s, r, m);
    // of_each(vehicle, the environments that it decides in, how many drivers come before it)
    auto for_drivers = [&](auto of_vehicle) {
        int count = 0;
        for (int i = 0; i < r.vehicles; i++) {
            Mask decides = due & ~is_ego(r, i);
            if (!s.flow) decides &= r.valid[i] != 0.0f;  // who waits to enter drives on
            if (!any(decides)) continue;
            of_vehicle(i, decides, count);
            for (int lane = 0; lane < LANES; lane++) count += decides[lane] != 0;
        }
        return count;
    };
    int count = for_drivers([&](int i, Mask decides, int before) { look_at(s, r, m, i, decides, before); });
    consider_lanes(m, count);
    for_drivers([&](int i, Mask decides, int before) { choose_lane(s, r, m, i, decides, before); });
    if (s.ends) find_lanes_of_fronts(s, r);
    decide_moves(m, count);
    for_drivers([&](int i, Mask decides, int before) { commit(s, r, m, i, decides, before); });
}

// One physics step of everybody; the ego by IDM, as everywhere.
static inline void drive_humans(const Settings& s, Rows& r, Humans& m, int substep) {
    Float share;
    Mask due;
    for (int lane = 0; lane < LANES; lane++) {
        int phase = (int)((r.start_step[lane] + substep) % DECISION_STEPS);
        due[lane] = phase == 0 && r.running[lane] ? -1 : 0;
        share[lane] = (float)(phase + 1) / (float)DECISION_STEPS;
    }
    if (any(due)) decide_humans(s, r, m, due);
    for (int i = 0; i < r.vehicles; i++) {
        Float speed = r.speed[i] * r.cosine[i], lateral = r.speed[i] * r.sine[i], zero = filled(0.0f);
        Float from = r.memory[LATERAL_FROM][i], across = from + share * (r.memory[LATERAL_TO][i] - from);
        Float later = larger(speed + r.memory[DECIDED_ALONG][i] * PHYSICS_STEP, zero);
        // Nobody moves more aside than a fifth of its way ahead; who stands keeps its heading.
        across = smaller(larger(across, -STEEPEST_PATH * later), STEEPEST_PATH * later);
        Mask moves = later > 0.0f;
        Float heading = arctangent(across / choose(moves, later, filled(1.0f)));
        place(s, r, i, {r.x[i] + 0.5f * (speed + later) * PHYSICS_STEP, r.y[i] + 0.5f * (lateral + across) * PHYSICS_STEP,
                        choose(moves, root(later * later + across * across), zero), choose(moves, heading, r.heading[i]),
                        (later - speed) / PHYSICS_STEP});
    }
}

// ---- The memory of drivers that enter: they have always driven as they do now

// Rows of `r` hold first scenes; headways that nothing shows are drawn: 1.4 s in the middle, spread by a third.
static void enter_humans(const Settings& s, Rows& r, Humans& m) {
    see(s, r, m);
    for (int i = 0; i < r.vehicles; i++) {
        Float closing = m.ahead[3 * i + MIDDLE_LANE].closing, lateral = m.lateral[i];
        Float otherwise = 0.33647224f + 0.35f * normal_of(keys_of(r, i), OWN_HEADWAY);
        for (int k = 0; k < count_of(HUMAN); k++) r.memory[k][i] = filled(0.0f);
        r.memory[STYLE][i] = log_headway(m, i, otherwise), r.memory[STYLE + 1][i] = filled(0.5f);
        r.memory[STYLE + 2][i] = pace_among(m, i);
        for (int k = 0; k < 2; k++) r.memory[LATERAL_SPEEDS + k][i] = lateral;
        r.memory[LATERAL_FROM][i] = r.memory[LATERAL_TO][i] = lateral;
        for (int k = 0; k < 2; k++) r.memory[CLOSING + k][i] = closing;
        r.memory[SINCE][i] = filled(LONG_AGO);
    }
}
