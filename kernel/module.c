// SPDX-License-Identifier: Apache-2.0

/* The kernel as a Python module; see tactile_cdma/_kernel.pyi for what it offers. */
#include "binding.h"

#include <errno.h>
#include <math.h>
#include <string.h>

#include "contacts.h"
#include "reader.h"
#include "readings.h"
#include "samples.h"
#include "scanner.h"
#include "transform.h"
#include "words.h"

#define VERSION 8 /* raise with every change of what this module offers; see base/kernel.py */
#define LONG_WORK (1 << 16)
/* Values that take tens of microseconds: work below does not release the GIL, since to get it back
 * from a busy thread can take 5 ms. */

/* ---- Transform --------------------------------------------------------------------------------- */

static PyObject *make_transform(PyTypeObject *type, PyObject *arguments, PyObject *keywords)
{
    static char *names[] = {"twos", "factors", "scale", "lanes", NULL};
    unsigned twos, lanes = 0;
    float scale;
    PyObject *factors;
    size_t orders[TRANSFORM_MOST_FACTORS];
    const int8_t *matrices[TRANSFORM_MOST_FACTORS];

    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "IO!f|I", names, &twos, &PyTuple_Type,
                                     &factors, &scale, &lanes))
        return NULL;
    Py_ssize_t count = PyTuple_Size(factors);
    for (Py_ssize_t i = 0; i < count && i < TRANSFORM_MOST_FACTORS; i++) {
        char *bytes;
        Py_ssize_t size;
        if (PyBytes_AsStringAndSize(PyTuple_GetItem(factors, i), &bytes, &size))
            return NULL;
        orders[i] = 0;
        while (orders[i] * orders[i] < (size_t)size)
            orders[i]++;
        if (orders[i] * orders[i] != (size_t)size) {
            PyErr_Format(PyExc_ValueError, "%zd signs are no square matrix", size);
            return NULL;
        }
        matrices[i] = (const int8_t *)bytes;
    }
    struct transform *transform = transform_new(twos, (size_t)count, orders, matrices, scale, lanes);
    if (!transform) {
        PyErr_Format(PyExc_ValueError,
                     "%u factors of 2 and %zd others with %u lanes: no memory, or beyond what the "
                     "kernel is built for",
                     twos, count, lanes);
        return NULL;
    }
    PyObject *self = hold(type, transform);
    if (!self)
        transform_free(transform);
    return self;
}

static void drop_transform(PyObject *self)
{
    transform_free(held_by(self));
    drop(self);
}

static PyObject *multiply(PyObject *self, PyObject *const *arguments, Py_ssize_t count)
{
    const struct transform *transform = held_by(self);
    Py_buffer from, to;

    if (count != 2) {
        PyErr_SetString(PyExc_TypeError, "multiply takes two arrays");
        return NULL;
    }
    if (get_array(arguments[0], &from, 'f', 0, "source"))
        return NULL;
    if (get_array(arguments[1], &to, 'f', PyBUF_WRITABLE, "out")) {
        PyBuffer_Release(&from);
        return NULL;
    }
    size_t values = (size_t)from.len / sizeof(float), order = transform_order(transform);
    const char *from_end = (char *)from.buf + from.len, *to_end = (char *)to.buf + to.len;
    bool fits = from.len == to.len && values % order == 0;
    bool apart = from.buf == to.buf || from_end <= (char *)to.buf || to_end <= (char *)from.buf;
    if (!fits)
        PyErr_Format(PyExc_ValueError, "%zu values to %zd bytes: neither fits order %zu", values,
                     to.len, order);
    else if (!apart)
        PyErr_SetString(PyExc_ValueError, "source and out overlap");
    else if (values < LONG_WORK)
        transform_multiply(transform, from.buf, to.buf, values / order);
    else {
        Py_BEGIN_ALLOW_THREADS
        transform_multiply(transform, from.buf, to.buf, values / order);
        Py_END_ALLOW_THREADS
    }
    PyBuffer_Release(&from);
    PyBuffer_Release(&to);
    if (!fits || !apart)
        return NULL;
    Py_RETURN_NONE;
}

static PyMethodDef transform_methods[] = {
    {"multiply", (PyCFunction)(void (*)(void))multiply, METH_FASTCALL, NULL},
    {0},
};

