"""Which errors do the instruments have, and which records and channels share them?

Takes the pieces that a scene names (oscilloscope channels, probes, shunts). Gives the distribution of each error.
"""
