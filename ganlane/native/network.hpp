// The Social-GAN's generator (ganlane.generator.networks) on the vehicles of some environments.
//
// Here a vector holds LANES outputs of a layer, not LANES environments: a batch of one environment fills it as well as
// a large one. A vehicle's numbers depend on no other vehicle's place, every sum runs over the inputs in their order,
// and products and sums are fused (one rounding) on every instruction set: so the result is the same, bit for bit, in
// any batch and with any LANES.

#pragma once

#include <stddef.h>

#include "vectors.hpp"

// GeneratorSizes of ganlane.settings.generator.
struct Network {
    const float* weights;  // in the order of `layers_of`, aligned to a vector
    int32_t embedding, hidden, pooling, pooled, context, noise, neighbours, extra_inputs, motions, differences;
};

// Units of the inputs, as in ganlane.generator.networks.
const float DIFFERENCE_ALONG = 0.04f, DIFFERENCE_ACROSS = 0.02f, LARGEST_DIFFERENCE = 5.0f;
const float PER_DISPLACEMENT_ACROSS = 20.0f, PER_DIFFERENCE_ALONG = 25.0f, PER_DIFFERENCE_ACROSS = 50.0f;
const float PAIR_SCALE[4] = {20.0f, 4.0f, 0.4f, 0.05f};
const float RANGE = 100.0f;

// Layers have a multiple of this many outputs, of which the last ones may be zeros: whole vectors of any kernel.
const int WIDEST = 16;
static inline int padded(int width) { return (width + WIDEST - 1) / WIDEST * WIDEST; }

// ---- Layers

struct Layer {
    const float *weight, *bias;  // [inputs, width], [width]
    int inputs, width;
};

// The layers one after the other, as they are packed (ganlane.native.drivers): biases first.
struct PackedWeights {
    const float* at;
    Layer operator()(int inputs, int width) {
        Layer l = {at + padded(width), at, inputs, padded(width)};
        at += (size_t)(inputs + 1) * padded(width);
        return l;
    }
};

// Memory in pieces, each aligned to a vector. Without memory (`begin` null) they are only counted.
struct Pieces {
    float* begin;
    size_t count;
    float* operator()(size_t floats) {
        float* piece = begin ? begin + count : nullptr;
        count += (floats + WIDEST - 1) / WIDEST * WIDEST;
        return piece;
    }
};

INLINE Float read(const float* from) {
    Float numbers;
    __builtin_memcpy(&numbers, from, sizeof numbers);
    return numbers;
}
INLINE void write(float* to, Float numbers) { __builtin_memcpy(to, &numbers, sizeof numbers); }

// Sums of ROWS rows and VECTORS vectors of outputs, in registers from the first input to the last.
template <int ROWS, int VECTORS>
INLINE void tile(const float* weight, int width, int inputs, const float* x, int x_stride, const float* start,
                 int start_stride, float* y, int y_stride, bool relu) {
    Float sums[ROWS][VECTORS];
#pragma GCC unroll 8
    for (int row = 0; row < ROWS; row++)
#pragma GCC unroll 8
        for (int v = 0; v < VECTORS; v++) sums[row][v] = read(start + row * start_stride + v * LANES);
    for (int i = 0; i < inputs; i++, weight += width) {
        Float weights[VECTORS];
#pragma GCC unroll 8
        for (int v = 0; v < VECTORS; v++) weights[v] = read(weight + v * LANES);
#pragma GCC unroll 8
        for (int row = 0; row < ROWS; row++) {
            Float number = filled(x[row * x_stride + i]);
#pragma GCC unroll 8
            for (int v = 0; v < VECTORS; v++) sums[row][v] = fused(number, weights[v], sums[row][v]);
        }
    }
#pragma GCC unroll 8
    for (int row = 0; row < ROWS; row++)
#pragma GCC unroll 8
        for (int v = 0; v < VECTORS; v++)
            write(y + row * y_stride + v * LANES, relu ? larger(sums[row][v], filled(0.0f)) : sums[row][v]);
}

