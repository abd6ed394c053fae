"""What a campaign leaves: tables of its answers and failures, and a page that links its reports."""

import os
from pathlib import Path

from fitact.files import replacing
from fitact.inference.many import Fits
from fitact.report.page import render
from fitact.units import engineering

_SHOWN = 2_000  # rows on the page; the tables have all


def write_campaign(folder: str | os.PathLike[str], fits: Fits) -> Path:
    """Write results.parquet, failures.csv and index.html into a folder; gives the page.

    Raises:
        InputError: the place cannot be written.
    """
    place = Path(folder)
    fits.answered.to_parquet(place / "results.parquet")
    Fits(fits.failures).to_csv(place / "failures.csv", ("record", "result", "message"))
    page = render(
        "campaign.html",
        answers=fits.answered[:_SHOWN],
        failures=fits.failures[:_SHOWN],
        counts={"records": len(fits), "answers": len(fits.answered), "failures": len(fits.failures)},
        trusted=sum(bool(row["trusted"]) for row in fits),
        engineering=engineering,
    )
    with replacing(place / "index.html") as temporary:
        temporary.write_text(page, encoding="utf-8")
    return place / "index.html"
