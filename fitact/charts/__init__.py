"""Figures made from arrays, rows and names.

Draws figures for print (`figure`, matplotlib) and for the screen (`interactive`, plotly), without any result class.
Each function is imported at its first use, because matplotlib takes long to import.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