// Columns [v, ...) of all `rows`.
template <int VECTORS>
static void columns(const Layer& l, int first, int rows, const float* x, int x_stride, const float* start,
                    int start_stride, float* y, int y_stride, bool relu) {
    const float* weight = l.weight + first;
    int row = 0;
    for (; row + 6 <= rows; row += 6)
        tile<6, VECTORS>(weight, l.width, l.inputs, x + row * x_stride, x_stride, start + row * start_stride + first,
                         start_stride, y + row * y_stride + first, y_stride, relu);
    for (; row + 3 <= rows; row += 3)
        tile<3, VECTORS>(weight, l.width, l.inputs, x + row * x_stride, x_stride, start + row * start_stride + first,
                         start_stride, y + row * y_stride + first, y_stride, relu);
    for (; row < rows; row++)
        tile<1, VECTORS>(weight, l.width, l.inputs, x + row * x_stride, x_stride, start + row * start_stride + first,
                         start_stride, y + row * y_stride + first, y_stride, relu);
}

// As many vectors at a time as the registers hold sums of six rows.
const int TILE_VECTORS = LANES == 16 ? 4 : 2;

// y = start + W x, perhaps cut off below 0, of `rows` rows; `start` null: the layer's bias.
static void apply(const Layer& l, int rows, const float* x, int x_stride, float* y, int y_stride, bool relu = false,
                  const float* start = nullptr, int start_stride = 0) {
    if (!start) start = l.bias;
    int first = 0;
    for (; first + TILE_VECTORS * LANES <= l.width; first += TILE_VECTORS * LANES)
        columns<TILE_VECTORS>(l, first, rows, x, x_stride, start, start_stride, y, y_stride, relu);
    if (TILE_VECTORS > 2)
        for (; first + 2 * LANES <= l.width; first += 2 * LANES)
            columns<2>(l, first, rows, x, x_stride, start, start_stride, y, y_stride, relu);
    for (; first < l.width; first += LANES)
        columns<1>(l, first, rows, x, x_stride, start, start_stride, y, y_stride, relu);
}

// ---- The generator's layers and what they write

struct Layers {
    Layer embed, input, recurrent, pair, vehicle, second, context_first, context_second;
    Layer decoder_embed, decoder_input, decoder_recurrent, head;
};

static Layers layers_of(const Network& n) {
    PackedWeights layer = {n.weights};
    int gates = 4 * padded(n.hidden);
    Layers l;
    l.embed = layer(4, n.embedding), l.input = layer(n.embedding, gates), l.recurrent = layer(n.hidden, gates);
    l.pair = layer(4, n.pooling), l.vehicle = layer(n.hidden, n.pooling), l.second = layer(n.pooling, n.pooled);
    l.context_first = layer(n.hidden + n.pooled + n.extra_inputs, n.context);
    l.context_second = layer(n.context, n.hidden - n.noise);
    // Of the decoder's gates three: its cell begins at 0, so there is nothing to forget.
    int three = 3 * padded(n.hidden);
    l.decoder_embed = layer(4, n.embedding), l.decoder_input = layer(n.embedding, three);
    l.decoder_recurrent = layer(n.hidden, three), l.head = layer(n.hidden, 2);
    return l;
}

// Rows of the layers are vehicles of environments; they go through the layers so many at a time, for the cache.
const int BLOCK_ROWS = 24;

// Memory of one thread for `rows` vehicles.
struct Activations {
    float *features, *embedded, *gates, *hidden, *cell, *own, *terms, *pairs, *second, *inputs, *context, *start, *outputs;
    int* chosen;
    float* distance;
};

static Activations activations_in(Pieces& room, const Network& n, int rows, int vehicles) {
    Activations a;
    size_t r = rows;
    a.features = room(4 * r), a.hidden = room(padded(n.hidden) * r), a.cell = room(padded(n.hidden) * r);
    a.own = room(padded(n.pooling) * r), a.terms = room(padded(n.pooling) * r);
    a.inputs = room((n.hidden + n.pooled + n.extra_inputs) * r), a.start = room(n.hidden * r);
    a.outputs = room(WIDEST * r);
    a.embedded = room(padded(n.embedding) * BLOCK_ROWS), a.gates = room(4 * padded(n.hidden) * BLOCK_ROWS);
    a.pairs = room(padded(n.pooling) * BLOCK_ROWS), a.second = room(padded(n.pooled) * BLOCK_ROWS);
    a.context = room((padded(n.context) + padded(n.hidden)) * BLOCK_ROWS);
    a.chosen = (int*)room(vehicles), a.distance = room(vehicles);
    return a;
}

