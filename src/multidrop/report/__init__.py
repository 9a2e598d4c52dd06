"""Show a recording as pictures or as one HTML page; needs matplotlib (the extra `plot`)."""

from multidrop.recording.series import Event as Event
from multidrop.report.html import plot_page as plot_page
from multidrop.report.html import report_page as report_page
from multidrop.report.load import Recording as Recording
from multidrop.report.load import Series as Series
from multidrop.report.load import TimeSpan as TimeSpan
from multidrop.report.load import load as load
from multidrop.report.style import png as png
from multidrop.report.value_plot import plot as plot
