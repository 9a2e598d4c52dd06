"""Write the cffi module's C source: `python cdef.py HEADER OUTPUT`.

The cdef is the marked part of the header itself; there is no second copy of the contract.
"""

import sys
from pathlib import Path

from cffi import FFI


def main(header: str, output: str) -> None:
    text = Path(header).read_text()
    contract = text.split("/* cdef: begin */")[1].split("/* cdef: end */")[0]
    ffi = FFI()
    ffi.cdef(contract)
    ffi.set_source("multidrop._core", '#include "multidrop.h"', py_limited_api=True)
    ffi.emit_c_code(output)


if __name__ == "__main__":
    main(*sys.argv[1:])
