// SPDX-License-Identifier: Apache-2.0

#include "words.h"

#include <math.h>
#include <string.h>

#include "vectors.h"

#define BLOCK 128 /* nodes that are measured together: their sums stay in the nearest cache */
#define PART 1024 /* values that are added up in floats */

/* ---- measure ----------------------------------------------------------------------------------- */

INLINE void measure_block(const float *levels, size_t step, size_t bits, size_t nodes,
                          const struct words_measures *measures, size_t first)
{
    float sum[BLOCK] = {0}, least[BLOCK], most[BLOCK] = {0}, squares[BLOCK] = {0};
    int32_t signs[BLOCK] = {0}, place[BLOCK] = {0};

    for (size_t i = 0; i < nodes; i++)
        least[i] = INFINITY;
    for (size_t bit = 0; bit < bits; bit++, levels += step)
        for (size_t i = 0; i < nodes; i++) {
            float level = fabsf(levels[i]);
            sum[i] += level;
            squares[i] += level * level;
            place[i] = level < least[i] ? (int32_t)bit : place[i];
            least[i] = level < least[i] ? level : least[i];
            most[i] = level > most[i] ? level : most[i];
            signs[i] = signs[i] << 1 | (levels[i] > 0);
        }
    for (size_t i = 0; i < nodes; i++) {
        measures->amplitude[first + i] = sum[i] * (float)(1.0 / (double)bits);
        measures->weakest[first + i] = least[i];
        measures->strongest[first + i] = most[i];
        measures->squares[first + i] = squares[i];
        measures->signs[first + i] = signs[i];
        measures->weakest_bit[first + i] = place[i];
    }
}

/* levels: k rows of n values, `step` values from row to row. */
VECTORS static void measure(const float *levels, size_t step, size_t bits, size_t nodes,
                            const struct words_measures *measures)
{
    size_t first = 0;

    for (; first + BLOCK <= nodes; first += BLOCK)
        measure_block(levels + first, step, bits, BLOCK, measures, first);
    if (first < nodes)
        measure_block(levels + first, step, bits, nodes - first, measures, first);
}

/* ---- decide ------------------------------------------------------------------------------------ */

/* NaN if any is, as numpy's. */
VECTORS static float highest(size_t nodes, const float *amplitude)
{
    float loudest = -INFINITY;

    for (size_t i = 0; i < nodes; i++)
        loudest = amplitude[i] > loudest || isnan(amplitude[i]) ? amplitude[i] : loudest;
    return loudest;
}

/* Whether any word is faint: _find_active in decode.py. loudest: of all amplitudes. */
VECTORS static bool find_active(size_t nodes, const float *restrict amplitude, float loudest,
                                const float *restrict squares, const float *restrict expected,
                                const struct words_reading *reading, float per_noise,
                                uint8_t *restrict active)
{
    const float threshold = reading->threshold, faint_share = reading->faint_share;
    const float sound_share = reading->sound_share, least = reading->least_squares;
    const float most_noise = reading->loud_squares, hiding = reading->hiding_rho;
    int any = 0;

    float most = isnan(loudest) ? INFINITY : loudest;
    float none = isnan(loudest) ? loudest : 0; /* NaN is no sound level */
    for (size_t i = 0; i < nodes; i++) {
        float sound = sound_share * (most < expected[i] ? most : expected[i]) + none;
        int spoke = amplitude[i] > threshold * expected[i];
        int rises = (squares[i] > least * expected[i] * expected[i]) &
                    (squares[i] * per_noise * per_noise > most_noise);
        active[i] = (uint8_t)spoke;
        any |= (amplitude[i] > faint_share * expected[i]) & ((amplitude[i] < sound) | !spoke);
        any |= (rises | (expected[i] * per_noise < hiding)) & !spoke;
    }
    return any;
}

INLINE int odd_of(uint32_t word)
{
    word ^= word >> 16;
    word ^= word >> 8;
    word ^= word >> 4;
    word ^= word >> 2;
    return (int)((word ^ word >> 1) & 1);
}

