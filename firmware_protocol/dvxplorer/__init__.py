"""Models of a DVXplorer (FX3) and of a DVXplorer Micro (CX3): the USB devices that a host sees."""
