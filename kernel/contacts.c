// SPDX-License-Identifier: Apache-2.0

#include "contacts.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

/* Bits of contacts_kept.unread: the taxel has no reading; it had one in the frame before and has none, or
 * the other way round; it may carry more than it reads. */
enum { UNREAD = 1, CHANGED = 2, DIM = 4 };

static int32_t root_of(int32_t *root, int32_t taxel)
{
    while (root[taxel] != taxel) {
        root[taxel] = root[root[taxel]];
        taxel = root[taxel];
    }
    return taxel;
}

/* Labels the connected components of the taxels above `least`, in the order of their first taxels; -1:
 * of none. Returns their number, or SIZE_MAX for a neighbour that is no taxel. */
static size_t connect(const struct contacts_skin *skin, const float *pressure_pa, float least,
                      int32_t *root, int32_t *label)
{
    size_t count = 0;

    for (size_t i = 0; i < skin->taxels; i++) {
        root[i] = -1;
        if (!(pressure_pa[i] > least))
            continue;
        int32_t own = root[i] = (int32_t)i; /* root of its tree so far, the tree's first taxel */
        for (size_t n = 0; n < skin->near; n++) {
            int32_t j = skin->neighbours[i * skin->near + n];
            if (j < 0 || (size_t)j >= skin->taxels)
                return SIZE_MAX;
            if ((size_t)j >= i || root[j] < 0 || root[j] == own)
                continue;
            int32_t other = root_of(root, j), first = own < other ? own : other;
            root[own < other ? other : own] = first;
            own = first;
        }
    }
    for (size_t i = 0; i < skin->taxels; i++) {
        label[i] = -1;
        if (root[i] >= 0) {
            int32_t first = root_of(root, (int32_t)i);
            label[i] = (size_t)first == i ? (int32_t)count++ : label[first];
        }
    }
    return count;
}

static int stronger(const void *left, const void *right)
{
    const struct contacts_load *a = left, *b = right;

    if (a->load_n != b->load_n)
        return a->load_n < b->load_n ? 1 : -1;
    return a->label < b->label ? -1 : a->label > b->label;
}

/* Ranks components that are contacts by their loads, others -1; returns the number of contacts. A
 * component is one where a taxel exceeds contact_pa, or was in contact before. */
static size_t rank(const struct contacts_skin *skin, float contact_pa, const float *pressure_pa,
                   const int32_t *place, size_t components, const struct contacts_scratch *scratch)
{
    struct contacts_load *loads = scratch->loads;
    int32_t *alive = scratch->rank;
    size_t count = 0;

    for (size_t label = 0; label < components; label++) {
        loads[label] = (struct contacts_load){0, (int32_t)label};
        alive[label] = 0;
    }
    for (size_t i = 0; i < skin->taxels; i++) {
        int32_t label = scratch->label[i];
        if (label < 0)
            continue;
        loads[label].load_n += pressure_pa[i] * skin->moments[i * CONTACTS_MOMENTS];
        alive[label] |= pressure_pa[i] > contact_pa || place[i] >= 0;
    }
    for (size_t label = 0; label < components; label++)
        if (!alive[label])
            loads[label].load_n = 0;
    qsort(loads, components, sizeof *loads, stronger);
    while (count < components && loads[count].load_n > 0)
        count++;
    for (size_t i = 0; i < components; i++)
        scratch->rank[loads[i].label] = i < count ? (int32_t)i : -1;
    return count;
}

/* Notes what is to be said of each taxel's reading; returns the bits that any of them has. */
static uint8_t note_unread(size_t taxels, const struct contacts_limits *limits,
                           const float *pressure_pa, const uint8_t *status, uint8_t *unread)
{
    const float below_pa = -limits->contact_pa;
    uint8_t any = 0;

    for (size_t i = 0; i < taxels; i++) {
        uint8_t now = pressure_pa[i] != pressure_pa[i], before = unread[i] & UNREAD; /* NaN */
        uint8_t dim = now | ((status[i] & limits->saturated) != 0) | (pressure_pa[i] < below_pa);
        unread[i] = (uint8_t)(now * UNREAD | (now ^ before) * CHANGED | dim * DIM);
        any |= unread[i];
    }
    return any;
}

