# SPDX-License-Identifier: Apache-2.0

"""Binds the kernel to Python by the names in its own headers, with cffi.

`HEADERS` lists what Python may use; a new header needs nothing but its name there. setup.py builds
the module by `builder`; CMakeLists.txt has `python kernel/build_kernel.py FILE` write its C source,
and compiles that with the kernel's files and options.
"""

import re
import sys
from pathlib import Path

from cffi import FFI

KERNEL = Path(__file__).resolve().parent
HEADERS = (
    "transform.h", "code.h", "words.h", "certificate.h", "fit.h", "frame_reader.h", "scanner.h",
    "detect.h", "sparse.h", "frame_stream.h", "reader.h", "readout.h", "contacts.h",
    "cover.h",
)  # fmt: skip
"""Of the kernel, in an order in which each needs those before it only."""
WAITING = "reader_read", "frame_reader_read", "cover_press"
"""Functions that wait, or take milliseconds. Only they, and `reader_follow`, release Python's lock:
to get that back from a busy thread takes up to 5 ms, and a frame makes some calls."""
FOLLOW = "int reader_follow(struct reader *reader, int file, double timeout_ms);"
"""As reader_next, while other threads run; -1 while one of them is in it."""
SAMPLES = "struct tp_samples { uint64_t device_time_us, first_index; uint8_t flags; ...; };"
"""The members that Python reads of a struct of the protocol."""

PRELUDE = r"""
#include <string.h>
{includes}

/* In place of Python's own, which release its lock in every call. */
static inline int waits(const char *function)
{{
    return {waits};
}}
#undef Py_BEGIN_ALLOW_THREADS
#undef Py_END_ALLOW_THREADS
#define Py_BEGIN_ALLOW_THREADS \
    {{ PyThreadState *released = waits(__func__) ? PyEval_SaveThread() : NULL;
#define Py_END_ALLOW_THREADS \
    if (released) PyEval_RestoreThread(released); }}

static int reader_follow(struct reader *reader, int file, double timeout_ms)
{{
    enum stream_event event;

    if (reader->busy)
        return -1;
    scanner_tell(reader->scanner); /* others see a packet counted once what it gave was taken in */
    reader->busy = true;
    PyThreadState *released = PyEval_SaveThread();
    event = reader_next(reader, file, timeout_ms);
    PyEval_RestoreThread(released);
    reader->busy = false;
    if (event == STREAM_NEEDS_BYTES)
        scanner_tell(reader->scanner);
    return (int)event;
}}
"""


def declarations(header: str) -> str:
    """Return what a header declares, as cffi reads it: the compiler tells what its numbers are."""
    text = re.sub(r"/\*.*?\*/|//[^\n]*", "", (KERNEL / header).read_text("utf-8"), flags=re.DOTALL)
    whole = r"^#define (\w+)[ \t]+(?:\(|\d+(?![\d.]))"
    numbers = re.findall(whole, text, flags=re.MULTILINE)
    text = re.sub(r"^[ \t]*#(?:.*\\\n)*.*", "", text, flags=re.MULTILINE)
    text = re.sub(r"^static inline [^{]*\{.*?^\}", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"\[[A-Z]\w*\]", "[...]", text)
    return "\n".join([*(f"#define {number} ..." for number in numbers), text])


def compiled_by() -> list[str]:
    """Return the options of the compiler."""
    return (KERNEL / "options.txt").read_text().split()


builder = FFI()
builder.cdef("\n".join([SAMPLES, *map(declarations, HEADERS), FOLLOW]))
builder.set_source(
    "tactile_cdma._kernel",
    PRELUDE.format(
        includes="\n".join(f'#include "{header}"' for header in HEADERS),
        waits=" || ".join(f'!strcmp(function, "_cffi_f_{name}")' for name in WAITING),
    ),
    # Relative, as setuptools wants them: it is run in the folder above.
    sources=sorted(str(path.relative_to(KERNEL.parent)) for path in KERNEL.glob("*.c")),
    depends=[
        *sorted(str(path.relative_to(KERNEL.parent)) for path in KERNEL.glob("*.h")),
        "kernel/build_kernel.py",
        "kernel/options.txt",
        "firmware/core/tactile_protocol.h",
    ],
    include_dirs=["kernel"],
    extra_compile_args=compiled_by(),
    # Before setuptools names the library of one Python, so that every Python loads the module.
    libraries=["m", *(["python3"] if sys.platform == "win32" else [])],
)

if __name__ == "__main__":
    builder.emit_c_code(sys.argv[1])
