// SPDX-License-Identifier: Apache-2.0

#include "skin.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define LOW_V 0.11 /* of a wire that 77 Ω pull low (SPICE) */

struct member {
    struct avr_node *node;
    double swing_nv; /* nV at the amplifier's output per level; an integer, so that sums are exact */
    double shift_nv; /* … while it drives the line */
    double gain;
};

struct skin {
    struct amplifier amplifier;
    struct sync_line sync;
    struct member *members;
    size_t size;
    int64_t now_ns; /* time to which nodes have run */
    bool stuck;     /* the data wire, low */
    double lowest_v;
    uint64_t random;
    double spare; /* of a pair of normal deviates; NaN: none */
};

struct skin *skin_create(const struct amplifier *amplifier)
{
    struct skin *skin = calloc(1, sizeof *skin);

    skin->amplifier = *amplifier;
    skin->random = amplifier->seed;
    skin->spare = NAN;
    skin->lowest_v = INFINITY;
    skin->sync.rest_v = amplifier->offset_v;
    skin->sync.low_v = LOW_V;
    skin->sync.back_ns = amplifier->back_ns;
    return skin;
}

void skin_free(struct skin *skin)
{
    for (size_t i = 0; i < skin->size; i++)
        node_free(skin->members[i].node);
    free(skin->members);
    free(skin->sync.edges);
    free(skin);
}

int skin_add(struct skin *skin, const struct node_plan *plan, char *error, size_t error_size)
{
    const struct amplifier *amplifier = &skin->amplifier;
    double swing_v = amplifier->polarity * plan->gain * plan->supply_v / 2;
    double shift_v = amplifier->load > 0 ? plan->gain * (plan->supply_v / 2 - amplifier->offset_v) : 0;
    struct avr_node *node = node_create(plan, &skin->sync, error, error_size);

    if (!node)
        return -1;
    skin->members = realloc(skin->members, (skin->size + 1) * sizeof *skin->members);
    skin->members[skin->size] = (struct member){node, round(swing_v * 1e9), round(shift_v * 1e9), plan->gain};
    return (int)skin->size++;
}

struct avr_node *skin_node(struct skin *skin, int node)
{
    return skin->members[node].node;
}

bool skin_sync(struct skin *skin, int64_t t_ns, bool level)
{
    struct sync_line *sync = &skin->sync;

    if (skin->stuck)
        return true; /* it is low already */
    if (t_ns < skin->now_ns || (sync->size && t_ns < sync->edges[sync->size - 1].t_ns))
        return false;
    if (sync->size == sync->capacity) {
        sync->capacity = 2 * sync->capacity + 64;
        sync->edges = realloc(sync->edges, sync->capacity * sizeof *sync->edges);
    }
    sync->edges[sync->size++] = (struct sync_edge){t_ns, level};
    return true;
}

void skin_stick(struct skin *skin, int64_t t_ns)
{
    skin_sync(skin, t_ns, true);
    skin->stuck = true;
}

double skin_lowest(const struct skin *skin)
{
    return skin->lowest_v;
}

void skin_run(struct skin *skin, int64_t t_ns)
{
    for (size_t i = 0; i < skin->size; i++)
        node_run(skin->members[i].node, t_ns);
    if (t_ns > skin->now_ns)
        skin->now_ns = t_ns;
}

void skin_forget(struct skin *skin, int64_t t_ns)
{
    struct sync_line *sync = &skin->sync;
    uint64_t seen = sync->dropped + sync->size;

    for (size_t i = 0; i < skin->size; i++) {
        node_forget(skin->members[i].node, t_ns);
        if (node_seen(skin->members[i].node) < seen)
            seen = node_seen(skin->members[i].node);
    }
    /* skin_volts wants the last one before that time, too */
    while (seen > sync->dropped && sync->edges[seen - sync->dropped - 1].t_ns >= t_ns)
        seen--;
    seen -= seen > sync->dropped;
    sync->size -= seen - sync->dropped;
    memmove(sync->edges, sync->edges + (seen - sync->dropped), sync->size * sizeof *sync->edges);
    sync->dropped = seen;
}

/* The line */

