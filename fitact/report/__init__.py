"""What people look at: one self-contained HTML page."""

from fitact.report.page import read_results, write_report

__all__ = ["read_results", "write_report"]
