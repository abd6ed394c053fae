"""What a campaign leaves: tables of its answers and failures, and a page that links its reports."""

import os
from pathlib import Path

from fitact.batch.fit_many import Fits
from fitact.report.frame import Answer, Frame, Origin, write_page
from fitact.units import engineering

_SHOWN = 2_000  # rows on the page; the tables have all


def write_campaign(folder: str | os.PathLike[str], fits: Fits, origin: Origin) -> Path:
    """Write results.parquet, failures.csv and index.html into a folder; gives the page.

    Raises:
        InputError: the place cannot be written.
    """
    place, answered, failures = Path(folder), fits.answered, Fits(fits.failures)
    answered.to_parquet(place / "results.parquet")
    failures.to_csv(place / "failures.csv", ("record", "result", "message"))
    trusted = sum(bool(row["trusted"]) for row in fits)
    frame = Frame(
        title="Campaign",
        subject=f"{len(fits):,} records, each fitted by itself.",
        trusted=True,
        verdict=f"{trusted:,} of {len(fits):,} records have an answer to be trusted",
        findings={},
        answers=(
            Answer("trusted", f"{trusted:,}", "answers"),
            Answer("not to be trusted", f"{len(answered) - trusted:,}", "answers; their result says why"),
            Answer("without an answer", f"{len(failures):,}", "records; failures.csv has the reasons"),
        ),
        warnings=(),
        reserved=trusted < len(fits),
    )
    write_page(
        place / "index.html",
        "campaign.html",
        frame,
        origin,
        answers=answered[:_SHOWN],
        failures=[(row["record"], row["result"], row["message"]) for row in failures[:_SHOWN]],
        count=len(answered),
        engineering=engineering,
    )
    return place / "index.html"
