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

static const struct field frame_fields[] = {
    FIELD(words_frame, bits),          FIELD(words_frame, order),
    FIELD(words_frame, first),         FIELD(words_frame, nodes),
    FIELD(words_frame, unipolar),      FIELD(words_frame, swing),
    FIELD(words_frame, loudest_share), FIELD(words_frame, active_share),
    FIELD(words_frame, spoken_over),
};

#define OF_READOUT(member) FIELD(readout_settings, member)

static const struct field readout_fields[] = {
    OF_READOUT(frame.bits),                   OF_READOUT(frame.order),
    OF_READOUT(frame.first),                  OF_READOUT(frame.nodes),
    OF_READOUT(frame.unipolar),               OF_READOUT(frame.swing),
    OF_READOUT(frame.loudest_share),          OF_READOUT(frame.active_share),
    OF_READOUT(frame.spoken_over),            OF_READOUT(reading.threshold),
    OF_READOUT(reading.faint_share),          OF_READOUT(reading.sound_share),
    OF_READOUT(reading.most_square),          OF_READOUT(reading.a_chip),
    OF_READOUT(reading.few_share),            OF_READOUT(reading.tone_share),
    OF_READOUT(reading.moved_share),          OF_READOUT(reading.least_squares),
    OF_READOUT(reading.loud_squares),         OF_READOUT(reading.hiding_rho),
    OF_READOUT(reading.few),                  OF_READOUT(reading.parity),
    OF_READOUT(reading.limits.low_rho),       OF_READOUT(reading.limits.low_margin),
    OF_READOUT(reading.limits.shared),        OF_READOUT(reading.limits.two),
    OF_READOUT(reading.limits.clear_rho),     OF_READOUT(reading.limits.lower),
    OF_READOUT(lateness.late_share),          OF_READOUT(lateness.by_chance),
    OF_READOUT(lateness.of_two),              OF_READOUT(bits.silent),
    OF_READOUT(bits.low_snr),                 OF_READOUT(bits.stale),
    OF_READOUT(bits.saturated),               OF_READOUT(bits.uncalibrated),
    OF_READOUT(bits.masked),                  OF_READOUT(bits.faulty),
    OF_READOUT(scrambled),                    OF_READOUT(spare),
    OF_READOUT(spare_count),                  OF_READOUT(codes),
    OF_READOUT(pieces),                       OF_READOUT(taxels),
};

static const struct field burst_fields[] = {
    FIELD(burst_search, half),      FIELD(burst_search, window),       FIELD(burst_search, group),
    FIELD(burst_search, low),       FIELD(burst_search, high),         FIELD(burst_search, bit),
    FIELD(burst_search, width),     FIELD(burst_search, gap_size),     FIELD(burst_search, side),
    FIELD(burst_search, nodes),     FIELD(burst_search, chip),         FIELD(burst_search, snr_floor),
    FIELD(burst_search, loud),      FIELD(burst_search, no_power),     FIELD(burst_search, bias),
    FIELD(burst_search, newest),    FIELD(burst_search, calmer),       FIELD(burst_search, drifting),
    FIELD(burst_search, median),    FIELD(burst_search, beside_level), FIELD(burst_search, beside),
};

static const struct field rules_fields[] = {
    FIELD(gap_rules, judge.distortion),     FIELD(gap_rules, judge.most),
    FIELD(gap_rules, judge.most_deviations), FIELD(gap_rules, judge.vote),
    FIELD(gap_rules, blur),                 FIELD(gap_rules, settled_chips),
    FIELD(gap_rules, shortest),             FIELD(gap_rules, longest),
    FIELD(gap_rules, bit),                  FIELD(gap_rules, period),
    FIELD(gap_rules, beyond),               FIELD(gap_rules, carried_noise),
    FIELD(gap_rules, carried_misfit),       FIELD(gap_rules, doubt),
    FIELD(gap_rules, disturbed),            FIELD(gap_rules, wide),
    FIELD(gap_rules, ruled_out),            FIELD(gap_rules, rail_low),
    FIELD(gap_rules, rail_high),            FIELD(gap_rules, deafened),
    FIELD(gap_rules, still_misfit),         FIELD(gap_rules, least_chip),
    FIELD(gap_rules, uneven),               FIELD(gap_rules, spread),
    FIELD(gap_rules, left),                 FIELD(gap_rules, misfit),
    FIELD(gap_rules, faint),                FIELD(gap_rules, near),
    FIELD(gap_rules, far),                  FIELD(gap_rules, beside),
    FIELD(gap_rules, perhaps),              FIELD(gap_rules, inner),
    FIELD(gap_rules, turned),               FIELD(gap_rules, scatter),
    FIELD(gap_rules, stray_left),           FIELD(gap_rules, clear),
    FIELD(gap_rules, most_turned),          FIELD(gap_rules, spare),
    FIELD(gap_rules, spare_count),          FIELD(gap_rules, twins),
};

static const struct layout layouts[] = {
    LAYOUT(words_frame, frame_fields),
    LAYOUT(readout_settings, readout_fields),
    LAYOUT(burst_search, burst_fields),
    LAYOUT(gap_rules, rules_fields),
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
    return hold((PyTypeObject *)call->self, transform, drop_transform);
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

static PyMethodDef transform_methods[] = {ENTRY(multiply), {0}};

static PyType_Slot transform_slots[] = {
    {Py_tp_new, Transform},
    {Py_tp_dealloc, drop_holder},
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

static void drop_scanner(void *held)
{
    scanner_free(held);
}

CONSTRUCTOR(Scanner, SIZE("most_repeated"))
{
    return hold((PyTypeObject *)call->self, scanner_new(call->value[0].size), drop_scanner);
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

static PyObject *skip(PyObject *self, PyObject *unused)
{
    (void)unused;
    scanner_skip(held_by(self));
    scanner_tell(held_by(self));
    Py_RETURN_NONE;
}

static PyObject *held(PyObject *self, PyObject *unused)
{
    (void)unused;
    return PyLong_FromSize_t(scanner_held(held_by(self)));
}

static PyObject *counts(PyObject *self, PyObject *unused)
{
    (void)unused;
    return counts_dict(scanner_told(held_by(self)));
}

static PyMethodDef scanner_methods[] = {
    ENTRY(feed),
    {"skip", skip, METH_NOARGS, NULL},
    {"held", held, METH_NOARGS, NULL},
    {"counts", counts, METH_NOARGS, NULL},
    {0},
};

static PyType_Slot scanner_slots[] = {
    {Py_tp_new, Scanner},
    {Py_tp_dealloc, drop_holder},
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
    if (add_type(module, &transform_spec) || add_type(module, &scanner_spec) ||
        add_type(module, &readout_spec) || add_type(module, &stream_spec) ||
        add_type(module, &code_spec) || add_type(module, &sparse_spec))
        return -1;
    PyObject *structs = PyDict_New();
    int failed = !add_layouts(structs, layouts, sizeof layouts / sizeof *layouts) ||
                 !add_layouts(structs, stream_layouts, STREAM_LAYOUTS) ||
                 !add_layouts(structs, &sparse_layout, 1) ||
                 PyModule_AddObjectRef(module, "STRUCTS", structs);
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