/* SplitMix64 (Steele, Lea, Flood 2014): (0, 1] */
static double uniform(struct skin *skin)
{
    uint64_t z = skin->random += 0x9E3779B97F4A7C15u;

    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9u;
    z = (z ^ z >> 27) * 0x94D049BB133111EBu;
    return (double)(((z ^ z >> 31) >> 11) + 1) * 0x1p-53;
}

/* Box and Muller's pair, one at a time */
static double normal(struct skin *skin)
{
    double radius, angle, deviate = skin->spare;

    skin->spare = NAN;
    if (!isnan(deviate))
        return deviate;
    radius = sqrt(-2 * log(uniform(skin)));
    angle = 2 * M_PI * uniform(skin);
    skin->spare = radius * sin(angle);
    return radius * cos(angle);
}

/* The first edge at or after a time. */
static size_t find_edge(const struct pin_edge *edges, size_t size, double t_ns)
{
    size_t low = 0;

    while (low < size) {
        size_t middle = low + (size - low) / 2;
        if ((double)edges[middle].t_ns > t_ns)
            size = middle;
        else
            low = middle + 1;
    }
    return low;
}

/* A member at a level in place of another, from a sample on. */
static void add_step(const struct member *member, int8_t before, int8_t level, double *nv, double *loads)
{
    int drives = (level != 0) - (before != 0);

    *nv += member->swing_nv * (level - before) + member->shift_nv * drives;
    if (loads)
        *loads += member->gain * drives;
}

/* Adds a sensor's steps to the line's, and to its load: the difference of each sample from the one before. */
static void add_steps(const struct member *member, int sensor, double t_ns, double step_ns, double *nv,
                      double *loads, size_t size)
{
    const struct pin_edge *edges;
    int8_t level;
    size_t count = node_edges(member->node, sensor, &edges, &level);
    size_t i = find_edge(edges, count, t_ns);

    if (i)
        level = edges[i - 1].level;
    add_step(member, 0, level, nv, loads);
    for (; i < count; i++) {
        double sample = ceil(((double)edges[i].t_ns - t_ns) / step_ns);
        if (sample >= (double)size)
            break;
        size_t at = (size_t)sample;
        add_step(member, level, edges[i].level, &nv[at], loads ? &loads[at] : NULL);
        level = edges[i].level;
    }
}

/* What the pulled wire makes of the line's voltage. edge: the first sync edge that is not known to be over. */
static double pulled(struct skin *skin, double t_ns, double volts, size_t *edge)
{
    const struct sync_line *sync = &skin->sync;
    const struct amplifier *amplifier = &skin->amplifier;

    while (*edge < sync->size && (double)sync->edges[*edge].t_ns <= t_ns)
        ++*edge;
    if (!*edge)
        return volts;
    const struct sync_edge *last = &sync->edges[*edge - 1];
    if (last->level)
        return amplifier->pulled_v;
    if (amplifier->load > 0 && volts < skin->lowest_v)
        skin->lowest_v = volts;
    return volts + (amplifier->pulled_v - volts) * exp(((double)last->t_ns - t_ns) / amplifier->recovery_ns);
}

void skin_volts(struct skin *skin, double t_ns, double step_ns, double *volts, size_t size)
{
    const struct amplifier *amplifier = &skin->amplifier;
    double *loads = amplifier->load > 0 ? calloc(size, sizeof *loads) : NULL;
    double sum_nv = 0, load = amplifier->load;
    size_t edge = 0;

    for (size_t i = 0; i < size; i++)
        volts[i] = 0;
    for (size_t i = 0; size && i < skin->size; i++)
        for (int s = 0; s < node_sensors(skin->members[i].node); s++)
            add_steps(&skin->members[i], s, t_ns, step_ns, volts, loads, size);
    for (size_t i = 0; i < size; i++) {
        double noise = amplifier->noise_v > 0 ? amplifier->noise_v * normal(skin) : 0;
        sum_nv += volts[i];
        if (loads)
            load += loads[i];
        volts[i] = amplifier->offset_v + sum_nv / 1e9 / (loads ? load : 1);
        if (amplifier->on_data)
            volts[i] = pulled(skin, t_ns + (double)i * step_ns, volts[i], &edge);
        volts[i] += noise;
        volts[i] = fmin(fmax(volts[i], amplifier->low_v), amplifier->high_v);
    }
    free(loads);
}