/* Without branches, and with pointers that are known to differ, so that it is done for many nodes at once:
 * `parity` is a constant where this is inlined. */
INLINE bool decide_by(const bool parity, size_t nodes, const struct words_measures *measures,
                      const uint8_t *restrict active, const float *restrict expected,
                      const int32_t *restrict sign_mask, float per_noise, unsigned bits,
                      float most_square, const struct words_limits *limits,
                      const struct words_decided *decided)
{
    const float *restrict amplitudes = measures->amplitude, *restrict least = measures->weakest;
    const float *restrict most = measures->strongest, *restrict squares = measures->squares;
    const int32_t *restrict signs = measures->signs, *restrict weakest_bit = measures->weakest_bit;
    float *restrict rhos = decided->rho, *restrict margins = decided->margin;
    int32_t *restrict codes = decided->codes;
    uint8_t *restrict doubtful = decided->doubtful, *restrict doubled = decided->doubled;
    uint8_t *restrict odd = decided->odd;
    const struct words_limits limit = *limits;
    int any_uneven = 0;

    APART
    for (size_t i = 0; i < nodes; i++) {
        float amplitude = amplitudes[i], two = limit.two * expected[i];
        float rho = amplitude * per_noise;
        float margin = least[i] / (amplitude < 1e-30f ? 1e-30f : amplitude);
        int doubt = (rho < limit.low_rho) | (margin < limit.low_margin), is_odd = 0;
        uint32_t code = (uint32_t)(signs[i] ^ sign_mask[i]);
        if (parity) {
            is_odd = odd_of(code);
            uint32_t place = (bits - 1 - (uint32_t)weakest_bit[i]) & 31;
            code = (code ^ (uint32_t)is_odd << place) >> 1;
            doubt |= is_odd;
        }
        int cancelling = doubt & (least[i] < limit.low_margin * expected[i]);
        int three = (amplitude > limit.shared * expected[i]) & (rho > limit.clear_rho) &
                    (least[i] < limit.lower * most[i]);
        int twice = (cancelling | three) & (most[i] > two) & (amplitude == amplitude); /* no NaN */
        codes[i] = (int32_t)code;
        rhos[i] = rho;
        margins[i] = margin;
        doubtful[i] = (uint8_t)(active[i] & (doubt | twice | (amplitude > two)));
        doubled[i] = (uint8_t)twice;
        odd[i] = (uint8_t)is_odd;
        any_uneven |= active[i] & (squares[i] > amplitude * amplitude * most_square);
    }
    return any_uneven;
}

/* Whether any word is uneven: _decide in decode.py. */
VECTORS static bool decide(size_t nodes, const struct words_measures *measures, const uint8_t *active,
                           const float *expected, const int32_t *sign_mask, float per_noise,
                           unsigned bits, bool parity, float most_square,
                           const struct words_limits *limits, const struct words_decided *decided)
{
    if (parity)
        return decide_by(true, nodes, measures, active, expected, sign_mask, per_noise, bits,
                         most_square, limits, decided);
    return decide_by(false, nodes, measures, active, expected, sign_mask, per_noise, bits, most_square,
                     limits, decided);
}

/* ---- fit --------------------------------------------------------------------------------------- */

/* Of all lanes: many partial sums keep their error at that of a few additions. */
INLINE double all_lanes(const floats8 *sums, size_t count)
{
    double sum = 0;

    for (size_t i = 0; i < count; i++)
        for (size_t lane = 0; lane < 8; lane++)
            sum += (double)sums[i][lane];
    return sum;
}

/* Sum of products. */
INLINE double dot(const float *some, const float *others, size_t size)
{
    double sum = 0;

    for (size_t begin = 0; begin < size; begin += PART) {
        size_t end = size - begin < PART ? size : begin + PART, i = begin;
        floats8 sums[2] = {{0}, {0}};
        for (; i + 16 <= end; i += 16) {
            const floats8 *a = (const floats8 *)(some + i), *b = (const floats8 *)(others + i);
            sums[0] += a[0] * b[0];
            sums[1] += a[1] * b[1];
        }
        for (; i < end; i++)
            sums[0][0] += some[i] * others[i];
        sum += all_lanes(sums, 2);
    }
    return sum;
}