static PyType_Slot transform_slots[] = {
    {Py_tp_new, make_transform},
    {Py_tp_dealloc, drop_transform},
    {Py_tp_methods, transform_methods},
    {0},
};

static PyType_Spec transform_spec = {
    .name = "tactile_cdma._kernel.Transform",
    .basicsize = sizeof(struct holder),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = transform_slots,
};

/* ---- Scanner ----------------------------------------------------------------------------------- */

static PyObject *make_scanner(PyTypeObject *type, PyObject *arguments, PyObject *keywords)
{
    static char *names[] = {"most_repeated", NULL};
    unsigned long most_repeated;

    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "k", names, &most_repeated))
        return NULL;
    struct scanner *scanner = scanner_new(most_repeated);
    if (!scanner)
        return PyErr_NoMemory();
    PyObject *self = hold(type, scanner);
    if (!self)
        scanner_free(scanner);
    return self;
}

static void drop_scanner(PyObject *self)
{
    scanner_free(held_by(self));
    drop(self);
}

static PyObject *feed(PyObject *self, PyObject *data)
{
    struct scanner *scanner = held_by(self);
    struct scanner_packet packet;
    Py_buffer buffer;
    PyObject *packets = PyList_New(0);

    if (!packets || PyObject_GetBuffer(data, &buffer, PyBUF_SIMPLE)) {
        Py_XDECREF(packets);
        return NULL;
    }
    const uint8_t *bytes = buffer.buf;
    size_t left = (size_t)buffer.len;
    while (left) {
        size_t taken = scanner_take(scanner, bytes, left, &packet);
        bytes += taken;
        left -= taken;
        if (!packet.payload)
            continue;
        PyObject *tuple = packet_tuple(&packet);
        if (!tuple || PyList_Append(packets, tuple)) {
            Py_XDECREF(tuple);
            Py_CLEAR(packets);
            break;
        }
        Py_DECREF(tuple);
    }
    PyBuffer_Release(&buffer);
    return packets;
}

static PyObject *skip(PyObject *self, PyObject *unused)
{
    (void)unused;
    scanner_skip(held_by(self));
    Py_RETURN_NONE;
}

static PyObject *held(PyObject *self, PyObject *unused)
{
    (void)unused;
    return PyLong_FromSize_t(scanner_held(held_by(self)));
}

static PyObject *counts(PyObject *self, PyObject *unused)
{
    struct scanner_counts seen;

    (void)unused;
    scanner_counts(held_by(self), &seen);
    return counts_dict(&seen);
}

static PyMethodDef scanner_methods[] = {
    {"feed", feed, METH_O, NULL},
    {"skip", skip, METH_NOARGS, NULL},
    {"held", held, METH_NOARGS, NULL},
    {"counts", counts, METH_NOARGS, NULL},
    {0},
};

static PyType_Slot scanner_slots[] = {
    {Py_tp_new, make_scanner},
    {Py_tp_dealloc, drop_scanner},
    {Py_tp_methods, scanner_methods},
    {0},
};

static PyType_Spec scanner_spec = {
    .name = "tactile_cdma._kernel.Scanner",
    .basicsize = sizeof(struct holder),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = scanner_slots,
};

/* ---- reader ------------------------------------------------------------------------------------ */

static PyObject *read_packets(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    uint8_t bytes[READER_SIZE];
    bool had_waited;
    ptrdiff_t size;
    int failure;

    (void)module;
    if (!takes(count, 2))
        return NULL;
    long file = PyLong_AsLong(arguments[0]), timeout_ms = PyLong_AsLong(arguments[1]);
    if (PyErr_Occurred())
        return NULL;
    Py_BEGIN_ALLOW_THREADS
    size = reader_read((int)file, bytes, sizeof bytes, (int)timeout_ms, &had_waited);
    failure = errno;
    Py_END_ALLOW_THREADS
    if (size < 0)
        return file_error(failure);
    return Py_BuildValue("(y#O)", bytes, (Py_ssize_t)size, had_waited ? Py_True : Py_False);
}

/* ---- words ------------------------------------------------------------------------------------- */

