"""Make the pictures of README and docs, or only the named ones: `python docs/pictures/make.py [NAME]...`.

The timing diagrams are drawn from the tables in `diagrams.py`. The demo's screen and the plot come from the
programs themselves, on a simulated line. They take a minute and differ each time. Needs
`pip install '.[plot]'`.
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
from collections.abc import Iterator
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory

from diagrams import DIAGRAMS, draw

HERE = Path(__file__).parent
WIDTH, HEIGHT = 110, 24  # characters
SHOWN_S = 20  # s for which the demo runs; its last full screen is the picture
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
    """Return an SVG of a full screen that `multidrop demo` draws on a terminal."""
    with TemporaryDirectory() as directory:
        return _svg(_last_screen(_drawn(directory)))


def _drawn(directory: str) -> str:
    """Return the demo's output on a terminal of this size."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ.update(TERM="xterm-256color", COLORTERM="truecolor", COLUMNS=str(WIDTH), LINES=str(HEIGHT))
        os.chdir(directory)
        os.execv(COMMAND[0], [*COMMAND, "demo", "--seconds", str(SHOWN_S)])
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
    """Return the last screen on which a drive has a fault, or else the last one."""
    on_screen, _, _ = drawn.partition("\x1b[?1049l")
    screens = on_screen.split("\x1b[H")
    last = next((one for one in reversed(screens) if " fault " in one), screens[-1])
    return re.sub(r"\x1b\[\?\d+[hl]", "", last).replace("\r", "")


CHARACTER, LINE, MARGIN, BAR = 8.4, 18, 12, 34  # px; BAR is the window's title
DARK, LIGHT = "#1d2126", "#d5dae0"  # background, text
COLOURS = {"31": "#ff7b72", "33": "#e3b341", "37": "#ffffff"}
FONT = "ui-monospace,'DejaVu Sans Mono',Menlo,Consolas,monospace"


def _svg(screen: str) -> str:
    """Return an SVG of a terminal's screen, given as text with the escapes of `cli/support/terminal.py`."""
    width, height = WIDTH * CHARACTER + 2 * MARGIN, HEIGHT * LINE + BAR + MARGIN
    parts = [
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width:.0f} {height}' "
        f'font-family="{FONT}" font-size="14">',
        f"<rect width='{width:.0f}' height='{height}' rx='8' fill='{DARK}'/>",
        *(
            f"<circle cx='{20 + 18 * at}' cy='18' r='5.5' fill='{colour}'/>"
            for at, colour in enumerate(("#ff5f57", "#febc2e", "#28c840"))
        ),
        f"<text x='{width / 2:.0f}' y='23' fill='{LIGHT}' text-anchor='middle'>multidrop demo</text>",
    ]
    for number, line in enumerate(screen.split("\n")):
        parts += _runs(line, BAR + number * LINE)
    return "\n".join([*parts, "</svg>", ""])


def _runs(line: str, top: int) -> Iterator[str]:
    """Yield a line's runs of one style as rectangles and texts."""
    column, codes = 0, {""}
    for piece in re.split(r"(\x1b\[[\d;]*m)", line):
        if piece.startswith("\x1b"):
            codes = set(piece[2:-1].split(";"))
            continue
        x, size = MARGIN + column * CHARACTER, len(piece) * CHARACTER
        column += len(piece)
        ink = next((COLOURS[code] for code in sorted(codes) if code in COLOURS), LIGHT)
        paper = "#a4262c" if "41" in codes else ""
        if "7" in codes:
            ink, paper = DARK, ink
        if paper:
            yield f"<rect x='{x:.1f}' y='{top}' width='{size:.1f}' height='{LINE}' fill='{paper}'/>"
        if piece.strip():
            style = " font-weight='bold'" * ("1" in codes) + " text-decoration='underline'" * ("4" in codes)
            style += " opacity='0.6'" * ("2" in codes)
            yield (
                f"<text x='{x:.1f}' y='{top + 13}' fill='{ink}' textLength='{size:.1f}' "
                f"lengthAdjust='spacingAndGlyphs' xml:space='preserve'{style}>{escape(piece)}</text>"
            )


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
