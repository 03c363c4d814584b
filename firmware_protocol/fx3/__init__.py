"""Cameras with iniVation's FX3 firmware: the requests, registers, words and data path that their models share."""
