// SPDX-License-Identifier: Apache-2.0

#include "certificate.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sums.h"

#define SIDE 2            /* chips by which nodes may be off, and beside a frame that are asked to be at rest */
#define HALF_NORMAL 0.8   /* mean of |x| of a normal variable of deviation 1, √(2/π) */
#define HALF_SCATTER 0.6  /* and its deviation, √(1 − 2/π) */
#define HIDDEN_NODE 0.5   /* A²: half of what a node leaves that fits no row, however much others leave */

static const int SHIFTS[] = {-2, -1, 1, 2};
#define SHIFT_COUNT (sizeof SHIFTS / sizeof *SHIFTS)

struct certifier {
    const struct code *code;
    struct certificate_limits limits;
    float *expected;
    const uint8_t *broken;
    float *rows;   /* (k, N) of the frame */
    float *model;  /* (k, N) chips of its words */
    float *padded; /* (k, N) what they leave over, and SIDE chips on either side */
    float *work, *other, *without; /* (k, N) */
    float *level;  /* (k) of each bit, V */
    bool leaks;    /* what leaks from chip to chip is taken off what is left of them */
    float *power, *most; /* (N) of what is left on a row: sum of squares, greatest square */
    float *mean;   /* (N) */
    float beside[CERTIFICATE_BESIDE], leaked[CERTIFICATE_BESIDE]; /* V, beside the frame; with what leaks there */
    double edges;          /* V, by which edges may put a chip off */
    double beyond, worse;  /* V²: sum of squares of what is left beyond that; by which that of a rival must be more */
    struct words_measures measures;
};

static float *left_of(const struct certifier *certifier)
{
    return certifier->padded + SIDE;
}

struct certifier *certifier_new(const struct code *code, const struct certificate_limits *limits, float *expected,
                                const uint8_t *broken)
{
    struct certifier *certifier = calloc(1, sizeof *certifier);
    size_t chips = code->bits * code->order, nodes = code->nodes;

    if (!certifier)
        return NULL;
    float *floats = calloc(6 * chips + 2 * SIDE + code->bits + 3 * code->order + 3 * nodes, sizeof *floats);
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
    certifier->level = certifier->padded + chips + 2 * SIDE;
    certifier->power = certifier->level + code->bits;
    certifier->most = certifier->power + code->order;
    certifier->mean = certifier->most + code->order;
    certifier->measures.weakest = certifier->mean + code->order;
    certifier->measures.strongest = certifier->measures.weakest + nodes;
    certifier->measures.squares = certifier->measures.strongest + nodes;
    certifier->measures.weakest_bit = ints + nodes;
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

/* ---- words ------------------------------------------------------------------------------------- */

/* Words of constant amplitude: rows that hold ±amplitude where a node spoke, (k, N); what they hold where it is
 * broken. */
VECTORS static void make_symbols(const struct code *code, const float *restrict rows, const float *restrict amplitude,
                                 const uint8_t *restrict active, const uint8_t *restrict broken,
                                 float *restrict symbols)
{
    memset(symbols, 0, code->bits * code->order * sizeof *symbols);
    for (size_t at = code->first; at < code->bits * code->order; at += code->order)
        for (size_t i = 0; i < code->nodes; i++) {
            float level = rows[at + i], word = active[i] ? copysignf(amplitude[i], level) : 0;
            symbols[at + i] = broken[i] ? level : word;
        }
}

/* Who spoke, and how many; weakest: V, of those. */
static size_t find_speakers(struct certifier *certifier, double noise, const struct words *words, double *weakest)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    float loudest, usual = words_usual(words->amplitude, code->nodes, (float)limits->loud_share, &loudest);
    float *expected = certifier->expected, least = (float)limits->loud_share * loudest;
    size_t speakers = 0;

    if (isnan(code->swing)) {
        float floor = (float)(limits->unknown_noise * sqrt(noise / (double)code->order));
        usual = fmaxf(fmaxf(usual, floor / code->active_share), 1e-9f);
        for (size_t i = 0; i < code->nodes; i++)
            expected[i] = usual;
    }
    *weakest = INFINITY;
    for (size_t i = 0; i < code->nodes; i++) {
        float amplitude = words->amplitude[i];
        words->active[i] = amplitude > code->active_share * expected[i] && amplitude > least;
        speakers += words->active[i];
        if (words->active[i] && (double)amplitude < *weakest)
            *weakest = (double)amplitude;
    }
    return speakers;
}

/* ---- the rest ---------------------------------------------------------------------------------- */

/* What the words leave over, without the level of each bit. */
VECTORS static void leave(const struct certifier *certifier, const float *restrict chips, float *restrict left)
{
    const size_t bits = certifier->code->bits, order = certifier->code->order;
    const bool has_level = certifier->code->first > 0 || certifier->code->scrambled;
    const float *restrict model = certifier->model;

    for (size_t bit = 0; bit < bits; bit++, chips += order, model += order, left += order) {
        const size_t whole = order & ~(size_t)7;
        floats8 sums = {0};
        float sum = 0;
        for (size_t i = 0; i < order; i++)
            left[i] = chips[i] - model[i];
        for (size_t i = 0; i < whole; i += 8)
            sums += *(const floats8 *)(left + i);
        for (size_t i = whole; i < order; i++)
            sum += left[i];
        for (size_t lane = 0; lane < 8; lane++)
            sum += sums[lane];
        float level = has_level ? sum / (float)order : 0;
        for (size_t i = 0; i < order; i++)
            left[i] -= level;
        certifier->level[bit] = level;
    }
}

