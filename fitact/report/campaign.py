"""What a campaign leaves: tables of its answers and failures, and a page that links its reports."""

import os
from pathlib import Path

from fitact.batch.fit_many import Fits
from fitact.report.frame import Answer, PageSummary, Provenance, write_page


def write_campaign(folder: str | os.PathLike[str], fits: Fits, origin: Provenance, max_rows: int = 2000) -> Path:
    """Write results.parquet, failures.csv and index.html, with no more than `max_rows` of each; gives the page.

    Raises:
        InputError: the place cannot be written.
    """
    place, answered, failures = Path(folder), fits.answered, Fits(fits.failures)
    answered.to_parquet(place / "results.parquet")
    failures.to_csv(place / "failures.csv", ("record", "result", "message"))
    trusted = sum(bool(row["trusted"]) for row in fits)
    frame = PageSummary(
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
        has_reservation=trusted < len(fits),
    )
    write_page(
        place / "index.html",
        "campaign.html",
        frame=frame,
        origin=origin,
        answers=answered[:max_rows],
        failures=[(row["record"], row["result"], row["message"]) for row in failures[:max_rows]],
        count=len(answered),
    )
    return place / "index.html"
