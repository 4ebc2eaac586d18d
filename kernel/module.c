// SPDX-License-Identifier: Apache-2.0

/* The kernel as a Python module: each FUNCTION, as binding.h explains, lists its arguments. */
#include "binding.h"

#include <errno.h>
#include <math.h>

#include "contacts.h"
#include "gap.h"
#include "marked_frame.h"
#include "readout.h"
#include "scanner.h"
#include "transform.h"
#include "words.h"

#define VERSION 34 /* raise with every change of what this module offers; see base/kernel.py */
#define LONG_WORK (1 << 16)
/* Values that take tens of microseconds: work below does not release the GIL, since to get it back
 * from a busy thread can take 5 ms. */

/* ---- settings ---------------------------------------------------------------------------------- */

FIELDS(words_frame, bits, order, first, nodes, unipolar, swing, loudest_share, active_share, spoken_over);

FIELDS(readout_settings, frame.bits, frame.order, frame.first, frame.nodes, frame.unipolar, frame.swing,
       frame.loudest_share, frame.active_share, frame.spoken_over, reading.threshold, reading.faint_share,
       reading.sound_share, reading.most_square, reading.a_chip, reading.few_share, reading.tone_share,
       reading.moved_share, reading.least_squares, reading.loud_squares, reading.hiding_rho, reading.few,
       reading.parity, reading.limits.low_rho, reading.limits.low_margin, reading.limits.shared,
       reading.limits.two, reading.limits.clear_rho, reading.limits.lower, lateness.late_share,
       lateness.by_chance, lateness.of_two, bits.silent, bits.low_snr, bits.stale, bits.saturated,
       bits.uncalibrated, bits.masked, bits.faulty, scrambled, spare, spare_count, codes, pieces, taxels);

FIELDS(burst_search, half, window, group, low, high, bit, width, gap_size, side, nodes, chip, snr_floor, loud,
       no_power, bias, newest, calmer, drifting, median, beside_level, beside);

FIELDS(gap_rules, judge.distortion, judge.most, judge.most_deviations, judge.vote, blur, settled_chips, shortest,
       longest, bit, period, beyond, carried_noise, carried_misfit, doubt, disturbed, wide, ruled_out, rail_low,
       rail_high, deafened, still_misfit, least_chip, uneven, spread, left, misfit, faint, near, far, beside,
       perhaps, inner, turned, scatter, stray_left, clear, most_turned, spare, spare_count, twins);

static const struct layout *const layouts[] = {
    &words_frame_layout,  &readout_settings_layout, &burst_search_layout,  &gap_rules_layout,
    &stream_rules_layout, &stream_timing_layout,    &sparse_rules_layout,
};

/* ---- Transform --------------------------------------------------------------------------------- */

static void drop_transform(void *held)
{
    transform_free(held);
}

CONSTRUCTOR(Transform, SIZE("twos"), ARRAY("orders", 'I', "f"), ARRAY("signs", 'b', "s"),
            NUMBER("scale"), SIZE("lanes"))
{
    size_t twos = call->value[0].size, lanes = call->value[4].size, count = axis(call, 'f');
    const unsigned *given = call->value[1].data;
    const int8_t *signs = call->value[2].data;
    size_t orders[TRANSFORM_MOST_FACTORS], left = axis(call, 's');
    const int8_t *matrices[TRANSFORM_MOST_FACTORS];

    for (size_t i = 0; i < count && i < TRANSFORM_MOST_FACTORS; i++) {
        orders[i] = given[i];
        if (!(orders[i] <= TRANSFORM_MOST_DENSE && orders[i] * orders[i] <= left))
            return refuse(call, "signs: too few for orders, or an order is too large");
        matrices[i] = signs;
        signs += orders[i] * orders[i];
        left -= orders[i] * orders[i];
    }
    struct transform *transform =
        twos <= 16 && lanes <= 8 ? transform_new((unsigned)twos, count, orders, matrices,
                                                 (float)call->value[3].number, (unsigned)lanes)
                                 : NULL;
    if (!transform)
        return refuse(call,
                      "%zu factors of 2 and %zu others with %zu lanes: no memory, or beyond what the "
                      "kernel is built for",
                      twos, count, lanes);
    return hold(call, transform, drop_transform);
}

