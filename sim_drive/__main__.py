"""``python -m sim_drive``."""

from sim_drive.cli import main

main()
