"""Report docstrings that begin with a preposition or a pronoun instead of a verb or a noun (see CONTRIBUTING.md)."""

import ast
import sys
from pathlib import Path

FIRST_WORDS = {"Of", "As", "By", "With", "In", "From", "At", "That", "What"}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def main(folders: list[str]) -> int:
    """Print each such docstring, and return their number."""
    found = 0
    for path in (path for folder in folders for path in sorted(Path(folder).rglob("*.py"))):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            words = (ast.get_docstring(node) or "").split() if isinstance(node, DOCUMENTED) else []
            if words and words[0].strip(".,:;") in FIRST_WORDS:
                line = 1 if isinstance(node, ast.Module) else node.lineno
                print(f"{path}:{line}: the docstring begins with {words[0]!r}: begin with a verb or a noun")
                found += 1
    return found


if __name__ == "__main__":
    sys.exit(min(main(sys.argv[1:]), 1))
