// SPDX-License-Identifier: Apache-2.0

/* The class Steady of the Python module; see steady.h and tactile_cdma/_kernel.pyi. */
#include "binding.h"

#include <errno.h>
#include <time.h>

#include "reader.h"
#include "steady.h"

static int get_array(PyObject *object, Py_buffer *buffer, char code, int flags, const char *what)
{
    if (PyObject_GetBuffer(object, buffer, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | flags))
        return -1;
    const char *format = buffer->format;
    if (format[0] == code && format[1] == 0)
        return 0;
    PyErr_Format(PyExc_TypeError, "%s holds '%s', not '%c'", what, format, code);
    PyBuffer_Release(buffer);
    return -1;
}

static bool takes(Py_ssize_t count, Py_ssize_t expected)
{
    if (count != expected)
        PyErr_Format(PyExc_TypeError, "%zd arguments, not %zd", count, expected);
    return count == expected;
}

static int get_arrays(PyObject *const *objects, size_t count, const char *codes, size_t writable,
                      size_t size, Py_buffer *buffers)
{
    for (size_t i = 0; i < count; i++) {
        int flags = i < writable ? 0 : PyBUF_WRITABLE;
        int failed = get_array(objects[i], &buffers[i], codes[i], flags, "an array");
        if (!failed && (size_t)(buffers[i].len / buffers[i].itemsize) != size) {
            PyErr_Format(PyExc_ValueError, "an array of %zd values, not %zu",
                         buffers[i].len / buffers[i].itemsize, size);
            PyBuffer_Release(&buffers[i]);
            failed = -1;
        }
        if (failed) {
            while (i-- > 0)
                PyBuffer_Release(&buffers[i]);
            return -1;
        }
    }
    return 0;
}

static void release(size_t count, Py_buffer *buffers)
{
    while (count-- > 0)
        PyBuffer_Release(&buffers[count]);
}

enum fit_array { WHOLE, SHARE, NUMBER, PLACES, FIT_ARRAYS };

struct following {
    struct steady *steady;
    PyObject *scanner, *transform, *given; /* given: the bytes that are used up next */
    Py_buffer rows, arrays[FIT_ARRAYS];
    bool has_fit;
    struct carried_fit fit;
    size_t size, chips;          /* samples and chips of a frame */
    double t_host;               /* of the bytes used last */
    bool backlog;
    volatile bool busy;          /* in a call that has released the GIL */
    struct scanner_counts told;  /* as of the last event */
    uint8_t bytes[READER_SIZE];
};

static double now_s(void)
{
    struct timespec now;

    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + (double)now.tv_nsec * 1e-9;
}

/* NULL with an exception while another thread is in a call. */
static struct following *free_one(PyObject *self)
{
    struct following *following = held_by(self);

    if (!following->busy)
        return following;
    PyErr_SetString(PyExc_RuntimeError, "another thread follows this stream");
    return NULL;
}

static void drop_fit(struct following *following)
{
    if (following->has_fit)
        release(FIT_ARRAYS, following->arrays);
    following->has_fit = false;
}

static void drop_following(void *held)
{
    struct following *following = held;

    drop_fit(following);
    if (following->rows.obj)
        PyBuffer_Release(&following->rows);
    Py_XDECREF(following->scanner);
    Py_XDECREF(following->transform);
    Py_XDECREF(following->given);
    if (following->steady)
        steady_free(following->steady);
    PyMem_Free(following);
}

/* Whether an object is of the class of this name in the same module; if not, with an exception. */
static bool is_a(PyObject *object, PyTypeObject *type, const char *name)
{
    PyObject *module = PyType_GetModule(type);
    PyObject *class = module ? PyObject_GetAttrString(module, name) : NULL;
    int is = class ? PyObject_IsInstance(object, class) : -1;

    Py_XDECREF(class);
    if (is == 0)
        PyErr_Format(PyExc_TypeError, "not a %s of the kernel", name);
    return is == 1;
}

