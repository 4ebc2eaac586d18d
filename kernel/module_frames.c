// SPDX-License-Identifier: Apache-2.0

/* The class Code of the Python module, which looks for frames: see fit.h, judge.h and gap.h. */
#include "binding.h"

#include <math.h>

#include "gap.h"

/* flips: none, or one per chip. */
CONSTRUCTOR(Code, SETTINGS(words_frame), OBJECT("correlate", "Transform"), OBJECT("spread", "Transform"),
            ARRAY("flips", 'f', "f"), ARRAY("places", 'i', "c"), SIZE("span"))
{
    const struct words_frame *frame = call->value[0].data;
    const int32_t *places = call->value[4].data;
    size_t chips = axis(call, 'c'), flips = axis(call, 'f'), span = call->value[5].size;

    if (!(frame->bits >= 2 && frame->bits <= WORDS_MOST_BITS && frame->nodes &&
          frame->first <= frame->order && frame->nodes <= frame->order - frame->first &&
          transform_order(call->value[1].data) == frame->order &&
          transform_order(call->value[2].data) == frame->order))
        return refuse(call, "words_frame: of no frame, or not of the transforms' order");
    if (!(chips == frame->bits * frame->order && (flips == 0 || flips == chips) && span < 1 << 24))
        return refuse(call, "places: %zu chips expected, and as many flips or none",
                      frame->bits * frame->order);
    for (size_t i = 0; i < chips; i++)
        if (places[i] < 0 || (size_t)places[i] >= span || (i && places[i] <= places[i - 1]))
            return refuse(call, "places: not rising, or beyond the span");
    struct fit_code *code = PyMem_Malloc(sizeof *code);
    if (code)
        *code = (struct fit_code){*frame, span, call->value[1].data, call->value[2].data,
                                  flips ? call->value[3].data : NULL, places};
    return hold(call, code, PyMem_Free);
}

FUNCTION(refine, ARRAY("volts", 'd', "m"), ARRAY("sums", 'd', "s"), NUMBER("blur"),
         NUMBER("settled_chips"), ARRAY("reaches", 'd', "r"), NUMBER("start"), NUMBER("chip"),
         NUMBER("earliest"), NUMBER("latest"), OUT("scratch", 'f', "f"))
{
    const struct fit_code *code = held_by(call->self);
    const struct fit_line line = {axis(call, 'm'), call->value[0].data, call->value[1].data, 0};
    struct fit fit = {call->value[5].number, call->value[6].number};
    struct fit_refining refining = {call->value[2].number, call->value[3].number, axis(call, 'r'),
                                    call->value[4].data};

    if (!(line.size && axis(call, 's') == line.size + 1))
        return refuse(call, "volts: some, and one more of sums, expected");
    if (axis(call, 'f') < fit_scratch(code))
        return refuse(call, "scratch: %zu values expected", fit_scratch(code));
    fit = fit_refine(code, &line, &refining, fit, call->value[7].number, call->value[8].number,
                     call->value[9].data);
    return Py_BuildValue("(dd)", fit.start, fit.chip);
}

/* Whether the lengths of a search are possible. */
static bool is_search(const struct burst_search *search)
{
    return search->half && search->group && search->low <= search->high && search->high < 1 << 20 &&
           search->bit < 1 << 20 && search->window && search->width && search->gap_size < 1 << 26 &&
           search->group < 1 << 20;
}

FUNCTION(look, SETTINGS(burst_search), SETTINGS(gap_rules), ARRAY("reaches", 'd', "r"), ARRAY("volts", 'd', "m"),
         ARRAY("raw", 'd', "m"), NUMBER("least_power"), NUMBER("level"), NUMBER("variance"), NUMBER("start"),
         NUMBER("scatter"), NUMBER("chip"), NUMBER("slips"), OUT("rows", 'f', "1kN"), OUT("amplitude", 'f', "1n"),
         OUT("uneven", 'f', "1n"), OUT("pedestal", 'f', "1"), OUT("power", 'f', "1"), OUT("spread", 'f', "1"),
         OUT("misfit", 'f', "1"), OUT("values", 'd', "v"), OUT("scratch", 'f', "f"))
{
    const struct fit_code *code = held_by(call->self);
    const struct words_frame *frame = &code->frame;
    const union value *value = call->value;
    const struct burst_search *search = value[0].data;
    const struct gap_rules *rules = value[1].data;
    const struct fit_refining refining = {rules->blur, rules->settled_chips, axis(call, 'r'), value[2].data};
    struct burst_gap known = {value[6].number, value[7].number, 0};
    struct gap_expected expected = {value[8].number, value[9].number, value[10].number, value[11].number};
    struct gap_seen seen = {.words = {value[12].data, value[13].data, value[14].data, value[15].data, value[16].data,
                                      value[17].data, value[18].data}};
    size_t samples = axis(call, 'm');
    enum gap_look look;

    if (!(axis(call, 'k') == frame->bits && axis(call, 'N') == frame->order && axis(call, 'n') == frame->nodes))
        return refuse(call, "rows: (%zu, %zu) with %zu nodes expected", frame->bits, frame->order, frame->nodes);
    if (!is_search(search))
        return refuse(call, "burst_search: a length is 0 or too large");
    if (rules->spare > code->frame.order || rules->spare_count > code->frame.order - rules->spare)
        return refuse(call, "gap_rules: spare rows beyond the order");
    if (!(axis(call, 'v') >= gap_values(search, samples) && axis(call, 'f') >= gap_scratch(code, search)))
        return refuse(call, "values, scratch: %zu and %zu expected", gap_values(search, samples),
                      gap_scratch(code, search));
    if (!gap_look(code, search, rules, &refining, value[3].data, value[4].data, samples, value[5].number, &known,
                  &expected, &seen, &look, value[19].data, value[20].data))
        Py_RETURN_NONE;
    return Py_BuildValue("i(ddn)(dddddd)d(dd)O(ddOd)Odd", (int)look, seen.gap.level, seen.gap.variance,
                         (Py_ssize_t)seen.gap.begin, seen.burst.first, seen.burst.last, seen.burst.slack,
                         seen.burst.power, seen.burst.variance, seen.burst.pause, seen.proven, seen.fit.start,
                         seen.fit.chip, seen.unaided ? Py_True : Py_False, seen.beside.level, seen.beside.variance,
                         seen.beside.quiet ? Py_True : Py_False, seen.beside.noise, seen.sound ? Py_True : Py_False,
                         seen.clipped, seen.noise);
}

CLASS(code_spec, Code, ENTRY(refine), ENTRY(look));
