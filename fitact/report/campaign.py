"""Output of a campaign: tables of results and failures, and a page with links to the reports."""

import os
from pathlib import Path

from fitact.batch.fit_many import Fits
from fitact.report.frame import Answer, PageSummary, Provenance, write_page


def write_campaign(folder: str | os.PathLike[str], fits: Fits, origin: Provenance, max_rows: int = 2000) -> Path:
    """Write results.parquet, failures.csv and index.html (at most `max_rows` of each), and return the page."""
    out, results, failures = Path(folder), fits.results, Fits(fits.failures)
    results.to_parquet(out / "results.parquet")
    failures.to_csv(out / "failures.csv", ("record", "result", "message"))
    trusted = sum(bool(row["trusted"]) for row in fits)
    frame = PageSummary(
        title="Campaign",
        subject=f"{len(fits):,} records, fitted separately.",
        trusted=True,
        verdict=f"{trusted:,} of {len(fits):,} records have a reliable fit",
        findings={},
        answers=(
            Answer("reliable", f"{trusted:,}", "fits"),
            Answer("unreliable", f"{len(results) - trusted:,}", "fits; see the column result"),
            Answer("failed", f"{len(failures):,}", "records; failures.csv states the reasons"),
        ),
        warnings=(),
        has_reservation=trusted < len(fits),
    )
    write_page(
        out / "index.html",
        "campaign.html",
        frame=frame,
        origin=origin,
        answers=results[:max_rows],
        failures=[(row["record"], row["result"], row["message"]) for row in failures[:max_rows]],
        count=len(results),
    )
    return out / "index.html"