VECTORS static void take_off(const float *from, float share, size_t size, float *left)
{
    for (size_t i = 0; i < size; i++)
        left[i] -= share * from[i];
}

/* Takes off what leaks from the chip before and the one after, the same share for all; least squares of two. False,
 * and nothing is taken off, where they explain no more than chance does. chip_before, chip_after: next to the frame. */
static bool take_leakage(const struct certifier *certifier, float *chip_before, float *chip_after)
{
    const float *model = certifier->model;
    float *left = left_of(certifier);
    const size_t chips = certifier->code->bits * certifier->code->order;
    const double most = certifier->limits.leak, by_chance = 2 * certifier->limits.log_odds / (double)chips;
    double before = sums_power(model, chips - 1), after = sums_power(model + 1, chips - 1);
    double both = sums_dot(model, model + 2, chips - 2);
    double of_before = sums_dot(model, left + 1, chips - 1), of_after = sums_dot(model + 1, left, chips - 1);
    double tiny = 1e-9 * (before + after), determinant = (before + tiny) * (after + tiny) - both * both;

    if (!(determinant > 0))
        return false;
    double late = ((after + tiny) * of_before - both * of_after) / determinant;
    double early = ((before + tiny) * of_after - both * of_before) / determinant;
    if (late * of_before + early * of_after < by_chance * sums_power(left, chips))
        return false;
    late = fmin(fmax(late, -most), most);
    early = fmin(fmax(early, -most), most);
    take_off(model, (float)late, chips - 1, left + 1);
    take_off(model + 1, (float)early, chips - 1, left);
    *chip_before -= (float)early * model[0];
    *chip_after -= (float)late * model[chips - 1];
    return true;
}

/* The chips beside a frame without the level that goes on there; of unipolar drive it ends with the words. */
static void level_beside(const struct certifier *certifier, size_t side, float *beside)
{
    const struct code *code = certifier->code;
    const float *level = certifier->level;
    const size_t last = code->bits - 1;

    if (code->unipolar)
        return;
    float before = level[0] + 0.5f * (level[0] - level[1]);
    float after = level[last] + 0.5f * (level[last] - level[last - 1]);
    for (size_t i = 0; i < side; i++) {
        beside[i] -= before;
        beside[side + i] -= after;
    }
}

VECTORS static double greatest(const float *values, size_t size)
{
    float most = 0;

    for (size_t i = 0; i < size; i++)
        most = fabsf(values[i]) > most ? fabsf(values[i]) : most;
    return (double)most;
}

/* Mean |x| of each of `size` columns of k rows, `step` apart. */
VECTORS static void mean_of_columns(const float *restrict rows, size_t step, size_t bits, size_t size,
                                    float *restrict mean)
{
    memset(mean, 0, size * sizeof *mean);
    for (size_t bit = 0; bit < bits; bit++, rows += step)
        for (size_t i = 0; i < size; i++)
            mean[i] += fabsf(rows[i]);
    for (size_t i = 0; i < size; i++)
        mean[i] /= (float)bits;
}

VECTORS static void squares_of_columns(const float *restrict rows, size_t order, size_t bits, float *restrict power,
                                       float *restrict most)
{
    memset(power, 0, order * sizeof *power);
    memset(most, 0, order * sizeof *most);
    for (size_t bit = 0; bit < bits; bit++, rows += order)
        for (size_t i = 0; i < order; i++) {
            float square = rows[i] * rows[i];
            power[i] += square;
            most[i] = square > most[i] ? square : most[i];
        }
}

/* ---- the clauses ------------------------------------------------------------------------------- */

/* What is known of a frame while its clauses are computed; powers in V². */
struct reading {
    const struct certificate_view *view;
    double swing, weakest, least; /* V: of a node; of the words; the less of both */
    double free;                  /* degrees of freedom that the words leave to noise */
    double total, left;           /* sum of squares of what is left, and over `free` */
    double more;                  /* that edges of the words may leave */
    size_t speakers;
    const float *before, *after;  /* what is left of `side` chips beside the frame; NaN where not seen */
    const float *shown_before, *shown_after; /* of these, with what leaks from the frame, */
    double shown;                 /* and the sum of squares of what is left with leakage, there and in the frame */
    size_t side;
};

/* By the cube root of Wilson and Hilferty 1931. */
double certificate_chance(double count, double deviations)
{
    double spread = 2 / (9 * count), root = 1 - spread + deviations * sqrt(spread);

    return root * root * root;
}

double certificate_energy(const struct certificate_limits *limits, const struct certificate_residue *residue,
                          double *power)
{
    const size_t chips = residue->bits * residue->order;
    double noise = residue->noise, most = 0, tiny = 1e-12 * residue->swing * residue->swing;

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
    double chip = greatest(residue->left, chips) / ((limits->deviations + 1) * sqrt(*power) + edges);
    return fmax(frame, fmax(bit, chip));
}

/* The same of a frame of this certifier. */
static double energy(const struct certifier *certifier, const struct reading *reading)
{
    const struct code *code = certifier->code;
    struct certificate_residue residue = {
        .left = left_of(certifier), .bits = code->bits, .order = code->order, .speakers = reading->speakers,
        .free = reading->free, .noise = reading->view->noise, .more = reading->more, .swing = reading->swing};
    double power;

    return certificate_energy(&certifier->limits, &residue, &power);
}

/* Mean square of noise on a row, V²: what is left, or less where rows that no node has show less. */
static double row_noise(const struct certifier *certifier, const struct reading *reading)
{
    const struct code *code = certifier->code;
    double noise = reading->left / (double)code->order, spare = 0;

    if (code->spare_count < 2)
        return noise;
    for (size_t i = 0; i < code->spare_count; i++)
        spare += (double)certifier->power[code->spare + i];
    return fmin(noise, spare / (double)(code->bits * code->spare_count));
}

