"""python -m loopwright.service: the same as the `loopwright` command."""

from loopwright.service.cli.main import main

main()