static PyObject *measure(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer levels, out[6];

    (void)module;
    if (!takes(count, 7) ||
        PyObject_GetBuffer(arguments[0], &levels, PyBUF_STRIDED | PyBUF_FORMAT))
        return NULL;
    const Py_ssize_t item = sizeof(float);
    if (levels.ndim != 2 || levels.format[0] != 'f' || levels.format[1] ||
        levels.strides[1] != item || levels.strides[0] % item || levels.shape[0] < 1 ||
        levels.shape[0] > 31) {
        PyErr_SetString(PyExc_ValueError,
                        "levels are not float32 of shape (1…31, n) with contiguous rows");
        goto fail;
    }
    size_t nodes = (size_t)levels.shape[1];
    if (get_arrays(arguments + 1, 6, "ffffii", 0, nodes, out))
        goto fail;
    struct words_measures measures = {out[0].buf, out[1].buf, out[2].buf,
                                      out[3].buf, out[4].buf, out[5].buf};
    words_measure(levels.buf, levels.strides[0] / item, (size_t)levels.shape[0], nodes, &measures);
    release(6, out);
    PyBuffer_Release(&levels);
    Py_RETURN_NONE;
fail:
    PyBuffer_Release(&levels);
    return NULL;
}

static PyObject *find_active(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer arrays[4];
    double shares[3];

    (void)module;
    if (!takes(count, 8) || get_numbers(arguments, 3, shares))
        return NULL;
    size_t nodes = PyLong_AsSize_t(arguments[3]);
    if (PyErr_Occurred() || get_arrays(arguments + 4, 4, "ff??", 2, nodes, arrays))
        return NULL;
    bool any = words_find_active(nodes, arrays[0].buf, arrays[1].buf, (float)shares[0],
                                 (float)shares[1], (float)shares[2], arrays[2].buf, arrays[3].buf);
    release(4, arrays);
    return PyBool_FromLong(any);
}

static PyObject *decide(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer arrays[15];
    double numbers[9];

    (void)module;
    if (!takes(count, 25) || get_numbers(arguments, 9, numbers))
        return NULL;
    size_t nodes = PyLong_AsSize_t(arguments[9]);
    if (PyErr_Occurred() ||
        get_arrays(arguments + 10, 15, "ffffii?fiiff???", 9, nodes, arrays))
        return NULL;
    struct words_measures measures = {arrays[0].buf, arrays[1].buf, arrays[2].buf,
                                      arrays[3].buf, arrays[4].buf, arrays[5].buf};
    struct words_decided decided = {arrays[9].buf,  arrays[10].buf, arrays[11].buf,
                                    arrays[12].buf, arrays[13].buf, arrays[14].buf};
    struct words_limits limits = {(float)numbers[4], (float)numbers[5], (float)numbers[6],
                                  (float)numbers[7], (float)numbers[8]};
    unsigned bits = numbers[1] >= 1 && numbers[1] <= 31 ? (unsigned)numbers[1] : 1;
    bool uneven = words_decide(nodes, &measures, arrays[6].buf, arrays[7].buf, arrays[8].buf,
                               (float)numbers[0], bits, numbers[2] != 0, (float)numbers[3], &limits,
                               &decided);
    release(15, arrays);
    return PyBool_FromLong(uneven);
}

static PyObject *fit_words(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer rows, nodes_out[2], out[4];
    double numbers[6];

    (void)module;
    if (!takes(count, 13) || get_numbers(arguments, 6, numbers) ||
        get_array(arguments[6], &rows, 'f', 0, "rows"))
        return NULL;
    struct words_frame frame = {.first = (size_t)numbers[0],
                                .nodes = (size_t)numbers[1],
                                .unipolar = numbers[2] != 0,
                                .swing = (float)numbers[3],
                                .loudest_share = (float)numbers[4],
                                .active_share = (float)numbers[5]};
    if (rows.ndim != 3 || rows.shape[1] < 1 || numbers[0] < 0 || numbers[1] < 0 ||
        numbers[0] + numbers[1] > (double)rows.shape[2]) {
        PyErr_SetString(PyExc_ValueError, "rows are not (c, k, N) with those of the nodes in N");
        goto fail;
    }
    size_t candidates = (size_t)rows.shape[0], nodes = frame.nodes;
    frame.bits = (size_t)rows.shape[1];
    frame.order = (size_t)rows.shape[2];
    if (get_arrays(arguments + 7, 2, "ff", 0, candidates * nodes, nodes_out))
        goto fail;
    if (get_arrays(arguments + 9, 4, "ffff", 0, candidates, out)) {
        release(2, nodes_out);
        goto fail;
    }
    for (size_t i = 0; i < candidates; i++)
        words_fit(&frame, (const float *)rows.buf + i * frame.bits * frame.order,
                  (float *)nodes_out[0].buf + i * nodes, (float *)nodes_out[1].buf + i * nodes,
                  (float *)out[0].buf + i, (float *)out[1].buf + i, (float *)out[2].buf + i,
                  (float *)out[3].buf + i);
    release(4, out);
    release(2, nodes_out);
    PyBuffer_Release(&rows);
    Py_RETURN_NONE;
fail:
    PyBuffer_Release(&rows);
    return NULL;
}

