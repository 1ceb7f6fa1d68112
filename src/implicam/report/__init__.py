"""One page that a stranger understands: how good the measurement is, and whether its error bars tell the truth."""

from implicam.report.data import ReportData, report_of
from implicam.report.html_page import page, write_report

__all__ = ["ReportData", "page", "report_of", "write_report"]
