// SPDX-License-Identifier: Apache-2.0

/* The classes Stream and Readout of the Python module: the two calls that every frame takes. See
 * frame_stream.h and readout.h; used by tactile_cdma/driver/compiled_stream.py and readings/taxels.py. */
#include "binding.h"

#include <errno.h>
#include <poll.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "frame_stream.h"
#include "readout.h"

/* ---- reading a port ----------------------------------------------------------------------------- */

static double now_s(void)
{
    struct timespec now;

    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + (double)now.tv_nsec * 1e-9;
}

static long now_ms(void)
{
    return (long)(now_s() * 1e3);
}

ptrdiff_t reader_read(int file, uint8_t *bytes, size_t size, int timeout_ms, bool *had_waited)
{
    struct pollfd port = {.fd = file, .events = POLLIN};
    long end_ms = now_ms() + timeout_ms;
    size_t filled = 0;

    *had_waited = false;
    while (filled < size) {
        int ready = poll(&port, 1, 0);
        bool waited = ready > 0;
        long left_ms = end_ms - now_ms();
        if (left_ms < 0)
            break;
        if (!ready)
            ready = poll(&port, 1, (int)left_ms);
        if (!ready)
            break;
        ssize_t got = ready < 0 ? -1 : read(file, bytes + filled, size - filled);
        if (got < 0 && errno == EAGAIN)
            continue;
        if (got < 0 && errno == EINTR)
            break;
        if (got <= 0) {
            if (filled) /* the next call will tell */
                break;
            if (!got)
                errno = 0;
            return -1;
        }
        *had_waited = waited;
        filled += (size_t)got;
        if (memchr(bytes + filled - got, 0, (size_t)got))
            break;
    }
    return (ptrdiff_t)filled;
}

/* ---- Stream ------------------------------------------------------------------------------------ */

enum edge_array { WHOLE, SHARE, NUMBER_OF, PLACES, EDGE_ARRAYS };

/* A stream, and what it uses of Python's. */
struct owner {
    struct stream *stream;
    struct scanner *scanner;
    PyObject *transform, *sparse;
    Py_buffer given; /* the bytes that are used up next */
    Py_buffer rows, flips, spoke, edges[EDGE_ARRAYS];
    size_t chips; /* of a frame */
    double t_host; /* of the bytes used last */
    bool backlog;
    volatile bool busy; /* in a call that has released the GIL */
    uint8_t bytes[READER_SIZE];
};

FIELDS(stream_rules, frame.frame.bits, frame.frame.order, frame.frame.first, frame.frame.nodes,
       frame.frame.unipolar, frame.frame.swing, frame.frame.loudest_share, frame.frame.active_share,
       frame.frame.spoken_over, frame.spare, frame.spare_count, frame.size, frame.whole_size, frame.chip,
       frame.least_power, frame.silent_power, frame.most_noise, frame.rail_low, frame.rail_high, frame.deafened,
       frame.carried_noise, frame.carried_misfit, frame.loud, frame.spread, frame.misfit, frame.left,
       frame.clear_spread, frame.chips, frame.few, frame.whole, frame.hiding, frame.kept, frame.rest,
       frame.at_rest, frame.tail_noise, frame.tail_scatter, frame.tail_level, frame.least_tail,
       frame.integrated, frame.mean_is_offset, frame.scrambled, frame.noise_share, frame.most_silent_noise,
       frame.silent_rise, frame.silent_more, marked, in_blocks, zero_count, volts_per_count,
       most_volts, gap_size, least_rest, gap_weight, rise, rise_v2, silent_over, rate_hz, slack_s, slack, gap_s,
       gaps, least_gap_s, most_device_us, most_quiet, most_quiet_v2);

FIELDS(stream_timing, due, over, uses, has_frame, frame.chip, frame.until, frame.heard, frame.tail,
       frame.tail_end);

/* NULL with an exception while another thread is in a call. */
static struct owner *free_one(const struct call *call)
{
    struct owner *owner = held_by(call->self);

    if (!owner->busy)
        return owner;
    PyErr_SetString(PyExc_RuntimeError, "another thread follows this stream");
    return NULL;
}

/* A FUNCTION that nobody calls meanwhile, with its owner. */
#define STREAM_FUNCTION(function, ...)                                                              \
    static PyObject *function##_by(struct call *call, struct owner *owner);                         \
    FUNCTION(function, __VA_ARGS__)                                                                 \
    {                                                                                               \
        struct owner *owner = free_one(call);                                                       \
        return owner ? function##_by(call, owner) : NULL;                                           \
    }                                                                                               \
    static PyObject *function##_by(__attribute__((unused)) struct call *call, struct owner *owner)