static PyObject *late(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer rows, in[1], edges[1], out[1];
    double numbers[4];

    (void)module;
    if (!takes(count, 8) || get_numbers(arguments, 4, numbers) ||
        get_array(arguments[4], &rows, 'f', 0, "rows"))
        return NULL;
    PyObject *result = NULL;
    if (get_array(arguments[7], &out[0], '?', PyBUF_WRITABLE, "late"))
        goto drop_rows;
    struct words_frame frame = {.first = (size_t)numbers[0], .nodes = (size_t)out[0].len};
    if (rows.ndim != 2 || rows.shape[0] < 2 || rows.shape[0] > WORDS_MOST_BITS ||
        rows.shape[1] < 5 || numbers[0] < 0 ||
        numbers[0] + (double)out[0].len > (double)rows.shape[1]) {
        PyErr_SetString(PyExc_ValueError, "rows are not (2…31, N) with those of the nodes in N");
        goto drop_out;
    }
    frame.bits = (size_t)rows.shape[0];
    frame.order = (size_t)rows.shape[1];
    struct words_lateness limits = {(float)numbers[1], (float)numbers[2], (float)numbers[3]};
    if (get_arrays(arguments + 5, 1, "f", 1, frame.order, in))
        goto drop_out;
    if (!get_arrays(arguments + 6, 1, "f", 1, 4 * frame.order, edges)) {
        words_late(&frame, rows.buf, in[0].buf, edges[0].buf, &limits, out[0].buf);
        release(1, edges);
        result = Py_NewRef(Py_None);
    }
    release(1, in);
drop_out:
    release(1, out);
drop_rows:
    PyBuffer_Release(&rows);
    return result;
}

/* first_row, nodes, begin and number of the spare rows; rows (k, N). */
static PyObject *word_noise(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer rows;
    double n[4];

    (void)module;
    if (!takes(count, 5) || get_numbers(arguments, 4, n) ||
        get_array(arguments[4], &rows, 'f', 0, "rows"))
        return NULL;
    struct words_frame frame = {.first = (size_t)n[0], .nodes = (size_t)n[1]};
    bool fits = rows.ndim == 2 && rows.shape[0] > 1 && n[0] >= 0 && n[1] >= 1 && n[2] >= 0 &&
                n[3] >= 0 && n[0] + n[1] <= (double)rows.shape[1] &&
                n[2] + n[3] <= (double)rows.shape[1];
    double noise = NAN;
    if (fits) {
        frame.bits = (size_t)rows.shape[0];
        frame.order = (size_t)rows.shape[1];
        noise = words_noise(&frame, rows.buf, (size_t)n[2], (size_t)n[3]);
    } else
        PyErr_SetString(PyExc_ValueError, "rows are not (k, N) with those of nodes and noise in N");
    release(1, &rows);
    return fits ? PyFloat_FromDouble(noise) : NULL;
}

/* Numbers: first_row, per_noise, threshold, faint_share, sound_share, most_square, least_usual,
 * loudest_share, a_chip, few, parity, then those of words_limits. */
