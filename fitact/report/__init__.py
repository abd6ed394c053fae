"""How is an answer shown?

Takes results; gives self-contained HTML pages and figures, each imported when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