static void release(Py_buffer *buffer)
{
    if (buffer->obj)
        PyBuffer_Release(buffer);
}

/* Takes over an array from a call in place of another one. */
static void exchange(Py_buffer *kept, struct call *call, size_t argument)
{
    release(kept);
    *kept = keep(call, argument);
}

static void drop_owner(void *held)
{
    struct owner *owner = held;

    for (size_t i = 0; i < EDGE_ARRAYS; i++)
        release(&owner->edges[i]);
    release(&owner->rows);
    release(&owner->flips);
    release(&owner->spoke);
    Py_XDECREF(owner->transform);
    Py_XDECREF(owner->sparse);
    release(&owner->given);
    if (owner->stream)
        stream_free(owner->stream);
    PyMem_Free(owner);
}

CONSTRUCTOR(Stream, OBJECT("scanner", "Scanner"))
{
    struct owner *owner = PyMem_Calloc(1, sizeof *owner);

    if (!owner)
        return PyErr_NoMemory();
    owner->scanner = call->value[0].data;
    owner->stream = stream_new(owner->scanner);
    if (owner->stream)
        return hold(call, owner, drop_owner);
    drop_owner(owner);
    return PyErr_NoMemory();
}

/* ---- settings ---------------------------------------------------------------------------------- */

static bool is_possible(const struct stream_rules *rules, size_t bits, size_t order)
{
    const struct frame_rules *frame = &rules->frame;
    const struct words_frame *words = &frame->frame;

    return words->bits == bits && words->order == order && bits && bits <= WORDS_MOST_BITS &&
           words->nodes && words->first <= order && words->nodes <= order - words->first &&
           frame->spare <= order && frame->spare_count <= order - frame->spare && frame->size &&
           frame->size <= STREAM_MOST_SAMPLES && frame->whole_size && rules->gap_size &&
           rules->gap_size <= STREAM_MOST_SAMPLES && rules->least_rest > 1 && frame->chip > 0 &&
           rules->rate_hz > 0;
}

/* flips: empty where no chips are flipped. */
STREAM_FUNCTION(describe, SETTINGS(stream_rules), OBJECT("transform", "Transform"), ARRAY("flips", 'f', "*"),
         OUT("rows", 'f', "kn"))
{
    const struct stream_rules *rules = call->value[0].data;
    struct frame_code code = {.transform = call->value[1].data};
    size_t bits = axis(call, 'k'), order = axis(call, 'n');
    if (!(is_possible(rules, bits, order) && transform_order(code.transform) == order))
        return refuse(call, "rows: those of no frame of this code and these rules");
    if (length(call, 2)) {
        if (!(length(call, 2) == bits * order))
            return refuse(call, "flips: one for every chip expected");
        code.flips = call->value[2].data;
    }
    if (!stream_describe(owner->stream, rules, &code, call->value[3].data))
        return PyErr_NoMemory();
    exchange(&owner->flips, call, 2);
    exchange(&owner->rows, call, 3);
    owner->chips = bits * order;
    PyObject *before = owner->transform;
    owner->transform = Py_NewRef(call->given[1]);
    Py_XDECREF(before);
    Py_RETURN_NONE;
}

/* Frames are of sparse codes, which this takes apart. */
STREAM_FUNCTION(detect_by, OBJECT("sparse", "Sparse"), OUT("spoke", 'i', "n"))
{
    struct sparse *sparse = call->value[0].data;
    if (!(axis(call, 'n') == sparse_book(sparse)->nodes &&
          stream_detect_by(owner->stream, sparse, call->value[1].data)))
        return refuse(call, "sparse, spoke: of no frame that was described");
    exchange(&owner->spoke, call, 1);
    PyObject *before = owner->sparse;
    owner->sparse = Py_NewRef(call->given[0]);
    Py_XDECREF(before);
    Py_RETURN_NONE;
}

STREAM_FUNCTION(forget)
{
    stream_describe(owner->stream, NULL, NULL, NULL);
    Py_RETURN_NONE;
}