// ---- Parts

// e^-x and e^-2x, of numbers bounded so that no product of three sums 1 + e^-x overflows; beyond, the sigmoid is 0 or
// 1. To base 2: the integer part of the exponent lies in the last bits of `shifted`; the rest by a polynomial of least
// relative error, 1.7e-7 (a linear programme over 4001 points). Cephes' takes half as long again.
template <int TIMES>
INLINE Float decay(Float x) {
    Float z = within(x, 28.0f / TIMES), shift = filled(12582912.0f);
    Float to_base_2 = filled(-1.44269504088896341f * TIMES);
    Float shifted = fused(z, to_base_2, shift), r = fused(z, to_base_2, shift - shifted);
    Float p = fused(r, filled(1.3202981790527701e-3f), filled(9.674952365458012e-3f));
    p = fused(p, r, filled(5.5510472506284714e-2f)), p = fused(p, r, filled(2.4022166430950165e-1f));
    p = fused(p, r, filled(6.931465864181519e-1f)), p = fused(p, r, filled(1.0f));
    return (Float)((Mask)p + ((Mask)shifted << 23));
}

// Gates [input, forget, output, new] to the new cell and hidden state; the FIRST step needs no forget gate, and `gates`
// is 3 where there is none. The sigmoids and tanh over one divisor:
// s(i) tanh(g) + s(f) c = ((1 - G)(1 + F) + c (1 + I)(1 + G)) / ((1 + I)(1 + G)(1 + F)), I = e^-i, G = e^-2g, F = e^-f.
template <bool FIRST>
INLINE void recur(int hidden, int rows, const float* numbers, int gates, float* cell, float* state) {
    for (int row = 0; row < rows; row++) {
        const float* gate = numbers + (size_t)row * gates * hidden;
        for (int k = 0; k < hidden; k += LANES) {
            float* c = cell + (size_t)row * hidden + k;
            const float* now = gate + k;
            Float new_decay = decay<2>(read(now + (gates - 1) * hidden));
            Float input = 1.0f + decay<1>(read(now)), both = input * (1.0f + new_decay), value;
            if (FIRST) {
                value = (1.0f - new_decay) / both;
            } else {
                Float forget = 1.0f + decay<1>(read(now + hidden));
                value = fused(1.0f - new_decay, forget, read(c) * both) / (both * forget);
            }
            write(c, value);
            Float output = 1.0f + decay<1>(read(now + (gates - 2) * hidden)), tanh_decay = decay<2>(value);
            write(state + (size_t)row * hidden + k,
                  (1.0f - tanh_decay) / (output * (1.0f + tanh_decay)));
        }
    }
}

// Network inputs of the newest motions: `displacement` [rows, 2] in m per 0.1 s, and its change `difference`.
static void motion_features(const Network& n, int rows, const float* displacement, const float* difference, float* out) {
    auto bounded = [](float x) {
        return x < -LARGEST_DIFFERENCE ? -LARGEST_DIFFERENCE : x > LARGEST_DIFFERENCE ? LARGEST_DIFFERENCE : x;
    };
    for (int row = 0; row < rows; row++) {
        const float *d = displacement + 2 * row, *change = difference + 2 * row;
        float* f = out + 4 * row;
        f[0] = d[0], f[1] = d[1] * PER_DISPLACEMENT_ACROSS;
        f[2] = n.differences ? bounded(change[0] * PER_DIFFERENCE_ALONG) : 0.0f;
        f[3] = n.differences ? bounded(change[1] * PER_DIFFERENCE_ACROSS) : 0.0f;
    }
}

// The projection [rows, gates] of the newest motion, from its features.
static void project(const Network& n, const Layers& l, int rows, const Activations& a, float* motion) {
    int gates = 4 * padded(n.hidden);
    for (int first = 0; first < rows; first += BLOCK_ROWS) {
        int some = rows - first < BLOCK_ROWS ? rows - first : BLOCK_ROWS;
        apply(l.embed, some, a.features + 4 * first, 4, a.embedded, l.embed.width, true);
        apply(l.input, some, a.embedded, l.embed.width, motion + (size_t)first * gates, gates);
    }
}

