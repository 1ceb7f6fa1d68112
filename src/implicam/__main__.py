"""`python -m implicam` is the command line."""

from implicam.cli import main

main()
