"""Pages, from the folder of templates."""

import os
from typing import Any

import jinja2
from markupsafe import Markup

from fitact.files import replacing


def write_html(path: str | os.PathLike[str], template: str, **content: Any) -> None:
    """Write what a template makes of `content`.

    Raises:
        InputError: the place cannot be written.
        jinja2.UndefinedError: the template wants more than there is.
    """
    loader = jinja2.PackageLoader("fitact.report")
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.globals["verbatim"] = lambda name: Markup(loader.get_source(environment, name)[0])  # scripts of ours
    page = environment.get_template(template).render(**content)
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