// Hidden states after the window of motions, the oldest first, from a state of zeros.
static void encode(const Network& n, const Layers& l, int rows, float* const* motions, const Activations& a) {
    int width = padded(n.hidden), gates = 4 * width;
    for (int first = 0; first < rows; first += BLOCK_ROWS) {
        int some = rows - first < BLOCK_ROWS ? rows - first : BLOCK_ROWS;
        float *hidden = a.hidden + (size_t)first * width, *cell = a.cell + (size_t)first * width;
        for (int t = 0; t < n.motions; t++) {
            const float* motion = motions[t] + (size_t)first * gates;
            if (t == 0) {
                // The state of zeros adds nothing.
                recur<true>(width, some, motion, 4, cell, hidden);
            } else {
                apply(l.recurrent, some, hidden, width, a.gates, gates, false, motion, gates);
                recur<false>(width, some, a.gates, 4, cell, hidden);
            }
        }
    }
}

// The others that count for vehicle `i`: valid, within range, and of those the nearest. Rows of one environment are
// `step` apart. Returns how many; their places in `chosen`.
static int neighbours_of(const Network& n, int vehicles, int i, int step, const float* position, const uint8_t* valid,
                         const Activations& a) {
    int count = 0;
    for (int j = 0; j < vehicles; j++) {
        float dx = position[2 * j * step] - position[2 * i * step], dy = position[2 * j * step + 1] - position[2 * i * step + 1];
        float along = dx < 0.0f ? -dx : dx;
        if (j == i || !valid[j * step] || along > RANGE) continue;
        float distance = dx * dx + dy * dy;
        // Where not all fit, the list is in the order of distance; of two at the same one the first in order counts.
        int at = count;
        if (vehicles - 1 > n.neighbours) {
            while (at > 0 && distance < a.distance[at - 1]) at--;
            if (at >= n.neighbours) continue;
            if (count == n.neighbours) count--;
            for (int k = count; k > at; k--) a.chosen[k] = a.chosen[k - 1], a.distance[k] = a.distance[k - 1];
        }
        a.chosen[at] = j, a.distance[at] = distance;
        count++;
    }
    return count;
}

// Pairs of a vehicle and one of its neighbours, gathered until there are enough for the second layer.
struct Pairs {
    int count;
    int owner[BLOCK_ROWS];  // the vehicle's row
};

static void pool_pairs(const Network& n, const Layers& l, Pairs& pairs, const Activations& a) {
    apply(l.second, pairs.count, a.pairs, l.pair.width, a.second, l.second.width);
    for (int k = 0; k < pairs.count; k++) {
        float* pooled = a.inputs + (size_t)pairs.owner[k] * l.context_first.inputs + n.hidden;
        const float* numbers = a.second + k * l.second.width;
        for (int f = 0; f < n.pooled; f++) pooled[f] = pooled[f] > numbers[f] ? pooled[f] : numbers[f];
    }
    pairs.count = 0;
}

// Pooled states of the vehicles 1 and on of every environment, into their rows of `inputs` behind the hidden states.
static void pool(const Network& n, const Layers& l, int environments, int vehicles, const float* position,
                 const float* displacement, const uint8_t* valid, const Activations& a) {
    int rows = environments * vehicles, width = l.pair.width, inputs = l.context_first.inputs;
    for (int row = environments; row < rows; row++)
        for (int f = 0; f < n.pooled; f++) a.inputs[(size_t)row * inputs + n.hidden + f] = 0.0f;
    if (!n.neighbours) return;
    for (int row = 0; row < rows; row++) {
        // Relative to the first vehicle: far down the road differences of float32 positions lose digits.
        const float *p = position + 2 * row, *origin = position + 2 * (row % environments), *d = displacement + 2 * row;
        float* f = a.outputs + WIDEST * row;
        f[0] = (p[0] - origin[0]) / PAIR_SCALE[0], f[1] = (p[1] - origin[1]) / PAIR_SCALE[1];
        f[2] = d[0] / PAIR_SCALE[2], f[3] = d[1] / PAIR_SCALE[3];
    }
    // The first layer is linear in (other - self), so it runs once per vehicle; the bias is added per pair.
    apply(l.pair, rows, a.outputs, WIDEST, a.own, width);
    apply(l.vehicle, rows, a.hidden, padded(n.hidden), a.terms, width, false, a.own, width);
    Pairs pairs = {};
    for (int row = environments; row < rows; row++) {
        int environment = row % environments;
        int count = neighbours_of(n, vehicles, row / environments, environments, position + 2 * environment,
                                  valid + environment, a);
        for (int k = 0; k < count; k++) {
            const float* other = a.terms + (size_t)(a.chosen[k] * environments + environment) * width;
            const float* self = a.own + (size_t)row * width;
            float* pair = a.pairs + pairs.count * width;
            for (int f = 0; f < width; f += LANES)
                write(pair + f, larger(read(other + f) + read(l.vehicle.bias + f) - read(self + f), filled(0.0f)));
            pairs.owner[pairs.count++] = row;
            if (pairs.count == BLOCK_ROWS) pool_pairs(n, l, pairs, a);
        }
    }
    if (pairs.count) pool_pairs(n, l, pairs, a);
}