static PyObject *read_words(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    enum { NUMBERS = 16 };
    Py_buffer rows, given[2], floats, ints, flags;
    double n[NUMBERS];
    PyObject *result = NULL;

    (void)module;
    if (!takes(count, NUMBERS + 6) || get_numbers(arguments, NUMBERS, n) ||
        get_array(arguments[NUMBERS], &rows, 'f', 0, "rows"))
        return NULL;
    arguments += NUMBERS + 1;
    if (get_array(arguments[2], &floats, 'f', PyBUF_WRITABLE, "floats"))
        goto drop_rows;
    size_t nodes = floats.ndim == 2 ? (size_t)floats.shape[1] : 0;
    if (floats.ndim != 2 || floats.shape[0] != 6 || rows.ndim != 2 || rows.shape[0] < 1 ||
        rows.shape[0] > WORDS_MOST_BITS || n[0] < 0 || n[0] + (double)nodes > (double)rows.shape[1]) {
        PyErr_SetString(PyExc_ValueError, "rows are not (1…31, N) with those of n nodes in N, or "
                                          "floats not (6, n)");
        goto drop_floats;
    }
    if (get_arrays(arguments, 2, "if", 1, nodes, given))
        goto drop_floats;
    if (get_arrays(arguments + 3, 1, "i", 0, 3 * nodes, &ints))
        goto drop_given;
    if (get_arrays(arguments + 4, 1, "?", 0, 5 * nodes, &flags))
        goto drop_ints;
    struct words_frame frame = {.bits = (size_t)rows.shape[0],
                                .order = (size_t)rows.shape[1],
                                .first = (size_t)n[0],
                                .nodes = nodes,
                                .loudest_share = (float)n[7]};
    struct words_reading reading = {.per_noise = (float)n[1],
                                    .threshold = (float)n[2],
                                    .faint_share = (float)n[3],
                                    .sound_share = (float)n[4],
                                    .most_square = (float)n[5],
                                    .least_usual = (float)n[6],
                                    .a_chip = (float)n[8],
                                    .few = (size_t)n[9],
                                    .parity = n[10] != 0,
                                    .limits = {(float)n[11], (float)n[12], (float)n[13],
                                               (float)n[14], (float)n[15]}};
    float *f = floats.buf;
    int32_t *i = ints.buf;
    uint8_t *b = flags.buf;
    struct words_measures measures = {f,         f + 3 * nodes, f + 4 * nodes, f + 5 * nodes,
                                      i + nodes, i + 2 * nodes};
    struct words_decided decided = {i, f + nodes, f + 2 * nodes, b + nodes, b + 2 * nodes,
                                    b + 3 * nodes};
    result = PyLong_FromLong(words_read(&frame, &reading, rows.buf, given[0].buf, given[1].buf,
                                        &measures, &decided, b, b + 4 * nodes));
    release(1, &flags);
drop_ints:
    release(1, &ints);
drop_given:
    release(2, given);
drop_floats:
    release(1, &floats);
drop_rows:
    release(1, &rows);
    return result;
}

/* ---- readings ---------------------------------------------------------------------------------- */

/* Status bits, in the order of struct readings_bits. */
static int get_bits(PyObject *object, struct readings_bits *bits)
{
    Py_buffer buffer;

    if (get_arrays(&object, 1, "B", 1, sizeof *bits, &buffer))
        return -1;
    memcpy(bits, buffer.buf, sizeof *bits);
    release(1, &buffer);
    return 0;
}

/* now_s, stale_after_s, bits, table; active, doubtful, codes, state, untrusted, rest_v; what is kept;
 * what is written: see readings_hear. */
static PyObject *hear(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    enum { ARRAYS = 13 };
    Py_buffer table, a[ARRAYS];
    double times[2], until_s = NAN;
    struct readings_bits bits;

    (void)module;
    if (!takes(count, 4 + ARRAYS) || get_numbers(arguments, 2, times) ||
        get_bits(arguments[2], &bits) || get_array(arguments[3], &table, 'f', 0, "table"))
        return NULL;
    Py_ssize_t nodes = PyObject_Size(arguments[4]);
    int failed = nodes < 0 || get_arrays(arguments + 4, ARRAYS, "??iB?fiBdffB?", 6, (size_t)nodes, a);
    if (!failed) {
        struct readings_kept kept = {a[6].buf, a[7].buf, a[8].buf};
        struct readings_heard heard = {a[9].buf, a[10].buf, a[11].buf, a[12].buf};
        until_s = readings_hear((size_t)nodes, a[0].buf, a[1].buf, a[2].buf, &kept, table.buf,
                                (size_t)table.len / sizeof(float), a[3].buf, a[4].buf, a[5].buf,
                                times[0], times[1], &bits, &heard);
        release(ARRAYS, a);
    }
    release(1, &table);
    if (!failed && isnan(until_s))
        PyErr_SetString(PyExc_ValueError, "a code beyond the table");
    return failed || isnan(until_s) ? NULL : PyFloat_FromDouble(until_s);
}

