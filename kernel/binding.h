// SPDX-License-Identifier: Apache-2.0

/* What the parts of the Python module share: objects that hold one of the kernel's, and arguments.
 *
 * Limited API of 3.11, the first with buffers: one build serves all later Pythons. */
#ifndef TACTILE_BINDING_H
#define TACTILE_BINDING_H

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>

#include <stdbool.h>

#include "scanner.h"

/* An object of one of this module's types, which holds one of the kernel's. */
struct holder {
    PyObject_HEAD
    void *held;
};

PyObject *hold(PyTypeObject *type, void *held);
void *held_by(PyObject *self);
/* Frees an object, but not what it holds. */
void drop(PyObject *self);

/* A contiguous array of this type (struct's code), or -1 with an exception. `what` is its name. */
int get_array(PyObject *object, Py_buffer *buffer, char code, int flags, const char *what);

/* Whether a function got as many arguments as it takes; if not, with an exception. */
bool takes(Py_ssize_t count, Py_ssize_t expected);

/* Gets `count` arrays of `size` values each, of types that a letter of `codes` each names: those from
 * number `writable` on to be written to. Returns 0, or -1 with an exception, and then holds none. */
int get_arrays(PyObject *const *objects, size_t count, const char *codes, size_t writable,
               size_t size, Py_buffer *buffers);
void release(size_t count, Py_buffer *buffers);

/* Converts `count` numbers. Returns 0, or -1 with an exception. */
int get_numbers(PyObject *const *objects, size_t count, double *numbers);

/* (type, sequence, payload) of a packet; the payload of well-formed samples is taken apart. */
PyObject *packet_tuple(const struct scanner_packet *packet);
/* Counts of a scanner by name. */
PyObject *counts_dict(const struct scanner_counts *seen);
/* What went wrong with a file: errno, or 0 at its end. Returns NULL. */
PyObject *file_error(int failure);

/* The types of the module, each in a file of its own or in module.c. */
extern PyType_Spec steady_spec;

#endif
