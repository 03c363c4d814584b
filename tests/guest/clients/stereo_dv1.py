"""The stereo camera of dv-processing 1.7: two cameras that its own class brings to one clock."""

from __future__ import annotations

from datetime import timedelta

import dv_processing as dv
from collecting import arguments
from stereo import LEFT, RIGHT, take_both


def main() -> None:
    options = arguments()
    # A second by default, which a processor that QEMU translates may need for less.
    stereo = dv.io.StereoCapture(f"DAVIS346_{LEFT}", f"DAVIS346_{RIGHT}", timedelta(seconds=30))
    take_both((stereo.left, stereo.right), options)


if __name__ == "__main__":
    main()
