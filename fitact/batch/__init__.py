"""What is the answer for thousands of records?

Takes many records or files; gives a table with a row for each, by the fits and posteriors of one record, side by
side.
"""
