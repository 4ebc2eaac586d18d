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
#define MORE_NOISE 1.5 /* times the gap's noise that a carried timing may leave before it is refined */
#define NEAR 0.7     /* share of what a frame's words explain, from which on others may explain as much when refined */
#define EDGE 0.5     /* of a sample by which a chip beside may reach beyond the samples */

struct frame_reader {
    const struct code *code;
    struct frame_rules rules;
    struct certificate_limits limits;
    struct certifier *certifier;  /* of orthogonal codes; NULL: they are sparse */
    struct sparse *sparse;        /* the other way round */
    struct fit carried, proposed; /* chip 0: none */
    struct fit taken;             /* by which the chips are */
    struct {
        double left, kurtosis;    /* V²; see certificate */
    } seen[SEEN];                 /* what the words of the last frames left over */
    size_t count;                 /* of those, ever */
    size_t placed;                /* see count_placed; a frame that fails RIVALS alone leaves it as it is */
    bool timed;                   /* a certain word has shown that frames begin at their marks, which keep their distance */
    double mark, distance; /* chips: time of the last mark; distance of two marks in succession, 0 without marks */
    double *sums;                 /* of the samples of a frame */
    size_t room;
    size_t begin;                 /* sample at which the frame is expected to begin */
    bool is_free, measures;       /* it may begin whole chips beside that, too; that is refined in any case */
    struct place {
        struct fit fit;
        int shift;                /* chips by which it is later */
    } places[CERTIFICATE_BESIDE]; /* where else, and of how many of these the words explain nearly as much */
    size_t place_count;
    float *levels;                /* (span + 2·side) V, chips by a fit, with those beside and pauses */
    float *halves;                /* (2·span) V, of chips */
    float *chips, *split;         /* (k, N) of these; see certificate_view */
    float *scratch;
};

struct frame_reader *frame_reader_new(const struct code *code, const struct frame_rules *rules,
                                      const struct certificate_limits *limits, float *expected, const uint8_t *broken)
{
    struct frame_reader *reader = calloc(1, sizeof *reader);

    if (!reader)
        return NULL;
    reader->code = code;
    reader->rules = *rules;
    reader->limits = *limits;
    if (code->sparse)
        reader->sparse = sparse_new(code, limits, expected);
    else
        reader->certifier = certifier_new(code, limits, expected, broken);
    reader->levels = malloc((code->span + 2 * rules->side) * sizeof(float));
    reader->halves = malloc(2 * code->span * sizeof(float));
    reader->chips = malloc(2 * code->bits * code->order * sizeof(float));
    reader->scratch = malloc(fit_scratch(code) * sizeof(float));
    if ((reader->certifier || reader->sparse) && reader->levels && reader->halves && reader->chips &&
        reader->scratch) {
        reader->split = reader->chips + code->bits * code->order;
        return reader;
    }
    frame_reader_free(reader);
    return NULL;
}

void frame_reader_free(struct frame_reader *reader)
{
    if (!reader)
        return;
    certifier_free(reader->certifier);
    sparse_free(reader->sparse);
    free(reader->levels);
    free(reader->halves);
    free(reader->chips);
    free(reader->scratch);
    free(reader->sums);
    free(reader);
}

const struct frame_rules *frame_reader_rules(const struct frame_reader *reader)
{
    return &reader->rules;
}

size_t frame_reader_nodes(const struct frame_reader *reader)
{
    return reader->code->nodes;
}

double frame_reader_span(const struct frame_reader *reader)
{
    return (double)reader->code->span;
}

void frame_reader_expect(struct frame_reader *reader, const struct fit *fit, double scatter, bool measures)
{
    reader->carried = *fit;
    reader->rules.earliest = fit->start - scatter;
    reader->rules.latest = fit->start + scatter;
    reader->begin = (size_t)fmax(0, ceil(fit->start));
    reader->is_free = isinf(scatter);
    reader->measures = measures;
}

void frame_reader_propose(struct frame_reader *reader, const struct fit *fit)
{
    reader->proposed = *fit;
}

