"""Synthetic records by routes of their own, scipy and ngspice: nothing here imports fitact, whose tests they serve."""
