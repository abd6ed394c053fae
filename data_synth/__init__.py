"""Synthetic records by scipy and ngspice for the tests of fitact, independent of it: nothing here imports fitact."""