size_t frame_reader_due(const struct frame_reader *reader)
{
    const struct frame_rules *rules = &reader->rules;

    if (rules->integrated)
        return rules->size;
    double end = reader->carried.chip > 0 ? fit_end(&reader->carried, reader->code->span) + 0.5 : 0;
    return (size_t)ceil(fmax((double)rules->size, end) + rules->tail * rules->chip - EDGE);
}

/* ---- samples ----------------------------------------------------------------------------------- */

VECTORS void samples_volts(const int16_t *restrict counts, size_t size, float zero, float per_count, float most,
                           float *restrict volts)
{
    for (size_t i = 0; i < size; i++) {
        float level = ((float)counts[i] - zero) * per_count;
        volts[i] = fabsf(level) < most ? level : NAN;
    }
}

VECTORS struct samples_sums samples_add(const float *volts, size_t size)
{
    doubles4 sum[2] = {{0}, {0}}, squares[2] = {{0}, {0}};
    struct samples_sums all = {0, 0};
    size_t i = 0;

    for (; i + 8 <= size; i += 8)
        for (size_t half = 0; half < 2; half++) {
            doubles4 four = __builtin_convertvector(*(const floats4 *)(volts + i + 4 * half), doubles4);
            sum[half] += four;
            squares[half] += four * four;
        }
    for (; i < size; i++) {
        double level = (double)volts[i];
        all.sum += level;
        all.squares += level * level;
    }
    for (size_t lane = 0; lane < 8; lane++) {
        all.sum += sum[lane / 4][lane % 4];
        all.squares += squares[lane / 4][lane % 4];
    }
    return all;
}

VECTORS static double share_clipped(const struct frame_rules *rules, const float *volts, size_t size)
{
    float low = (float)rules->rail_low, high = (float)rules->rail_high;
    size_t count = 0;

    for (size_t i = 0; i < size; i++)
        count += (size_t)(volts[i] <= low) | (size_t)(volts[i] >= high);
    return (double)count / (double)size;
}

/* ---- silence ------------------------------------------------------------------------------------ */

/* Nobody spoke; or the rows of those who did alternate, and their chips begin half a chip from where they are taken for
 * beginning: means show nothing of them. */
static enum frame_verdict silent(const struct frame_reader *reader, const struct frame_rest *rest, double power,
                                 size_t begin, const struct words *words, struct frame_found *found)
{
    const struct frame_rules *rules = &reader->rules;

    found->start = rules->integrated ? 0 : (double)begin - 0.5;
    found->chip = rules->chip;
    found->noise = sqrt(power / rules->chip);
    found->certificate = (struct certificate){.left = power / rules->chip};
    if (found->clipped > rules->deafened)
        return FRAME_AT_RAIL;
    if (fmax(found->noise, sqrt(rest->noise)) > rules->most_noise)
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
    return silent(reader, rest, variance, 0, words, found);
}

/* ---- timing ------------------------------------------------------------------------------------- */

/* Chips by a fit, into reader->levels with those beside the frame, and into reader->chips. */
static void take_chips(struct frame_reader *reader, const struct fit_line *line, const struct fit *fit)
{
    const struct code *code = reader->code;
    const size_t chips = code->bits * code->order;
    const size_t side = reader->rules.side;
    const float *levels = reader->levels + side;

    reader->taken = *fit;
    fit_levels(line, fit, reader->rules.refining.blur, side, code->span + 2 * side, reader->levels);
    if (code->span == chips)
        memcpy(reader->chips, levels, chips * sizeof *levels);
    else
        for (size_t i = 0; i < chips; i++)
            reader->chips[i] = levels[code->places[i]];
}

/* What changes within the chips of a fit. */
VECTORS static const float *take_split(struct frame_reader *reader, const struct fit_line *line, const struct fit *fit)
{
    const struct code *code = reader->code;
    const struct fit halves = {fit->start, fit->chip / 2};

    fit_levels(line, &halves, reader->rules.refining.blur, 0, 2 * code->span, reader->halves);
    for (size_t i = 0; i < code->bits * code->order; i++) {
        const float *chip = reader->halves + 2 * code->places[i];
        reader->split[i] = (chip[0] - chip[1]) / 2;
    }
    return reader->split;
}