/* Marks silent nodes on whose rows there is more than noise; whether there are any. */
static bool find_faint(const struct certifier *certifier, const struct reading *reading, const struct words *words)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    double noise = row_noise(certifier, reading), bits = (double)code->bits, swing = reading->swing;
    double chance = certificate_chance(bits, limits->faint_deviations) * noise;
    float least = (float)(bits * fmax(limits->faint * limits->faint * swing * swing, chance));
    float one = (float)fmax(limits->faint_bit * limits->faint_bit * swing * swing,
                            limits->deviations * limits->deviations * noise);
    const float *power = certifier->power + code->first, *most = certifier->most + code->first;
    int any = 0;

    for (size_t i = 0; i < code->nodes; i++) {
        words->faint[i] = (uint8_t)((words->active[i] ^ 1) & ((power[i] > least) | (most[i] > one)));
        any |= words->faint[i];
    }
    return any;
}

/* ρ of faint nodes: what is on their own rows is none of the noise on these. */
static void measure_faint(const struct certifier *certifier, const struct reading *reading, const struct words *words)
{
    const struct code *code = certifier->code;
    const double order = (double)code->order, tiny = 1e-12 * reading->swing * reading->swing;

    for (size_t i = 0; i < code->nodes; i++)
        if (words->faint[i]) {
            double own = (double)certifier->power[code->first + i] * order;
            double noise = fmax((reading->total - own) / fmax(reading->free - (double)code->bits, 1), tiny);
            words->rho[i] = words->amplitude[i] / (float)sqrt(noise / order);
        }
}

/* Atoms in place: the row on which most is left. */
static double row_atoms(const struct certifier *certifier, const struct reading *reading)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    size_t from = code->first > 0 && !code->scrambled; /* the level is on row 0 */
    double chance = certificate_chance((double)code->bits, limits->deviations) * reading->left / (double)code->order;
    double share = limits->row * reading->swing;

    return greatest(certifier->power + from, code->order - from) / ((double)code->bits * fmax(share * share, chance));
}

/* Sum of squares by which a rival must leave more, V², so that a word of this amplitude, V, is certain. */
static double least_worse(const struct certifier *certifier, const struct reading *reading, double amplitude)
{
    return 2 * certifier->limits.log_odds * reading->left + certifier->limits.better * amplitude * amplitude;
}

/* Whether a delay makes one of these words that of another node, whose row is `alike`, as likely. rows: of what is
 * left, read later by the twin's shift. Its value, of which 1 is the limit. */
static double twin(const struct certifier *certifier, const struct reading *reading, const struct code_twin *twin,
                   const float *rows, float amplitude)
{
    const struct code *code = certifier->code;
    const size_t bits = code->bits, order = code->order, lag = (size_t)abs(twin->shift);
    const float *sent = certifier->rows + code->first + twin->sent;
    const float *beside = twin->shift > 0 ? reading->after : reading->before + reading->side - lag;
    bool seen = !isnan(beside[0]) && !isnan(beside[lag - 1]);
    double sum = 0;

    for (size_t bit = 0; bit < bits; bit++) {
        float level = rows[bit * order + code->first + (size_t)twin->alike];
        level += copysignf(amplitude, sent[bit * order]) * twin->share;
        size_t other = twin->shift > 0 ? bit + 1 : bit - 1;
        if (other < bits)
            level += copysignf(amplitude, sent[other * order]) * twin->wrap;
        else if (!seen)
            level *= (float)order / (float)(order - lag);
        sum += fabs((double)level);
    }
    double there = sum / (double)bits, here = (double)amplitude;
    /* The chips at the other end of the frame, in which that one would be at rest. */
    double worse = (double)(bits * order) * (here * here - there * there) + (double)lag * here * here;
    double least = least_worse(certifier, reading, here);
    return worse > least * 1e-6 ? least / worse : 1e6;
}

/* Whether any delay may make a word another node's, by the most that such a row can hold: its shares of the word, and
 * what is left, V RMS. */
static bool any_near_twin(const struct certifier *certifier, const struct reading *reading, const struct words *words,
                          double left)
{
    const struct code *code = certifier->code;
    const double chips = (double)(code->bits * code->order), order = (double)code->order;
    bool any = false;

    for (size_t i = 0; i < code->twin_count && !any; i++) {
        const struct code_twin *twin = &code->twins[i];
        double here = (double)words->amplitude[twin->sent], lag = (double)abs(twin->shift);
        double share = (double)(fabsf(twin->share) + fabsf(twin->wrap)) * order / (order - lag);
        double there = here * share + left;
        double worse = chips * (here * here - there * there) + lag * here * here;
        any = words->active[twin->sent] && !words->active[twin->alike] &&
              worse < least_worse(certifier, reading, here);
    }
    return any;
}

/* Mean of the levels on a row, V, from which on they are no noise, but of a node of this amplitude out of its place. */
static double least_atom(const struct certifier *certifier, const struct reading *reading, double amplitude)
{
    const struct code *code = certifier->code;
    double scatter = HALF_NORMAL + HALF_SCATTER * certifier->limits.deviations / sqrt((double)code->bits);
    double noise = scatter * sqrt(reading->left / (double)code->order);

    return fmax(certifier->limits.atom * amplitude, noise);
}

/* Atoms out of place: what is left, read early or late, on the rows of all nodes; and, of codes that are not
 * scrambled, words that may be another node's which is early or late. */