/* pieces (p, 3, n); volts, drift_v, end_v; pressure_pa and saturated, which are written. */
static PyObject *convert(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer pieces, a[5];

    (void)module;
    if (!takes(count, 6) || get_array(arguments[0], &pieces, 'f', 0, "pieces"))
        return NULL;
    size_t nodes = pieces.ndim == 3 && pieces.shape[1] == 3 ? (size_t)pieces.shape[2] : 0;
    int failed = get_arrays(arguments + 1, 5, "ffff?", 3, nodes, a);
    if (!failed) {
        readings_convert(nodes, a[0].buf, a[1].buf, pieces.buf, nodes ? (size_t)pieces.shape[0] : 0,
                         a[2].buf, a[3].buf, a[4].buf);
        release(5, a);
    }
    release(1, &pieces);
    return failed ? NULL : Py_NewRef(Py_None);
}

/* bits; saturated, valid, uncalibrated, masked; status, pressure_pa and voltage_v, which are written. */
static PyObject *finish(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer a[7];
    struct readings_bits bits;

    (void)module;
    if (!takes(count, 8) || get_bits(arguments[0], &bits))
        return NULL;
    Py_ssize_t nodes = PyObject_Size(arguments[1]);
    if (nodes < 0 || get_arrays(arguments + 1, 7, "????Bff", 4, (size_t)nodes, a))
        return NULL;
    readings_finish((size_t)nodes, a[0].buf, a[1].buf, a[2].buf, a[3].buf, &bits, a[4].buf, a[5].buf,
                    a[6].buf);
    release(7, a);
    Py_RETURN_NONE;
}

/* weak_v, weak_rho, low_margin, low_rho, suspected_frames; active, amplitude_v, rho, margin, doubtful,
 * doubled, odd, astray; the sums (5, n) and suspected, which are written. */
static PyObject *count_words(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer a[8], sums, suspected;
    double n[5];
    PyObject *result = NULL;

    (void)module;
    if (!takes(count, 15) || get_numbers(arguments, 5, n))
        return NULL;
    Py_ssize_t length = PyObject_Size(arguments[5]);
    size_t nodes = length < 0 ? 0 : (size_t)length;
    if (length < 0 || get_arrays(arguments + 5, 8, "?fff????", 8, nodes, a))
        return NULL;
    if (get_arrays(arguments + 13, 1, "f", 0, 5 * nodes, &sums))
        goto drop_words;
    if (!get_arrays(arguments + 14, 1, "i", 0, nodes, &suspected)) {
        float *sum = sums.buf;
        struct readings_seen seen = {sum,
                                     sum + nodes,
                                     sum + 2 * nodes,
                                     sum + 3 * nodes,
                                     sum + 4 * nodes,
                                     suspected.buf};
        struct readings_limits limits = {(float)n[0], (float)n[1], (float)n[2], (float)n[3],
                                         (int32_t)n[4]};
        result = PyBool_FromLong(readings_count(nodes, a[0].buf, a[1].buf, a[2].buf, a[3].buf,
                                                a[4].buf, a[5].buf, a[6].buf, a[7].buf, &limits,
                                                &seen));
        release(1, &suspected);
    }
    release(1, &sums);
drop_words:
    release(8, a);
    return result;
}

/* ---- contacts ---------------------------------------------------------------------------------- */

/* contact_pa, release_pa, rim_pa, the bit of saturation; neighbours (t, m), moments (t, 10), pressure,
 * status; place, unread, and the arrays that are written: ints (6·t + 1), doubles (13·t), peak, flags. */