STREAM_FUNCTION(carry, SETTINGS(stream_timing), ARRAY("whole", 'i', "e"), ARRAY("share", 'd', "e"),
         ARRAY("number", 'd', "g"), ARRAY("places", 'i', "c"))
{
    const struct stream_timing *timing = call->value[0].data;
    const struct frame_edges edges = {
        {axis(call, 'e'), call->value[1].data, call->value[2].data, call->value[3].data},
        call->value[4].data};
    if (!(timing->due && timing->due <= STREAM_MOST_SAMPLES && timing->over <= STREAM_MOST_SAMPLES))
        return refuse(call, "due, over: beyond what a frame may have");
    if (timing->has_frame &&
        !(axis(call, 'g') + 1 == axis(call, 'e') && axis(call, 'c') == owner->chips &&
          timing->frame.heard && timing->frame.tail >= timing->frame.heard &&
          timing->frame.tail_end >= timing->frame.tail && timing->frame.chip > 0 &&
          timing->frame.until <= STREAM_MOST_SAMPLES))
        return refuse(call, "edges: those of no frame that was described");
    if (!stream_carry(owner->stream, timing, &edges))
        return PyErr_NoMemory();
    for (size_t i = 0; i < EDGE_ARRAYS; i++)
        exchange(&owner->edges[i], call, i + 1);
    Py_RETURN_NONE;
}

/* ---- bytes ------------------------------------------------------------------------------------- */

STREAM_FUNCTION(give, ARRAY("data", 'B', "*"), NUMBER("t_host"), FLAG("backlog"))
{
    if (stream_left(owner->stream)) {
        PyErr_SetString(PyExc_RuntimeError, "other bytes are not used up");
        return NULL;
    }
    const uint8_t *data = call->value[0].data;
    size_t size = length(call, 0);
    exchange(&owner->given, call, 0);
    owner->t_host = call->value[1].number;
    owner->backlog = call->value[2].size;
    stream_give(owner->stream, data, size, owner->t_host, owner->backlog);
    Py_RETURN_NONE;
}

STREAM_FUNCTION(end)
{
    stream_conclude(owner->stream);
    Py_RETURN_NONE;
}

static PyObject *flag(bool is)
{
    return is ? Py_True : Py_False;
}

/* (index, device_time_us, count, sequence, t_host, backlog) of every packet that passed. */
static PyObject *passed_list(struct stream *stream)
{
    const struct stream_passed *passed;
    size_t count = stream_passed(stream, &passed);
    PyObject *list = PyList_New((Py_ssize_t)count);

    for (size_t i = 0; list && i < count; i++) {
        const struct stream_passed *one = &passed[i];
        PyObject *tuple = Py_BuildValue("(LKkHdO)", (long long)one->index,
                                        (unsigned long long)one->device_time_us,
                                        (unsigned long)one->count, one->sequence, one->t_host,
                                        flag(one->backlog));
        if (!tuple || PyList_SetItem(list, (Py_ssize_t)i, tuple))
            Py_CLEAR(list);
    }
    return list;
}

/* What an event is about. */
static PyObject *subject_of(const struct stream *stream, enum stream_event event)
{
    const struct stream_subject *about = stream_subject(stream);
    const struct frame_rest *rest = about->rest;

    switch (event) {
    case STREAM_HEARD:
    case STREAM_SILENT:
        return Py_BuildValue("(LdddOnB)", (long long)about->start, about->found.noise,
                             about->found.level, about->found.clipped, flag(rest->known),
                             (Py_ssize_t)about->found.speakers, about->turn);
    case STREAM_PACKET:
    case STREAM_FOREIGN:
        return packet_tuple(&about->packet);
    case STREAM_DOUBT:
        return Py_BuildValue("(iLy#OnnnO(dd)(ddO)B)", about->look, (long long)about->start,
                             (const char *)about->volts,
                             (Py_ssize_t)(about->count * sizeof *about->volts), flag(about->final),
                             (Py_ssize_t)about->marks, (Py_ssize_t)about->uses,
                             (Py_ssize_t)about->ended, flag(about->summed_up), about->mean,
                             about->variance, rest->level, rest->noise, flag(rest->known), about->turn);
    case STREAM_BLOCK:
        return Py_BuildValue("(LN)", (long long)about->start, /* not copied: until stream_look is called */
                             PyMemoryView_FromMemory((char *)about->volts,
                                                     (Py_ssize_t)(about->count * sizeof *about->volts),
                                                     PyBUF_READ));
    default:
        return Py_NewRef(Py_None);
    }
}

/* The next event: from the bytes that were given and, if file is not negative, from those that are read
 * there within timeout_ms. Returns (event, subject, passed, t_host, backlog). */
