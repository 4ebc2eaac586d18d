// SPDX-License-Identifier: Apache-2.0

#include "binding.h"

#include <errno.h>

PyObject *hold(PyTypeObject *type, void *held)
{
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    PyObject *self = allocate(type, 0);

    if (self)
        ((struct holder *)self)->held = held;
    return self;
}

void *held_by(PyObject *self)
{
    return ((struct holder *)self)->held;
}

void drop(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);

    ((freefunc)PyType_GetSlot(type, Py_tp_free))(self);
    Py_DECREF(type);
}

int get_array(PyObject *object, Py_buffer *buffer, char code, int flags, const char *what)
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

bool takes(Py_ssize_t count, Py_ssize_t expected)
{
    if (count != expected)
        PyErr_Format(PyExc_TypeError, "%zd arguments, not %zd", count, expected);
    return count == expected;
}

int get_arrays(PyObject *const *objects, size_t count, const char *codes, size_t writable,
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

void release(size_t count, Py_buffer *buffers)
{
    while (count-- > 0)
        PyBuffer_Release(&buffers[count]);
}

int get_numbers(PyObject *const *objects, size_t count, double *numbers)
{
    for (size_t i = 0; i < count; i++) {
        numbers[i] = PyFloat_AsDouble(objects[i]);
        if (numbers[i] == -1 && PyErr_Occurred())
            return -1;
    }
    return 0;
}

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
