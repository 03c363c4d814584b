"""Camera on a real USB cable: a gadget of Linux's FunctionFS on a machine with a USB device controller."""