INLINE double power_of(const float *values, size_t size)
{
    return dot(values, values, size);
}

/* Sum of a block of squares. */
INLINE double sum_of(const float *squares, size_t size)
{
    floats8 sums[2] = {{0}, {0}};
    size_t i = 0;

    for (; i + 16 <= size; i += 16) {
        sums[0] += ((const floats8 *)(squares + i))[0];
        sums[1] += ((const floats8 *)(squares + i))[1];
    }
    for (; i < size; i++)
        sums[0][0] += squares[i];
    return all_lanes(sums, 2);
}

/* Means of |r| and of r² of each node. */
VECTORS static void sum_up(const struct words_frame *frame, const float *rows, float *mean, float *square)
{
    size_t bits = frame->bits;

    for (size_t first = 0; first < frame->nodes; first += BLOCK) {
        float sum[BLOCK] = {0}, squares[BLOCK] = {0};
        size_t size = frame->nodes - first < BLOCK ? frame->nodes - first : BLOCK;
        const float *levels = rows + frame->first + first;
        for (size_t bit = 0; bit < bits; bit++, levels += frame->order)
            for (size_t i = 0; i < size; i++) {
                sum[i] += fabsf(levels[i]);
                squares[i] += levels[i] * levels[i];
            }
        for (size_t i = 0; i < size; i++) {
            mean[first + i] = sum[i] / (float)bits;
            square[first + i] = squares[i] / (float)bits;
        }
    }
}

VECTORS static double frame_power(const struct words_frame *frame, const float *rows)
{
    /* A free row 0 holds nothing but what is left of the offset. */
    size_t from = !frame->unipolar && frame->first > 0;
    double power = 0;

    for (size_t bit = 0; bit < frame->bits; bit++)
        power += power_of(rows + bit * frame->order + from, frame->order - from);
    return power;
}

/* The loudest word's amplitude, and through `usual` that of a sound node: see usual_amplitude in
 * amplitude.py. NaN if any is. */
static float loudest_of(const float *mean, size_t nodes, float loudest_share, float *usual)
{
    float first = -INFINITY, second = -INFINITY, third = -INFINITY; /* loudest ones */

    for (size_t i = 0; i < nodes; i++) {
        float level = mean[i];
        if (isnan(level))
            return *usual = level;
        if (level > third) {
            third = level;
            if (third > second) {
                third = second;
                second = level;
            }
            if (second > first) {
                second = first;
                first = level;
            }
        }
    }
    *usual = nodes >= 3 && third > loudest_share * first ? second : first;
    return first;
}

/* Amplitude that the words of a frame exceed; see word_floor in fit.py. */
static float floor_of(const struct words_frame *frame, const float *mean)
{
    float usual, first = loudest_of(mean, frame->nodes, frame->loudest_share, &usual);

    if (isnan(first))
        return first;
    if (!isnan(frame->swing))
        usual = first < frame->swing ? first : frame->swing;
    float least = frame->loudest_share * first;
    usual *= frame->active_share;
    return least > usual ? least : usual;
}

void words_fit(const struct words_frame *frame, const float *rows, float *amplitude, float *uneven,
               float *pedestal, float *power, float *spread, float *misfit)
{
    double word_power = 0, uneven_power = 0, level = 0;
    const float tiny = 1e-30f; /* for divisors that may be zero */

    sum_up(frame, rows, amplitude, uneven);
    float floor = floor_of(frame, amplitude);
    for (size_t i = 0; i < frame->nodes && !misfit; i++)
        amplitude[i] *= amplitude[i] > floor ? 1.0f : 0.0f;
    for (size_t i = 0; i < frame->nodes && misfit; i++) {
        bool active = amplitude[i] > floor;
        uneven[i] = active ? uneven[i] - amplitude[i] * amplitude[i] : 0.0f;
        amplitude[i] = active ? amplitude[i] : amplitude[i] * 0.0f; /* NaN stays */
        word_power += (double)amplitude[i] * (double)amplitude[i];
        uneven_power += (double)uneven[i];
    }
    if (frame->unipolar)
        for (size_t bit = 0; bit < frame->bits; bit++)
            level += (double)rows[bit * frame->order];
    *pedestal = (float)(level / (double)frame->bits);
    if (!misfit)
        return;
    *power = (float)word_power + *pedestal * *pedestal;
    float bits_power = (float)frame->bits * *power, words = (float)word_power;
    *spread = (float)uneven_power / (words < tiny ? tiny : words);
    *misfit = (float)frame_power(frame, rows) / (bits_power < tiny ? tiny : bits_power) - 1.0f;
}

