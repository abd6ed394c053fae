"""HTML reports and figures of results.

Makes self-contained pages; each function is imported at its first use. Every function that writes raises InputError
where the path cannot be written.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
