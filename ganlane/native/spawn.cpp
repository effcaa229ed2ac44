// First scenes of random episodes, Table II: what ganlane.sim.spawn and ganlane.sim.random say, number for number.

#include <stdint.h>
#include <stdlib.h>

#include "arrays.hpp"
#include "random.hpp"

// ---- A scene

// What is known of the vehicles before they are put in order; each [vehicles], `places` [lanes * capacity].
struct Draft {
    int64_t* places;
    float *u, *x, *position;
    int32_t *lane, *drawn_lane;
};

// A random lane for each vehicle: all places of all lanes are shuffled, and the first of them taken.
static void draw_lanes(const Spawn& s, uint64_t at_start, const Draft& d) {
    int places = s.lanes * s.capacity;
    for (int i = 0; i < places; i++) d.places[i] = (int64_t)absorb(absorb(at_start, i), SPAWN_LANE);
    int64_t last_key = INT64_MIN;
    int last_place = -1;
    for (int i = 0; i < s.vehicles; i++) {  // the smallest key after the last one; of equal keys the first place
        int found = -1;
        for (int p = 0; p < places; p++) {
            bool after = d.places[p] > last_key || (d.places[p] == last_key && p > last_place);
            if (after && (found < 0 || d.places[p] < d.places[found])) found = p;
        }
        last_key = d.places[found], last_place = found;
        d.drawn_lane[i] = found / s.capacity;
    }
}

// Positions: in a lane of k, sorted uniforms on [0, spread - spacing (k - 1)] plus spacing times the rank.
static void place_in_lanes(const Spawn& s, const Draft& d) {
    for (int i = 0; i < s.vehicles; i++) {
        int count = 0, rank = 0;
        for (int j = 0; j < s.vehicles; j++) {
            if (d.drawn_lane[j] != d.drawn_lane[i]) continue;
            count++;
            rank += d.u[j] < d.u[i] || (d.u[j] == d.u[i] && j < i);
        }
        float room = s.spread - s.spacing * (float)(count - 1);
        d.position[i] = d.u[i] * room + s.spacing * (float)rank;
    }
}

// The vehicles by position, but the middle one, the ego, first and at x = 0.
static void put_ego_first(const Spawn& s, const Draft& d) {
    int middle = (s.vehicles - 1) / 2;
    for (int i = 0; i < s.vehicles; i++) {
        int rank = 0;
        for (int j = 0; j < s.vehicles; j++)
            rank += d.position[j] < d.position[i] || (d.position[j] == d.position[i] && j < i);
        int to = rank == middle ? 0 : rank < middle ? rank + 1 : rank;
        d.x[to] = d.position[i], d.lane[to] = d.drawn_lane[i];
    }
    float ego = d.x[0];
    for (int i = 0; i < s.vehicles; i++) d.x[i] = d.x[i] - ego;
}

static inline float from(const Range& range, float u) { return range.low + u * range.span; }

// The vehicles of Table II.
static void place_random(const Spawn& s, const Scene& scene, const Outputs& state, const Draft& d, long row, uint64_t at_start) {
    for (int i = 0; i < s.vehicles; i++) d.u[i] = uniform_of(absorb(absorb(at_start, i), SPAWN_POSITION));
    draw_lanes(s, at_start, d);
    place_in_lanes(s, d);
    put_ego_first(s, d);
    for (int i = 0; i < s.vehicles; i++) {
        long at = row * s.vehicles + i;
        uint64_t vehicle = absorb(at_start, i);
        float speed = uniform_of(absorb(vehicle, SPAWN_SPEED)), desired = uniform_of(absorb(vehicle, SPAWN_DESIRED_SPEED));
        bool ego = i == 0, lorry = !ego && uniform_of(absorb(vehicle, SPAWN_TRUCK)) < s.truck_share;
        state.x[at] = d.x[i];
        state.y[at] = (float)d.lane[i] * s.lane_width;
        state.speed[at] = from(ego ? s.ego_speed : d.x[i] > 0.0f ? s.front_speed : s.rear_speed, speed);
        state.target_lane[at] = d.lane[i];
        scene.desired_speed[at] = ego ? s.ego_desired_speed : from(lorry ? s.truck_desired_speed : s.desired_speed, desired);
        scene.length[at] = lorry ? s.truck_length : s.length;
        scene.width[at] = lorry ? s.truck_width : s.width;
        scene.visibility[at] = ego ? s.ego_visibility : s.others_visibility;
    }
}