void words_fit_all(const struct words_frame *frame, size_t count, const float *rows, float *amplitude, float *uneven,
                   float *pedestal, float *power, float *spread, float *misfit)
{
    for (size_t i = 0; i < count; i++)
        words_fit(frame, rows + i * frame->bits * frame->order, amplitude + i * frame->nodes,
                  uneven + i * frame->nodes, pedestal + i, power + i, spread + i, misfit + i);
}

VECTORS double words_most_left(const struct words_frame *frame, const float *rows, const float *amplitude)
{
    const size_t from = frame->first > 0, end = frame->first + frame->nodes;
    double sum = 0, most = -INFINITY;
    float off[PART];

    for (size_t bit = 0; bit < frame->bits; bit++, rows += frame->order) {
        double left = power_of(rows + from, frame->first - from) + power_of(rows + end, frame->order - end);
        for (size_t begin = 0; begin < frame->nodes; begin += PART) {
            size_t size = frame->nodes - begin < PART ? frame->nodes - begin : PART;
            const float *levels = rows + frame->first + begin;
            for (size_t i = 0; i < size; i++)
                off[i] = fabsf(levels[i]) - amplitude[begin + i];
            left += power_of(off, size);
        }
        sum += left;
        most = most > left ? most : left;
    }
    return most - (sum - most) / (double)(frame->bits - 1);
}

/* ---- noise ------------------------------------------------------------------------------------- */

/* A spoken word's levels scatter about their mean with the noise. The levels of a silent node are the
 * noise itself: folded, their mean is 1.3 of their deviations only. */
static double noise_of_words(const struct words_frame *frame, const float *rows)
{
    const double bits = (double)frame->bits;
    double power = 0;

    for (size_t node = 0; node < frame->nodes; node++) {
        const float *levels = rows + frame->first + node;
        double sum = 0, squares = 0, scatter = 0;
        for (size_t bit = 0; bit < frame->bits; bit++) {
            double level = fabs((double)levels[bit * frame->order]);
            sum += level;
            squares += level * level;
        }
        for (size_t bit = 0; bit < frame->bits; bit++) {
            double off = fabs((double)levels[bit * frame->order]) - sum / bits;
            scatter += off * off / (bits - 1);
        }
        power += sum / bits > frame->spoken_over * sqrt(scatter) ? scatter : squares / bits;
    }
    return sqrt(power / (double)frame->nodes);
}

double words_noise(const struct words_frame *frame, const float *rows, size_t spare, size_t count)
{
    double power = 0;

    if (count < 2)
        return noise_of_words(frame, rows);
    for (size_t bit = 0; bit < frame->bits; bit++)
        power += power_of(rows + bit * frame->order + spare, count);
    return sqrt(power / (double)(frame->bits * count));
}

/* ---- read -------------------------------------------------------------------------------------- */

/* What the words of a frame add up to. */
struct spoken {
    size_t words;
    double power, rows_power; /* of the words; of their rows in all bits */
    float least, expected;    /* amplitude; of all nodes that is expected */
};

/* Clears what silent nodes have, and adds up the rest. least: share of the expected amplitude below which
 * a margin says nothing. */
