"""`python -m fitact.cli.warm`: a process that runs one command after the other, with its imports done.

It first prints the keys of scenes and the names of shipped scenes, then answers each line on standard input,
`{"folder": ..., "arguments": [...]}`, with a line `{"code": ..., "out": ..., "error": ...}`.
"""

import contextlib
import io
import json
import os
import sys
from typing import Any

import fitact.report.record  # noqa: F401  (matplotlib)
from fitact.cli import _run_command
from fitact.cli.app import app
from fitact.scene.fields import describe_fields
from fitact.scene.toml import shipped_scenes


def _answer(folder: str, arguments: list[str]) -> dict[str, Any]:
    os.chdir(folder)
    sys.argv = ["fitact", *arguments]
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as error:
        code = _run_command(lambda: app(args=arguments, standalone_mode=False))
    return {"code": code, "out": out.getvalue(), "error": error.getvalue()}


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever else prints does not disturb the answers
    print(json.dumps({"fields": describe_fields(), "scenes": sorted(shipped_scenes())}), file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps(_answer(**json.loads(line))), file=answers, flush=True)
