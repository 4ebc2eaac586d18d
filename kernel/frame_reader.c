// SPDX-License-Identifier: Apache-2.0

#include "frame_reader.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "sparse.h"
#include "sums.h"

#define SEEN 16      /* frames by the least of which noise is known where no gap shows it */
#define LEARNT 8     /* of these, until then it is unknown */
#define PLACED 8     /* certain frames in succession that began at their marks, after which the next one does, too */

struct frame_reader {
    const struct code *code;
    struct frame_rules rules;
    struct certificate_limits limits;
    struct certifier *certifier;  /* of orthogonal codes; NULL: they are sparse */
    struct sparse *sparse;        /* the other way round */
    struct fitter fitter;
    struct {
        double left, kurtosis;    /* V²; see certificate */
    } seen[SEEN];                 /* what the words of the last frames left over */
    size_t count;                 /* of those, ever */
    size_t placed;                /* see count_placed; a frame that fails RIVALS alone leaves it as it is */
    bool timed;                   /* a certain word has shown that frames begin at their marks, which keep their distance */
    double mark, distance; /* chips: time of the last mark; distance of two marks in succession, 0 without marks */
    size_t begin;                 /* sample at which the frame is expected to begin */
};

struct frame_reader *frame_reader_new(const struct code *code, const struct frame_rules *rules,
                                      const struct certificate_limits *limits, float *expected, const uint8_t *broken)
{
    bool is_possible = rules->fit.side >= CERTIFICATE_SIDE && 2 * rules->fit.side <= CERTIFICATE_BESIDE;
    struct frame_reader *reader = is_possible ? calloc(1, sizeof *reader) : NULL;

    if (!reader)
        return NULL;
    reader->code = code;
    reader->rules = *rules;
    reader->limits = *limits;
    if (code->sparse)
        reader->sparse = sparse_new(code, limits, expected);
    else
        reader->certifier = certifier_new(code, limits, expected, broken);
    if (fitter_make(&reader->fitter, code, &reader->rules.fit, reader->certifier) && (reader->certifier || reader->sparse))
        return reader;
    frame_reader_free(reader);
    return NULL;
}

void frame_reader_free(struct frame_reader *reader)
{
    if (!reader)
        return;
    certifier_free(reader->certifier);
    sparse_free(reader->sparse);
    fitter_free(&reader->fitter);
    free(reader);
}

const struct frame_rules *frame_reader_rules(const struct frame_reader *reader)
{
    return &reader->rules;
}

struct fitter *frame_reader_fitter(struct frame_reader *reader)
{
    return &reader->fitter;
}

void frame_reader_expect(struct frame_reader *reader, const struct fit *fit, double scatter, bool measures)
{
    reader->fitter.carried = *fit;
    reader->rules.fit.earliest = fit->start - scatter;
    reader->rules.fit.latest = fit->start + scatter;
    reader->begin = (size_t)fmax(0, ceil(fit->start));
    reader->fitter.is_free = isinf(scatter);
    reader->fitter.measures = measures;
}

void frame_reader_propose(struct frame_reader *reader, const struct fit *fit)
{
    reader->fitter.proposed = *fit;
}

size_t frame_reader_due(const struct frame_reader *reader)
{
    const struct frame_rules *rules = &reader->rules;

    if (rules->integrated)
        return rules->size;
    double end = reader->fitter.carried.chip > 0 ? fit_end(&reader->fitter.carried, reader->code->span) + 0.5 : 0;
    return (size_t)ceil(fmax((double)rules->size, end) + rules->tail * rules->fit.chip - FIT_EDGE);
}

/* ---- samples ----------------------------------------------------------------------------------- */

/* Share of samples that are nearer to a rail than so many V, or beyond it. */
VECTORS static double share_clipped(const struct frame_rules *rules, double near, const float *volts, size_t size)
{
    float low = (float)(rules->rail_low + near), high = (float)(rules->rail_high - near);
    int32_t count = 0; /* as many bits as a volt, so that eight are compared at once */

    for (size_t i = 0; i < size; i++)
        count += (volts[i] <= low) | (volts[i] >= high);
    return (double)count / (double)size;
}

/* ---- silence ------------------------------------------------------------------------------------ */

/* A frame in which nobody spoke, however faintly: where that is told by silent_power, ρ is above 10 √N, far beyond
 * silent_rho; GapTiming doubts those that it has summed up, and `continues` bounds the variance of others. But where the rows of those who spoke
 * alternate, and their chips begin half a chip from where they are taken for beginning, means show nothing of them. */