/* What is seen of a frame by a fit. */
static struct certificate_view view_of(struct frame_reader *reader, const struct fit_line *line,
                                       const struct fit *fit, const struct frame_rest *rest)
{
    const size_t side = reader->rules.side, after = side + reader->code->span;
    const double end = fit_end(fit, reader->code->span), last = (double)line->size - EDGE + 0.1;
    struct certificate_view view = {
        .chips = reader->chips, .side = side, .noise = rest->noise, .is_noise = true, .level_unknown = !rest->known,
        .is_compared = reader->place_count > 0, .is_placed = reader->placed >= PLACED};

    view.rows_known = fit->start == reader->taken.start && fit->chip == reader->taken.chip;
    if (!view.rows_known)
        take_chips(reader, line, fit);
    for (size_t i = 0; i < side; i++) {
        bool before_seen = fit->start - (double)(side - i) * fit->chip > -EDGE - 0.1;
        bool after_seen = end + (double)(i + 1) * fit->chip < last;
        view.beside[i] = before_seen ? reader->levels[i] : NAN;
        view.beside[side + i] = after_seen ? reader->levels[after + i] : NAN;
    }
    return view;
}

/* Whether a fit is within the limits, and its frame within the samples. */
static bool is_possible(const struct frame_reader *reader, const struct fit_line *line, const struct fit *fit)
{
    const struct frame_rules *rules = &reader->rules;

    return fit->chip >= rules->least_chip && fit->chip <= rules->most_chip &&
           !(reader->is_free && fit->start < -EDGE) &&
           fit_end(fit, reader->code->span) <= (double)line->size - EDGE + 0.3 * fit->chip;
}

/* The timing of the frames before where that explains this one, else the best of it, of one that was proposed, and of
 * these refined. left, power: mean squares, V². False where none is possible. */
static bool find_fit(struct frame_reader *reader, const struct fit_line *line, double noise, struct fit *best,
                     double *left, double *power)
{
    const struct frame_rules *rules = &reader->rules;
    const struct fit nominal = {0.5 * (rules->earliest + rules->latest) - 0.25, rules->chip};
    const struct fit begin = reader->carried.chip > 0 ? reader->carried : nominal;
    struct fit tries[] = {reader->carried, reader->proposed, begin, reader->proposed};
    bool any = false;

    *left = *power = INFINITY;
    for (size_t i = 0; i < 4; i++) {
        struct fit fit = tries[i];
        double over, of_chips;
        if (!(fit.chip > 0))
            continue;
        if (i >= 2)
            fit = fit_refine(reader->code, line, &rules->refining, reader->certifier, fit, rules->earliest,
                             rules->latest, reader->scratch);
        if (!is_possible(reader, line, &fit)) {
            fit = i >= 2 ? tries[i] : fit;
            if (!is_possible(reader, line, &fit))
                continue;
        }
        take_chips(reader, line, &fit);
        over = certifier_left(reader->certifier, reader->chips, &of_chips);
        if (!any || over < 0.98 * *left || reader->measures) {
            *best = fit;
            *left = over;
            *power = of_chips;
        }
        any = true;
        if (*left < MORE_NOISE * noise + rules->refined * *power && !reader->measures)
            break;
    }
    return any;
}

/* Sum of squares, V², that the words of a fit explain. */
static double explained_by(struct frame_reader *reader, const struct fit_line *line, const struct fit *fit)
{
    take_chips(reader, line, fit);
    return certifier_explained(reader->certifier, reader->chips);
}

/* Moves a frame that may begin anywhere by whole chips to where its words explain most, and keeps the other places at
 * which they explain nearly as much: each with its own best timing, as that of one suits the words of no other. */
