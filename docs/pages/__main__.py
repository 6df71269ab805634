"""`python -m docs.pages [CHECKOUT]`."""

import sys

from docs.pages.write import main

main(sys.argv[1:])