VECTORS static struct spoken clear_silent(size_t nodes, const struct words_measures *measures,
                                          const struct words_decided *decided,
                                          const uint8_t *restrict active,
                                          const float *restrict expected, float share)
{
    struct spoken spoken = {.least = INFINITY, .expected = INFINITY};
    const float *restrict amplitude = measures->amplitude;
    float *restrict margins = decided->margin;
    int32_t *restrict codes = decided->codes;
    uint8_t *restrict doubled = decided->doubled, *restrict odd = decided->odd;
    const uint8_t *restrict doubtful = decided->doubtful;

    for (size_t begin = 0; begin < nodes; begin += BLOCK) {
        size_t size = nodes - begin < BLOCK ? nodes - begin : BLOCK;
        float level[BLOCK], loud[BLOCK], least = INFINITY, usual = INFINITY;
        unsigned words = 0;
        for (size_t i = 0; i < size; i++) {
            size_t node = begin + i;
            float margin = margins[node], amplitude_v = amplitude[node];
            margins[node] = amplitude_v > share * expected[node] ? margin : 0.0f;
            level[i] = active[node] ? amplitude_v : 0.0f;
            loud[i] = active[node] ? amplitude_v : INFINITY;
            codes[node] &= -(int32_t)active[node];
        }
        for (size_t i = begin; i < begin + size; i++) {
            doubled[i] &= doubtful[i];
            odd[i] &= active[i];
        }
        for (size_t i = 0; i < size; i++) {
            words += active[begin + i];
            least = loud[i] < least ? loud[i] : least;
            usual = expected[begin + i] < usual ? expected[begin + i] : usual;
        }
        spoken.words += words;
        spoken.least = least < spoken.least ? least : spoken.least;
        spoken.expected = usual < spoken.expected ? usual : spoken.expected;
        spoken.power += power_of(level, size);
        spoken.rows_power += sum_of(measures->squares + begin, size);
    }
    return spoken;
}

INLINE float sign_of(float level)
{
    return (float)((level > 0) - (level < 0));
}

/* Energy per bit that one offset of all chips explains of what words leave over, V²; offset: (k, N), rows
 * of an offset of 1 V; as common_energy in lateness.py. */
VECTORS static double common_energy(const struct words_frame *frame, const float *rows, const float *offset,
                                    const float *amplitude, const uint8_t *active, size_t from)
{
    const size_t bits = frame->bits, order = frame->order;
    double product = 0, norm = 0;

    for (size_t at = from; at < bits * order; at += order) {
        product += dot(rows + at, offset + at, order - from);
        norm += power_of(offset + at, order - from);
    }
    for (size_t begin = 0; begin < frame->nodes; begin += BLOCK) {
        size_t size = frame->nodes - begin < BLOCK ? frame->nodes - begin : BLOCK;
        float along[BLOCK] = {0};
        for (size_t at = frame->first + begin; at < bits * order; at += order)
            for (size_t i = 0; i < size; i++)
                along[i] += sign_of(rows[at + i]) * offset[at + i];
        for (size_t i = 0; i < size; i++)
            along[i] = active[begin + i] ? along[i] : 0;
        product -= dot(along, amplitude + begin, size);
        norm -= power_of(along, size) / (double)bits;
    }
    return product * product / norm / (double)bits;
}

