"""Table of what is read: each layout with a file that is made in it, and the table in the documentation.

A layout is a row of `records.RECORDS` or `spectra.SPECTRA`. Rows that differ in nothing but the program share a line.

    python -m tests.layouts

writes the table into docs/input.md. tests/data/test_layouts.py reads each file and compares its values with the truth.
"""
