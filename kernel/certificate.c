// SPDX-License-Identifier: Apache-2.0

#include "certifier.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sums.h"

#define HALF_NORMAL 0.8   /* mean of |x| of a normal variable of deviation 1, √(2/π) */
#define HALF_SCATTER 0.6  /* and its deviation, √(1 − 2/π) */

static const int SHIFTS[] = {-2, -1, 1, 2};
#define SHIFT_COUNT (sizeof SHIFTS / sizeof *SHIFTS)

struct certifier *certifier_new(const struct code *code, const struct certificate_limits *limits, float *expected,
                                const uint8_t *broken)
{
    struct certifier *certifier = calloc(1, sizeof *certifier);
    size_t chips = code->bits * code->order, nodes = code->nodes, offsets = code->scrambled ? chips : 0;

    if (!certifier)
        return NULL;
    const size_t per_skin = 3 * code->order + 3 * nodes, per_frame = 6 * chips + 2 * CERTIFICATE_SIDE + code->bits;
    float *floats = calloc(per_frame + per_skin + offsets, sizeof *floats);
    int32_t *ints = calloc(2 * nodes, sizeof *ints);
    *certifier = (struct certifier){.code = code, .limits = *limits, .expected = expected, .broken = broken,
                                    .rows = floats};
    certifier->measures.signs = ints;
    if (!(floats && ints)) {
        certifier_free(certifier);
        return NULL;
    }
    certifier->model = floats + chips;
    certifier->work = certifier->model + chips;
    certifier->other = certifier->work + chips;
    certifier->without = certifier->other + chips;
    certifier->padded = certifier->without + chips;
    certifier->offset = certifier->padded + chips + 2 * CERTIFICATE_SIDE;
    certifier->power = certifier->offset + code->bits;
    certifier->most = certifier->power + code->order;
    certifier->mean = certifier->most + code->order;
    certifier->measures.weakest = certifier->mean + code->order;
    certifier->measures.strongest = certifier->measures.weakest + nodes;
    certifier->measures.squares = certifier->measures.strongest + nodes;
    certifier->measures.weakest_bit = ints + nodes;
    if (code->scrambled) {
        certifier->ones = certifier->measures.squares + nodes;
        for (size_t i = 0; i < chips; i++)
            certifier->ones[i] = 1;
        certifier_rows(code, certifier->ones, certifier->ones);
    }
    return certifier;
}

void certifier_free(struct certifier *certifier)
{
    if (!certifier)
        return;
    free(certifier->rows);
    free(certifier->measures.signs);
    free(certifier);
}

/* By the cube root of Wilson and Hilferty 1931. */
double certificate_chance(double count, double deviations)
{
    double spread = 2 / (9 * count), root = 1 - spread + deviations * sqrt(spread);

    return root * root * root;
}

VECTORS double certificate_energy(const struct certificate_limits *limits, const struct certificate_residue *residue,
                          double *power)
{
    const size_t chips = residue->bits * residue->order;
    double noise = residue->noise_v2, most = 0, tiny = 1e-12 * residue->swing * residue->swing;

    *power = 0;
    for (size_t bit = 0; bit < residue->bits; bit++) {
        double of_bit = sums_power(residue->left + bit * residue->order, residue->order) -
                        residue->better * (double)residue->order;
        most = fmax(most, of_bit);
        *power += of_bit;
    }
    most *= (double)residue->bits / residue->free;
    *power = fmax(*power / residue->free, tiny);
    double frame = *power / (noise * certificate_chance(residue->free, limits->deviations) + residue->more);
    double bit = most / (noise * certificate_chance((double)residue->order, limits->deviations) +
                         limits->bit * residue->more);
    double edges = limits->chip * residue->swing * (1 + 0.3 * sqrt((double)residue->speakers));
    double chip = certifier_greatest(residue->left, chips) / ((limits->deviations + 1) * sqrt(*power) + edges);
    return fmax(frame, fmax(bit, chip));
}

/* The same of a frame of this certifier. */
static double energy(const struct certifier *certifier, const struct reading *reading)
{
    const struct code *code = certifier->code;
    struct certificate_residue residue = {
        .left = left_of(certifier), .bits = code->bits, .order = code->order, .speakers = reading->speakers,
        .free = reading->free, .noise_v2 = reading->view->noise_v2, .more = reading->more, .swing = reading->swing};
    double power;

    return certificate_energy(&certifier->limits, &residue, &power);
}

