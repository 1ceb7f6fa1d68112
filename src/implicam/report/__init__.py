"""One page that a stranger understands: how good the measurement is, and whether its error bars tell the truth.

The module can be called: `ic.report(calibration, "report.html", data=others)` (`call.report`).
"""

from implicam.callable_module import make_callable
from implicam.report import call
from implicam.report.data import KnownLengths, ReportData, report_of
from implicam.report.html_page import page, write_report

__all__ = ["KnownLengths", "ReportData", "page", "report_of", "write_report"]

make_callable(__name__, call.report)