FUNCTION(multiply, ARRAY("source", 'f', "*"), OUT("out", 'f', "*"))
{
    const struct transform *transform = held_by(call->self);
    const float *from = call->value[0].data;
    float *to = call->value[1].data;
    size_t values = length(call, 0), order = transform_order(transform);

    if (!(values == length(call, 1) && values % order == 0))
        return refuse(call, "out: %zu values of order %zu expected, not %zu", values, order,
                      length(call, 1));
    if (!(from == to || from + values <= to || to + values <= from))
        return refuse(call, "source and out overlap");
    if (values < LONG_WORK)
        transform_multiply(transform, from, to, values / order);
    else {
        Py_BEGIN_ALLOW_THREADS
        transform_multiply(transform, from, to, values / order);
        Py_END_ALLOW_THREADS
    }
    Py_RETURN_NONE;
}

CLASS(transform_spec, Transform, ENTRY(multiply));

/* ---- Scanner ----------------------------------------------------------------------------------- */

static void drop_scanner(void *held)
{
    scanner_free(held);
}

CONSTRUCTOR(Scanner, SIZE("most_repeated"))
{
    return hold(call, scanner_new(call->value[0].size), drop_scanner);
}

FUNCTION(feed, ARRAY("data", 'B', "*"))
{
    struct scanner *scanner = held_by(call->self);
    struct scanner_packet packet;
    const uint8_t *bytes = call->value[0].data;
    size_t left = length(call, 0);
    PyObject *packets = PyList_New(0);

    while (packets && left) {
        size_t taken = scanner_take(scanner, bytes, left, &packet);
        bytes += taken;
        left -= taken;
        if (!packet.payload)
            continue;
        PyObject *tuple = packet_tuple(&packet);
        if (!tuple || PyList_Append(packets, tuple))
            Py_CLEAR(packets);
        Py_XDECREF(tuple);
    }
    scanner_tell(scanner);
    return packets;
}

FUNCTION(skip)
{
    struct scanner *scanner = held_by(call->self);

    scanner_skip(scanner);
    scanner_tell(scanner);
    Py_RETURN_NONE;
}

FUNCTION(held)
{
    return PyLong_FromSize_t(scanner_held(held_by(call->self)));
}

FUNCTION(counts)
{
    return counts_dict(scanner_told(held_by(call->self)));
}

CLASS(scanner_spec, Scanner, ENTRY(feed), ENTRY(skip), ENTRY(held), ENTRY(counts));

/* ---- reader ------------------------------------------------------------------------------------ */

FUNCTION(read_packets, SIZE("file"), SIZE("timeout_ms"))
{
    int file = (int)call->value[0].size, timeout_ms = (int)call->value[1].size;
    uint8_t bytes[READER_SIZE];
    bool had_waited;
    ptrdiff_t size;
    int failure;

    Py_BEGIN_ALLOW_THREADS
    size = reader_read(file, bytes, sizeof bytes, timeout_ms, &had_waited);
    failure = errno;
    Py_END_ALLOW_THREADS
    if (size < 0)
        return file_error(failure);
    return Py_BuildValue("(y#O)", bytes, (Py_ssize_t)size, had_waited ? Py_True : Py_False);
}

/* ---- words ------------------------------------------------------------------------------------- */

FUNCTION(fit_words, SETTINGS(words_frame), ARRAY("rows", 'f', "ckN"), OUT("amplitude", 'f', "cn"),
         OUT("uneven", 'f', "cn"), OUT("pedestal", 'f', "c"), OUT("power", 'f', "c"),
         OUT("spread", 'f', "c"), OUT("misfit", 'f', "c"))
{
    const struct words_frame *frame = call->value[0].data;
    const float *rows = call->value[1].data;
    float *amplitude = call->value[2].data, *uneven = call->value[3].data;
    float *pedestal = call->value[4].data, *power = call->value[5].data;
    float *spread = call->value[6].data, *misfit = call->value[7].data;

    if (!are_of(call, frame))
        return NULL;
    if (!(frame->nodes == axis(call, 'n')))
        return refuse(call, "amplitude: %zu nodes expected, not %zu", frame->nodes, axis(call, 'n'));
    for (size_t i = 0; i < axis(call, 'c'); i++)
        words_fit(frame, rows + i * frame->bits * frame->order, amplitude + i * frame->nodes,
                  uneven + i * frame->nodes, pedestal + i, power + i, spread + i, misfit + i);
    Py_RETURN_NONE;
}