/* Atoms in place: the row on which most is left. */
static double row_atoms(const struct certifier *certifier, const struct reading *reading)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    size_t from = code->first > 0 && !code->scrambled; /* offsets are on row 0 */
    double chance = certificate_chance((double)code->bits, limits->deviations) * reading->left / (double)code->order;
    double share = limits->row * reading->swing;

    return certifier_greatest(certifier->power + from, code->order - from) / ((double)code->bits * fmax(share * share, chance));
}

double certifier_least_worse(const struct certifier *certifier, const struct reading *reading, double amplitude)
{
    return 2 * certifier->limits.log_odds * reading->left + certifier->limits.better * amplitude * amplitude;
}

/* Whether any delay may make a word a silent node's, by the most that such a row can hold: its shares of the word, and
 * what is left, V RMS. */
static bool any_near_twin(const struct certifier *certifier, const struct reading *reading, const struct words *words,
                          double left)
{
    const struct code *code = certifier->code;
    const double chips = (double)(code->bits * code->order), order = (double)code->order;

    for (size_t i = 0; reading->speakers < code->nodes && i < code->twin_count; i++) {
        const struct code_twin *twin = &code->twins[i];
        if (!words->active[twin->sent] || words->active[twin->alike])
            continue;
        double here = (double)words->amplitude[twin->sent], lag = (double)abs(twin->shift);
        double share = (double)(fabsf(twin->share) + fabsf(twin->wrap)) * order / (order - lag);
        double there = here * share + left;
        double worse = chips * (here * here - there * there) + lag * here * here;
        if (worse < certifier_least_worse(certifier, reading, here))
            return true;
    }
    return false;
}

/* Mean of the levels on a row, V, from which on they are no noise, but of a node of this amplitude out of its place. */
static double least_atom(const struct certifier *certifier, double left, double amplitude)
{
    const struct code *code = certifier->code;
    double scatter = HALF_NORMAL + HALF_SCATTER * certifier->limits.deviations / sqrt((double)code->bits);
    double noise = scatter * sqrt(left / (double)code->order);

    return fmax(certifier->limits.atom * amplitude, noise);
}

/* Atoms out of place: what is left, read early or late, on the rows of all nodes; and, of codes that are not
 * scrambled, words that may be another node's which is early or late. */
VECTORS static void shifted_atoms(struct certifier *certifier, const struct reading *reading, const struct words *words,
                          double *atoms, double *rivals)
{
    const struct code *code = certifier->code;
    const size_t chips = code->bits * code->order;
    const struct code_twin *next = code->twins, *end = next + code->twin_count;
    double least = least_atom(certifier, reading->left, reading->least);

    for (size_t i = 0; i < CERTIFICATE_SIDE; i++) {
        const float *beside = certifier->beside + reading->side;
        float before = beside[(ptrdiff_t)i - CERTIFICATE_SIDE], after = beside[i];
        certifier->padded[i] = isnan(before) ? 0 : before;
        left_of(certifier)[chips + i] = isnan(after) ? 0 : after;
    }
    /* No row holds more than all that is left; nor has a twin more than its share of the word, and that. */
    double hidden = sums_power(certifier->padded, chips + 2 * CERTIFICATE_SIDE) / (double)chips;
    if (hidden < least * least && !any_near_twin(certifier, reading, words, sqrt(hidden))) {
        *atoms = sqrt(hidden) / least;
        return;
    }
    for (size_t shift = 0; shift < SHIFT_COUNT; shift++) {
        float *rows = certifier->work;
        certifier_rows(code, left_of(certifier) + SHIFTS[shift], rows);
        certifier_means(rows + code->first, code->order, code->bits, code->nodes, certifier->mean);
        *atoms = fmax(*atoms, certifier_greatest(certifier->mean, code->nodes) / least);
        for (; next < end && next->shift == SHIFTS[shift]; next++)
            if (words->active[next->sent] && (next->alike == next->sent || !words->active[next->alike]))
                *rivals = fmax(*rivals, certifier_twin(certifier, reading, next, rows, words->amplitude[next->sent]));
    }
}

