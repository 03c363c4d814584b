"""Model of the DAVIS346 and of the DAVIS240C: the USB devices that a host sees."""
