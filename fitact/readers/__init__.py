"""Readers of files of oscilloscopes, DAQ programs and fitact.

Read text, binary and MATLAB files into channels with units, without guessing which channel is V, Vsc or I.
"""
