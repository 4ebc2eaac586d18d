// SPDX-License-Identifier: Apache-2.0

#include "contacts.h"

#include <math.h>
#include <stdbool.h>
#include <string.h>

/* Bits of contacts_kept.notes: the taxel has no reading; it had one in the frame before and has none, or
 * the other way round; it may carry more than it reads. */
enum { UNREAD = 1, CHANGED = 2, DIM = 4 };
enum { NONE = -1, OPEN = -2 }; /* labels of taxels: in no component, not in one yet */

/* Notes what is to be said of each reading, and counts; returns the bits that any has, or -1 if nothing
 * touches the skin or did. */
static int note(const struct contacts_skin *skin, const float *pressure_pa, const uint8_t *status,
                const struct contacts_kept *kept, int32_t *tally)
{
    const float below_pa = -skin->contact_pa;
    int any = 0, valid = 0, in_service = 0, doubtful = 0;
    bool is_touched = false;

    for (size_t i = 0; i < skin->taxels; i++) {
        float here_pa = status[i] & skin->uncertain ? NAN : pressure_pa[i];
        int now = isnan(here_pa) != 0, before = kept->notes[i] & UNREAD;
        int saturated = (status[i] & skin->saturated) != 0, below = here_pa < below_pa;
        int serves = (status[i] & skin->masked) == 0, reads = serves & (isfinite(here_pa) != 0);
        kept->notes[i] =
            (uint8_t)(now * UNREAD | (now ^ before) * CHANGED | (now | saturated | below) * DIM);
        any |= kept->notes[i];
        is_touched |= (here_pa > skin->contact_pa) | (kept->place[i] >= 0);
        in_service += serves;
        valid += reads;
        doubtful += reads & ((saturated & (here_pa <= skin->contact_pa)) | below);
    }
    tally[0] = valid;
    tally[1] = in_service;
    tally[2] = doubtful;
    tally[3] = 0;
    return is_touched ? any : -1;
}

static bool exceeds(const float *pressure_pa, const struct contacts_kept *kept, size_t taxel, float least_pa)
{
    return pressure_pa[taxel] > least_pa && !(kept->notes[taxel] & UNREAD);
}

/* Labels the connected components of the taxels above the release in the order of their first taxels, NONE
 * elsewhere. Returns their number; SIZE_MAX for a neighbour that is no taxel. */
static size_t connect(const struct contacts_skin *skin, const float *pressure_pa,
                      const struct contacts_kept *kept, int32_t *label, int32_t *waiting)
{
    int32_t count = 0;

    for (size_t i = 0; i < skin->taxels; i++)
        label[i] = exceeds(pressure_pa, kept, i, skin->release_pa) ? OPEN : NONE;
    for (size_t i = 0; i < skin->taxels; i++) {
        if (label[i] != OPEN)
            continue;
        size_t left = 1;
        waiting[0] = (int32_t)i;
        label[i] = count;
        while (left) {
            const int32_t *near = skin->neighbours + (size_t)waiting[--left] * skin->near;
            for (size_t n = 0; n < skin->near; n++) {
                if (near[n] < 0 || (size_t)near[n] >= skin->taxels)
                    return SIZE_MAX;
                if (label[near[n]] == OPEN) {
                    label[near[n]] = count;
                    waiting[left++] = near[n];
                }
            }
        }
        count++;
    }
    return (size_t)count;
}

/* Numbers the components that are contacts, the strongest first, others NONE; returns how many are. A
 * component is one where a taxel exceeds contact_pa, or was in contact before. */
static int32_t rank(const struct contacts_skin *skin, const float *pressure_pa, const int32_t *label,
                    const struct contacts_kept *kept, size_t components, int32_t *number,
                    int32_t *strongest)
{
    int32_t count = 0;
    double *loads = kept->loads;

    for (size_t c = 0; c < components; c++) {
        loads[c] = 0;
        number[c] = NONE;
    }
    for (size_t i = 0; i < skin->taxels; i++)
        if (label[i] >= 0) {
            loads[label[i]] += pressure_pa[i] * skin->moments[i * CONTACTS_MOMENTS];
            if (pressure_pa[i] > skin->contact_pa || kept->place[i] >= 0)
                number[label[i]] = 0;
        }
    for (size_t c = 0; c < components; c++) {
        if (number[c] == NONE || !(loads[c] > 0)) {
            number[c] = NONE;
            continue;
        }
        int32_t at = count++;
        for (; at > 0 && loads[strongest[at - 1]] < loads[c]; at--)
            strongest[at] = strongest[at - 1];
        strongest[at] = (int32_t)c;
    }
    for (int32_t at = 0; at < count; at++)
        number[strongest[at]] = at;
    return count;
}