static void shifted_atoms(struct certifier *certifier, const struct reading *reading, const struct words *words,
                          double *atoms, double *rivals)
{
    const struct code *code = certifier->code;
    const size_t chips = code->bits * code->order;
    const struct code_twin *next = code->twins, *end = next + code->twin_count;
    double least = least_atom(certifier, reading, reading->least);

    for (size_t i = 0; i < SIDE; i++) {
        float before = reading->before[reading->side - SIDE + i], after = reading->after[i];
        certifier->padded[i] = isnan(before) ? 0 : before;
        left_of(certifier)[chips + i] = isnan(after) ? 0 : after;
    }
    /* No row holds more than all that is left; nor has a twin more than its share of the word, and that. */
    double hidden = sums_power(certifier->padded, chips + 2 * SIDE) / (double)chips;
    if (hidden < least * least && !any_near_twin(certifier, reading, words, sqrt(hidden))) {
        *atoms = sqrt(hidden) / least;
        return;
    }
    for (size_t shift = 0; shift < SHIFT_COUNT; shift++) {
        float *rows = certifier->work;
        code_rows(code, left_of(certifier) + SHIFTS[shift], rows);
        mean_of_columns(rows + code->first, code->order, code->bits, code->nodes, certifier->mean);
        *atoms = fmax(*atoms, greatest(certifier->mean, code->nodes) / least);
        for (; next < end && next->shift == SHIFTS[shift]; next++)
            if (words->active[next->sent] && (next->alike == next->sent || !words->active[next->alike]))
                *rivals = fmax(*rivals, twin(certifier, reading, next, rows, words->amplitude[next->sent]));
    }
}

/* Atoms within chips: what the halves of a chip differ by, on the rows of nodes. A node that is half a chip late, and
 * whose row alternates, shows nowhere else. */
static double split_atoms(struct certifier *certifier, const struct reading *reading)
{
    const struct code *code = certifier->code;
    const size_t chips = code->bits * code->order;
    const float *split = reading->view->split;
    const double least = least_atom(certifier, reading, reading->swing);
    float *rows = certifier->work;

    if (!split)
        return 0;
    double power = sums_power(split, chips) / (double)chips;
    if (power < least * least) /* no row holds more than all */
        return sqrt(power) / least;
    code_rows(code, split, rows);
    mean_of_columns(rows + code->first, code->order, code->bits, code->nodes, certifier->mean);
    return greatest(certifier->mean, code->nodes) / least;
}

/* Sum of squares that words of one amplitude leave of rows (k, N), and whether they are others than a frame's. */
static double rows_left(struct certifier *certifier, const float *rows, const struct words *words, bool *differ)
{
    const struct code *code = certifier->code;
    float *mean = certifier->mean, loudest;
    size_t from = code->first > 0 && !code->scrambled;
    double total = 0;

    mean_of_columns(rows + code->first, code->order, code->bits, code->nodes, mean);
    float usual = words_usual(mean, code->nodes, (float)certifier->limits.loud_share, &loudest);
    if (!isnan(code->swing))
        usual = fminf(loudest, code->swing);
    float least = fmaxf(code->active_share * usual, (float)certifier->limits.loud_share * loudest);
    for (size_t bit = 0; bit < code->bits; bit++)
        total += sums_power(rows + bit * code->order + from, code->order - from);
    *differ = false;
    for (size_t i = 0; i < code->nodes; i++) {
        bool spoke = mean[i] > least;
        if (words)
            *differ |= spoke != words->active[i];
        mean[i] = spoke ? mean[i] : 0;
        total -= (double)code->bits * (double)mean[i] * (double)mean[i];
        for (size_t bit = 0; words && spoke && !*differ && bit < code->bits; bit++) {
            size_t at = bit * code->order + code->first + i;
            *differ = (rows[at] > 0) != (certifier->rows[at] > 0);
        }
    }
    return total * (double)code->order;
}

/* The frame's chips without levels, read later by a shift; chips beside the frame that were not seen are those that
 * the words would have there. */
static void read_shifted(struct certifier *certifier, const struct reading *reading, int shift, float *rows)
{
    const struct code *code = certifier->code;
    const size_t chips = code->bits * code->order;
    const size_t lag = (size_t)abs(shift);
    const float *beside = shift > 0 ? reading->shown_after : reading->shown_before + reading->side - lag;
    const size_t hidden = shift > 0 ? chips - lag : 0;
    bool seen = true;

    for (size_t i = 0; i < chips; i++) {
        size_t from = i + (size_t)(ptrdiff_t)shift;
        if (from < chips)
            rows[i] = reading->view->chips[from] - certifier->level[from / code->order];
    }
    for (size_t i = 0; i < lag; i++) {
        seen &= !isnan(beside[i]);
        rows[hidden + i] = isnan(beside[i]) ? 0 : beside[i];
    }
    if (!seen) {
        certifier_model(certifier, rows, certifier->other);
        for (size_t i = 0; i < lag; i++)
            rows[hidden + i] = isnan(beside[i]) ? certifier->other[hidden + i] : beside[i];
    }
    code_rows(code, rows, rows);
}

/* Sum of squares of chips beside the frame, where seen. */
static double sum_beside(const float *beside, size_t count)
{
    double sum = 0;

    for (size_t i = 0; i < count; i++)
        sum += isnan(beside[i]) ? 0 : (double)beside[i] * (double)beside[i];
    return sum;
}

