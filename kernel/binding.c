// SPDX-License-Identifier: Apache-2.0

#include "binding.h"

#include <errno.h>
#include <stdarg.h>
#include <string.h>

/* ---- arguments --------------------------------------------------------------------------------- */

/* Raises "function: …", or "function: argument: …" of one of them. */
static void complain(const struct call *call, const struct argument *takes, PyObject *error, const char *format,
                     va_list values)
{
    PyObject *text = PyUnicode_FromFormatV(format, values);

    if (text)
        PyErr_Format(error, "%s%s%s: %U", call->name, takes ? ": " : "", takes ? takes->name : "", text);
    Py_XDECREF(text);
}

/* Of an argument; returns false. */
static bool unfit(const struct call *call, const struct argument *takes, PyObject *error,
                  const char *format, ...)
{
    va_list values;

    va_start(values, format);
    complain(call, takes, error, format, values);
    va_end(values);
    return false;
}

/* The same with the exception that is raised, whose text does not say of what. */
static bool unfit_as_raised(const struct call *call, const struct argument *takes)
{
    PyObject *type, *reason, *trace;

    PyErr_Fetch(&type, &reason, &trace);
    unfit(call, takes, type, "%S", reason);
    Py_XDECREF(type);
    Py_XDECREF(reason);
    Py_XDECREF(trace);
    return false;
}

PyObject *refuse(const struct call *call, const char *format, ...)
{
    va_list values;

    va_start(values, format);
    complain(call, NULL, PyExc_ValueError, format, values);
    va_end(values);
    return NULL;
}

/* Whether an array's axes are as long as the letters of its shape say; a new letter takes the length. */
static bool fits(struct call *call, const struct argument *takes, const Py_buffer *buffer)
{
    const char *shape = takes->shape;
    int axes = (int)strlen(shape);

    if (*shape == '*')
        return true;
    if (buffer->ndim != axes)
        return unfit(call, takes, PyExc_ValueError, "%d axes (%s) expected, not %d", axes, shape,
                     buffer->ndim);
    for (int i = 0; i < axes; i++) {
        size_t has = (size_t)buffer->shape[i], digit = (size_t)(shape[i] - '0');
        size_t *known = digit < 10 ? &digit : &call->axes[shape[i] & 63], needs = *known;
        if (needs == SIZE_MAX)
            *known = needs = has;
        if (has == needs)
            continue;
        if (axes == 1)
            return unfit(call, takes, PyExc_ValueError, "%zu values expected, not %zu", needs, has);
        return unfit(call, takes, PyExc_ValueError, "%c of (%s) is %zu, not %zu", shape[i], shape,
                     needs, has);
    }
    return true;
}

/* Gets one array or settings; unless it is false, the buffer has to be released. */
static bool get_buffer(struct call *call, const struct argument *takes, PyObject *object,
                       Py_buffer *buffer)
{
    bool has_type = takes->kind != SETTINGS_KIND;
    int flags = has_type ? PyBUF_C_CONTIGUOUS | PyBUF_FORMAT : PyBUF_SIMPLE;

    if (PyObject_GetBuffer(object, buffer, flags | (takes->written ? PyBUF_WRITABLE : 0)))
        return unfit_as_raised(call, takes);
    const char *format = buffer->format;
    bool is_fit;
    if (!has_type)
        is_fit = (size_t)buffer->len == takes->size ||
                 unfit(call, takes, PyExc_ValueError, "%zu bytes of settings expected, not %zd",
                       takes->size, buffer->len);
    else
        is_fit = (format[0] == takes->kind && format[1] == 0) ?
                     fits(call, takes, buffer) :
                     unfit(call, takes, PyExc_TypeError, "values of type '%c' expected, not '%s'",
                           takes->kind, format);
    if (!is_fit)
        PyBuffer_Release(buffer);
    return is_fit;
}

/* What an object of a class of this module holds. */
static bool get_object(struct call *call, const struct argument *takes, PyObject *object,
                       union value *value)
{
    const char *name = takes->shape;

