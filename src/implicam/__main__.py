"""`python -m implicam` is the command line."""

from implicam.cli import main

if __name__ == "__main__":
    main()
