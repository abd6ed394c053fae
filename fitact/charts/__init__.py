"""How do numbers become a picture?

Takes arrays, rows and names; gives figures for paper (`figure`, matplotlib) and for the screen (`interactive`, plotly).
Knows no result class.
"""