static enum frame_verdict read_silence(const struct frame_reader *reader, const struct frame_rest *rest, double power,
                                 size_t begin, const struct words *words, struct frame_found *found)
{
    const struct frame_rules *rules = &reader->rules;

    found->start = rules->integrated ? 0 : (double)begin - 0.5;
    found->chip = rules->fit.chip;
    found->chip_noise_v = sqrt(power / rules->fit.chip);
    found->certificate = (struct certificate){.left = power / rules->fit.chip};
    if (found->clipped > rules->deafened)
        return FRAME_AT_RAIL;
    if (fmax(found->chip_noise_v, sqrt(rest->noise_v2)) > rules->most_noise)
        return FRAME_NOISY;
    if (!rules->integrated || reader->timed)
        return FRAME_SILENT;
    memset(words->amplitude, 0, WORDS_BYTES * reader->code->nodes);
    memset(words->doubtful, 1, reader->code->nodes);
    return FRAME_READ;
}

enum frame_verdict frame_reader_sum_up(const struct frame_reader *reader, const struct frame_rest *rest, double mean,
                                       double variance, const struct words *words, struct frame_found *found)
{
    const struct frame_rules *rules = &reader->rules;

    *found = (struct frame_found){.level = rest->level,
                                  .clipped = mean <= rules->rail_low || mean >= rules->rail_high};
    return read_silence(reader, rest, variance, 0, words, found);
}

/* ---- a frame ------------------------------------------------------------------------------------ */

/* What is seen of a frame by a fit. */
static struct certificate_view view_of(struct frame_reader *reader, const struct fit *fit, const struct frame_rest *rest)
{
    const size_t side = reader->rules.fit.side, after = side + reader->code->span;
    const double end = fit_end(fit, reader->code->span), last = (double)reader->fitter.line.size - FIT_EDGE + 0.1;
    struct certificate_view view = {
        .chips = reader->fitter.chips, .side = side, .noise_v2 = rest->noise_v2, .is_noise = true, .rest_unknown = !rest->known,
        .is_compared = reader->fitter.place_count > 0, .is_placed = reader->placed >= PLACED};

    view.rows_known = fit->start == reader->fitter.taken.start && fit->chip == reader->fitter.taken.chip;
    if (!view.rows_known)
        fitter_take(&reader->fitter, fit);
    for (size_t i = 0; i < side; i++) {
        bool before_seen = fit->start - (double)(side - i) * fit->chip > -FIT_EDGE - 0.1;
        bool after_seen = end + (double)(i + 1) * fit->chip < last;
        view.beside[i] = before_seen ? reader->fitter.levels[i] : NAN;
        view.beside[side + i] = after_seen ? reader->fitter.levels[after + i] : NAN;
    }
    return view;
}

/* The noise of a chip, V², as frames show it where no gap does: the least that any of the last ones left. */
static double noise_of_frames(const struct frame_reader *reader)
{
    double least = INFINITY;

    for (size_t i = 0; i < SEEN && i < reader->count; i++)
        least = fmin(least, reader->seen[i].left);
    return reader->count < LEARNT ? 0 : least;
}

/* Whether no clause fails but this one. */
static bool holds_beside(const struct certificate *certificate, enum certificate_clause except)
{
    bool holds = true;

    for (size_t clause = 0; clause < CERTIFICATE_CLAUSES; clause++)
        holds &= clause == (size_t)except || certificate->value[clause] < 1;
    return holds;
}

/* Whether frames of so much noise are as Gaussian as that, which they would not be if the noise were that of a node
 * or a tone in them all. A node has lowered the kurtosis by 2 (A² / noise)². */
static bool is_noise(const struct frame_reader *reader, const struct certificate_limits *limits, double noise)
{
    double chips = (double)(reader->code->bits * reader->code->order),
           swing2 = (double)(reader->code->swing * reader->code->swing);
    double by_chance = limits->deviations * sqrt(24 / chips), alike = 1 + 2 * limits->deviations * sqrt(2 / chips);
    double kurtosis = 0, count = 0;

    for (size_t i = 0; i < SEEN && i < reader->count; i++)
        if (reader->seen[i].left < alike * noise && reader->seen[i].kurtosis < 3 + by_chance) {
            kurtosis += reader->seen[i].kurtosis;
            count++;
        }
    by_chance /= sqrt(count);
    double of_node = swing2 / fmax(noise, swing2);
    return count > 0 && kurtosis > (3 - by_chance) * count && by_chance < of_node * of_node;
}

/* Counts certain frames in succession, from a mark on. */
static void count_placed(struct frame_reader *reader, const struct certificate *certificate)
{
    if (!holds_beside(certificate, CLAUSE_RIVALS))
        reader->placed = 0;
    else if (reader->distance > 0)
        reader->placed += certificate->speakers > 0 && certificate->value[CLAUSE_RIVALS] < 1;
}

