"""Fits and posteriors of thousands of records.

Computes many records or files in batches, by the methods for one record, and returns a table with one row for each.
"""
