"""What people look at: self-contained pages, and pictures."""

from fitact.report.page import read_results, write_report

__all__ = ["read_results", "write_report"]
