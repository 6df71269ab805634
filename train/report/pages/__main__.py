"""`python -m train.report.pages [CHECKOUT]`."""

import sys

from train.report.pages.write import main

main(sys.argv[1:])
