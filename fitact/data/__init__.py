"""What was recorded?

Takes files and arrays; gives checked `Record`s and `Spectrum`s, with sentences on what looks wrong.
"""
