"""A recording as pictures and as one page; needs matplotlib, the extra `plot`."""

from multidrop.report.html import plot_page, report_page
from multidrop.report.load import Selection, Series, TimeSpan, load
from multidrop.report.style import png
from multidrop.report.value_plot import plot

__all__ = ["Selection", "Series", "TimeSpan", "load", "plot", "plot_page", "png", "report_page"]
