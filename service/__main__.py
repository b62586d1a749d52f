"""python -m service: the same as the `loopwright` command."""

from service.cli import main

main()