STREAM_FUNCTION(next, NUMBER("file"), SIZE("timeout_ms"))
{
    int file = call->value[0].number >= 0 ? (int)call->value[0].number : -1;
    enum stream_event event;
    ptrdiff_t size = 1;
    int failure = 0;

    struct stream *stream = owner->stream;
    double left_ms = call->value[1].size < 3600000 ? (double)call->value[1].size : 3600000;
    scanner_tell(owner->scanner); /* others see a packet counted once what it gave was taken in */
    owner->busy = true;
    Py_BEGIN_ALLOW_THREADS
    double end_s = now_s() + left_ms * 1e-3;
    event = stream_next(stream);
    /* Once at least, and not for ever if bytes come that are no packets. */
    while (event == STREAM_NEEDS_BYTES && file >= 0 && size > 0 && left_ms >= 0) {
        size = reader_read(file, owner->bytes, sizeof owner->bytes, (int)left_ms, &owner->backlog);
        failure = errno;
        if (size > 0) {
            owner->t_host = now_s();
            stream_give(stream, owner->bytes, (size_t)size, owner->t_host, owner->backlog);
            event = stream_next(stream);
            left_ms = (end_s - owner->t_host) * 1e3;
        }
    }
    Py_END_ALLOW_THREADS
    owner->busy = false;
    if (event == STREAM_NEEDS_BYTES)
        scanner_tell(owner->scanner);
    if (size < 0)
        return file_error(failure);
    PyObject *passed = passed_list(stream), *subject = passed ? subject_of(stream, event) : NULL;
    if (!subject) {
        Py_XDECREF(passed);
        return NULL;
    }
    return Py_BuildValue("(iNNdO)", event, subject, passed, owner->t_host, flag(owner->backlog));
}

/* ---- answers ----------------------------------------------------------------------------------- */

static PyObject *answered(const struct call *call, bool is)
{
    return is ? Py_NewRef(Py_None) : refuse(call, "nothing of the kind was asked, or no memory");
}

/* Returns whether a frame was cut short. */
STREAM_FUNCTION(place, SIZE("answer"), OBJECT("origin", NULL), FLAG("anew"), NUMBER("mean"), NUMBER("variance"))
{
    bool cut_short;

    unsigned long long origin = PyLong_AsUnsignedLongLong(call->given[1]);
    if (PyErr_Occurred())
        return NULL;
    if (!(call->value[0].size <= STREAM_TAKE_HELD))
        return refuse(call, "answer: there is none of this number");
    if (!stream_place(owner->stream, (enum stream_answer)call->value[0].size, origin,
                      call->value[2].size, call->value[3].number, call->value[4].number, &cut_short))
        return answered(call, false);
    return Py_NewRef(flag(cut_short));
}

/* A stream index of a call; -1 for none, or none that can be. */
static int64_t index_of(const struct call *call, size_t argument)
{
    double index = call->value[argument].number;

    return index >= 0 && index < (double)(1LL << 53) ? (int64_t)index : -1;
}

STREAM_FUNCTION(decide, NUMBER("due"), NUMBER("over"), NUMBER("level"), NUMBER("noise"))
{
    return answered(call, stream_decide(owner->stream, index_of(call, 0), index_of(call, 1),
                                        call->value[2].number, call->value[3].number));
}

STREAM_FUNCTION(look, NUMBER("due"))
{
    return answered(call, stream_look(owner->stream, index_of(call, 0)));
}

CLASS(stream_spec, Stream, ENTRY(describe), ENTRY(detect_by), ENTRY(forget), ENTRY(carry), ENTRY(give), ENTRY(end),
      ENTRY(next), ENTRY(place), ENTRY(look), ENTRY(decide));

/* ---- Readout ----------------------------------------------------------------------------------- */

static void drop_readout(void *held)
{
    readout_free(held);
}

