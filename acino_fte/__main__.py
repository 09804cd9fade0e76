"""``python -m acino_fte`` is the command ``acino-fte``."""

from acino_fte.cli import main

main()