static void add(const struct contacts_skin *skin, size_t taxel, double pressure_pa, double *sums)
{
    for (size_t m = 0; m < CONTACTS_MOMENTS; m++)
        sums[m] += skin->moments[taxel * CONTACTS_MOMENTS + m] * pressure_pa;
}

/* Adds pressed taxels beside contacts to these. Returns false for a neighbour that is no taxel. */
static bool add_rim(const struct contacts_skin *skin, float rim_pa, const float *pressure_pa,
                    const int32_t *place, double *sums)
{
    for (size_t i = 0; i < skin->taxels; i++) {
        int32_t beside = -1;
        if (place[i] >= 0 || !(pressure_pa[i] > rim_pa))
            continue;
        for (size_t n = 0; n < skin->near; n++) {
            int32_t j = skin->neighbours[i * skin->near + n];
            if (j < 0 || (size_t)j >= skin->taxels)
                return false;
            if (place[j] > beside)
                beside = place[j];
        }
        if (beside >= 0)
            add(skin, i, pressure_pa[i], sums + (size_t)beside * CONTACTS_SUMS);
    }
    return true;
}

size_t contacts_gather(const struct contacts_skin *skin, const struct contacts_limits *limits,
                       const float *pressure_pa, const uint8_t *status,
                       const struct contacts_kept *kept, const struct contacts_scratch *scratch,
                       const struct contacts_found *found)
{
    uint8_t any = note_unread(skin->taxels, limits, pressure_pa, status, kept->unread);
    bool is_touched = false;
    for (size_t i = 0; i < skin->taxels; i++)
        is_touched |= (pressure_pa[i] > limits->contact_pa) | (kept->place[i] >= 0);
    found->starts[0] = 0;
    if (!is_touched) /* nor was it in the frame before */
        return 0;
    size_t components =
        connect(skin, pressure_pa, limits->release_pa, scratch->root, scratch->label);
    if (components == SIZE_MAX)
        return SIZE_MAX;
    size_t count =
        rank(skin, limits->contact_pa, pressure_pa, kept->place, components, scratch);
    int32_t *cursor = scratch->root;

    for (size_t c = 0; c <= count; c++)
        found->starts[c] = 0;
    for (size_t i = 0; i < skin->taxels; i++)
        if (scratch->label[i] >= 0 && scratch->rank[scratch->label[i]] >= 0)
            found->starts[scratch->rank[scratch->label[i]] + 1]++;
    for (size_t c = 0; c < count; c++) {
        found->starts[c + 1] += found->starts[c];
        cursor[c] = found->starts[c];
        memset(found->sums + c * CONTACTS_SUMS, 0, CONTACTS_SUMS * sizeof(double));
        found->peak_pa[c] = -INFINITY;
        found->saturated[c] = found->lower_bound[c] = found->torn[c] = 0;
    }
    for (size_t i = 0; i < skin->taxels; i++) {
        int32_t before = kept->place[i];
        int32_t c = scratch->label[i] < 0 ? -1 : scratch->rank[scratch->label[i]];
        kept->place[i] = c;
        if (c < 0)
            continue;
        double *sums = found->sums + (size_t)c * CONTACTS_SUMS;
        found->taxels[cursor[c]] = (int32_t)i;
        found->before[cursor[c]++] = before;
        add(skin, i, pressure_pa[i], sums);
        sums[CONTACTS_MOMENTS] += skin->moments[i * CONTACTS_MOMENTS];
        if (pressure_pa[i] > found->peak_pa[c])
            found->peak_pa[c] = pressure_pa[i];
        found->saturated[c] |= (status[i] & limits->saturated) != 0;
        uint8_t bits = 0;
        for (size_t n = 0; any && n < skin->near; n++)
            bits |= kept->unread[skin->neighbours[i * skin->near + n]];
        bits |= kept->unread[i];
        found->lower_bound[c] |= (bits & DIM) != 0;
        found->torn[c] |= (bits & CHANGED) != 0;
    }
    return add_rim(skin, limits->rim_pa, pressure_pa, kept->place, found->sums) ? count : SIZE_MAX;
}
