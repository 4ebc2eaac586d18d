// SPDX-License-Identifier: Apache-2.0

/* Python's arguments for the kernel: described in tables, gathered, checked and released in one place.
 *
 * A function of the module is a table of its arguments and a body that runs once all of them fit:
 *
 *     FUNCTION(mean_of, ARRAY("levels", 'f', "kn"), SIZE("bit"), OUT("mean", 'f', "n"))
 *     {
 *         if (!(call->value[1].size < axis(call, 'k')))
 *             return refuse(call, "bit: beyond the levels");
 *         ... call->value[0].data, call->value[2].data, axis(call, 'n') ...
 *         Py_RETURN_NONE;
 *     }
 *
 * Every letter of a shape stands for one length throughout the call, so that arrays are checked against
 * each other. The same macro makes methods (call->self is then the object) and, as CONSTRUCTOR, what
 * makes an object, which keeps the arrays and objects that it is made of. One that uses an array of a later
 * call takes it over by keep().
 *
 * Settings are C structs. FIELDS describes one by the names of its members, `layouts` in module.c offers
 * them to Python, and tactile_cdma/base/kernel.py makes numpy's dtype of that and fills it by name: what a
 * setting is called, where it lies and of which type it is, is written once, in the struct.
 *
 * Limited API of 3.11, the first with buffers: one build serves all later Pythons. */
#ifndef TACTILE_BINDING_H
#define TACTILE_BINDING_H

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "scanner.h"
#include "words.h"

#define BINDING_MOST 24 /* arguments of a function */

/* ---- arguments --------------------------------------------------------------------------------- */

/* A buffer's `kind` is the letter of its values as in Python's struct. */
enum kind { NUMBER_KIND = 1, SIZE_KIND, FLAG_KIND, SETTINGS_KIND, OBJECT_KIND };

struct argument {
    const char *name;
    char kind;
    const char *shape; /* a letter or digit per axis; "*": any. Of an object: its class here, or NULL */
    bool written;
    size_t size; /* of settings, bytes */
};

#define ARRAY(name, kind, shape) {name, kind, shape, false, 0} /* contiguous */
#define OUT(name, kind, shape) {name, kind, shape, true, 0}
#define NUMBER(name) {name, NUMBER_KIND, NULL, false, 0}
#define SIZE(name) {name, SIZE_KIND, NULL, false, 0} /* a number, 0 or more */
#define FLAG(name) {name, FLAG_KIND, NULL, false, 0}
#define OBJECT(name, class) {name, OBJECT_KIND, class, false, 0}
#define SETTINGS(type) {#type, SETTINGS_KIND, NULL, false, sizeof(struct type)}

union value {
    double number; /* NUMBER */
    size_t size;   /* SIZE, FLAG */
    void *data;    /* ARRAY, OUT, SETTINGS; of an OBJECT with a class, what it holds */
};

/* A call while its body runs. */
struct call {
    const char *name;
    const struct argument *takes;
    PyObject *self, *const *given;
    union value value[BINDING_MOST];
    size_t axes[64];
    Py_buffer buffers[BINDING_MOST];
};

/* The length that a letter of the shapes stands for. */
static inline size_t axis(const struct call *call, char letter)
{
    return call->axes[letter & 63];
}

/* Number of values of an array. */
size_t length(const struct call *call, size_t argument);

/* Takes over an array from a call, to be released later by PyBuffer_Release. */
Py_buffer keep(struct call *call, size_t argument);

/* Raises ValueError "function: …"; returns NULL. */
PyObject *refuse(const struct call *call, const char *format, ...);

typedef PyObject *body(struct call *call);
PyObject *run(const char *name, const struct argument *takes, size_t count, body *body, PyObject *self,
              PyObject *const *given, Py_ssize_t number);
PyObject *make(const char *name, const struct argument *takes, size_t count, body *body,
               PyTypeObject *type, PyObject *given, PyObject *keywords);

#define FUNCTION(function, ...)                                                                     \
    static body run_##function;                                                                     \
    static PyObject *call_##function(PyObject *self, PyObject *const *given, Py_ssize_t number)     \
    {                                                                                               \
        static const struct argument takes[] = {__VA_ARGS__};                                       \
        _Static_assert(sizeof takes / sizeof *takes <= BINDING_MOST, "more arguments");             \
        return run(#function, takes, sizeof takes / sizeof *takes, run_##function, self, given,     \
                   number);                                                                         \
    }                                                                                               \
    static PyObject *run_##function(struct call *call)

/* Its entry in a table of methods. */
#define ENTRY(function) {#function, (PyCFunction)(void (*)(void))call_##function, METH_FASTCALL, NULL}

/* Makes an object of a class; call->self is the type. */
#define CONSTRUCTOR(function, ...)                                                                  \
    static body run_##function;                                                                     \
    static PyObject *function(PyTypeObject *type, PyObject *given, PyObject *keywords)              \
    {                                                                                               \
        static const struct argument takes[] = {__VA_ARGS__};                                       \
        _Static_assert(sizeof takes / sizeof *takes <= BINDING_MOST, "more arguments");             \
        return make(#function, takes, sizeof takes / sizeof *takes, run_##function, type, given,    \
                    keywords);                                                                      \
    }                                                                                               \
    static PyObject *run_##function(struct call *call)

