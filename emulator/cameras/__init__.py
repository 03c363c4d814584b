"""One record for each camera model: its sensor, its chip and its USB device."""
