"""`python -m selfcal`: the command."""

from selfcal.cli import main

main()
