"""One HTML file a run, to be read offline by whoever has to trust the calibration."""

from cellctl.report.page import write_report
from cellctl.report.writer import ReportWriter

__all__ = ["ReportWriter", "write_report"]
