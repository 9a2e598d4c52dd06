"""Sub-interpreters: refused with one sentence before the core is loaded."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
try:
    import _interpreters as interpreters
except ImportError:
    import _xxsubinterpreters as interpreters

INSIDE = '''
import sys
try:
    import multidrop
except ImportError as refusal:
    print(refusal)
print([name for name in sys.modules if name.startswith("multidrop")])
'''
for _ in range(3):
    one = interpreters.create()
    interpreters.run_string(one, INSIDE)
    interpreters.destroy(one)
from multidrop import Bus
print("and here it works:", Bus.__name__)
"""


@pytest.mark.slow
def test_a_sub_interpreter_is_refused_and_the_main_one_is_served() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    refused = (
        "multidrop works in a process's main interpreter only, and this is a sub-interpreter: "
        "use it there, or in a process of its own"
    )
    lines = done.stdout.splitlines()
    assert lines[0::2][:3] == [refused] * 3
    assert lines[1::2] == ["['multidrop.interpreter']"] * 3
    assert lines[6] == "and here it works: Bus"