CONSTRUCTOR(Readout, SETTINGS(readout_settings), ARRAY("sign_mask", 'i', "n"),
            ARRAY("offset", 'f', "o"), OUT("expected_v", 'f', "n"), ARRAY("edges", 'f', "4N"), ARRAY("table_v", 'f', "c"),
            ARRAY("state", 'B', "n"), ARRAY("invalid", '?', "n"), ARRAY("uncalibrated", '?', "n"),
            ARRAY("masked", '?', "n"), ARRAY("sign", 'f', "n"), ARRAY("rest_v", 'f', "n"), ARRAY("margin_v", 'f', "n"),
            ARRAY("end_v", 'f', "n"), ARRAY("pieces", 'f', "p3n"), ARRAY("source", 'i', "t"), OUT("kept_codes", 'i', "n"),
            OUT("kept_flags", 'B', "n"), OUT("heard_s", 'd', "n"), OUT("sums", 'f', "5n"))
{
    const struct readout_settings *settings = call->value[0].data;
    const struct words_frame *frame = &settings->frame;
    const union value *v = call->value;
    struct readout_skin skin = {v[1].data,  v[2].data,  v[3].data,  v[4].data,  v[5].data,  v[6].data,
                                v[7].data,  v[8].data,  v[9].data,  v[10].data, v[11].data, v[12].data,
                                v[13].data, v[14].data, v[15].data, v[16].data, v[17].data, v[18].data,
                                v[19].data};
    const int32_t *source = skin.source;
    bool in_range = true;

    for (size_t i = 0; i < axis(call, 't'); i++)
        in_range = in_range && source[i] < (int64_t)frame->nodes;
    for (size_t i = 0; i < axis(call, 'n'); i++)
        in_range = in_range && skin.kept_codes[i] >= 0 && (size_t)skin.kept_codes[i] < axis(call, 'c');
    if (!axis(call, 't'))
        skin.source = NULL;
    if (!axis(call, 'o'))
        skin.offset = NULL;
    if (!(in_range && frame->nodes == axis(call, 'n') && frame->order == axis(call, 'N') &&
          frame->bits > settings->reading.parity && frame->bits <= WORDS_MOST_BITS &&
          axis(call, 'o') == (settings->scrambled ? frame->bits * frame->order : 0) &&
          settings->codes == axis(call, 'c') && settings->pieces == axis(call, 'p') &&
          settings->codes == (size_t)1 << (frame->bits - settings->reading.parity) &&
          settings->taxels == (skin.source ? axis(call, 't') : frame->nodes) &&
          frame->first <= frame->order && frame->nodes <= frame->order - frame->first &&
          settings->spare <= frame->order && settings->spare_count <= frame->order - settings->spare))
        return refuse(call, "the settings do not fit each other, or the arrays");
    return hold(call, readout_new(settings, &skin), drop_readout);
}

/* only_these: rows are those of the nodes that spoke; see words_read_some. */
FUNCTION(read, ARRAY("rows", 'f', "kN"), ARRAY("spoke", 'i', "m"), FLAG("only_these"), NUMBER("per_noise"),
         NUMBER("least_usual"), FLAG("in_place"), NUMBER("now_s"), NUMBER("stale_after_s"), ARRAY("drift_v", 'f', "n"),
         ARRAY("tare_pa", 'f', "n"), OUT("active", '?', "n"), OUT("codes", 'i', "n"),
         OUT("floats", 'f', "3n"), OUT("doubts", '?', "3n"), OUT("readings", 'f', "2t"),
         OUT("status", 'B', "t"), OUT("rest", 'f', "2n"), OUT("valid", '?', "n"))
{
    struct readout *readout = held_by(call->self);
    const struct readout_settings *settings = readout_settings(readout);
    const union value *v = call->value;
    size_t nodes = axis(call, 'n');
    uint8_t *doubts = v[13].data;
    float *words = v[12].data, *readings = v[14].data, *rest = v[16].data;
    const int32_t *spoke = v[1].data;
    bool in_range = true;
    struct readout_frame frame = {v[10].data,
                                  doubts,
                                  doubts + nodes,
                                  doubts + 2 * nodes,
                                  v[11].data,
                                  words,
                                  words + nodes,
                                  words + 2 * nodes,
                                  readings,
                                  readings + settings->taxels,
                                  v[15].data,
                                  rest,
                                  rest + nodes,
                                  v[17].data};

    if (v[2].size && !(axis(call, 'k') == settings->frame.bits && axis(call, 'N') == axis(call, 'm')))
        return refuse(call, "rows: not of these nodes");
    if (!v[2].size && !are_of(call, &settings->frame))
        return NULL;
    if (!(nodes == settings->frame.nodes && axis(call, 't') == settings->taxels))
        return refuse(call, "%zu nodes and %zu taxels expected, not %zu and %zu", settings->frame.nodes,
                      settings->taxels, nodes, axis(call, 't'));
    for (size_t i = 0; i < axis(call, 'm'); i++)
        in_range = in_range && spoke[i] >= 0 && (size_t)spoke[i] < nodes;
    if (!in_range)
        return refuse(call, "spoke: beyond the nodes");
    return PyLong_FromLong(readout_read(readout, v[0].data, v[2].size ? spoke : NULL,
                                        axis(call, 'm'), (float)v[3].number, (float)v[4].number,
                                        v[5].size, v[6].number, v[7].number, v[8].data, v[9].data,
                                        &frame));
}

CLASS(readout_spec, Readout, ENTRY(read));
