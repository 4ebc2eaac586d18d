// SPDX-License-Identifier: Apache-2.0

/* The classes Code and Bursts of the Python module, with which frames are looked for: see fit.h, judge.h and
 * burst.h, and tactile_cdma/_kernel.pyi. */
#include "binding.h"

#include <math.h>

#include "burst.h"
#include "judge.h"

/* ---- Code -------------------------------------------------------------------------------------- */

struct code {
    struct fit_code code;
    PyObject *correlate, *spread;
    Py_buffer flips, places;
};

static void drop_code(void *held)
{
    struct code *code = held;

    PyBuffer_Release(&code->flips);
    PyBuffer_Release(&code->places);
    Py_XDECREF(code->correlate);
    Py_XDECREF(code->spread);
    PyMem_Free(code);
}

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
    struct code *code = PyMem_Calloc(1, sizeof *code);
    if (!code)
        return PyErr_NoMemory();
    code->code = (struct fit_code){*frame, span, call->value[1].data, call->value[2].data,
                                   flips ? call->value[3].data : NULL, places};
    code->correlate = Py_NewRef(call->given[1]);
    code->spread = Py_NewRef(call->given[2]);
    code->flips = keep(call, 3);
    code->places = keep(call, 4);
    return hold((PyTypeObject *)call->self, code, drop_code);
}

/* The line of the arguments `volts` (m) and `sums`; refused unless there is one more of these. */
static bool is_line(struct call *call, size_t volts, struct fit_line *line)
{
    *line = (struct fit_line){length(call, volts), call->value[volts].data, call->value[volts + 1].data};
    if (line->size && length(call, volts + 1) == line->size + 1)
        return true;
    refuse(call, "volts: some, and one more of sums, expected");
    return false;
}

FUNCTION(refine, ARRAY("volts", 'd', "m"), ARRAY("sums", 'd', "s"), NUMBER("blur"),
         NUMBER("settled_chips"), ARRAY("reaches", 'd', "r"), NUMBER("start"), NUMBER("chip"),
         NUMBER("earliest"), NUMBER("latest"), OUT("scratch", 'f', "f"))
{
    const struct code *code = held_by(call->self);
    struct fit_line line;
    struct fit fit = {call->value[5].number, call->value[6].number};
    struct fit_refining refining = {call->value[2].number, call->value[3].number, axis(call, 'r'),
                                    call->value[4].data};

    if (!is_line(call, 0, &line))
        return NULL;
    if (axis(call, 'f') < fit_scratch(&code->code))
        return refuse(call, "scratch: %zu values expected", fit_scratch(&code->code));
    fit = fit_refine(&code->code, &line, &refining, fit, call->value[7].number, call->value[8].number,
                     call->value[9].data);
    return Py_BuildValue("(dd)", fit.start, fit.chip);
}

FUNCTION(weigh, SETTINGS(judge_limits), ARRAY("volts", 'd', "m"), ARRAY("sums", 'd', "s"),
         ARRAY("start", 'd', "c"), ARRAY("chip", 'd', "c"), NUMBER("begin"), NUMBER("end"),
         NUMBER("noise"), NUMBER("distortion"), NUMBER("variance"),
         OUT("rows", 'f', "ckN"), OUT("amplitude", 'f', "cn"), OUT("uneven", 'f', "cn"),
         OUT("pedestal", 'f', "c"), OUT("power", 'f', "c"), OUT("spread", 'f', "c"),
         OUT("misfit", 'f', "c"), OUT("cost", 'd', "c"), OUT("scratch", 'f', "f"))
{
    const struct fit_code *code = &((struct code *)held_by(call->self))->code;
    struct judge_candidates candidates = {axis(call, 'c'), call->value[3].data, call->value[4].data,
                                          call->value[5].number, call->value[6].number};
    struct judge_found found = {call->value[10].data, call->value[11].data, call->value[12].data,
                                call->value[13].data, call->value[14].data, call->value[15].data,
                                call->value[16].data, call->value[17].data};
    struct judge_votes votes = {call->value[8].number, call->value[9].number};
    struct fit_line line;

    if (!is_line(call, 1, &line))
        return NULL;
    if (!(axis(call, 'k') == code->frame.bits && axis(call, 'N') == code->frame.order &&
          axis(call, 'n') == code->frame.nodes))
        return refuse(call, "rows: (c, %zu, %zu) with %zu nodes expected", code->frame.bits,
                      code->frame.order, code->frame.nodes);
    size_t chips = judge_chips(code, &candidates);
    if (!chips)
        return refuse(call, "start: a candidate is not within the view");
    if (axis(call, 'f') < 2 * chips + code->frame.bits * code->frame.order)
        return refuse(call, "scratch: %zu values expected", 2 * chips + code->frame.bits * code->frame.order);
    judge_weigh(code, &line, call->value[0].data, &candidates, call->value[7].number, &found, &votes,
                call->value[18].data);
    return Py_BuildValue("(ddn)", votes.distortion, votes.variance, (Py_ssize_t)chips);
}