/* Rest: chips beside the frame, and how the offset moves from bit to bit. Edges that are off put a share of the
 * frame's outer chips into those next to them. */
static double rest(const struct certifier *certifier, const struct reading *reading)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    const double first = fabs((double)certifier->model[0]), bits = (double)code->bits;
    const double last = fabs((double)certifier->model[code->bits * code->order - 1]);
    double least = limits->deviations * sqrt(reading->view->noise_v2) + limits->beside * reading->least, most = 0;
    double mean = 0, variance = 0;

    for (size_t i = 0; i < CERTIFICATE_SIDE; i++) {
        double before = fabs((double)certifier->beside[reading->side - 1 - i]);
        double after = fabs((double)certifier->beside[reading->side + i]);
        double edges = i ? 0 : limits->left_of_word;
        most = isnan(before) ? most : fmax(most, before / (least + edges * first));
        most = isnan(after) ? most : fmax(most, after / (least + edges * last));
    }
    for (size_t bit = 0; bit < code->bits; bit++)
        mean += (double)certifier->offset[bit] / bits;
    for (size_t bit = 0; bit < code->bits; bit++)
        variance += ((double)certifier->offset[bit] - mean) * ((double)certifier->offset[bit] - mean) / bits;
    return fmax(most, sqrt(variance) / (limits->moves * reading->swing));
}

void certifier_read(struct certifier *certifier, const struct certificate_view *view, const struct words *words,
                    struct certificate *certificate)
{
    const struct code *code = certifier->code;
    const struct reading reading = certifier_residue(certifier, view, words);
    const struct certificate_limits *limits = &certifier->limits;
    const double row_noise_v = sqrt(reading.left / (double)code->order);
    double *value = certificate->value, atoms = 0, rivals = 0;

    words_decide(&certifier->measures, code, certifier->expected, (float)(1 / fmax(row_noise_v, 1e-12)),
                 &certifier->limits.words, words);
    bool any_faint = certifier_doubt(certifier, &reading, words, &value[CLAUSE_WORDS]);
    value[CLAUSE_ENERGY] = energy(certifier, &reading);
    certifier->edges = limits->edges * reading.weakest * sqrt((double)reading.speakers);
    if (view->is_compared)
        certifier->beyond = certifier_beyond_edges(certifier, view->side);
    certifier->worse = 2 * certifier->limits.log_odds * reading.shown / reading.free +
                       certifier->limits.better * reading.weakest * reading.weakest;
    value[CLAUSE_REST] = rest(certifier, &reading);
    shifted_atoms(certifier, &reading, words, &atoms, &rivals);
    value[CLAUSE_ATOMS] = fmax(atoms, row_atoms(certifier, &reading));
    for (int sign = -1;
         sign <= 1 && !code->scrambled && reading.speakers && reading.speakers <= certifier->limits.few; sign += 2)
        rivals = fmax(rivals, certifier_shifted_frames(certifier, &reading, words, sign));
    value[CLAUSE_RIVALS] = rivals;
    certificate->left = reading.left;
    certificate->row_noise_v = row_noise_v;
    certificate->swing = reading.swing;
    certificate->speakers = reading.speakers;
    certifier_conclude(certifier, &reading, words, any_faint, certificate);
}

/* What the halves of a chip differ by, on the rows of nodes: a node that is half a chip late, and whose row alternates,
 * shows nowhere else. */
VECTORS void certifier_split(struct certifier *certifier, const float *split, struct certificate *certificate)
{
    const struct code *code = certifier->code;
    const size_t chips = code->bits * code->order;
    const double least = least_atom(certifier, certificate->left, certificate->swing);
    double most = sqrt(sums_power(split, chips) / (double)chips), *value = &certificate->value[CLAUSE_ATOMS];

    if (most >= least) { /* no row holds more than all */
        certifier_rows(code, split, certifier->work);
        certifier_means(certifier->work + code->first, code->order, code->bits, code->nodes, certifier->mean);
        most = certifier_greatest(certifier->mean, code->nodes);
    }
    *value = fmax(*value, most / least);
}

double certificate_worst(const struct certificate *certificate)
{
    double worst = certificate->value[0];

    for (size_t i = 1; i < CERTIFICATE_CLAUSES; i++)
        worst = certificate->value[i] > worst ? certificate->value[i] : worst;
    return worst;
}
