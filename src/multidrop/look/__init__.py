"""A recording as pictures and as one page; needs matplotlib, the extra `plot`."""

from multidrop.look.page import plot_page, report_page
from multidrop.look.recorded import Look, Series, Span, load
from multidrop.look.style import png
from multidrop.look.values import plot

__all__ = ["Look", "Series", "Span", "load", "plot", "plot_page", "png", "report_page"]