/* The numbers of a setting, in the order of _setting in tactile_cdma/driver/steady.py. */
static struct steady_setting setting_of(const double *n)
{
    return (struct steady_setting){
        .line = {.frame = {.bits = (size_t)n[0],
                           .order = (size_t)n[1],
                           .first = (size_t)n[2],
                           .nodes = (size_t)n[3],
                           .unipolar = n[4] != 0,
                           .swing = (float)n[5],
                           .loudest_share = (float)n[6],
                           .active_share = (float)n[7],
                           .spoken_over = n[42]},
                 .spare = (size_t)n[8],
                 .spare_count = (size_t)n[9],
                 .size = (size_t)n[10],
                 .chip = n[11],
                 .least_power = n[12],
                 .most_noise = n[13],
                 .rail_low = n[14],
                 .rail_high = n[15],
                 .deafened = n[16],
                 .carried_noise = n[17],
                 .carried_misfit = n[18],
                 .loud = n[19],
                 .integrated = n[36] != 0,
                 .mean_is_offset = n[37] != 0,
                 .heard = (size_t)n[38],
                 .spread = n[39],
                 .misfit = n[40],
                 .left = n[41]},
        .zero = (float)n[20],
        .per_count = (float)n[21],
        .zero_count = n[20],
        .volts_per_count = n[21],
        .most_volts = n[22],
        .gap_size = (size_t)n[23],
        .least_rest = (size_t)n[24],
        .gap_weight = n[25],
        .rise = n[26],
        .rise_v2 = n[27],
        .silent_over = (size_t)n[28],
        .rate_hz = n[29],
        .behind_s = n[30],
        .ahead_s = n[31],
        .ahead = n[32],
        .most_device_us = (uint64_t)n[33],
        .most_quiet = n[34],
        .most_quiet_v2 = n[35],
    };
}

#define NUMBERS 43

static bool is_possible(const struct steady_setting *setting, size_t order, size_t values)
{
    const struct carried_line *line = &setting->line;
    const struct words_frame *frame = &line->frame;

    return frame->bits && frame->bits <= WORDS_MOST_BITS && frame->order == order &&
           values == frame->bits * order && frame->nodes && frame->first + frame->nodes <= order &&
           line->spare + line->spare_count <= order && line->size &&
           (!line->integrated || (line->size >= values && line->heard >= 1)) && line->size < 1 << 26 &&
           setting->gap_size && setting->gap_size < 1 << 26 && line->chip > 0 &&
           setting->rate_hz > 0 && setting->least_rest > 1;
}

/* scanner, transform, numbers (float64), rows (float32). */
static PyObject *make_steady(PyTypeObject *type, PyObject *arguments, PyObject *keywords)
{
    static char *names[] = {"", "", "", "", NULL};
    PyObject *scanner, *transform, *numbers_given, *rows;
    Py_buffer numbers;

    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "OOOO", names, &scanner, &transform,
                                     &numbers_given, &rows) ||
        !is_a(scanner, type, "Scanner") || !is_a(transform, type, "Transform") ||
        get_arrays(&numbers_given, 1, "d", 1, NUMBERS, &numbers))
        return NULL;
    struct following *following = PyMem_Calloc(1, sizeof *following);
    if (!following) {
        release(1, &numbers);
        return PyErr_NoMemory();
    }
    struct steady_setting setting = setting_of(numbers.buf);
    release(1, &numbers);
    following->scanner = Py_NewRef(scanner);
    following->transform = Py_NewRef(transform);
    following->size = setting.line.size;
    following->chips = setting.line.frame.bits * setting.line.frame.order;
    setting.line.transform = held_by(transform);
    if (get_array(rows, &following->rows, 'f', PyBUF_WRITABLE, "rows")) {
        following->rows.obj = NULL;
        goto fail;
    }
    if (!is_possible(&setting, transform_order(setting.line.transform),
                     (size_t)following->rows.len / sizeof(float))) {
        PyErr_SetString(PyExc_ValueError, "the numbers are those of no frame of this code and rows");
        goto fail;
    }
    following->steady = steady_new(&setting, held_by(scanner), following->rows.buf);
    if (!following->steady) {
        PyErr_NoMemory();
        goto fail;
    }
    return hold(type, following, drop_following);
fail:
    drop_following(following);
    return NULL;
}

