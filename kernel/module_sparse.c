// SPDX-License-Identifier: Apache-2.0

/* The class Sparse of the Python module: see sparse.h. */
#include "binding.h"

#include "sparse.h"

#define OF_RULES(member) FIELD(sparse_rules, member)

#define OF_DETECTION(member) FIELD(sparse_rules, detect.member)

static const struct field sparse_fields[] = {
    OF_DETECTION(swing),     OF_DETECTION(least),      OF_DETECTION(soft_noise), OF_DETECTION(slope),
    OF_DETECTION(log_odds),  OF_DETECTION(hard_share), OF_DETECTION(settled),    OF_DETECTION(near),
    OF_DETECTION(negligible), OF_DETECTION(stalled),   OF_DETECTION(turns),      OF_RULES(capacity),
    OF_RULES(most_noise),    OF_RULES(more),           OF_RULES(tolerance),      OF_RULES(faintest),
    OF_RULES(chance),        OF_RULES(chance_of_bit),  OF_RULES(hiding),         OF_RULES(weight),
    OF_RULES(silent_square), OF_RULES(silent_power),   OF_RULES(alike),
};

const struct layout sparse_layout = LAYOUT(sparse_rules, sparse_fields);

struct owned {
    struct sparse *sparse;
    size_t bits, order, rows, nodes;
    PyObject *walsh;
    Py_buffer flips, places, codes;
};

static void drop_owned(void *held)
{
    struct owned *owned = held;

    sparse_free(owned->sparse);
    PyBuffer_Release(&owned->flips);
    PyBuffer_Release(&owned->places);
    PyBuffer_Release(&owned->codes);
    Py_XDECREF(owned->walsh);
    PyMem_Free(owned);
}

struct sparse *sparse_of(void *held)
{
    return ((struct owned *)held)->sparse;
}

CONSTRUCTOR(Sparse, SETTINGS(sparse_rules), OBJECT("walsh", "Transform"), ARRAY("flips", 'f', "kN"),
            ARRAY("places", 'i', "kN"), ARRAY("codes", 'i', "M"), SIZE("nodes"))
{
    struct sparse_book book = {axis(call, 'k'),     axis(call, 'N'),     axis(call, 'M'),
                               call->value[5].size, call->value[1].data, call->value[3].data,
                               call->value[4].data, call->value[2].data};

    if (!(book.bits && book.bits <= WORDS_MOST_BITS && book.order && book.nodes && book.nodes < book.rows &&
          transform_order(book.walsh) == book.rows))
        return refuse(call, "codes: more than nodes, and as many as the transform's rows, expected");
    for (size_t i = 0; i < book.bits * book.order; i++)
        if (book.places[i] < 0 || (size_t)book.places[i] >= book.rows)
            return refuse(call, "places: beyond the rows");
    for (size_t i = 0; i < book.rows; i++)
        if (book.codes[i] < 0 || (size_t)book.codes[i] >= book.rows)
            return refuse(call, "codes: beyond the rows");
    const struct sparse_rules *rules = call->value[0].data;
    if (rules->capacity > book.nodes)
        return refuse(call, "capacity: more than nodes");
    struct owned *owned = PyMem_Calloc(1, sizeof *owned);
    if (!owned)
        return PyErr_NoMemory();
    *owned = (struct owned){sparse_new(&book, call->value[0].data), book.bits, book.order, book.rows,
                            book.nodes, Py_NewRef(call->given[1]), keep(call, 2), keep(call, 3),
                            keep(call, 4)};
    if (!owned->sparse) {
        drop_owned(owned);
        return PyErr_NoMemory();
    }
    return hold((PyTypeObject *)call->self, owned, drop_owned);
}

FUNCTION(detect, ARRAY("chips", 'f', "kN"), NUMBER("damping"), OUT("rows", 'f', "kM"),
         OUT("heard", '?', "n"), OUT("left", 'f', "kN"), OUT("power", 'd', "k"))
{
    struct owned *owned = held_by(call->self);
    struct detected found = {.rows = call->value[2].data,
                                 .left = call->value[4].data,
                                 .heard = call->value[3].data,
                                 .power = call->value[5].data};

    if (!(axis(call, 'k') == owned->bits && axis(call, 'N') == owned->order &&
          axis(call, 'M') == owned->rows && axis(call, 'n') == owned->nodes))
        return refuse(call, "chips: not of this book");
    Py_BEGIN_ALLOW_THREADS
    detector_detect(sparse_detector(owned->sparse), call->value[0].data, call->value[1].number, &found);
    Py_END_ALLOW_THREADS
    return Py_BuildValue("dO", found.level, found.settled ? Py_True : Py_False);
}

FUNCTION(loudness, ARRAY("chips", 'f', "kN"), SIZE("lateness"), FLAG("late"), OUT("loudness", 'f', "n"))
{
    struct owned *owned = held_by(call->self);
    ptrdiff_t lateness = (ptrdiff_t)call->value[1].size;

    if (!(axis(call, 'k') == owned->bits && axis(call, 'N') == owned->order &&
          axis(call, 'n') == owned->nodes && call->value[1].size < owned->order))
        return refuse(call, "chips: not of this book, or all of a bit late");
    detector_loudness(sparse_detector(owned->sparse), call->value[0].data, call->value[2].size ? lateness : -lateness,
                      call->value[3].data);
    Py_RETURN_NONE;
}

FUNCTION(learn, NUMBER("noise"), NUMBER("found"))
{
    struct owned *owned = held_by(call->self);

    return PyFloat_FromDouble(sparse_learn(owned->sparse, call->value[0].number, call->value[1].number));
}

static PyMethodDef sparse_methods[] = {ENTRY(detect), ENTRY(loudness), ENTRY(learn), {0}};

static PyType_Slot sparse_slots[] = {
    {Py_tp_new, Sparse},
    {Py_tp_dealloc, drop_holder},
    {Py_tp_methods, sparse_methods},
    {0},
};

PyType_Spec sparse_spec = {
    .name = "tactile_cdma._kernel.Sparse",
    .basicsize = sizeof(struct holder),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = sparse_slots,
};
