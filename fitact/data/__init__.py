"""Reading and checking of measured data.

Reads files and arrays into checked `Record`s and `Spectrum`s, with warnings on possible errors.
"""