static void choose_place(struct frame_reader *reader, const struct fit_line *line, struct fit *best)
{
    const int side = (int)reader->rules.side;
    const struct fit here = *best;
    double most = explained_by(reader, line, best), least = fmax(NEAR * most, 0);
    int moved = 0;

    reader->place_count = 0;
    for (int shift = -side; shift <= side; shift++) {
        struct fit there = {here.start + shift * here.chip, here.chip};
        double power = shift && is_possible(reader, line, &there) ? explained_by(reader, line, &there) : 0;
        if (!(power > least)) /* nor is there one where words explain nothing, or it is not known what */
            continue;
        struct fit own = fit_refine(reader->code, line, &reader->rules.refining, reader->certifier, there, -INFINITY,
                                    INFINITY, reader->scratch);
        bool is_near = fabs(own.start - there.start) < here.chip / 2 && is_possible(reader, line, &own);
        double refined = is_near ? explained_by(reader, line, &own) : 0;
        if (refined > power) {
            there = own;
            power = refined;
        }
        struct place *place = &reader->places[reader->place_count++];
        *place = (struct place){there, shift};
        if (power > (1 + reader->rules.tied) * most) {
            *place = (struct place){*best, moved};
            *best = there;
            moved = shift;
            most = power;
        }
    }
    for (size_t i = 0; i < reader->place_count; i++)
        reader->places[i].shift -= moved;
}

/* ---- a frame ------------------------------------------------------------------------------------ */