static PyObject *gather_contacts(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer neighbours, a[5], moments, ints, doubles, flags;
    double n[4];
    PyObject *result = NULL;

    (void)module;
    if (!takes(count, 14) || get_numbers(arguments, 4, n) ||
        get_array(arguments[4], &neighbours, 'i', 0, "neighbours"))
        return NULL;
    if (neighbours.ndim != 2) {
        PyErr_SetString(PyExc_ValueError, "neighbours are not (t, m)");
        goto drop_neighbours;
    }
    size_t t = (size_t)neighbours.shape[0];
    PyObject *each[] = {arguments[6], arguments[7], arguments[8], arguments[9], arguments[12]};
    if (get_arrays(each, 5, "fBiBf", 2, t, a))
        goto drop_neighbours;
    if (get_arrays(arguments + 5, 1, "d", 1, CONTACTS_MOMENTS * t, &moments))
        goto drop_each;
    if (get_arrays(arguments + 10, 1, "i", 0, 6 * t + 1, &ints))
        goto drop_moments;
    if (get_arrays(arguments + 11, 1, "d", 0, (CONTACTS_SUMS + 2) * t, &doubles))
        goto drop_ints;
    if (!get_arrays(arguments + 13, 1, "?", 0, 3 * t, &flags)) {
        int32_t *whole = ints.buf;
        double *sums = doubles.buf;
        uint8_t *flag = flags.buf;
        struct contacts_skin skin = {t, (size_t)neighbours.shape[1], neighbours.buf, moments.buf};
        struct contacts_limits limits = {(float)n[0], (float)n[1], (float)n[2], (uint8_t)n[3]};
        struct contacts_kept kept = {a[2].buf, a[3].buf};
        _Static_assert(sizeof(struct contacts_load) == 2 * sizeof(double), "two doubles");
        struct contacts_scratch scratch = {whole, whole + t, whole + 2 * t,
                                           (struct contacts_load *)(sums + CONTACTS_SUMS * t)};
        struct contacts_found found = {whole + 3 * t, whole + 4 * t, whole + 5 * t, sums,
                                       a[4].buf,      flag,          flag + t,      flag + 2 * t};
        size_t contacts = contacts_gather(&skin, &limits, a[0].buf, a[1].buf, &kept, &scratch, &found);
        if (contacts == SIZE_MAX)
            PyErr_SetString(PyExc_ValueError, "a neighbour is no taxel");
        else
            result = PyLong_FromSize_t(contacts);
        release(1, &flags);
    }
    release(1, &doubles);
drop_ints:
    release(1, &ints);
drop_moments:
    release(1, &moments);
drop_each:
    release(5, a);
drop_neighbours:
    PyBuffer_Release(&neighbours);
    return result;
}

/* ---- samples ----------------------------------------------------------------------------------- */

static PyObject *to_volts(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer counts, volts;
    double numbers[2];

    (void)module;
    if (!takes(count, 4) || get_numbers(arguments, 2, numbers) ||
        get_array(arguments[2], &counts, 'h', 0, "counts"))
        return NULL;
    size_t size = (size_t)counts.len / sizeof(int16_t);
    int failed = get_arrays(arguments + 3, 1, "f", 0, size, &volts);
    if (!failed) {
        samples_volts(counts.buf, size, (float)numbers[0], (float)numbers[1], volts.buf);
        release(1, &volts);
    }
    release(1, &counts);
    return failed ? NULL : Py_NewRef(Py_None);
}

static PyObject *copy_samples(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer volts, copy;
    double most;

    (void)module;
    if (!takes(count, 3) || get_numbers(arguments, 1, &most) ||
        get_array(arguments[1], &volts, 'f', 0, "volts"))
        return NULL;
    size_t size = (size_t)volts.len / sizeof(float);
    int failed = get_arrays(arguments + 2, 1, "d", 0, size, &copy);
    if (!failed) {
        samples_copy(volts.buf, size, most, copy.buf);
        release(1, &copy);
    }
    release(1, &volts);
    return failed ? NULL : Py_NewRef(Py_None);
}

static PyObject *add_samples(PyObject *module, PyObject *volts)
{
    Py_buffer buffer;

    (void)module;
    if (get_array(volts, &buffer, 'd', 0, "volts"))
        return NULL;
    struct samples_sums sums = samples_add(buffer.buf, (size_t)buffer.len / sizeof(double));
    release(1, &buffer);
    return Py_BuildValue("(dd)", sums.sum, sums.squares);
}

static PyObject *count_outside(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer volts;
    double levels[2];

    (void)module;
    if (!takes(count, 3) || get_numbers(arguments, 2, levels) ||
        get_array(arguments[2], &volts, 'd', 0, "volts"))
        return NULL;
    size_t size = (size_t)volts.len / sizeof(double);
    size_t outside = samples_outside(volts.buf, size, levels[0], levels[1]);
    release(1, &volts);
    return PyLong_FromSize_t(outside);
}