FUNCTION(word_noise, SETTINGS(words_frame), SIZE("spare"), SIZE("spare_count"),
         ARRAY("rows", 'f', "kN"))
{
    const struct words_frame *frame = call->value[0].data;
    size_t spare = call->value[1].size, count = call->value[2].size;

    if (!are_of(call, frame))
        return NULL;
    if (!(spare <= frame->order && count <= frame->order - spare && frame->nodes))
        return refuse(call, "spare: %zu rows from %zu on are not within %zu, or there are no nodes",
                      count, spare, frame->order);
    return PyFloat_FromDouble(words_noise(frame, call->value[3].data, spare, count));
}

/* ---- contacts ---------------------------------------------------------------------------------- */

FUNCTION(gather_contacts, NUMBER("contact_pa"), NUMBER("release_pa"), NUMBER("rim_pa"),
         SIZE("saturated"), SIZE("uncertain"), SIZE("masked"), ARRAY("neighbours", 'i', "tm"),
         ARRAY("moments", 'd', "tc"), ARRAY("pressure_pa", 'f', "t"), ARRAY("status", 'B', "t"),
         OUT("place", 'i', "t"), OUT("notes", 'B', "t"), OUT("scratch", 'i', "3t"), OUT("loads", 'd', "t"),
         OUT("taxels", 'i', "2t"), OUT("starts", 'i', "s"), OUT("tally", 'i', "4"), OUT("sums", 'd', "te"),
         OUT("peak_pa", 'f', "t"), OUT("flags", '?', "3t"))
{
    const union value *v = call->value;
    size_t t = axis(call, 't');
    int32_t *taxels = v[14].data;
    uint8_t *flags = v[19].data;
    const struct contacts_skin skin = {
        t, axis(call, 'm'), v[6].data, v[7].data, (float)v[0].number, (float)v[1].number,
        (float)v[2].number, (uint8_t)v[3].size, (uint8_t)v[4].size, (uint8_t)v[5].size};
    const struct contacts_kept kept = {v[10].data, v[11].data, v[12].data, v[13].data};
    const struct contacts_found found = {taxels, taxels + t, v[15].data, v[16].data, v[17].data,
                                         v[18].data, flags, flags + t, flags + 2 * t};

    if (!(axis(call, 'c') == CONTACTS_MOMENTS && axis(call, 'e') == CONTACTS_SUMS &&
          axis(call, 's') == t + 1))
        return refuse(call, "moments, sums, starts: (t, %d), (t, %d) and (t + 1,) expected",
                      CONTACTS_MOMENTS, CONTACTS_SUMS);
    size_t contacts = contacts_gather(&skin, v[8].data, v[9].data, &kept, &found);
    return contacts == SIZE_MAX ? refuse(call, "neighbours: one is no taxel")
                                : PyLong_FromSize_t(contacts);
}

/* ---- samples ----------------------------------------------------------------------------------- */

FUNCTION(add_samples, ARRAY("volts", 'd', "m"))
{
    struct samples_sums sums = samples_add_wide(call->value[0].data, axis(call, 'm'));

    return Py_BuildValue("(dd)", sums.sum, sums.squares);
}

static PyMethodDef functions[] = {
    ENTRY(read_packets), ENTRY(fit_words),   ENTRY(word_noise),
    ENTRY(add_samples),  ENTRY(gather_contacts), {0},
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
    PyType_Spec *classes[] = {&transform_spec, &scanner_spec, &readout_spec,
                              &stream_spec,    &code_spec,    &sparse_spec};

    for (size_t i = 0; i < sizeof classes / sizeof *classes; i++)
        if (add_type(module, classes[i]))
            return -1;
    PyObject *structs = PyDict_New();
    bool added = structs;
    for (size_t i = 0; added && i < sizeof layouts / sizeof *layouts; i++)
        added = add_layout(structs, layouts[i]);
    bool failed = !added || PyModule_AddObjectRef(module, "STRUCTS", structs);
    Py_XDECREF(structs);
    if (failed || PyModule_AddIntConstant(module, "VERSION", VERSION))
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