/* What is left over by words: what out_of_place in lateness.py asks, and toned in tones.py. */
static enum words_look look_at_rest(const struct words_frame *frame, const struct words_reading *reading,
                         const float *rows, const float *offset, const float *amplitude,
                         const uint8_t *active, const struct spoken *spoken)
{
    const size_t from = frame->first > 0, end = frame->first + frame->nodes;
    double sum = 0, moved = 0;
    double total = spoken->rows_power, share = spoken->words <= reading->few ? (double)reading->few_share : 1;
    for (size_t bit = 0; bit < frame->bits; bit++) {
        const float *levels = rows + bit * frame->order;
        total += power_of(levels + from, frame->first - from) + power_of(levels + end, frame->order - end);
        sum += (double)levels[0];
        moved += (double)levels[0] * (double)levels[0];
    }
    total = total / (double)frame->bits - spoken->power;
    sum /= (double)frame->bits;
    moved = from && !offset ? moved / (double)frame->bits - sum * sum : 0; /* of what is no offset */
    double most_moved = (double)reading->moved_share * (double)spoken->expected;
    if (moved > most_moved * most_moved && spoken->words < frame->nodes)
        return WORDS_NEED_STAGES;
    double least = (double)spoken->least * (double)spoken->least;
    if (!offset && total + moved >= (double)reading->tone_share * least)
        return WORDS_LEAVE_MUCH;
    float weakest = offset && spoken->expected < spoken->least ? spoken->expected : spoken->least;
    double most = share * (double)reading->a_chip * (double)weakest * (double)weakest / (double)frame->order;
    if (offset && total >= most)
        total -= common_energy(frame, rows, offset, amplitude, active, from);
    return total < most ? WORDS_ARE_PLAIN : WORDS_LEAVE_ENERGY;
}

enum words_look words_read(const struct words_frame *frame, const struct words_reading *reading,
                           float per_noise, float least_usual, const float *rows,
                           const int32_t *sign_mask, const float *offset, float *expected,
                           const struct words_measures *measures,
                           const struct words_decided *decided, uint8_t *active)
{
    const float *amplitude = measures->amplitude;
    float threshold = reading->threshold;

    measure(rows + frame->first, frame->order, frame->bits, frame->nodes, measures);
    if (!isnan(least_usual)) {
        float usual;
        loudest_of(amplitude, frame->nodes, frame->loudest_share, &usual);
        usual = usual < least_usual ? least_usual : usual; /* NaN stays */
        for (size_t i = 0; i < frame->nodes; i++)
            expected[i] = usual;
    }
    if (find_active(frame->nodes, amplitude, highest(frame->nodes, amplitude), measures->squares, expected, reading,
                    per_noise, active))
        return WORDS_NEED_STAGES;
    if (decide(frame->nodes, measures, active, expected, sign_mask, per_noise,
               (unsigned)frame->bits, reading->parity, reading->most_square, &reading->limits,
                     decided) && frame->nodes > 2)
        return WORDS_NEED_STAGES;
    float share = threshold < reading->faint_share ? threshold : reading->faint_share;
    struct spoken spoken =
        clear_silent(frame->nodes, measures, decided, active, expected, share);
    return spoken.words ? look_at_rest(frame, reading, rows, offset, amplitude, active, &spoken)
                        : WORDS_NEED_STAGES;
}

/* Whether noise may hide the word of a node of such an amplitude. */
VECTORS static bool any_hidden(size_t nodes, const float *expected, float per_noise, float hiding)
{
    int any = 0;

    for (size_t i = 0; i < nodes; i++)
        any |= expected[i] * per_noise < hiding;
    return any;
}

static void clear_words(size_t nodes, float *amplitude, const struct words_decided *decided, uint8_t *active)
{
    memset(amplitude, 0, nodes * sizeof *amplitude);
    memset(decided->codes, 0, nodes * sizeof *decided->codes);
    memset(decided->rho, 0, nodes * sizeof *decided->rho);
    memset(decided->margin, 0, nodes * sizeof *decided->margin);
    memset(decided->doubtful, 0, nodes);
    memset(decided->doubled, 0, nodes);
    memset(decided->odd, 0, nodes);
    memset(active, 0, nodes);
}