static PyMethodDef code_methods[] = {ENTRY(refine), ENTRY(weigh), {0}};

static PyType_Slot code_slots[] = {
    {Py_tp_new, Code},
    {Py_tp_dealloc, drop_holder},
    {Py_tp_methods, code_methods},
    {0},
};

PyType_Spec code_spec = {
    .name = "tactile_cdma._kernel.Code",
    .basicsize = sizeof(struct holder),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = code_slots,
};

/* ---- bursts ------------------------------------------------------------------------------------ */

/* Whether a search is one, and there is scratch for so many samples; if not, with an exception. */
static bool is_search(const struct call *call, const struct burst_search *search, size_t size)
{
    if (!(search->half && search->group && search->low <= search->high && search->high < 1 << 20 &&
          search->bit < 1 << 20 && search->window && search->width && search->gap_size < 1 << 26 &&
          search->group < 1 << 20)) {
        refuse(call, "burst_search: a length is 0 or too large");
        return false;
    }
    if (axis(call, 's') >= burst_scratch(search, size))
        return true;
    refuse(call, "scratch: %zu values expected", burst_scratch(search, size));
    return false;
}

FUNCTION(find_gap, SETTINGS(burst_search), ARRAY("volts", 'd', "m"), NUMBER("level"), NUMBER("variance"),
         OUT("scratch", 'd', "s"))
{
    const struct burst_search *search = call->value[0].data;
    struct burst_gap known = {call->value[2].number, call->value[3].number, 0}, gap = known;

    if (!is_search(call, search, axis(call, 'm')))
        return NULL;
    if (!burst_gap(search, call->value[1].data, axis(call, 'm'), &known, &gap, call->value[4].data))
        Py_RETURN_NONE;
    return Py_BuildValue("(ddn)", gap.level, gap.variance, (Py_ssize_t)gap.begin);
}

FUNCTION(find_burst, SETTINGS(burst_search), ARRAY("volts", 'd', "m"), NUMBER("least_power"),
         NUMBER("variance"), OUT("scratch", 'd', "s"))
{
    const struct burst_search *search = call->value[0].data;
    struct burst_found found;

    if (!is_search(call, search, axis(call, 'm')))
        return NULL;
    if (!burst_find(search, call->value[1].data, axis(call, 'm'), call->value[2].number,
                    call->value[3].number, &found, call->value[4].data))
        Py_RETURN_NONE;
    return Py_BuildValue("(dddddd)", found.first, found.last, found.slack, found.power, found.variance,
                         found.pause);
}

FUNCTION(look_beside, SETTINGS(burst_search), ARRAY("volts", 'd', "m"), SIZE("first"), SIZE("end"),
         NUMBER("variance"), NUMBER("power"), OUT("scratch", 'd', "s"))
{
    const struct burst_search *search = call->value[0].data;
    size_t first = call->value[2].size, end = call->value[3].size;

    if (!is_search(call, search, 2 * search->gap_size))
        return NULL;
    if (!(first <= axis(call, 'm')))
        return refuse(call, "first: beyond the samples");
    struct burst_beside found =
        burst_beside(search, call->value[1].data, axis(call, 'm'), first, end, call->value[4].number,
                     call->value[5].number, call->value[6].data);
    return Py_BuildValue("(ddO)", found.level, found.variance, found.quiet ? Py_True : Py_False);
}

PyMethodDef burst_functions[] = {ENTRY(find_gap), ENTRY(find_burst), ENTRY(look_beside), {0}};
