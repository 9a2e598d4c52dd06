"""`multidrop completion`: bash completes commands, actions, options and file names by the printed script."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from commands import Run

TYPED = {
    "multidrop po": {"ports", "poll"},
    "multidrop fleet wa": {"watch"},
    "multidrop params di": {"diff"},
    "multidrop poll --capt": {"--capture"},
    "multidrop poll pla": {"plant.toml"},
}
COMPLETE = """COMP_WORDS=({}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); COMPREPLY=(); _shtab_multidrop
echo "${{COMPREPLY[@]}}"
"""


@pytest.mark.slow
def test_bash_completes_words_by_the_script(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("shtab")
    status, script, _ = run("completion", "bash")
    assert status == 0
    (tmp_path / "plant.toml").touch()
    script += "".join(COMPLETE.format(words) for words in TYPED)
    done = subprocess.run(["bash"], input=script, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    found = [set(line.split()) for line in done.stdout.splitlines()]
    assert dict(zip(TYPED, found, strict=True)) == TYPED
