"""`python -m straightpcf`: the command line, where its script is not on the PATH."""

from straightpcf.clients.__main__ import main

if __name__ == "__main__":
    main()