/* Sees to it that the running sums of so many samples have room. */
static bool make_room(struct frame_reader *reader, size_t count)
{
    if (reader->room > count)
        return true;
    double *sums = malloc(2 * (count + 1) * sizeof *sums);
    if (!sums)
        return false;
    free(reader->sums);
    reader->sums = sums;
    reader->room = 2 * (count + 1);
    return true;
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

/* Words and certificate of the chips in the reader. line: the frame's samples, to compare other places; NULL: none.
 * power: V², mean square of the chips. within: the value of what samples have on top of their chips. */
static enum frame_verdict certify(struct frame_reader *reader, const struct certificate_view *view,
                                  const struct fit_line *line, const struct frame_rest *rest, double power,
                                  double within, const struct words *words, struct frame_found *found)
{
    const struct frame_rules *rules = &reader->rules;
    struct certificate *certificate = &found->certificate;

    if (reader->sparse)
        sparse_read(reader->sparse, view, words, certificate);
    else
        certifier_read(reader->certifier, view, words, certificate);
    if (within > certificate->value[CLAUSE_ENERGY])
        certificate->value[CLAUSE_ENERGY] = within;
    for (size_t i = 0; line && i < reader->place_count; i++) {
        struct certificate_view other = view_of(reader, line, &reader->places[i].fit, rest);
        certifier_compare(reader->certifier, &other, reader->places[i].shift, words, certificate);
    }
    count_placed(reader, certificate);
    reader->timed |= certificate->speakers > 0 && certificate_worst(certificate, NULL) < 1;
    for (size_t i = 0; rules->integrated && !reader->timed && i < reader->code->nodes; i++)
        words->doubtful[i] |= !words->active[i]; /* of rows that alternate half a chip off, means show nothing */
    found->noise = certificate->noise * sqrt((double)reader->code->order);
    bool is_hopeless = certificate->value[CLAUSE_ENERGY] > 1 / (rules->misfit * rules->misfit);
    bool is_misfit = certificate->speakers ? certificate->left > rules->misfit * power + 3 * view->noise
                                             : is_hopeless && !certificate->understood;
    is_misfit |= reader->is_free && is_hopeless; /* nothing but its words says that there is a frame */
    if (is_misfit && !reader->sparse) { /* of sparse codes it says how many speak */
        reader->carried.chip = 0;
        return FRAME_MISFIT;
    }
    if (!certificate->speakers && found->noise > rules->most_noise)
        return FRAME_NOISY;
    if (!(certificate_worst(certificate, NULL) < 1))
        memset(words->doubtful, 1, reader->code->nodes);
    if (found->clipped > rules->deafened ||
        (view->level_unknown && reader->code->first == 0 && !reader->code->scrambled && !rules->integrated))
        memset(words->doubtful, 1, reader->code->nodes);
    return FRAME_READ;
}

/* A frame whose samples are means of chips. */
static enum frame_verdict read_means(struct frame_reader *reader, const float *volts, size_t count,
                                  const struct frame_rest *rest, const struct words *words, struct frame_found *found)
{
    const struct code *code = reader->code;
    const size_t chips = code->bits * code->order;
    struct certificate_view view = {.chips = reader->chips,
                                    .side = reader->rules.side,
                                    .noise = noise_of_frames(reader),
                                    .level_unknown = !rest->known,
                                    .is_placed = reader->placed >= PLACED};

    for (size_t i = 0; i < 2 * view.side; i++)
        view.beside[i] = NAN;
    for (size_t i = 0; i < chips; i++)
        reader->chips[i] = volts[i] - (float)found->level;
    view.is_noise = reader->sparse && is_noise(reader, &reader->limits, view.noise);
    found->start = 0;
    found->chip = 1;
    double power = sums_power(reader->chips, chips) / (double)chips;
    enum frame_verdict verdict = certify(reader, &view, NULL, rest, power, 0, words, found);
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
    struct fit_line line = {count, given->volts, reader->sums, found->level};
    struct fit fit;
    double left, power;

    fit_sums(given->volts, count, found->level, reader->sums);
    if (!find_fit(reader, &line, rest->noise, &fit, &left, &power))
        return FRAME_INCOMPLETE;
    if (isnan(power)) /* chips of absurd samples, or behind such: they would look like silence */
        return FRAME_ABSURD;
    if (given->searches && rules->searches && left > rules->searched * power + 3 * rest->noise) {
        double longest = ceil(rules->most_chip * (frame_reader_span(reader) + rules->tail));
        if (given->final || (double)count >= longest)
            return FRAME_SEARCH;
        found->more = (size_t)longest - count;
        return FRAME_NEEDS_MORE;
    }
    reader->proposed.chip = 0;
    reader->place_count = 0;
    if (reader->is_free) {
        choose_place(reader, &line, &fit);
        take_chips(reader, &line, &fit);
        certifier_left(reader->certifier, reader->chips, &power);
    }
    double end = fit_end(&fit, reader->code->span), missing = end + rules->tail * fit.chip - (double)count;
    if (missing > EDGE && !given->final) {
        reader->carried = fit;
        found->more = (size_t)ceil(missing);
        return FRAME_NEEDS_MORE;
    }
    struct certificate_view view = view_of(reader, &line, &fit, rest);
    view.split = reader->sparse ? NULL : take_split(reader, &line, &fit);
    /* What samples have besides their chips is noise, unless chips are misplaced and change within. */
    double size = (double)rules->size, noise = rest->noise * rules->chip;
    double within = (sampled - noise - power) / (rules->kept * power + 3 * noise * sqrt(2 / size) + 1e-12);
    reader->carried = fit;
    found->start = fit.start;
    found->chip = fit.chip;
    return certify(reader, &view, &line, rest, power, within, words, found);
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

void frame_reader_explained(struct frame_reader *reader, const float *volts, size_t size, double level,
                            const struct fit *fit, size_t count, double *powers)
{
    if (!make_room(reader, size))
        count = 0;
    struct fit_line line = {size, volts, reader->sums, level};
    struct fit at = *fit;

    if (count)
        fit_sums(volts, size, level, reader->sums);
    for (size_t i = 0; i < count; i++, at.start += at.chip) {
        double power;
        take_chips(reader, &line, &at);
        double left = certifier_left(reader->certifier, reader->chips, &power);
        powers[i] = power - left;
    }
}

enum frame_verdict frame_reader_read(struct frame_reader *reader, const float *volts, size_t count, bool final,
                                     bool searches, const struct frame_rest *rest, const struct words *words,
                                     struct frame_found *found)
{
    const struct frame_rules *rules = &reader->rules;

    *found = (struct frame_found){.level = rest->level};
    const float *frame = volts + reader->begin;
    if (count < reader->begin + rules->size || !make_room(reader, count))
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
    found->clipped = share_clipped(rules, frame, rules->size);
    if (found->clipped > rules->clipped)
        return FRAME_AT_RAIL;
    if (power <= rules->silent_power) {
        double most = 0;
        for (size_t i = 0; rules->integrated && i < rules->size; i++)
            most = fmax(most, fabs((double)volts[i] - found->level));
        if (most <= rules->silent_chip)
            return silent(reader, rest, fmax(power, 0), reader->begin, words, found);
    }
    return rules->integrated
               ? read_means(reader, volts, count, rest, words, found)
               : read_samples(reader, &(struct given){volts, count, final, searches}, power, rest, words, found);
}