/* Rivals: the frame some chips beside its place, or from one of its bits on, where a chip was taken twice or not at
 * all. Shifts that leave out louder chips than a rival may are none. sign: later, or earlier. */
static double shifted_frames(struct certifier *certifier, const struct reading *reading, const struct words *words,
                             int sign)
{
    const struct code *code = certifier->code;
    const size_t chips = code->bits * code->order, side = reading->side;
    const float *read = reading->view->chips, *level = certifier->level;
    double cut = 0, value = 0;
    double beside = sum_beside(reading->shown_before, 2 * side);
    double base = reading->shown + certifier->worse;
    bool differ;

    for (size_t lag = 1; lag <= side; lag++) {
        float *rows = certifier->work;
        double chip = sign > 0 ? (double)(read[lag - 1] - level[0])
                               : (double)(read[chips - lag] - level[code->bits - 1]);
        cut += chip * chip;
        if (cut > base)
            break;
        read_shifted(certifier, reading, sign * (int)lag, rows);
        double covered = sum_beside(sign > 0 ? reading->shown_after : reading->shown_before + side - lag, lag);
        double left = rows_left(certifier, rows, words, &differ) + cut + beside - covered;
        if (differ && !reading->view->is_placed)
            value = fmax(value, base / fmax(left, 1e-30));
        for (size_t bit = 1; lag == 1 && bit < code->bits; bit++) {
            memcpy(certifier->other, certifier->rows, bit * code->order * sizeof *rows);
            memcpy(certifier->other + bit * code->order, rows + bit * code->order,
                   (code->bits - bit) * code->order * sizeof *rows);
            left = rows_left(certifier, certifier->other, words, &differ) + beside - covered;
            if (differ)
                value = fmax(value, base / fmax(left, 1e-30));
        }
    }
    return value;
}

/* Rest: chips beside the frame, and how the level moves from bit to bit. Edges that are off put a share of the
 * frame's outer chips into those next to them. */
static double rest(const struct certifier *certifier, const struct reading *reading)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    const double first = fabs((double)certifier->model[0]), bits = (double)code->bits;
    const double last = fabs((double)certifier->model[code->bits * code->order - 1]);
    double least = limits->deviations * sqrt(reading->view->noise) + limits->beside * reading->least, most = 0;
    double mean = 0, variance = 0;

    for (size_t i = 0; i < SIDE; i++) {
        double before = fabs((double)reading->before[reading->side - 1 - i]), after = fabs((double)reading->after[i]);
        double edges = i ? 0 : limits->left_of_word;
        most = isnan(before) ? most : fmax(most, before / (least + edges * first));
        most = isnan(after) ? most : fmax(most, after / (least + edges * last));
    }
    for (size_t bit = 0; bit < code->bits; bit++)
        mean += (double)certifier->level[bit] / bits;
    for (size_t bit = 0; bit < code->bits; bit++)
        variance += ((double)certifier->level[bit] - mean) * ((double)certifier->level[bit] - mean) / bits;
    return fmax(most, sqrt(variance) / (limits->moves * reading->swing));
}

/* Whether a word is weak enough to be a part of one, though its node be known to be weak: a tone makes nodes so. */
static bool any_weak(const struct certifier *certifier, double swing, const struct words *words)
{
    float weak = (float)(certifier->limits.weak * swing);
    int any = 0;

    for (size_t i = 0; i < certifier->code->nodes; i++)
        any |= words->active[i] & (words->amplitude[i] < weak);
    return any;
}

/* Where chips leak into others, or are half a chip off, a row that a delay makes alike holds a part of a word, which
 * counts where its node is known to be weak: there, words that are weaker than such a one, or than a sound one, and
 * have its bits are doubtful. */
static void doubt_parts(const struct certifier *certifier, double swing, const struct words *words)
{
    const struct code *code = certifier->code;
    const int32_t *signs = certifier->measures.signs, all = (int32_t)(UINT32_MAX >> (32 - code->bits));
    const float weak = (float)certifier->limits.weak, sound = (float)swing;

    for (size_t i = 0; i < code->twin_count; i++) {
        const struct code_twin *twin = &code->twins[i];
        int32_t said = twin->share < 0 ? signs[twin->sent] ^ all : signs[twin->sent];
        bool is_part = words->active[twin->sent] && words->active[twin->alike] && said == signs[twin->alike] &&
                       words->amplitude[twin->alike] < weak * fmaxf(words->amplitude[twin->sent], sound);
        words->doubtful[twin->alike] |= is_part;
    }
}

/* Whether the silence of nodes is uncertain: noise is as loud as a word may be, one may hide in it, or a word that is
 * uneven without noise says that there is something else on its row: where that is a second node, also of a broken
 * one. */
static bool hides_nodes(const struct certifier *certifier, const struct reading *reading, const struct words *words,
                        double noise)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    double known = reading->view->noise * certificate_chance(reading->free, limits->deviations);
    double words_left = limits->left_of_word * limits->left_of_word * (double)reading->speakers;
    double most = (limits->hidden + fmin(words_left, HIDDEN_NODE)) * reading->swing * reading->swing;
    int uneven = 0;

    if (noise * limits->silent_rho > reading->swing)
        return true;
    if ((code->scrambled || reading->view->noise <= 0) && reading->left - known > most)
        return true;
    for (size_t i = 0; i < code->nodes; i++)
        uneven |= words->doubled[i] |
                  (words->doubtful[i] & !certifier->broken[i] & (words->rho[i] > limits->words.clear_rho));
    return uneven;
}