/* ---- settings ---------------------------------------------------------------------------------- */

struct field {
    const char *member; /* its name for Python is what follows the last dot */
    size_t offset;
    char kind;
};

struct layout {
    const char *name;
    size_t size, count;
    const struct field *fields;
};

#define FIELD_KIND(member)                                                                          \
    _Generic((member), bool: '?', uint8_t: 'B', int: 'i', unsigned: 'I', unsigned long: 'L',        \
             unsigned long long: 'Q', float: 'f', double: 'd')
#define FIELD(type, member)                                                                         \
    {#member, offsetof(struct type, member), FIELD_KIND(((struct type *)NULL)->member)},

/* FIELD of each of the members; a preprocessor repeats nothing but by reading its own output again. */
#define AGAIN(...) AGAIN_64(AGAIN_64(__VA_ARGS__)) /* more than 100 times */
#define AGAIN_64(...) AGAIN_16(AGAIN_16(AGAIN_16(AGAIN_16(__VA_ARGS__))))
#define AGAIN_16(...) AGAIN_4(AGAIN_4(AGAIN_4(AGAIN_4(__VA_ARGS__))))
#define AGAIN_4(...) ONCE(ONCE(ONCE(ONCE(__VA_ARGS__))))
#define ONCE(...) __VA_ARGS__
#define EACH_FIELD(type, member, ...) FIELD(type, member) __VA_OPT__(EACH_NEXT PARENTHESES(type, __VA_ARGS__))
#define EACH_NEXT() EACH_FIELD
#define PARENTHESES ()

/* Defines `type`_layout of a struct, by its members. */
#define FIELDS(type, ...)                                                                           \
    static const struct field type##_fields[] = {AGAIN(EACH_FIELD(type, __VA_ARGS__))};             \
    const struct layout type##_layout = {#type, sizeof(struct type),                                \
                                         sizeof type##_fields / sizeof *type##_fields, type##_fields}

/* Adds name: (bytes, ((field, offset, kind), …)); whether that succeeds: else with an exception. */
bool add_layout(PyObject *dict, const struct layout *layout);

/* ---- objects ----------------------------------------------------------------------------------- */

/* An object of one of this module's classes, which holds one of the kernel's; `drop` frees that. kept: of the
 * arguments that it was made of, arrays and objects. */
struct holder {
    PyObject_HEAD
    void *held;
    void (*drop)(void *held);
    size_t kept_count;
    Py_buffer *kept;
};

/* What a constructor returns. NULL, and nothing is held, with an exception: out of memory, or `held` is NULL. */
PyObject *hold(const struct call *call, void *held, void (*drop)(void *held));
void *held_by(PyObject *self);
void drop_holder(PyObject *self);

/* Defines a class of the module by its constructor's name and its methods. */
#define CLASS(spec, class, ...)                                                                     \
    static PyMethodDef class##_methods[] = {__VA_ARGS__, {0}};                                      \
    static PyType_Slot class##_slots[] = {                                                          \
        {Py_tp_new, class}, {Py_tp_dealloc, drop_holder}, {Py_tp_methods, class##_methods}, {0}};   \
    PyType_Spec spec = {.name = "tactile_cdma._kernel." #class,                                     \
                        .basicsize = sizeof(struct holder),                                         \
                        .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,                     \
                        .slots = class##_slots}

/* ---- packets and files ------------------------------------------------------------------------- */

/* (type, sequence, payload) of a packet; the payload of well-formed samples is taken apart. */
PyObject *packet_tuple(const struct scanner_packet *packet);
/* Counts of a scanner by name. */
PyObject *counts_dict(const struct scanner_counts *seen);
#define READER_SIZE 32768 /* bytes; a packet has at most half of that */

/* Reads until a delimiter (0) has come, `size` bytes are there, or `timeout_ms` have passed: so a reader
 * wakes once for a packet, however few bytes a tty gives at once. Returns the bytes that were read; -1
 * with errno where it cannot be read and nothing was; errno is 0 at the end of the file. had_waited:
 * whether the last bytes were there before they were waited for. */
ptrdiff_t reader_read(int file, uint8_t *bytes, size_t size, int timeout_ms, bool *had_waited);
/* What went wrong with a file: errno, or 0 at its end. Returns NULL. */
PyObject *file_error(int failure);

/* Whether correlations (k, N) are those of such frames; if not, with an exception. */
bool are_of(const struct call *call, const struct words_frame *frame);

/* The classes and settings of the module, in whichever file. */
extern PyType_Spec stream_spec, readout_spec, code_spec, sparse_spec;
extern const struct layout stream_rules_layout, stream_timing_layout, sparse_rules_layout;

#endif
