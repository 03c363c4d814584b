"""The command line of evstim, whose process a file names: evstim_program.py PID_FILE ARGUMENTS..."""

import os
import sys
from pathlib import Path

from emulator.cli import main

Path(sys.argv.pop(1)).write_text(str(os.getpid()))
main()
