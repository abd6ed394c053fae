"""Figures made from arrays, rows and names.

Draws figures for print (`figure`, matplotlib) and for the screen (`interactive`, plotly), without any result class.
"""
