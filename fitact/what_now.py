"""Advice for each result name: what it means and what to try first, from the page docs/what_now.md."""

import difflib
import importlib.resources
import re

from fitact.errors import InputError


def advice_sections() -> dict[str, str]:
    """Return the sections of the page in Markdown, with links as text, by result name."""
    page = (importlib.resources.files("fitact") / "what_now.md").read_text(encoding="utf-8")
    text = re.sub(r"\[([^\]]+)\]\(#[^)]*\)", r"\1", page)
    text = re.sub(r"\[([^\]]+)\]\(([^)]*)\)", r"\1: docs/\2", text)
    parts = text.split("\n## ")[1:]
    return {title.strip(): body.strip() for title, _, body in (part.partition("\n") for part in parts)}


def explain(name: str) -> str:
    """Return the advice for a result name, in Markdown; raise InputError for any other name."""
    sections = advice_sections()
    if name in sections:
        return f"## {name}\n\n{sections[name]}"
    near = difflib.get_close_matches(name, sections, n=1)
    suggestion = f"did you mean '{near[0]}'? " if near else ""
    raise InputError(f"'{name}' is not a result name; {suggestion}known: {', '.join(sections)}")
