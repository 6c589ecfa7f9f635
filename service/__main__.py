"""``python -m service`` is the command `softmaps`."""

from service.cli import main

main()
