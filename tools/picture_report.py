"""Take the picture of the demo's report for README.md: `make picture`.

Writes docs/report.png, the first screen of out/demo/report.html at 1,280 x 900 pixels. Needs Chromium.
"""

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Open the report in a browser without a window, and save what it shows first."""
    page, picture = ROOT / "out" / "demo" / "report.html", ROOT / "docs" / "report.png"
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        sys.exit("make picture: Chromium is missing; install it, e.g. with: apt install chromium")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1280,900"]
    options += [f"--screenshot={picture}", "--virtual-time-budget=20000"]
    done = subprocess.run([browser, *options, page.as_uri()], capture_output=True, text=True, check=False)
    if done.returncode or not picture.exists():
        sys.exit(f"make picture: {browser} failed: {done.stderr.strip()[-500:]}")
    print(f"wrote {picture.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