enum words_look words_read_some(const struct words_frame *frame, const struct words_reading *reading, float per_noise,
                                float least_usual, const float *levels, const int32_t *spoke, size_t speakers,
                                const int32_t *sign_mask, float *expected, const struct words_measures *measures,
                                float *amplitude, const struct words_decided *decided, uint8_t *active)
{
    float share = fminf(reading->threshold, reading->faint_share);
    size_t words = 0;

    measure(levels, speakers, frame->bits, speakers, measures);
    if (!isnan(least_usual)) {
        float usual;
        loudest_of(measures->amplitude, speakers, frame->loudest_share, &usual);
        usual = usual < least_usual ? least_usual : usual; /* NaN stays */
        for (size_t i = 0; i < frame->nodes; i++)
            expected[i] = usual;
    }
    if (any_hidden(frame->nodes, expected, per_noise, reading->hiding_rho))
        return WORDS_NEED_STAGES;
    clear_words(frame->nodes, amplitude, decided, active);
    float loudest = highest(speakers, measures->amplitude);
    for (size_t begin = 0; begin < speakers; begin += BLOCK) {
        size_t size = speakers - begin < BLOCK ? speakers - begin : BLOCK;
        float usual[BLOCK], rho[BLOCK], margin[BLOCK];
        int32_t mask[BLOCK], codes[BLOCK];
        uint8_t doubtful[BLOCK], doubled[BLOCK], odd[BLOCK], is_active[BLOCK];
        const struct words_measures some = {measures->amplitude + begin, measures->weakest + begin,
                                            measures->strongest + begin, measures->squares + begin,
                                            measures->signs + begin, measures->weakest_bit + begin};
        const struct words_decided found = {codes, rho, margin, doubtful, doubled, odd};
        for (size_t i = 0; i < size; i++) {
            usual[i] = expected[spoke[begin + i]];
            mask[i] = sign_mask[spoke[begin + i]];
        }
        if (find_active(size, some.amplitude, loudest, some.squares, usual, reading, per_noise, is_active))
            return WORDS_NEED_STAGES;
        if (decide(size, &some, is_active, usual, mask, per_noise, (unsigned)frame->bits, reading->parity,
                   reading->most_square, &reading->limits, &found) &&
            frame->nodes > 2)
            return WORDS_NEED_STAGES;
        words += clear_silent(size, &some, &found, is_active, usual, share).words;
        for (size_t i = 0; i < size; i++) {
            size_t node = (size_t)spoke[begin + i];
            amplitude[node] = some.amplitude[i];
            decided->codes[node] = codes[i];
            decided->rho[node] = rho[i];
            decided->margin[node] = margin[i];
            decided->doubtful[node] = doubtful[i];
            decided->doubled[node] = doubled[i];
            decided->odd[node] = odd[i];
            active[node] = is_active[i];
        }
    }
    return words ? WORDS_ARE_PLAIN : WORDS_NEED_STAGES;
}

/* ---- late -------------------------------------------------------------------------------------- */

/* The chips of a bit that are looked at: what is left of its last two and first two. */
enum chip { END, LAST, FIRST, SECOND, CHIPS };

/* Chips of all bits, and the variance of the others that are left, without the line's offset. */
INLINE void find_chips(const struct words_frame *frame, const float *rows, const float *meant,
                         const float *edges, float (*chips)[CHIPS], float *variance)
{
    const size_t order = frame->order;

    for (size_t bit = 0; bit < frame->bits; bit++, rows += order) {
        floats8 sums[CHIPS + 1] = {{0}}; /* the last one: power */
        size_t i = frame->first > 0;
        for (; i + 8 <= order; i += 8) {
            floats8 level = *(const floats8 *)(rows + i);
            ints8 sign = (ints8)level & INT32_MIN;
            floats8 left = level - (floats8)(*(const ints8 *)(meant + i) | sign);
            for (size_t e = 0; e < CHIPS; e++)
                sums[e] += left * *(const floats8 *)(edges + e * order + i);
            sums[CHIPS] += left * left;
        }
        for (; i < order; i++) {
            float left = rows[i] - sign_of(rows[i]) * meant[i];
            for (size_t e = 0; e < CHIPS; e++)
                sums[e][0] += left * edges[e * order + i];
            sums[CHIPS][0] += left * left;
        }
        double power = (double)order * all_lanes(&sums[CHIPS], 1);
        for (size_t chip = 0; chip < CHIPS; chip++) {
            double level = all_lanes(&sums[chip], 1);
            chips[bit][chip] = (float)level;
            power -= level * level;
        }
        variance[bit] = (float)((power > 0 ? power : 0) / (double)(order - CHIPS));
    }
}