/* Whether what is on row 0 may be the line's level, or a step of it: its bits change once at most. */
static bool may_be_level(const struct certifier *certifier)
{
    const struct code *code = certifier->code;
    size_t changes = 0;

    for (size_t bit = 1; bit < code->bits; bit++)
        changes += (certifier->rows[bit * code->order] > 0) != (certifier->rows[(bit - 1) * code->order] > 0);
    return changes <= 1;
}

/* Whether the line shows beside a frame that its level is the one at rest, on both sides as far as it is seen there. */
static bool shows_rest(const struct certifier *certifier, const struct reading *reading)
{
    const struct certificate_limits *limits = &certifier->limits;
    const float *sides[] = {reading->before, reading->after};

    for (size_t side = 0; side < 2; side++) {
        double sum = 0, count = 0;
        for (size_t i = 0; i < reading->side; i++)
            if (!isnan(sides[side][i])) {
                sum += (double)sides[side][i];
                count++;
            }
        double chance = limits->deviations * sqrt(reading->view->noise / fmax(count, 1));
        if (count > 0 && fabs(sum / count) + chance > (double)certifier->code->active_share * reading->swing)
            return false;
    }
    return true;
}

/* What the word of a node leaves on its row on top of one amplitude, V², where that is too much for one; else 0, as
 * where the node is broken, of which nothing is left. */
static double uneven_power(const struct certifier *certifier, const struct reading *reading,
                           const struct words *words, size_t node)
{
    double bits = (double)certifier->code->bits, amplitude = (double)words->amplitude[node];
    double share = certifier->limits.row * reading->swing;
    double over = (double)certifier->measures.squares[node] - bits * amplitude * amplitude;

    return words->active[node] && !certifier->broken[node] && over > bits * share * share ? over : 0;
}

/* Whether a frame that leaves too much leaves no more than noise but for the words of few nodes, which are uneven:
 * then it says what is wrong with these. */
static bool is_understood(const struct certifier *certifier, const struct reading *reading, const struct words *words)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    double total = reading->total, uneven = 0;
    double more = limits->left * reading->swing * reading->swing; /* that edges of words as loud as these may leave */
    double noise = reading->view->noise * certificate_chance(reading->free, limits->deviations);

    for (size_t i = 0; i < code->nodes; i++) {
        double amplitude = words->active[i] ? (double)words->amplitude[i] : 0;
        double over = uneven_power(certifier, reading, words, i);
        more += limits->left_of_word * limits->left_of_word * amplitude * amplitude;
        total -= over * (double)code->order;
        uneven += over > 0;
    }
    return uneven <= limits->uneven * (double)(reading->speakers + 1) && total / reading->free < noise + more;
}

/* ρ of the uneven and faint words of a frame that is understood: what is on their rows is none of the noise on these. */
static void measure_odd_ones(const struct certifier *certifier, const struct reading *reading,
                             const struct words *words)
{
    const struct code *code = certifier->code;
    const double order = (double)code->order, bits = (double)code->bits;
    double total = reading->total, free = reading->free;

    for (size_t i = 0; i < code->nodes; i++) {
        double over = uneven_power(certifier, reading, words, i);
        double own = words->faint[i] ? (double)certifier->power[code->first + i] : over;
        total -= own * order;
        free -= own > 0 ? bits : 0;
    }
    double noise = fmax(total / fmax(free, 1), 1e-12 * reading->swing * reading->swing);
    for (size_t i = 0; i < code->nodes; i++)
        if (words->faint[i] || uneven_power(certifier, reading, words, i) > 0)
            words->rho[i] = words->amplitude[i] / (float)sqrt(noise / order);
}

/* Whether a frame in which no word is loud enough is explained by words that are all too weak: then the amplitude
 * that is expected is wrong. Faint nodes get the ρ of such words. */
static bool is_weaker(struct certifier *certifier, const struct reading *reading, const struct words *words)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    bool differ;
    double total = rows_left(certifier, certifier->rows, NULL, &differ), count = 0, power = 0;

    for (size_t i = 0; i < code->nodes; i++) {
        count += certifier->mean[i] > 0;
        power += (double)certifier->mean[i] * (double)certifier->mean[i];
    }
    double left = fmax(total / fmax(reading->free - count, 1), 1e-12 * power);
    double more = (limits->left + limits->left_of_word * limits->left_of_word * count) * power / fmax(count, 1);
    if (count <= 0 || left > reading->view->noise * certificate_chance(reading->free, limits->deviations) + more)
        return false;
    float per_noise = (float)sqrt((double)code->order / left);
    for (size_t i = 0; i < code->nodes; i++)
        words->rho[i] = words->faint[i] ? words->amplitude[i] * per_noise : words->rho[i];
    return true;
}

/* ---- a frame ----------------------------------------------------------------------------------- */

double certifier_left(struct certifier *certifier, const float *chips, double *power)
{
    const struct code *code = certifier->code;
    const double size = (double)(code->bits * code->order);
    bool differ;

    *power = sums_power(chips, code->bits * code->order) / size;
    code_rows(code, chips, certifier->rows);
    for (size_t bit = 0; bit < code->bits && code->unipolar && code->first > 0 && !code->scrambled; bit++) {
        double level = (double)certifier->rows[bit * code->order];
        *power -= level * level / (double)code->bits;
    }
    return rows_left(certifier, certifier->rows, NULL, &differ) / size;
}

