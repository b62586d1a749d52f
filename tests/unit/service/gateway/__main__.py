"""python -m tests.unit.service.gateway: imports the gateway as `loopwright serve` imports the service.

A computation imports the main module of the service that asks for it, unless it is called __main__: this one is.
"""

from loopwright.service.server.loading import loading

with loading():
    from tests.unit.service.gateway import main

main()