INLINE void find_late(const struct words_frame *frame, const float *rows, const float *meant,
                      float (*chips)[CHIPS], const float *variance,
                      const struct words_lateness *limits, uint8_t *late)
{
    /* A word is looked for in chips of the bit after it, and the other way round. */
    size_t pairs = frame->bits - 1;

    for (size_t begin = 0; begin < frame->nodes; begin += BLOCK) {
        size_t size = frame->nodes - begin < BLOCK ? frame->nodes - begin : BLOCK;
        float alike[BLOCK] = {0}, word[2][2][BLOCK] = {0}, owner[2][2][BLOCK] = {0};
        float noise[2] = {0}, common[2][BLOCK] = {0};
        const float *levels = rows + frame->first + begin, *spoken = meant + frame->first + begin;
        for (size_t pair = 0; pair < pairs; pair++, levels += frame->order) {
            const float *next = levels + frame->order;
            const float *now = chips[pair], *then = chips[pair + 1];
            const float here[2][2] = {{then[FIRST], then[SECOND]}, {now[END], now[LAST]}};
            noise[0] += variance[pair + 1];
            noise[1] += variance[pair];
            for (size_t i = 0; i < size; i++) {
                float earlier = sign_of(levels[i]), later = sign_of(next[i]);
                alike[i] += earlier * later;
                common[0][i] += earlier * later * variance[pair + 1];
                common[1][i] += earlier * later * variance[pair];
                for (size_t c = 0; c < 2; c++) {
                    word[0][c][i] += earlier * here[0][c];
                    owner[0][c][i] += later * here[0][c];
                    word[1][c][i] += later * here[1][c];
                    owner[1][c][i] += earlier * here[1][c];
                }
            }
        }
        for (size_t i = 0; i < size; i++) {
            float same = alike[i] / (float)pairs;
            float free = (float)pairs * (1 - same * same), scale = 1 / (free > 1e-3f ? free : 1e-3f);
            int is_late = 0;
            for (size_t side = 0; side < 2; side++) {
                float found[2];
                for (size_t c = 0; c < 2; c++)
                    found[c] = fabsf(word[side][c][i] - same * owner[side][c][i]) * scale;
                float together = sqrtf(found[0] * found[0] + found[1] * found[1]) / limits->of_two;
                float most = found[0] > found[1] ? found[0] : found[1];
                most = together > most ? together : most;
                float by_chance = (1 + same * same) * noise[side] - 2 * same * common[side][i]; /* squared */
                by_chance *= limits->by_chance * limits->by_chance * scale * scale;
                is_late |= most > limits->late_share * spoken[i] && most * most > by_chance;
            }
            late[begin + i] = spoken[i] > 0 && is_late;
        }
    }
}

/* Whether no two chips that are left are as high as a late word makes them: what find_late finds of a node,
 * a mean of such chips, is no higher than the highest, but for rounding. */
INLINE bool are_low(const struct words_frame *frame, const float *meant, float (*chips)[CHIPS], float share)
{
    float least = INFINITY;
    int high = 0;

    for (size_t i = 0; i < frame->nodes; i++) {
        float level = meant[frame->first + i];
        least = level > 0 && level < least ? level : least;
    }
    for (size_t bit = 0; bit < frame->bits; bit++)
        for (size_t chip = 0; chip < CHIPS; chip += 2) {
            float one = chips[bit][chip], other = chips[bit][chip + 1];
            high |= !((one * one + other * other) * 1.002f <= share * share * least * least);
        }
    return !high;
}

VECTORS void words_late(const struct words_frame *frame, const float *rows, const float *meant,
                        const float *edges, const struct words_lateness *limits, uint8_t *late)
{
    float chips[WORDS_MOST_BITS][CHIPS], variance[WORDS_MOST_BITS];

    find_chips(frame, rows, meant, edges, chips, variance);
    if (are_low(frame, meant, chips, limits->late_share)) {
        memset(late, 0, frame->nodes);
        return;
    }
    find_late(frame, rows, meant, chips, variance, limits, late);
}