static void add(const struct contacts_skin *skin, size_t taxel, double pressure_pa, double *sums)
{
    for (size_t m = 0; m < CONTACTS_MOMENTS; m++)
        sums[m] += skin->moments[taxel * CONTACTS_MOMENTS + m] * pressure_pa;
}

/* Adds pressed taxels beside contacts to these. */
static void add_rim(const struct contacts_skin *skin, const float *pressure_pa,
                    const struct contacts_kept *kept, double *sums)
{
    const int32_t *place = kept->place;

    for (size_t i = 0; i < skin->taxels; i++) {
        int32_t beside = NONE;
        if (place[i] >= 0 || !exceeds(pressure_pa, kept, i, skin->rim_pa))
            continue;
        for (size_t n = 0; n < skin->near; n++) {
            int32_t j = skin->neighbours[i * skin->near + n];
            if (j >= 0 && (size_t)j < skin->taxels && place[j] > beside)
                beside = place[j];
        }
        if (beside >= 0)
            add(skin, i, pressure_pa[i], sums + (size_t)beside * CONTACTS_SUMS);
    }
}

size_t contacts_gather(const struct contacts_skin *skin, const float *pressure_pa, const uint8_t *status,
                       const struct contacts_kept *kept, const struct contacts_found *found)
{
    size_t taxels = skin->taxels;
    int32_t *label = kept->scratch, *number = label + taxels, *cursor = number + taxels;
    int any = note(skin, pressure_pa, status, kept, found->tally);

    found->starts[0] = 0;
    if (any < 0)
        return 0;
    size_t components = connect(skin, pressure_pa, kept, label, cursor);
    if (components == SIZE_MAX)
        return SIZE_MAX;
    int32_t count = rank(skin, pressure_pa, label, kept, components, number, cursor);
    memset(found->starts, 0, ((size_t)count + 1) * sizeof *found->starts);
    for (size_t i = 0; i < taxels; i++) {
        label[i] = label[i] < 0 ? NONE : number[label[i]];
        if (label[i] >= 0)
            found->starts[label[i] + 1]++;
    }
    for (int32_t c = 0; c < count; c++) {
        found->starts[c + 1] += found->starts[c];
        cursor[c] = found->starts[c];
        memset(found->sums + (size_t)c * CONTACTS_SUMS, 0, CONTACTS_SUMS * sizeof(double));
        found->peak_pa[c] = -INFINITY;
        found->saturated[c] = found->lower_bound[c] = found->torn[c] = 0;
    }
    for (size_t i = 0; i < taxels; i++) {
        int32_t c = label[i], before = kept->place[i];
        kept->place[i] = c;
        if (c < 0)
            continue;
        double *sums = found->sums + (size_t)c * CONTACTS_SUMS;
        int notes = kept->notes[i];
        found->taxels[cursor[c]] = (int32_t)i;
        found->before[cursor[c]++] = before;
        found->tally[3] += before != c;
        add(skin, i, pressure_pa[i], sums);
        sums[CONTACTS_MOMENTS] += skin->moments[i * CONTACTS_MOMENTS];
        found->peak_pa[c] = fmaxf(found->peak_pa[c], pressure_pa[i]);
        for (size_t n = 0; any && n < skin->near; n++)
            notes |= kept->notes[skin->neighbours[i * skin->near + n]];
        found->saturated[c] |= (status[i] & skin->saturated) != 0;
        found->lower_bound[c] |= (notes & DIM) != 0;
        found->torn[c] |= (notes & CHANGED) != 0;
    }
    add_rim(skin, pressure_pa, kept, found->sums);
    return (size_t)count;
}
