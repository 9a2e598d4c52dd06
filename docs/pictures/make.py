"""Make the pictures of README and docs, or only the named ones: `python docs/pictures/make.py [NAME]...`.

The timing diagrams are drawn from the tables in `diagrams.py`. The demo's screen and the plot come from the
programs themselves, on a simulated line. They take a minute and differ each time. Needs
`pip install '.[plot,monitor]'`.
"""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory

from diagrams import DIAGRAMS, draw

HERE = Path(__file__).parent
WIDTH, HEIGHT = 104, 16  # characters
COMMAND = [str(Path(sys.executable).with_name("multidrop"))]

PLANT = """
[[line]]
name = "hall"
port = "{port}"

[[line.drive]]
name = "pump"
model = "erman-er-g-220"
address = 1
every = "200 ms"
poll = ["output_frequency", "output_current"]

[[line.drive]]
name = "fan"
model = "invt-che"
maximum_frequency = 50
address = 2
every = "200 ms"
poll = ["output_frequency", "output_current"]
"""


def demo_screen() -> str:
    """Return an SVG of the last full screen that `multidrop demo` draws on a terminal."""
    with TemporaryDirectory() as directory:
        return _svg(_last_screen(_drawn(directory)))


def _drawn(directory: str) -> str:
    """Return the demo's output on a terminal of this size."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ.update(TERM="xterm-256color", COLORTERM="truecolor", COLUMNS=str(WIDTH), LINES=str(HEIGHT))
        os.chdir(directory)
        os.execv(COMMAND[0], [*COMMAND, "demo", "--seconds", "20"])
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", HEIGHT, WIDTH, 0, 0))
    drawn = b""
    try:
        while chunk := os.read(terminal, 65536):
            drawn += chunk
    except OSError:  # the program has ended
        pass
    os.waitpid(pid, 0)
    return drawn.decode()


def _last_screen(drawn: str) -> str:
    """Return the last screen before the program closes it."""
    on_screen, _, _ = drawn.partition("\x1b[?1049l")
    last = on_screen.split("\x1b[H")[-1]
    return re.sub(r"\x1b\[\?\d+[hl]", "", last).replace("\r", "")


def _svg(screen: str) -> str:
    from rich.console import Console
    from rich.text import Text

    console = Console(record=True, width=WIDTH, file=StringIO(), color_system="truecolor")
    for line in screen.split("\n"):
        console.print(Text.from_ansi(line), no_wrap=True, overflow="crop")
    picture = console.export_svg(title="multidrop demo", unique_id="demo")
    return re.sub(r"\s*@font-face \{.*?\}\n", "\n", picture, flags=re.DOTALL)  # do not load fonts


def plot(out: Path) -> None:
    """Record two simulated motors that start and stop, and draw them with `multidrop plot`."""
    from multidrop import Plant, Poller, open_writer

    with TemporaryDirectory() as directory:
        plant_file, recording = Path(directory) / "hall.toml", Path(directory) / "hall.arrows"
        plant_file.write_text(PLANT.format(port=f"{directory}/hall"))
        words = [*COMMAND, "simulate", str(plant_file), "--ports", directory]
        with subprocess.Popen(words, stdout=subprocess.PIPE) as simulator:
            assert simulator.stdout is not None
            simulator.stdout.readline()
            try:
                plant = Plant.load(plant_file)
                with Poller(plant) as poller, open_writer(recording, plant.metadata()) as writer:
                    pump, fan = poller.bus("hall").drives
                    for do in (
                        lambda: (pump.set_frequency(40.0), pump.start()),
                        lambda: (fan.set_frequency(25.0), fan.start()),
                        lambda: pump.stop(),
                        lambda: fan.stop(),
                    ):
                        do()
                        for batch in poller.batches(seconds=6):
                            writer.write(batch)
            finally:
                simulator.terminate()
        out.unlink(missing_ok=True)
        subprocess.run([*COMMAND, "plot", str(recording), "--out", str(out)], check=True)


def main(names: list[str]) -> None:
    wanted = names or [*DIAGRAMS, "demo", "plot"]
    for name in wanted:
        if name == "plot":
            plot(HERE / "plot.png")
        else:
            text = demo_screen() if name == "demo" else draw(name)
            (HERE / f"{name}.svg").write_text(text, "utf-8")
        print(name)


if __name__ == "__main__":
    main(sys.argv[1:])