void certifier_model(struct certifier *certifier, const float *chips, float *model)
{
    const struct code *code = certifier->code;
    const size_t size = code->bits * code->order, nodes_end = code->first + code->nodes;
    double pedestal = 0;
    bool differ;

    code_rows(code, chips, model);
    rows_left(certifier, model, NULL, &differ);
    for (size_t at = 0; at < size; at += code->order) {
        pedestal += code->unipolar ? (double)model[at] / (double)code->bits : 0;
        for (size_t i = 0; i < code->order; i++) {
            bool is_node = i >= code->first && i < nodes_end;
            model[at + i] = copysignf(is_node ? certifier->mean[i - code->first] : 0, model[at + i]);
        }
    }
    code_chips(code, model, model);
    for (size_t i = 0; code->unipolar && i < size; i++)
        model[i] += (float)pedestal;
}

/* Chips beside a frame without their level and what leaks from it, which is taken off its chips, too. Sum of squares,
 * V², of what is left before that, there and in the frame. */
static double find_beside(struct certifier *certifier, const struct certificate_view *view)
{
    const struct code *code = certifier->code;
    float *beside = certifier->beside;

    memcpy(beside, view->beside, 2 * view->side * sizeof *beside);
    if (code->first > 0 || code->scrambled)
        level_beside(certifier, view->side, beside);
    memcpy(certifier->leaked, beside, 2 * view->side * sizeof *beside);
    double shown = sums_power(left_of(certifier), code->bits * code->order) + sum_beside(beside, 2 * view->side);
    certifier->leaks = take_leakage(certifier, beside + view->side - 1, beside + view->side);
    return shown;
}

/* Sum of squares, V², by which what is left, in the frame and beside it, is more than edges do. */
static double beyond_edges(const struct certifier *certifier, size_t side)
{
    const float *left = left_of(certifier), *beside = certifier->beside, edges = (float)certifier->edges;
    double sum = 0;

    for (size_t i = 0; i < certifier->code->bits * certifier->code->order; i++) {
        double more = (double)fmaxf(fabsf(left[i]) - edges, 0);
        sum += more * more;
    }
    for (size_t i = 0; i < 2 * side; i++) {
        double more = isnan(beside[i]) ? 0 : (double)fmaxf(fabsf(beside[i]) - edges, 0);
        sum += more * more;
    }
    return sum;
}

/* What words leave on rows, (k, N): the frame's without the words', and without the level, which is on row 0. */
VECTORS static void subtract_words(const struct code *code, const float *restrict rows, float *restrict symbols)
{
    for (size_t i = 0; i < code->bits * code->order; i++)
        symbols[i] = rows[i] - symbols[i];
    for (size_t bit = 0; bit < code->bits && code->first > 0; bit++)
        symbols[bit * code->order] = 0;
}

/* What the frame's words leave over, in chips and on rows. */
static struct reading find_residue(struct certifier *certifier, const struct certificate_view *view,
                                const struct words *words)
{
    const struct code *code = certifier->code;
    const struct certificate_limits *limits = &certifier->limits;
    const size_t chips = code->bits * code->order;
    const bool has_level = code->first > 0 || code->scrambled;
    struct reading reading = {.view = view};

    if (!view->rows_known)
        code_rows(code, view->chips, certifier->rows);
    certifier->measures.amplitude = words->amplitude;
    words_measure(certifier->rows + code->first, code->order, code->bits, code->nodes, &certifier->measures);
    reading.speakers = find_speakers(certifier, view->noise, words, &reading.weakest);
    reading.swing = isnan(code->swing) ? (double)certifier->expected[0] : (double)code->swing;
    reading.least = fmin(reading.swing, reading.weakest);
    make_symbols(code, certifier->rows, words->amplitude, words->active, certifier->broken, certifier->work);
    code_chips(code, certifier->work, certifier->model);
    leave(certifier, view->chips, left_of(certifier));
    reading.shown = find_beside(certifier, view);
    reading.side = view->side;
    reading.before = certifier->beside;
    reading.after = certifier->beside + view->side;
    reading.shown_before = certifier->leaked;
    reading.shown_after = certifier->leaked + view->side;
    double taken = (double)reading.speakers + (has_level ? (double)code->bits : 0) + (reading.speakers ? 2 : 0);
    for (size_t i = 0; i < code->nodes; i++)
        taken += certifier->broken[i] ? (double)code->bits : 0;
    reading.free = fmax((double)chips - taken, 1);
    reading.total = sums_power(left_of(certifier), chips);
    reading.left = fmax(reading.total / reading.free, 1e-12 * reading.swing * reading.swing);
    reading.more = (limits->left + limits->left_of_word * limits->left_of_word * (double)reading.speakers) *
                   reading.swing * reading.swing;
    if (certifier->leaks || code->scrambled)
        code_rows(code, left_of(certifier), certifier->work);
    else
        subtract_words(code, certifier->rows, certifier->work);
    squares_of_columns(certifier->work, code->order, code->bits, certifier->power, certifier->most);
    return reading;
}

void certifier_read(struct certifier *certifier, const struct certificate_view *view, const struct words *words,
                    struct certificate *certificate)
{
    const struct code *code = certifier->code;
    const struct reading reading = find_residue(certifier, view, words);
    const struct certificate_limits *limits = &certifier->limits;
    const double noise = sqrt(reading.left / (double)code->order);
    double *value = certificate->value, atoms = 0, rivals = 0;

