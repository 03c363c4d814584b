"""Effect of the GenX320's biases on the simulated pixels, which is uncertain: no formula and no measurement is public.

Biases are absolute, 0 to 127; at the values that OpenEB writes when it opens the sensor (fo 34, hpf 40, diff_on 25,
diff 51, diff_off 28, refr 10) all factors are 1. `prophesee.biases` has the form of the factors.

    directions      those of Prophesee's page "Biases", which holds for all its sensors: a higher diff_on, diff_off is a
                    higher threshold, a higher fo passes faster changes, a higher refr is a shorter dead time. OpenMV's
                    guide to its presets agrees on the first three, and states the opposite of refr
    diff_on,        twice the IMX636's slopes, which were fitted to a measurement: assumed is that 7 bits here span the
    diff_off        range of 8 bits there
    fo, refr        one over the value at open, as for the IMX636: assumed is a current proportional to the register

`[camera.bias_slopes]` of a rig replaces any of them.
"""

from __future__ import annotations

from firmware_protocol.prophesee.biases import BiasSlopes

SLOPES = BiasSlopes(diff_on=0.0298, diff_off=0.0508, diff_off_above=0.0234, off_delay=0.084, fo=1 / 34, refr=0.1)
"""Effect of one step of each bias."""
