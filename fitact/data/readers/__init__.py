"""Which numbers does a file hold?

Takes text, binary and MATLAB files of oscilloscopes and of fitact; gives channels with units, never guessing which is
which.
"""
