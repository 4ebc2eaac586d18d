// SPDX-License-Identifier: Apache-2.0

#include "words.h"

#include <math.h>

#define BLOCK 128 /* nodes that are measured together: their sums stay in the nearest cache */

#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif
#if defined(__GNUC__) && (defined(__x86_64__) || defined(__i386__))
#define HAS_AVX2
#define AVX2 __attribute__((target("avx2")))
#endif

/* ---- measure ----------------------------------------------------------------------------------- */

INLINE void measure_block(const float *levels, ptrdiff_t step, size_t bits, size_t nodes,
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

INLINE void measure(const float *levels, ptrdiff_t step, size_t bits, size_t nodes,
                    const struct words_measures *measures)
{
    size_t first = 0;

    for (; first + BLOCK <= nodes; first += BLOCK)
        measure_block(levels + first, step, bits, BLOCK, measures, first);
    if (first < nodes)
        measure_block(levels + first, step, bits, nodes - first, measures, first);
}

#if defined(HAS_AVX2)
AVX2 static void measure_avx2(const float *levels, ptrdiff_t step, size_t bits, size_t nodes,
                              const struct words_measures *measures)
{
    measure(levels, step, bits, nodes, measures);
}
#endif

void words_measure(const float *levels, ptrdiff_t step, size_t bits, size_t nodes,
                   const struct words_measures *measures)
{
#if defined(HAS_AVX2)
    if (__builtin_cpu_supports("avx2")) {
        measure_avx2(levels, step, bits, nodes, measures);
        return;
    }
#endif
    measure(levels, step, bits, nodes, measures);
}

/* ---- decide ------------------------------------------------------------------------------------ */

bool words_find_active(size_t nodes, const float *amplitude, const float *expected, float threshold,
                       float faint_share, float sound_share, uint8_t *active, uint8_t *faint)
{
    float loudest = -INFINITY;
    uint8_t any = 0;

    for (size_t i = 0; i < nodes; i++) /* NaN if any is, as numpy's */
        loudest = amplitude[i] > loudest || isnan(amplitude[i]) ? amplitude[i] : loudest;
    for (size_t i = 0; i < nodes; i++) {
        float sound = sound_share * (loudest < expected[i] || isnan(loudest) ? loudest : expected[i]);
        active[i] = amplitude[i] > threshold * expected[i];
        faint[i] = amplitude[i] > faint_share * expected[i] && (amplitude[i] < sound || !active[i]);
        any |= faint[i];
    }
    return any;
}

static uint8_t is_odd(uint32_t word)
{
    for (unsigned shift = 16; shift; shift /= 2)
        word ^= word >> shift;
    return word & 1;
}

bool words_decide(size_t nodes, const struct words_measures *measures, const uint8_t *active,
                  const float *expected, const int32_t *sign_mask, float per_noise, unsigned bits,
                  bool parity, float most_square, const struct words_limits *limits,
                  const struct words_decided *decided)
{
    bool uneven = false;

    for (size_t i = 0; i < nodes; i++) {
        float amplitude = measures->amplitude[i], weakest = measures->weakest[i];
        float strongest = measures->strongest[i], two = limits->two * expected[i];
        float rho = amplitude * per_noise, margin = weakest / (amplitude < 1e-30f ? 1e-30f : amplitude);
        bool doubtful = rho < limits->low_rho || margin < limits->low_margin;
        uint32_t code = (uint32_t)(measures->signs[i] ^ sign_mask[i]);
        uint8_t odd = 0;
        if (parity) {
            odd = is_odd(code);
            unsigned place = (bits - 1 - (unsigned)measures->weakest_bit[i]) & 31;
            code = (code ^ (uint32_t)odd << place) >> 1;
            doubtful |= odd;
        }
        bool cancelling = doubtful && weakest < limits->low_margin * expected[i];
        bool three = amplitude > limits->shared * expected[i] && rho > limits->clear_rho &&
                     weakest < 0.5f * strongest;
        bool doubled = (cancelling || three) && strongest > two && !isnan(amplitude);
        decided->codes[i] = (int32_t)code;
        decided->rho[i] = rho;
        decided->margin[i] = margin;
        decided->doubtful[i] = active[i] && (doubtful || doubled || amplitude > two);
        decided->doubled[i] = doubled;
        decided->odd[i] = odd;
        uneven |= active[i] && measures->squares[i] > amplitude * amplitude * most_square;
    }
    return uneven && nodes > 2;
}

/* ---- fit --------------------------------------------------------------------------------------- */

/* Sum of squares; many partial sums keep its error at that of a few additions. */
INLINE double power_of(const float *values, size_t size)
{
    float partial[16];
    double power = 0;

    for (size_t begin = 0; begin < size; begin += 1024) {
        size_t end = size - begin < 1024 ? size : begin + 1024, i = begin;
        for (size_t lane = 0; lane < 16; lane++)
            partial[lane] = 0;
        for (; i + 16 <= end; i += 16)
            for (size_t lane = 0; lane < 16; lane++)
                partial[lane] += values[i + lane] * values[i + lane];
        for (; i < end; i++)
            partial[0] += values[i] * values[i];
        for (size_t lane = 0; lane < 16; lane++)
            power += (double)partial[lane];
    }
    return power;
}

/* Means of |r| and of r² of each node. */
INLINE void sum_up(const struct words_frame *frame, const float *rows, float *mean, float *square)
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

INLINE double frame_power(const struct words_frame *frame, const float *rows)
{
    /* A free row 0 holds nothing but what is left of the offset. */
    size_t from = !frame->unipolar && frame->first > 0;
    double total = 0;

    for (size_t bit = 0; bit < frame->bits; bit++)
        total += power_of(rows + bit * frame->order + from, frame->order - from);
    return total;
}

#if defined(HAS_AVX2)
AVX2 static void sum_up_avx2(const struct words_frame *frame, const float *rows, float *mean,
                             float *square)
{
    sum_up(frame, rows, mean, square);
}

AVX2 static double frame_power_avx2(const struct words_frame *frame, const float *rows)
{
    return frame_power(frame, rows);
}
#endif

/* Amplitude that the words of a frame exceed; see word_floor in fit.py. */
static float floor_of(const struct words_frame *frame, const float *mean)
{
    float first = -INFINITY, second = -INFINITY, third = -INFINITY; /* loudest ones */

    for (size_t i = 0; i < frame->nodes; i++) {
        float level = mean[i];
        if (isnan(level))
            return level;
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
    float least = frame->loudest_share * first, usual = first;
    if (!isnan(frame->swing))
        usual = first < frame->swing ? first : frame->swing;
    else if (frame->nodes >= 3 && third > least)
        usual = second;
    usual *= frame->active_share;
    return least > usual ? least : usual;
}

void words_fit(const struct words_frame *frame, const float *rows, float *amplitude, float *uneven,
               float *pedestal, float *power, float *spread, float *misfit)
{
    double total, word_power = 0, uneven_power = 0, level = 0;
    const float tiny = 1e-30f; /* for divisors that may be zero */

#if defined(HAS_AVX2)
    if (__builtin_cpu_supports("avx2")) {
        sum_up_avx2(frame, rows, amplitude, uneven);
        total = frame_power_avx2(frame, rows);
    } else
#endif
    {
        sum_up(frame, rows, amplitude, uneven);
        total = frame_power(frame, rows);
    }
    float floor = floor_of(frame, amplitude);
    for (size_t i = 0; i < frame->nodes; i++) {
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
    *power = (float)word_power + *pedestal * *pedestal;
    float bits_power = (float)frame->bits * *power, words = (float)word_power;
    *spread = (float)uneven_power / (words < tiny ? tiny : words);
    *misfit = (float)total / (bits_power < tiny ? tiny : bits_power) - 1.0f;
}

/* ---- late -------------------------------------------------------------------------------------- */

/* The chips of a bit that are looked at: what is left of its last two and first two, and what is meant
 * by its last and its first one. */
enum chip { LEFT_END, LEFT_LAST, LEFT_FIRST, LEFT_SECOND, MEANT_LAST, MEANT_FIRST, CHIPS };

INLINE float sign_of(float level)
{
    return (float)((level > 0) - (level < 0));
}

INLINE float dot(const float *some, const float *others, size_t size)
{
    float partial[16] = {0}, sum = 0;
    size_t i = 0;

    for (; i + 16 <= size; i += 16)
        for (size_t lane = 0; lane < 16; lane++)
            partial[lane] += some[i + lane] * others[i + lane];
    for (; i < size; i++)
        partial[0] += some[i] * others[i];
    for (size_t lane = 0; lane < 16; lane++)
        sum += partial[lane];
    return sum;
}

/* Chips of all bits, and the power of what is left in all rows. */
INLINE double find_chips(const struct words_frame *frame, const float *rows, const float *meant,
                         const float *edges, float (*chips)[CHIPS])
{
    size_t order = frame->order;
    double power = 0;

    for (size_t bit = 0; bit < frame->bits; bit++, rows += order) {
        double sums[CHIPS] = {0};
        for (size_t begin = 0; begin < order; begin += 512) {
            float spoken[512], left[512];
            size_t size = order - begin < 512 ? order - begin : 512;
            for (size_t i = 0; i < size; i++) {
                spoken[i] = sign_of(rows[begin + i]) * meant[begin + i];
                left[i] = rows[begin + i] - spoken[i];
            }
            if (begin == 0 && frame->first > 0)
                left[0] = 0; /* the line's offset */
            for (size_t edge = 0; edge < 4; edge++)
                sums[edge] += (double)dot(left, edges + edge * order + begin, size);
            sums[MEANT_LAST] += (double)dot(spoken, edges + order + begin, size);
            sums[MEANT_FIRST] += (double)dot(spoken, edges + 2 * order + begin, size);
            power += (double)dot(left, left, size);
        }
        for (size_t chip = 0; chip < CHIPS; chip++)
            chips[bit][chip] = (float)sums[chip];
    }
    return power;
}

INLINE void find_late(const struct words_frame *frame, const float *rows, const float *meant,
                      float (*chips)[CHIPS], float variance, const struct words_lateness *limits,
                      uint8_t *late)
{
    /* A word is looked for in chips of the bit after it, but for what the one before that bit leaks
     * into it, and the other way round. */
    size_t pairs = frame->bits - 1;

    for (size_t begin = 0; begin < frame->nodes; begin += BLOCK) {
        size_t size = frame->nodes - begin < BLOCK ? frame->nodes - begin : BLOCK;
        float alike[BLOCK] = {0}, word[2][3][BLOCK] = {0}, owner[2][3][BLOCK] = {0};
        const float *levels = rows + frame->first + begin, *spoken = meant + frame->first + begin;
        for (size_t pair = 0; pair < pairs; pair++, levels += frame->order) {
            const float *next = levels + frame->order;
            const float *now = chips[pair], *then = chips[pair + 1];
            const float here[2][3] = {{then[LEFT_FIRST], then[LEFT_SECOND], now[MEANT_LAST]},
                                      {now[LEFT_END], now[LEFT_LAST], then[MEANT_FIRST]}};
            for (size_t i = 0; i < size; i++) {
                float earlier = sign_of(levels[i]), later = sign_of(next[i]);
                alike[i] += earlier * later;
                for (size_t c = 0; c < 3; c++) {
                    word[0][c][i] += earlier * here[0][c];
                    owner[0][c][i] += later * here[0][c];
                    word[1][c][i] += later * here[1][c];
                    owner[1][c][i] += earlier * here[1][c];
                }
            }
        }
        for (size_t i = 0; i < size; i++) {
            float same = alike[i] / (float)pairs, beside[2];
            float free = (float)pairs * (1 - same * same), scale = 1 / (free > 1e-3f ? free : 1e-3f);
            for (size_t side = 0; side < 2; side++) {
                float found[3];
                for (size_t c = 0; c < 3; c++)
                    found[c] = fabsf(word[side][c][i] - same * owner[side][c][i]) * scale;
                beside[side] = (found[0] > found[1] ? found[0] : found[1]) - limits->leaked * found[2];
            }
            float most = beside[0] > beside[1] ? beside[0] : beside[1];
            float by_chance = limits->by_chance * limits->by_chance * variance * scale; /* squared */
            late[begin + i] = spoken[i] > 0 && most > limits->late_share * spoken[i] &&
                              most * most > by_chance;
        }
    }
}

INLINE void look_for_late(const struct words_frame *frame, const float *rows, const float *meant,
                          const float *edges, const struct words_lateness *limits, uint8_t *late)
{
    float chips[WORDS_MOST_BITS][CHIPS];
    double within = (double)frame->order * find_chips(frame, rows, meant, edges, chips);

    for (size_t bit = 0; bit < frame->bits; bit++)
        for (size_t edge = 0; edge < 4; edge++)
            within -= (double)chips[bit][edge] * (double)chips[bit][edge];
    double variance = (within > 0 ? within : 0) / (double)(frame->bits * (frame->order - 4));
    find_late(frame, rows, meant, chips, (float)variance, limits, late);
}

#if defined(HAS_AVX2)
AVX2 static void look_for_late_avx2(const struct words_frame *frame, const float *rows,
                                    const float *meant, const float *edges,
                                    const struct words_lateness *limits, uint8_t *late)
{
    look_for_late(frame, rows, meant, edges, limits, late);
}
#endif

void words_late(const struct words_frame *frame, const float *rows, const float *meant,
                const float *edges, const struct words_lateness *limits, uint8_t *late)
{
#if defined(HAS_AVX2)
    if (__builtin_cpu_supports("avx2")) {
        look_for_late_avx2(frame, rows, meant, edges, limits, late);
        return;
    }
#endif
    look_for_late(frame, rows, meant, edges, limits, late);
}