/* chip, heard, tail, tail_samples; whole, share, number, places: see struct carried_fit. */
static int take_fit(struct following *following, PyObject *fit, size_t due)
{
    PyObject *objects[FIT_ARRAYS];
    Py_buffer *arrays = following->arrays;
    Py_ssize_t heard, tail, tail_samples;
    double chip;

    if (!PyArg_ParseTuple(fit, "dnnnOOOO", &chip, &heard, &tail, &tail_samples, &objects[WHOLE],
                          &objects[SHARE], &objects[NUMBER], &objects[PLACES]))
        return -1;
    Py_ssize_t edges = PyObject_Size(objects[WHOLE]);
    if (edges < 0)
        return -1;
    if (edges < 2 || heard < 1 || tail < 0 || tail_samples < 1 || (size_t)heard > due ||
        (size_t)tail + (size_t)tail_samples > due) {
        PyErr_SetString(PyExc_ValueError, "the timing does not fit the samples of a frame");
        return -1;
    }
    if (get_arrays(&objects[WHOLE], 1, "i", 1, (size_t)edges, &arrays[WHOLE]))
        return -1;
    if (get_arrays(&objects[SHARE], 1, "d", 1, (size_t)edges, &arrays[SHARE]))
        goto drop_whole;
    if (get_arrays(&objects[NUMBER], 1, "d", 1, (size_t)edges - 1, &arrays[NUMBER]))
        goto drop_share;
    if (get_arrays(&objects[PLACES], 1, "i", 1, following->chips, &arrays[PLACES]))
        goto drop_number;
    following->has_fit = true;
    following->fit = (struct carried_fit){
        .chip = chip,
        .edges = {(size_t)edges, arrays[WHOLE].buf, arrays[SHARE].buf, arrays[NUMBER].buf},
        .places = arrays[PLACES].buf,
        .heard = (size_t)heard,
        .tail = (size_t)tail,
        .tail_samples = (size_t)tail_samples,
    };
    return 0;
drop_number:
    release(1, &arrays[NUMBER]);
drop_share:
    release(1, &arrays[SHARE]);
drop_whole:
    release(1, &arrays[WHOLE]);
    return -1;
}

/* origin, end, gap_begin, mark, last_us, last_count, level, noise, (gap count, sum, squares), volts,
 * due, over, most_uses, fit or None. */
static PyObject *enter(PyObject *self, PyObject *arguments)
{
    struct following *following = free_one(self);
    struct steady_place place = {.start = -1};
    unsigned long long origin, last_us;
    long long end, gap_begin, mark;
    unsigned long last_count;
    Py_ssize_t due, over, most_uses;
    PyObject *volts, *fit;
    Py_buffer buffer;

    if (!following ||
        !PyArg_ParseTuple(arguments, "KLLLKkdd(ddd)OnnnO", &origin, &end, &gap_begin, &mark,
                          &last_us, &last_count, &place.level, &place.noise, &place.gap_count,
                          &place.gap_sum, &place.gap_squares, &volts, &due, &over, &most_uses, &fit))
        return NULL;
    if (due < 1 || (size_t)due < following->size || (size_t)due > (size_t)1 << 27 || over < 0 ||
        most_uses < 0 || end < 0) {
        PyErr_SetString(PyExc_ValueError, "fewer samples than a frame has, or too many");
        return NULL;
    }
    drop_fit(following);
    Py_CLEAR(following->given);
    if (fit != Py_None && take_fit(following, fit, (size_t)due))
        return NULL;
    if (get_array(volts, &buffer, 'd', 0, "volts"))
        return NULL;
    place.end = end;
    place.gap_begin = gap_begin;
    place.mark = mark;
    place.last_us = last_us;
    place.last_count = (uint32_t)last_count;
    struct steady_timing timing = {following->has_fit ? &following->fit : NULL, (size_t)due,
                                   (size_t)over, (size_t)most_uses};
    bool done = steady_enter(following->steady, &place, origin, &timing, buffer.buf,
                             (size_t)buffer.len / sizeof(double));
    release(1, &buffer);
    scanner_counts(held_by(following->scanner), &following->told);
    return done ? Py_NewRef(Py_None) : PyErr_NoMemory();
}

/* data, t_host, backlog. */
static PyObject *give(PyObject *self, PyObject *arguments)
{
    struct following *following = free_one(self);
    const uint8_t *left;
    PyObject *data;
    double t_host;
    int backlog;
    char *bytes;
    Py_ssize_t size;

    if (!following || !PyArg_ParseTuple(arguments, "Sdp", &data, &t_host, &backlog) ||
        PyBytes_AsStringAndSize(data, &bytes, &size))
        return NULL;
    if (steady_left(following->steady, &left)) {
        PyErr_SetString(PyExc_RuntimeError, "other bytes are not used up");
        return NULL;
    }
    PyObject *before = following->given;
    following->given = Py_NewRef(data);
    Py_XDECREF(before);
    following->t_host = t_host;
    following->backlog = backlog;
    steady_give(following->steady, (const uint8_t *)bytes, (size_t)size, t_host, backlog);
    Py_RETURN_NONE;
}