    const struct words_code sent = {code->nodes, (unsigned)code->bits, code->parity, code->sign_mask};
    words_decide(&certifier->measures, &sent, certifier->expected, (float)(1 / fmax(noise, 1e-12)),
                 &certifier->limits.words, words);
    doubt_parts(certifier, reading.swing, words);
    bool any_faint = find_faint(certifier, &reading, words);
    bool parts = any_faint && any_weak(certifier, reading.swing, words);
    if (any_faint)
        measure_faint(certifier, &reading, words);
    value[CLAUSE_ENERGY] = energy(certifier, &reading);
    certifier->edges = limits->edges * reading.weakest * sqrt((double)reading.speakers);
    if (view->is_compared)
        certifier->beyond = beyond_edges(certifier, view->side);
    certifier->worse = 2 * certifier->limits.log_odds * reading.shown / reading.free +
                       certifier->limits.better * reading.weakest * reading.weakest;
    value[CLAUSE_REST] = rest(certifier, &reading);
    value[CLAUSE_WORDS] = parts ? 2 : 0;
    double split = split_atoms(certifier, &reading);
    shifted_atoms(certifier, &reading, words, &atoms, &rivals);
    value[CLAUSE_ATOMS] = fmax(fmax(atoms, row_atoms(certifier, &reading)), split);
    for (int sign = -1;
         sign <= 1 && !code->scrambled && reading.speakers && reading.speakers <= certifier->limits.few; sign += 2)
        rivals = fmax(rivals, shifted_frames(certifier, &reading, words, sign));
    value[CLAUSE_RIVALS] = rivals;
    certificate->left = reading.left;
    certificate->noise = noise;
    certificate->swing = reading.swing;
    certificate->speakers = reading.speakers;
    certificate->understood = reading.speakers
                                  ? value[CLAUSE_REST] < 1 && is_understood(certifier, &reading, words)
                                  : any_faint && value[CLAUSE_ENERGY] > 1 && is_weaker(certifier, &reading, words);
    if (reading.speakers && certificate->understood && value[CLAUSE_ENERGY] > 1)
        measure_odd_ones(certifier, &reading, words);
    bool hidden = hides_nodes(certifier, &reading, words, noise);
    for (size_t i = 0; i < code->nodes; i++)
        words->doubtful[i] |= words->faint[i] | (hidden & !words->active[i]);
    if (code->first == 0 && !code->scrambled && (view->level_unknown || !shows_rest(certifier, &reading)) &&
        may_be_level(certifier))
        words->doubtful[0] = 1;
}

double certificate_worst(const struct certificate *certificate, enum certificate_clause *clause)
{
    size_t worst = 0;

    for (size_t i = 1; i < CERTIFICATE_CLAUSES; i++)
        if (certificate->value[i] > certificate->value[worst])
            worst = i;
    if (clause)
        *clause = (enum certificate_clause)worst;
    return certificate->value[worst];
}

double certifier_explained(struct certifier *certifier, const float *chips)
{
    const struct code *code = certifier->code;
    const size_t size = code->bits * code->order;
    double levels = 0;
    float beside;

    certifier_model(certifier, chips, certifier->model);
    leave(certifier, chips, left_of(certifier));
    take_leakage(certifier, &beside, &beside);
    for (size_t bit = 0; bit < code->bits; bit++)
        levels += (double)certifier->level[bit] * (double)certifier->level[bit];
    return sums_power(chips, size) - sums_power(left_of(certifier), size) - (double)code->order * levels;
}

/* How near chips come to being other words than those of the frame read last. */
static double other_words(struct certifier *certifier, const struct certificate_view *view, const struct words *words)
{
    bool differ;

    code_rows(certifier->code, view->chips, certifier->work);
    rows_left(certifier, certifier->work, words, &differ);
    if (!differ)
        return 0;
    certifier_model(certifier, view->chips, certifier->model);
    leave(certifier, view->chips, left_of(certifier));
    find_beside(certifier, view);
    double more = beyond_edges(certifier, view->side) - certifier->beyond;
    return certifier->worse / fmax(more, 1e-6 * certifier->worse);
}

/* Chips that are read `shift` chips later than the frame read last, without the word that a node has there. */
static struct certificate_view without(struct certifier *certifier, const struct certificate_view *view, int shift,
                                       const struct words *words, size_t node)
{
    const struct code *code = certifier->code;
    const size_t chips = code->bits * code->order, lag = (size_t)abs(shift), at = code->first + node;
    struct certificate_view others = *view;
    float *word = certifier->other, *left = certifier->without;

    memset(certifier->work, 0, chips * sizeof *certifier->work);
    for (size_t bit = 0; bit < chips; bit += code->order)
        certifier->work[bit + at] = copysignf(words->amplitude[node], certifier->rows[bit + at]);
    code_chips(code, certifier->work, word);
    memcpy(left, view->chips, chips * sizeof *left);
    if (shift > 0) {
        take_off(word + lag, 1, chips - lag, left);
        take_off(word, 1, lag, others.beside + view->side - lag);
    } else {
        take_off(word, 1, chips - lag, left + lag);
        take_off(word + chips - lag, 1, lag, others.beside + view->side);
    }
    others.chips = left;
    return others;
}

void certifier_compare(struct certifier *certifier, const struct certificate_view *view, int shift,
                       const struct words *words, struct certificate *certificate)
{
    double *value = &certificate->value[CLAUSE_RIVALS];

    if (!certificate->speakers)
        return;
    *value = fmax(*value, other_words(certifier, view, words));
    if (certificate->speakers == 1 || certificate->speakers > certifier->limits.few || certifier->code->unipolar ||
        abs(shift) > SIDE)
        return;
    for (size_t node = 0; node < certifier->code->nodes; node++) {
        if (!words->active[node])
            continue;
        struct certificate_view others = without(certifier, view, shift, words, node);
        words->active[node] = 0; /* which is late or early, so that it seems to be in its place here */
        *value = fmax(*value, other_words(certifier, &others, words));
        words->active[node] = 1;
    }
}