/* Words and certificate of the chips in the reader. */
static void read_words(struct frame_reader *reader, const struct certificate_view *view, const struct words *words,
                       struct certificate *certificate)
{
    if (reader->sparse)
        sparse_read(reader->sparse, view, words, certificate);
    else
        certifier_read(reader->certifier, view, words, certificate);
}

/* Raises the certificate of a frame by what its samples say beside its chips: `within`, the value of what they have on
 * top of these; halves of chips, which nothing else is wrong with; and the other places. */
static void read_between(struct frame_reader *reader, const struct frame_rest *rest, double within,
                         const struct words *words, struct frame_found *found)
{
    struct certificate *certificate = &found->certificate;
    const struct fit fit = {found->start, found->chip};

    certificate->value[CLAUSE_ENERGY] = fmax(certificate->value[CLAUSE_ENERGY], within);
    if (!reader->sparse && certificate_worst(certificate) < 1)
        certifier_split(reader->certifier, fitter_split(&reader->fitter, &fit), certificate);
    for (size_t i = 0; i < reader->fitter.place_count; i++) {
        struct certificate_view other = view_of(reader, &reader->fitter.places[i].fit, rest);
        certifier_compare(reader->certifier, &other, reader->fitter.places[i].shift, words, certificate);
    }
}

/* What a frame's certificate makes of it and its words. power: V², mean square of the chips. */
static enum frame_verdict pronounce(struct frame_reader *reader, const struct certificate_view *view, double power,
                                const struct words *words, struct frame_found *found)
{
    const struct frame_rules *rules = &reader->rules;
    const struct certificate *certificate = &found->certificate;

    count_placed(reader, certificate);
    reader->timed |= certificate->speakers > 0 && certificate_worst(certificate) < 1;
    for (size_t i = 0; rules->integrated && !reader->timed && i < reader->code->nodes; i++)
        words->doubtful[i] |= !words->active[i]; /* of rows that alternate half a chip off, means show nothing */
    found->chip_noise_v = certificate->row_noise_v * sqrt((double)reader->code->order);
    bool is_hopeless = certificate->value[CLAUSE_ENERGY] > 1 / (rules->misfit * rules->misfit);
    bool is_misfit = certificate->speakers ? certificate->left > rules->misfit * power + 3 * view->noise_v2
                                             : is_hopeless && !certificate->understood;
    is_misfit |= reader->fitter.is_free && is_hopeless; /* nothing but its words says that there is a frame */
    if (is_misfit && !reader->sparse) { /* of sparse codes it says how many speak */
        reader->fitter.carried.chip = 0;
        return FRAME_MISFIT;
    }
    if (!certificate->speakers && found->chip_noise_v > rules->most_noise)
        return FRAME_NOISY;
    if (!(certificate_worst(certificate) < 1))
        memset(words->doubtful, 1, reader->code->nodes);
    bool is_loud = found->clipped > 0 && !certificate->speakers; /* silence reaches no rail */
    if (found->clipped > rules->deafened || is_loud ||
        (view->rest_unknown && reader->code->first == 0 && !reader->code->scrambled && !rules->integrated))
        memset(words->doubtful, 1, reader->code->nodes);
    return FRAME_READ;
}

/* A frame whose samples are means of chips. */
VECTORS static enum frame_verdict read_means(struct frame_reader *reader, const float *volts, size_t count,
                                  const struct frame_rest *rest, const struct words *words, struct frame_found *found)
{
    const struct code *code = reader->code;
    const size_t chips = code->bits * code->order;
    struct certificate_view view = {.chips = reader->fitter.chips,
                                    .side = reader->rules.fit.side,
                                    .noise_v2 = noise_of_frames(reader),
                                    /* Of some of its samples, which noise lifts off the rail, a mean does not tell. */
                                    .clipped = share_clipped(&reader->rules, reader->rules.silent_chip, volts, chips),
                                    .rest_unknown = !rest->known,
                                    .is_placed = reader->placed >= PLACED};

    for (size_t i = 0; i < 2 * view.side; i++)
        view.beside[i] = NAN;
    for (size_t i = 0; i < chips; i++)
        reader->fitter.chips[i] = volts[i] - (float)found->level;
    view.is_noise = reader->sparse && is_noise(reader, &reader->limits, view.noise_v2);
    found->start = 0;
    found->chip = 1;
    double power = sums_power(reader->fitter.chips, chips) / (double)chips;
    read_words(reader, &view, words, &found->certificate);
    enum frame_verdict verdict = pronounce(reader, &view, power, words, found);
    /* Without knowing how much noise there is, what is left is taken for that if nothing else is wrong. */
    if (reader->sparse ? found->certificate.understood : holds_beside(&found->certificate, CLAUSE_ENERGY)) {
        reader->seen[reader->count % SEEN].left = reader->sparse ? found->certificate.usual : found->certificate.left;
        reader->seen[reader->count++ % SEEN].kurtosis = found->certificate.kurtosis;
    }
    if (verdict == FRAME_READ && count > chips) /* a value was taken twice */
        memset(words->doubtful, 1, code->nodes);
    return verdict;
}