// The decoder's first output [rows, WIDEST] (the first two count) of the rows from `begin` on, in a.outputs.
static void decode(const Network& n, const Layers& l, int begin, int rows, const float* noise, const Activations& a) {
    int width = padded(n.hidden), context = n.hidden - n.noise, inputs = l.context_first.inputs, three = 3 * width;
    for (int first = begin; first < rows; first += BLOCK_ROWS) {
        int some = rows - first < BLOCK_ROWS ? rows - first : BLOCK_ROWS;
        float* summary = a.context + padded(n.context) * BLOCK_ROWS;
        apply(l.context_first, some, a.inputs + (size_t)first * inputs, inputs, a.context, l.context_first.width, true);
        apply(l.context_second, some, a.context, l.context_first.width, summary, l.context_second.width);
        for (int row = 0; row < some; row++) {
            float* start = a.start + (size_t)(first + row) * n.hidden;
            __builtin_memcpy(start, summary + row * l.context_second.width, context * sizeof(float));
            __builtin_memcpy(start + context, noise + (size_t)(first + row) * n.noise, n.noise * sizeof(float));
        }
        apply(l.decoder_embed, some, a.features + 4 * first, 4, a.embedded, l.decoder_embed.width, true);
        apply(l.decoder_input, some, a.embedded, l.decoder_embed.width, a.gates, three);
        apply(l.decoder_recurrent, some, a.start + (size_t)first * n.hidden, n.hidden, a.gates, three, false, a.gates, three);
        float *hidden = a.hidden + (size_t)first * width, *cell = a.cell + (size_t)first * width;
        recur<true>(width, some, a.gates, 3, cell, hidden);
        apply(l.head, some, hidden, width, a.outputs + (size_t)WIDEST * first, WIDEST);
    }
}

// What the network reads of the vehicles, [vehicles, environments] each with its numbers: the egos come first.
struct Sight {
    const float *position, *displacement, *difference, *extra, *noise;  // m, m per 0.1 s, m; [2], [2], [2], [X], [Z]
    const uint8_t* valid;
};

// The network's first output for the vehicles 1 and on, in a.outputs [rows, WIDEST], of which the first two count. The
// newest motion is projected to the last one of `motions`, oldest first.
static void forecast(const Network& n, const Layers& l, int environments, int vehicles, const Sight& sight,
                     float* const* motions, const Activations& a) {
    int rows = environments * vehicles, inputs = l.context_first.inputs, width = padded(n.hidden);
    motion_features(n, rows, sight.displacement, sight.difference, a.features);
    project(n, l, rows, a, motions[n.motions - 1]);
    encode(n, l, rows, motions, a);
    pool(n, l, environments, vehicles, sight.position, sight.displacement, sight.valid, a);
    for (int row = environments; row < rows; row++) {
        float* input = a.inputs + (size_t)row * inputs;
        __builtin_memcpy(input, a.hidden + (size_t)row * width, n.hidden * sizeof(float));
        for (int k = 0; k < n.extra_inputs; k++)
            input[n.hidden + n.pooled + k] = sight.extra[(size_t)row * n.extra_inputs + k];
    }
    decode(n, l, environments, rows, sight.noise, a);
}
