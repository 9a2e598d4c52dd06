"""Write the cffi module's C source: `python cdef.py OUTPUT`.

The cdef is the marked part of each header.
"""

import sys
from pathlib import Path

from cffi import FFI

HEADERS = ("multidrop.h", "rows.h", "capture.h", "internal.h", "line.h")


def main(output: str) -> None:
    ffi = FFI()
    for header in HEADERS:
        text = Path(__file__).with_name(header).read_text()
        ffi.cdef(text.split("/* cdef: start */")[1].split("/* cdef: end */")[0])
    ffi.set_source("multidrop._core", '#include "line.h"', py_limited_api=True)
    ffi.emit_c_code(output)


if __name__ == "__main__":
    main(*sys.argv[1:])