    if (!name)
        return true;
    PyTypeObject *own = PyType_Check(call->self) ? (PyTypeObject *)call->self : Py_TYPE(call->self);
    PyObject *module = PyModule_Check(call->self) ? call->self : PyType_GetModule(own);
    PyObject *class = module ? PyObject_GetAttrString(module, name) : NULL;
    int is = class ? PyObject_IsInstance(object, class) : -1;

    Py_XDECREF(class);
    if (is == 1)
        value->data = held_by(object);
    return is == 1 ||
           (!is && unfit(call, takes, PyExc_TypeError, "a %s of the kernel expected", name));
}

static bool get(struct call *call, const struct argument *takes, PyObject *object, size_t i)
{
    union value *value = &call->value[i];

    call->buffers[i].obj = NULL;
    switch (takes->kind) {
    case NUMBER_KIND:
        value->number = PyFloat_AsDouble(object);
        return value->number != -1 || !PyErr_Occurred() || unfit_as_raised(call, takes);
    case SIZE_KIND:
        value->size = PyLong_AsSize_t(object);
        return value->size != SIZE_MAX || !PyErr_Occurred() || unfit_as_raised(call, takes);
    case FLAG_KIND: {
        int is = PyObject_IsTrue(object);
        value->size = is > 0;
        return is >= 0;
    }
    case OBJECT_KIND:
        return get_object(call, takes, object, value);
    default:
        if (!get_buffer(call, takes, object, &call->buffers[i]))
            return call->buffers[i].obj = NULL, false;
        value->data = call->buffers[i].buf;
        return true;
    }
}

/* Lets a new object have the arrays and objects of the call that made it; false with an exception. */
static bool keep_all(struct call *call, size_t count, struct holder *holder)
{
    holder->kept = PyMem_Calloc(count, sizeof *holder->kept);
    if (!holder->kept)
        return PyErr_NoMemory(), false;
    holder->kept_count = count;
    for (size_t i = 0; i < count; i++) {
        holder->kept[i] = keep(call, i);
        if (call->takes[i].kind == OBJECT_KIND)
            holder->kept[i].obj = Py_NewRef(call->given[i]);
    }
    return true;
}

PyObject *run(const char *name, const struct argument *takes, size_t count, body *body, PyObject *self,
              PyObject *const *given, Py_ssize_t number)
{
    struct call call;
    PyObject *result = NULL;
    size_t got = 0;

    if (number != (Py_ssize_t)count)
        return PyErr_Format(PyExc_TypeError, "%s: %zu arguments expected, not %zd", name, count, number);
    call.name = name;
    call.takes = takes;
    call.self = self;
    call.given = given;
    memset(call.axes, 0xff, sizeof call.axes);
    while (got < count && get(&call, &takes[got], given[got], got))
        got++;
    if (got == count)
        result = body(&call);
    if (result && PyType_Check(self) && !keep_all(&call, count, (struct holder *)result))
        Py_CLEAR(result);
    while (got-- > 0)
        if (call.buffers[got].obj)
            PyBuffer_Release(&call.buffers[got]);
    return result;
}

PyObject *make(const char *name, const struct argument *takes, size_t count, body *body,
               PyTypeObject *type, PyObject *given, PyObject *keywords)
{
    PyObject *each[BINDING_MOST];
    Py_ssize_t number = PyTuple_Size(given);

    if (keywords && PyDict_Size(keywords))
        return PyErr_Format(PyExc_TypeError, "%s: arguments have no names", name);
    for (Py_ssize_t i = 0; i < number && i < BINDING_MOST; i++)
        each[i] = PyTuple_GetItem(given, i);
    return run(name, takes, count, body, (PyObject *)type, each, number);
}

size_t length(const struct call *call, size_t argument)
{
    const Py_buffer *buffer = &call->buffers[argument];

    return (size_t)(buffer->len / buffer->itemsize);
}

Py_buffer keep(struct call *call, size_t argument)
{
    Py_buffer kept = call->buffers[argument];

    call->buffers[argument].obj = NULL;
    return kept;
}

/* ---- settings ---------------------------------------------------------------------------------- */

