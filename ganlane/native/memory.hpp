// What drivers carry from step to step, in the state and in the rows; and the random numbers of a step.

#pragma once

#include "random.hpp"
#include "rows.hpp"

// ---- Memory: arrays [rows, vehicles, numbers] of the state, behind Inputs and Outputs

enum Kind { FLOAT, INTEGER, FLAG };

struct Field {
    int first, numbers;  // places in Rows.memory
    Kind kind;
};

struct Fields {
    int arrays;
    Field field[9];
};

static inline int count_of(const Fields& fields) {
    int count = 0;
    for (int k = 0; k < fields.arrays; k++) count += fields.field[k].numbers;
    return count;
}

template <class Arrays>
static void* const* memory_of(const Arrays* arrays) {
    return (void* const*)(arrays + 1);
}

// One row's number of a vehicle: a vector seen as the array that it is.
INLINE float& at(Float* field, int i, int lane) { return ((float*)(field + i))[lane]; }

// The rows of the state that a vector holds; behind the last of them it is repeated.
struct Block {
    long count, row[LANES];
};

static void load_fields(const Fields& fields, Rows& r, void* const* arrays, const Block& block) {
    for (int k = 0; k < fields.arrays; k++) {
        const Field& f = fields.field[k];
        for (int lane = 0; lane < LANES; lane++) {
            long start = block.row[lane] * r.vehicles;
            for (int i = 0; i < r.vehicles; i++) {
                long from = start + (long)at(r.index, i, lane);
                for (int j = 0; j < f.numbers; j++)
                    at(r.memory[f.first + j], i, lane) = f.kind == FLOAT     ? ((const float*)arrays[k])[from * f.numbers + j]
                                                         : f.kind == INTEGER ? (float)((const int64_t*)arrays[k])[from]
                                                                             : (float)((const uint8_t*)arrays[k])[from];
            }
        }
    }
}

static void store_fields(const Fields& fields, Rows& r, void* const* arrays, const Block& block) {
    for (int k = 0; k < fields.arrays; k++) {
        const Field& f = fields.field[k];
        for (int lane = 0; lane < block.count; lane++)
            for (int i = 0; i < r.vehicles; i++) {
                long to = block.row[lane] * r.vehicles + (long)at(r.index, i, lane);
                for (int j = 0; j < f.numbers; j++) {
                    float number = at(r.memory[f.first + j], i, lane);
                    if (f.kind == FLOAT) ((float*)arrays[k])[to * f.numbers + j] = number;
                    else if (f.kind == INTEGER) ((int64_t*)arrays[k])[to] = (int64_t)number;
                    else ((uint8_t*)arrays[k])[to] = number != 0.0f;
                }
            }
    }
}

// A number of vehicle i, in the rows that go on.
INLINE void remember(Rows& r, int i, int field, Float number) {
    r.memory[field][i] = choose(r.running, number, r.memory[field][i]);
}

// ---- Random numbers of a step

// The key of vehicle i (in the order of the road) at this step, of every row.
struct Keys {
    uint64_t key[LANES];
};

INLINE Keys keys_of(const Rows& r, int i) {
    Keys k;
    for (int lane = 0; lane < LANES; lane++) k.key[lane] = absorb(r.step_key[lane], (int64_t)at(r.index, i, lane));
    return k;
}

INLINE Float uniform_of(const Keys& keys, int purpose) {
    Float u;
    for (int lane = 0; lane < LANES; lane++) u[lane] = uniform_of(absorb(keys.key[lane], purpose));
    return u;
}

// Box and Muller's transform of two uniform numbers.
INLINE Float normal_of(Float u, Float angle) {
    Float sine, cosine;
    sincos_of(6.283185307179586f * angle, sine, cosine);
    return root(-2.0f * logarithm(1.0f - u)) * cosine;
}

static Float normal_of(const Keys& keys, int purpose) {
    Float u, angle;
    for (int lane = 0; lane < LANES; lane++) {
        uint64_t key = absorb(keys.key[lane], purpose);
        u[lane] = uniform_of(absorb(key, 1)), angle[lane] = uniform_of(absorb(key, 2));
    }
    return normal_of(u, angle);
}