static PyObject *mean_chips(PyObject *module, PyObject *const *arguments, Py_ssize_t count)
{
    Py_buffer volts, whole, spans[2], places, chips;
    double level;
    int fits = -1;

    (void)module;
    if (!takes(count, 7) || get_numbers(arguments, 1, &level) ||
        get_array(arguments[1], &volts, 'd', 0, "volts"))
        return NULL;
    if (get_array(arguments[2], &whole, 'i', 0, "whole"))
        goto drop_volts;
    struct samples_edges edges = {.count = (size_t)whole.len / sizeof(int32_t), .whole = whole.buf};
    if (get_arrays(arguments + 3, 1, "d", 1, edges.count, &spans[0]))
        goto drop_whole;
    if (get_arrays(arguments + 4, 1, "d", 1, edges.count ? edges.count - 1 : 0, &spans[1]))
        goto drop_share;
    if (get_array(arguments[5], &places, 'i', 0, "places"))
        goto drop_number;
    size_t size = (size_t)places.len / sizeof(int32_t);
    if (get_arrays(arguments + 6, 1, "f", 0, size, &chips))
        goto drop_places;
    edges.share = spans[0].buf;
    edges.number = spans[1].buf;
    fits = samples_chips(volts.buf, (size_t)volts.len / sizeof(double), level, &edges, places.buf,
                         size, chips.buf);
    release(1, &chips);
    if (!fits)
        PyErr_SetString(PyExc_ValueError, "edges beyond the samples, or places beyond the edges");
drop_places:
    release(1, &places);
drop_number:
    release(1, &spans[1]);
drop_share:
    release(1, &spans[0]);
drop_whole:
    release(1, &whole);
drop_volts:
    release(1, &volts);
    return fits == 1 ? Py_NewRef(Py_None) : NULL;
}

static PyMethodDef functions[] = {
    {"read_packets", (PyCFunction)(void (*)(void))read_packets, METH_FASTCALL, NULL},
    {"measure", (PyCFunction)(void (*)(void))measure, METH_FASTCALL, NULL},
    {"find_active", (PyCFunction)(void (*)(void))find_active, METH_FASTCALL, NULL},
    {"decide", (PyCFunction)(void (*)(void))decide, METH_FASTCALL, NULL},
    {"late", (PyCFunction)(void (*)(void))late, METH_FASTCALL, NULL},
    {"fit_words", (PyCFunction)(void (*)(void))fit_words, METH_FASTCALL, NULL},
    {"word_noise", (PyCFunction)(void (*)(void))word_noise, METH_FASTCALL, NULL},
    {"read_words", (PyCFunction)(void (*)(void))read_words, METH_FASTCALL, NULL},
    {"hear", (PyCFunction)(void (*)(void))hear, METH_FASTCALL, NULL},
    {"convert", (PyCFunction)(void (*)(void))convert, METH_FASTCALL, NULL},
    {"finish", (PyCFunction)(void (*)(void))finish, METH_FASTCALL, NULL},
    {"count_words", (PyCFunction)(void (*)(void))count_words, METH_FASTCALL, NULL},
    {"gather_contacts", (PyCFunction)(void (*)(void))gather_contacts, METH_FASTCALL, NULL},
    {"to_volts", (PyCFunction)(void (*)(void))to_volts, METH_FASTCALL, NULL},
    {"copy_samples", (PyCFunction)(void (*)(void))copy_samples, METH_FASTCALL, NULL},
    {"add_samples", add_samples, METH_O, NULL},
    {"count_outside", (PyCFunction)(void (*)(void))count_outside, METH_FASTCALL, NULL},
    {"mean_chips", (PyCFunction)(void (*)(void))mean_chips, METH_FASTCALL, NULL},
    {0},
};

/* ---- the module -------------------------------------------------------------------------------- */

static int add_type(PyObject *module, PyType_Spec *spec)
{
    PyObject *type = PyType_FromModuleAndSpec(module, spec, NULL);
    int failed = !type || PyModule_AddType(module, (PyTypeObject *)type);

    Py_XDECREF(type);
    return failed ? -1 : 0;
}

static int fill(PyObject *module)
{
    if (add_type(module, &transform_spec) || add_type(module, &scanner_spec) ||
        add_type(module, &steady_spec))
        return -1;
    if (PyModule_AddIntConstant(module, "VERSION", VERSION))
        return -1;
    return PyModule_AddIntConstant(module, "LANES", (long)transform_lanes());
}

static PyModuleDef_Slot slots[] = {
    {Py_mod_exec, fill},
    {0},
};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT,
    .m_name = "_kernel",
    .m_methods = functions,
    .m_slots = slots,
};

PyMODINIT_FUNC PyInit__kernel(void)
{
    return PyModuleDef_Init(&definition);
}