static PyObject *fields_tuple(const struct layout *layout)
{
    PyObject *fields = PyTuple_New((Py_ssize_t)layout->count);

    for (size_t i = 0; fields && i < layout->count; i++) {
        const struct field *field = &layout->fields[i];
        const char *dot = strrchr(field->member, '.');
        PyObject *tuple = Py_BuildValue("(snC)", dot ? dot + 1 : field->member,
                                        (Py_ssize_t)field->offset, field->kind);
        if (!tuple || PyTuple_SetItem(fields, (Py_ssize_t)i, tuple))
            Py_CLEAR(fields);
    }
    return fields;
}

bool add_layout(PyObject *dict, const struct layout *layout)
{
    PyObject *fields = fields_tuple(layout);
    PyObject *entry = fields ? Py_BuildValue("(nN)", (Py_ssize_t)layout->size, fields) : NULL;
    bool added = entry && !PyDict_SetItemString(dict, layout->name, entry);

    Py_XDECREF(entry);
    return added;
}

/* ---- objects ----------------------------------------------------------------------------------- */

PyObject *hold(const struct call *call, void *held, void (*drop)(void *held))
{
    PyTypeObject *type = (PyTypeObject *)call->self;
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    PyObject *self = held ? allocate(type, 0) : PyErr_NoMemory();

    if (self) {
        ((struct holder *)self)->held = held;
        ((struct holder *)self)->drop = drop;
    } else if (held)
        drop(held);
    return self;
}

void *held_by(PyObject *self)
{
    return ((struct holder *)self)->held;
}

void drop_holder(PyObject *self)
{
    struct holder *holder = (struct holder *)self;
    PyTypeObject *type = Py_TYPE(self);

    if (holder->held)
        holder->drop(holder->held);
    for (size_t i = 0; i < holder->kept_count; i++)
        if (holder->kept[i].obj)
            PyBuffer_Release(&holder->kept[i]);
    PyMem_Free(holder->kept);
    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

/* ---- packets and files ------------------------------------------------------------------------- */

PyObject *packet_tuple(const struct scanner_packet *packet)
{
    size_t samples = scanner_samples(packet);

    if (!samples)
        return Py_BuildValue("(BHy#)", packet->type, packet->sequence, packet->payload,
                             (Py_ssize_t)packet->size);
    struct tp_samples head;
    PyObject *counts = PyBytes_FromStringAndSize(NULL, (Py_ssize_t)(samples * sizeof(int16_t)));
    if (!counts)
        return NULL;
    scanner_copy_samples(packet, &head, PyBytes_AsString(counts));
    return Py_BuildValue("(BH(KKBN))", packet->type, packet->sequence, head.device_time_us,
                         head.first_index, head.flags, counts);
}

PyObject *counts_dict(const struct scanner_counts *seen)
{
    return Py_BuildValue("{sKsKsKsKsKsKsKsKsKsK}", "bytes", seen->bytes, "packets", seen->packets,
                         "crc_errors", seen->crc_errors, "framing_errors", seen->framing_errors,
                         "malformed", seen->malformed, "lost_packets", seen->lost_packets, "jumps",
                         seen->jumps, "repeated_packets", seen->repeated_packets, "resyncs",
                         seen->resyncs, "text_bytes", seen->text_bytes);
}

PyObject *file_error(int failure)
{
    if (failure) {
        errno = failure;
        return PyErr_SetFromErrno(PyExc_OSError);
    }
    PyErr_SetString(PyExc_OSError, "end of file");
    return NULL;
}

bool are_of(const struct call *call, const struct words_frame *frame)
{
    size_t bits = axis(call, 'k'), order = axis(call, 'N');
    bool fit = bits == frame->bits && order == frame->order && bits >= 2 && bits <= WORDS_MOST_BITS &&
               frame->first <= order && frame->nodes <= order - frame->first;

    if (!fit)
        refuse(call, "rows: (%zu, %zu) with %zu nodes from row %zu on expected, not (%zu, %zu)",
               frame->bits, frame->order, frame->nodes, frame->first, bits, order);
    return fit;
}
