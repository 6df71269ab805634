"""`python -m docs.pages.keep RUN ...`: keep what pages show of comparisons, in docs/results of
the checkout.
"""

import sys
from pathlib import Path

from docs.pages.cells import keep

if __name__ == "__main__":
    if len(sys.argv) < 2:
        raise SystemExit("usage: python -m docs.pages.keep RUN ...")
    for run in sys.argv[1:]:
        print(f"wrote {keep(Path(run), Path('docs', 'results'))}")
