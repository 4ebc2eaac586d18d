// SPDX-License-Identifier: Apache-2.0

/* The class Sparse of the Python module: see sparse.h. */
#include "binding.h"

#include "sparse.h"

FIELDS(sparse_rules, detect.swing, detect.least, detect.soft_noise, detect.slope, detect.log_odds, detect.hard_share,
       detect.settled, detect.near, detect.negligible, detect.stalled, detect.turns, capacity, most_noise, more,
       tolerance, faintest, chance, chance_of_bit, hiding, weight, silent_square, silent_power, alike);

static void drop_sparse(void *held)
{
    sparse_free(held);
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
    return hold(call, sparse_new(&book, rules), drop_sparse);
}

FUNCTION(detect, ARRAY("chips", 'f', "kN"), NUMBER("damping"), OUT("rows", 'f', "kM"),
         OUT("heard", '?', "n"), OUT("left", 'f', "kN"), OUT("power", 'd', "k"))
{
    struct sparse *sparse = held_by(call->self);
    const struct sparse_book *book = sparse_book(sparse);
    struct detected found = {.rows = call->value[2].data,
                             .left = call->value[4].data,
                             .heard = call->value[3].data,
                             .power = call->value[5].data};

    if (!(axis(call, 'k') == book->bits && axis(call, 'N') == book->order && axis(call, 'M') == book->rows &&
          axis(call, 'n') == book->nodes))
        return refuse(call, "chips: not of this book");
    Py_BEGIN_ALLOW_THREADS
    detector_detect(sparse_detector(sparse), call->value[0].data, call->value[1].number, &found);
    Py_END_ALLOW_THREADS
    return Py_BuildValue("dO", found.level, found.settled ? Py_True : Py_False);
}

FUNCTION(loudness, ARRAY("chips", 'f', "kN"), SIZE("lateness"), FLAG("late"), OUT("loudness", 'f', "n"))
{
    struct sparse *sparse = held_by(call->self);
    const struct sparse_book *book = sparse_book(sparse);
    ptrdiff_t lateness = (ptrdiff_t)call->value[1].size;

    if (!(axis(call, 'k') == book->bits && axis(call, 'N') == book->order && axis(call, 'n') == book->nodes &&
          call->value[1].size < book->order))
        return refuse(call, "chips: not of this book, or all of a bit late");
    detector_loudness(sparse_detector(sparse), call->value[0].data, call->value[2].size ? lateness : -lateness,
                      call->value[3].data);
    Py_RETURN_NONE;
}

FUNCTION(learn, NUMBER("noise"), NUMBER("found"))
{
    return PyFloat_FromDouble(sparse_learn(held_by(call->self), call->value[0].number, call->value[1].number));
}

CLASS(sparse_spec, Sparse, ENTRY(detect), ENTRY(loudness), ENTRY(learn));