// The vehicles of a scene set by hand (ganlane.sim.scenes.FixedScene).
static void place_fixed(const Spawn& s, const Scene& scene, const Outputs& state, long row, uint64_t at_start) {
    const Fixed& f = *s.fixed;
    for (int i = 0; i < s.vehicles; i++) {
        long at = row * s.vehicles + i;
        uint64_t vehicle = absorb(at_start, i);
        float along = 2.0f * uniform_of(absorb(vehicle, SPAWN_POSITION)) - 1.0f;
        float faster = 2.0f * uniform_of(absorb(vehicle, SPAWN_SPEED)) - 1.0f, varied = f.speed[i] + f.jitter_mps * faster;
        state.x[at] = i == 0 ? f.x[i] : f.x[i] + f.jitter_m * along;
        state.y[at] = f.y[i];
        // Who stands remains standing.
        state.speed[at] = f.speed[i] > 0.0f ? (varied < 0.0f ? 0.0f : varied) : f.speed[i];
        state.target_lane[at] = f.target_lane[i];
        scene.desired_speed[at] = f.desired_speed[i];
        scene.length[at] = f.length[i], scene.width[at] = f.width[i];
        scene.visibility[at] = f.visibility[i];
    }
}

static void begin(const Spawn& s, const Scene& scene, const Outputs& state, const Draft& d, long row) {
    uint64_t key = episode_key(s.stream, scene.seed[row], scene.episode[row]), at_start = absorb(key, 0);
    if (s.fixed) place_fixed(s, scene, state, row, at_start);
    else place_random(s, scene, state, d, row, at_start);
    for (long at = row * s.vehicles; at < (row + 1) * s.vehicles; at++) {
        state.heading[at] = state.acceleration[at] = 0.0f;
        if (state.steering) state.steering[at] = 0.0f;
        scene.valid[at] = at < (row + 1) * s.vehicles - (s.fixed ? s.fixed->waiting : 0);
    }
    if (state.set_speed) state.set_speed[row] = scene.desired_speed[row * s.vehicles];
    // Share of the episodes in which vehicles are recycled.
    uint64_t chosen = absorb(absorb(absorb(key, -1), 0), RECYCLED_EPISODE);
    scene.recycles[row] = s.recycle && fine_uniform_of(chosen) < s.recycle_share;
    state.ego_steering[row] = state.mean_acceleration[row] = state.change_progress[row] = state.distance[row] = 0.0f;
    state.change_direction[row] = state.decisions[row] = state.lane_changes[row] = state.step[row] = 0;
    state.soft_crash[row] = state.soft_crash_behind[row] = state.started_change[row] = 0;
    state.goal[row] = state.hard_crash[row] = state.out_of_road[row] = 0;
    state.missed_exit[row] = state.timeout[row] = 0;
    state.soft_crashes[row] = state.soft_crashes_behind[row] = 0;
    state.done[row] = state.terminated[row] = state.truncated[row] = 0;
}

// Begins the episodes (`seed`, `episode`) in those of the rows [first, last) that are `fresh`. Returns 0, or 1 without
// memory.
extern "C" int ganlane_spawn(const Spawn* spawn, const Scene* scene, const Outputs* state, long first, long last) {
    const Spawn& s = *spawn;
    size_t places = (size_t)s.lanes * s.capacity, vehicles = s.vehicles;
    int64_t* memory = (int64_t*)malloc(sizeof(int64_t) * places + (3 * sizeof(float) + 2 * sizeof(int32_t)) * vehicles);
    if (!memory) return 1;
    float* floats = (float*)(memory + places);
    int32_t* lanes = (int32_t*)(floats + 3 * vehicles);
    Draft draft = {memory, floats, floats + vehicles, floats + 2 * vehicles, lanes, lanes + vehicles};
    for (long row = first; row < last; row++)
        if (scene->fresh[row]) begin(s, *scene, *state, draft, row);
    free(memory);
    return 0;
}