/* (index, device_time_us, count, sequence, t_host, backlog) of every packet that passed. */
static PyObject *passed_list(struct steady *steady)
{
    const struct steady_passed *passed;
    size_t count = steady_passed(steady, &passed);
    PyObject *list = PyList_New((Py_ssize_t)count);

    for (size_t i = 0; list && i < count; i++) {
        const struct steady_passed *one = &passed[i];
        PyObject *tuple = Py_BuildValue("(LKkHdO)", (long long)one->index,
                                        (unsigned long long)one->device_time_us,
                                        (unsigned long)one->count, one->sequence, one->t_host,
                                        one->backlog ? Py_True : Py_False);
        if (!tuple || PyList_SetItem(list, (Py_ssize_t)i, tuple))
            Py_CLEAR(list);
    }
    return list;
}

/* The next event, from the bytes that were given and, if file is not negative, from those read there
 * within timeout_ms. */
static PyObject *wait(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    struct following *following = free_one(self);
    struct scanner_packet packet = {0};
    enum steady_event event;
    ptrdiff_t size = 1;
    int failure = 0;

    if (!following || !takes(count, 2))
        return NULL;
    long file = PyLong_AsLong(arguments[0]), timeout_ms = PyLong_AsLong(arguments[1]);
    if (PyErr_Occurred())
        return NULL;
    struct steady *steady = following->steady;
    following->busy = true;
    Py_BEGIN_ALLOW_THREADS
    event = steady_next(steady, &packet);
    while (event == STEADY_MORE && file >= 0 && size > 0) {
        size = reader_read((int)file, following->bytes, sizeof following->bytes, (int)timeout_ms,
                           &following->backlog);
        failure = errno;
        if (size > 0) {
            following->t_host = now_s();
            steady_give(steady, following->bytes, (size_t)size, following->t_host,
                        following->backlog);
            event = steady_next(steady, &packet);
        }
    }
    Py_END_ALLOW_THREADS
    following->busy = false;
    scanner_counts(held_by(following->scanner), &following->told);
    if (size < 0)
        return file_error(failure);
    PyObject *passed = passed_list(steady);
    if (!passed)
        return NULL;
    PyObject *found;
    if (event == STEADY_PACKET)
        found = packet_tuple(&packet);
    else if (event == STEADY_HEARD || event == STEADY_SILENT) {
        const struct carried_found *frame = steady_found(steady);
        found = Py_BuildValue("(Lddd)", (long long)steady_start(steady), frame->noise,
                              frame->level, frame->clipped);
    } else
        found = Py_NewRef(Py_None);
    if (!found) {
        Py_DECREF(passed);
        return NULL;
    }
    return Py_BuildValue("(iNNdO)", event, found, passed, following->t_host,
                         following->backlog ? Py_True : Py_False);
}

/* (end, start, gap_begin, mark, level, noise, (gap count, sum, squares), uses, marks, bytes that are
 * left, float64 of the samples that are needed to go on). */
static PyObject *leave(PyObject *self, PyObject *unused)
{
    struct following *following = free_one(self);
    const uint8_t *left;
    const double *volts;

    (void)unused;
    if (!following)
        return NULL;
    struct steady *steady = following->steady;
    const struct steady_place *place = steady_place(steady);
    int64_t begin = place->start >= 0 ? place->start : 0;
    size_t samples = steady_samples(steady, &begin, &volts), size = steady_left(steady, &left);
    PyObject *result = Py_BuildValue(
        "(LLLLdd(ddd)nny#y#)", (long long)place->end, (long long)place->start,
        (long long)place->gap_begin, (long long)place->mark, place->level, place->noise,
        place->gap_count, place->gap_sum, place->gap_squares, (Py_ssize_t)steady_uses(steady),
        (Py_ssize_t)steady_marks(steady), size ? (const char *)left : "", (Py_ssize_t)size,
        (const char *)volts, (Py_ssize_t)(samples * sizeof *volts));
    if (result)
        steady_give(steady, NULL, 0, 0, false);
    return result;
}

static PyObject *told_counts(PyObject *self, PyObject *unused)
{
    struct following *following = held_by(self);

    (void)unused;
    return counts_dict(&following->told);
}

static PyMethodDef methods[] = {
    {"enter", enter, METH_VARARGS, NULL},
    {"give", give, METH_VARARGS, NULL},
    {"wait", (PyCFunction)(void (*)(void))wait, METH_FASTCALL, NULL},
    {"leave", leave, METH_NOARGS, NULL},
    {"counts", told_counts, METH_NOARGS, NULL},
    {0},
};

static PyType_Slot slots[] = {
    {Py_tp_new, make_steady},
    {Py_tp_dealloc, drop_holder},
    {Py_tp_methods, methods},
    {0},
};

PyType_Spec steady_spec = {
    .name = "tactile_cdma._kernel.Steady",
    .basicsize = sizeof(struct holder),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = slots,
};