/* Samples of a frame: how many, whether no more will follow, and whether FRAME_SEARCH is an answer. */
struct given {
    const float *volts;
    size_t count;
    bool final, searches;
};

/* A frame of raw samples. sampled: their mean power, V². */
static enum frame_verdict read_samples(struct frame_reader *reader, const struct given *given, double sampled,
                                       const struct frame_rest *rest, const struct words *words,
                                       struct frame_found *found)
{
    const struct frame_rules *rules = &reader->rules;
    const size_t count = given->count;
    struct fitter *fitter = &reader->fitter;
    struct fit fit;
    double left, power;

    if (!fitter_line(fitter, given->volts, count, found->level) ||
        !fitter_find(fitter, rest->noise_v2, &fit, &left, &power))
        return FRAME_INCOMPLETE;
    if (isnan(power)) /* chips of absurd samples, or behind such: they would look like silence */
        return FRAME_ABSURD;
    if (given->searches && rules->searches && fitter_is_poor(fitter, left, power, rest->noise_v2)) {
        double longest = ceil(rules->fit.most_chip * ((double)reader->code->span + rules->tail));
        if (given->final || (double)count >= longest)
            return FRAME_SEARCH;
        found->more = (size_t)longest - count;
        return FRAME_NEEDS_MORE;
    }
    reader->fitter.proposed.chip = 0;
    reader->fitter.place_count = 0;
    if (reader->fitter.is_free) {
        fitter_choose(fitter, &fit);
        fitter_take(fitter, &fit);
        certifier_left(reader->certifier, reader->fitter.chips, &power);
    }
    double end = fit_end(&fit, reader->code->span), missing = end + rules->tail * fit.chip - (double)count;
    if (missing > FIT_EDGE && !given->final) {
        reader->fitter.carried = fit;
        found->more = (size_t)ceil(missing);
        return FRAME_NEEDS_MORE;
    }
    struct certificate_view view = view_of(reader, &fit, rest);
    view.clipped = found->clipped;
    /* What samples have besides their chips is noise, unless chips are misplaced and change within. */
    double size = (double)rules->size, noise = rest->noise_v2 * rules->fit.chip;
    double within = (sampled - noise - power) / (rules->kept * power + 3 * noise * sqrt(2 / size) + 1e-12);
    reader->fitter.carried = fit;
    found->start = fit.start;
    found->chip = fit.chip;
    read_words(reader, &view, words, &found->certificate);
    read_between(reader, rest, within, words, found);
    return pronounce(reader, &view, power, words, found);
}

void frame_reader_mark(struct frame_reader *reader, double chips)
{
    double distance = chips - reader->mark, periods = round(distance / reader->distance); /* marks may be lost */

    if (!(periods >= 1 && fabs(distance - periods * reader->distance) < 0.5)) {
        reader->placed = 0;
        reader->timed = false;
        periods = 1;
    }
    reader->distance = distance / periods;
    reader->mark = chips;
}

enum frame_verdict frame_reader_read(struct frame_reader *reader, const float *volts, size_t count, bool final,
                                     bool searches, const struct frame_rest *rest, const struct words *words,
                                     struct frame_found *found)
{
    const struct frame_rules *rules = &reader->rules;

    *found = (struct frame_found){.level = rest->level};
    const float *frame = volts + reader->begin;
    if (count < reader->begin + rules->size)
        return FRAME_INCOMPLETE;
    struct samples_sums sums = samples_add(frame, rules->size);
    double mean = sums.sum / (double)rules->size, power = sums.squares / (double)rules->size;
    if (isnan(power))
        return FRAME_ABSURD;
    if (rules->mean_is_offset && (rules->integrated || !rest->known))
        found->level = mean;
    if (reader->code->first > 0)
        power -= mean * mean;
    else
        power += found->level * (found->level - 2 * mean);
    found->clipped = share_clipped(rules, 0, frame, rules->size);
    if (found->clipped > rules->clipped)
        return FRAME_AT_RAIL;
    if (power <= rules->silent_power) {
        double most = 0;
        for (size_t i = 0; rules->integrated && i < rules->size; i++)
            most = fmax(most, fabs((double)volts[i] - found->level));
        if (most <= rules->silent_chip)
            return read_silence(reader, rest, fmax(power, 0), reader->begin, words, found);
    }
    return rules->integrated
               ? read_means(reader, volts, count, rest, words, found)
               : read_samples(reader, &(struct given){volts, count, final, searches}, power, rest, words, found);
}
